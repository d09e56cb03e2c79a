# Copyright 2026 The flock_follower developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The field of view: bounds that keep the neighbor in it, and occlusion; then it brakes."""

from __future__ import annotations

import math
from types import SimpleNamespace

from flown import Follower, own, seen, STILL
from hypothesis import assume, given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.geometry import Array, GRAVITY
from flock_follower.planner.bound_keeping import keep_bounds as guard
from flock_follower.planner.bounds import (
    COLUMN_ANGLE,
    in_sight,
    MARKER_ANGLE,
    marker_bounds,
    sight_bounds,
)
from flock_follower.planner.guard import sort_bounds
from flock_follower.planner.inputs import Neighbor, Prediction
from flock_follower.planner.modes import State
from flock_follower.planner.params import FOLLOWER, LEADER, Member, PlannerParams
from flock_follower.planner.sight import (
    FieldOfView,
    MOST_PATIENT,
    Occlusion,
    occlusion,
    WIDEST,
)

PARAMS = PlannerParams(v_max=5.0)
K = [610.0, 0.0, 320.0, 0.0, 610.0, 240.0, 0.0, 0.0, 1.0]


def info(k: list[float] = K, model: str = 'plumb_bob') -> SimpleNamespace:
    """Return a CameraInfo."""
    return SimpleNamespace(width=640, height=480, k=k, distortion_model=model)


VIEW = FieldOfView.of_camera(info(), [0.0, 0.0, 0.0])


def expected(position: Array, velocity: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Prediction:
    return Prediction(position.tolist(), [*velocity], STILL, 0.0, 0.0, [*velocity])


def commanded(wanted: tuple[float, ...], offset: tuple[float, ...],
              its: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Array:
    """Return what becomes of a command at rest, with only sight to keep."""
    it = expected(np.array(offset), its)
    bounds = sight_bounds(it.position, np.zeros(3), it, 0.0, (VIEW,), PARAMS)
    return guard(np.array(wanted), np.zeros(3), sort_bounds([], (), bounds), 5.0, PARAMS.v_max,
                 0.1).acceleration


def test_the_angles_are_those_of_the_image() -> None:
    aside, up = math.atan(320.0 / 610.0), math.atan(240.0 / 610.0)
    assert (VIEW.left, VIEW.right, VIEW.up, VIEW.down) == pytest.approx((aside, aside, up, up))


def test_a_neighbor_without_a_marker_has_no_marker_angle() -> None:
    it = expected(np.array([2.0, 0.0, 0.0]))
    arguments = it.position, np.zeros(3), it, 1.0
    assert marker_bounds(*arguments, Member(LEADER, 0.0, (math.pi,)), PARAMS)
    assert marker_bounds(*arguments, Member(LEADER, 0.0, ()), PARAMS) == []


@pytest.mark.parametrize('several', [False, True])
def test_a_fisheye_sees_as_far_as_its_model_says(several: bool) -> None:
    narrow = FieldOfView.of_camera(
        info(model='equidistant'), [0.0, 0.0, math.pi if several else 0.0], several)
    assert (narrow.left, narrow.up) == pytest.approx((320.0 / 610.0, 240.0 / 610.0))
    wide = [190.0, 0.0, 320.0, 0.0, 190.0, 240.0, 0.0, 0.0, 1.0]  # 96 and 72 degrees to the sides
    lowered = FieldOfView.of_camera(info(wide, 'equidistant'), [0.0, 0.2, 0.0], several)
    assert (lowered.left, lowered.right) == pytest.approx((WIDEST, WIDEST), abs=1e-3)
    assert (lowered.up, lowered.down) == pytest.approx((240.0 / 190.0 - 0.2, WIDEST))
    # A leader at 60 degrees that is not found is occluded: it has not left the image.
    assert occlusion(None, leader(0.7, 1.0, 1.7), ME, frames(0.8, 0.9, 1.0), (lowered,), 0.0)
    undistorted = info(wide, 'equidistant')
    undistorted.p = [300.0, 0.0, 320.0, 0.0, 0.0, 300.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    pinhole = FieldOfView.of_camera(undistorted, [0.0, 0.0, 0.0], several, True)
    assert (pinhole.left, pinhole.up) == pytest.approx((math.atan(32 / 30), math.atan(24 / 30)))


def test_a_camera_that_looks_down_sees_more_below() -> None:
    lowered = FieldOfView.of_camera(info(), [0.0, 0.2, 0.0])
    assert (lowered.up, lowered.down) == pytest.approx((VIEW.up - 0.2, VIEW.down + 0.2))
    turned = FieldOfView.of_camera(info(), [0.0, 0.0, 0.1])
    assert (turned.left, turned.right) == pytest.approx((VIEW.left + 0.1, VIEW.right - 0.1))


@pytest.mark.parametrize(('k', 'rpy', 'message'), [
    ([0.0] * 9, [0.0, 0.0, 0.0], 'camera_info: fx = 0, fy = 0, 640 x 480 pixels'),
    (K, [0.0, 0.0, math.pi], 'the camera must look ahead'),
    (K, [0.0, 0.6, 0.0], 'the forward direction must be in the image'),
])
def test_a_camera_that_cannot_follow_is_refused(k: list[float], rpy: list[float],
                                                message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FieldOfView.of_camera(info(k), rpy)


@given(st.floats(-3.1, 3.1), st.floats(1.0, 2.8), st.floats(-0.6, 0.6), st.floats(-4.0, 4.0))
def test_no_command_pitches_the_neighbor_out_of_the_image(bearing: float, distance: float,
                                                          height: float, wanted: float) -> None:
    forward = np.array([math.cos(bearing), math.sin(bearing), 0.0])
    offset = distance * forward + [0.0, 0.0, height]
    assume(abs(math.atan2(height, distance)) < VIEW.up - 0.05)  # in sight when level
    a = commanded(tuple(wanted * forward), tuple(offset))
    pitched = math.atan2(height, distance) + math.atan2(float(forward @ a), GRAVITY)
    # A nose that goes down lifts the neighbor in the image.
    assert -VIEW.down <= pitched <= VIEW.up


def test_height_alone_never_forces_it_to_move() -> None:
    for height in (-3.0, 3.0):
        assert commanded((0.0, 0.0, 0.0), (1.5, 0.0, height)) == pytest.approx(np.zeros(3))


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_one_that_passes_too_fast_to_turn_is_flown_along_with(side: float) -> None:
    slow = commanded((0.0, 0.0, 0.0), (1.5, 0.0, 0.0), (0.0, side, 0.0))
    fast = commanded((0.0, 0.0, 0.0), (1.5, 0.0, 0.0), (0.0, 1.8 * side, 0.0))
    assert slow == pytest.approx(np.zeros(3))
    assert fast == pytest.approx([0.0, side * (1.8 - 0.8 * 1.5) / 0.3, 0.0])
    speeding_up = expected(np.array([1.5, 0.0, 0.0]))._replace(
        acceleration=np.array([0.0, 0.5, 0.0]))
    *_, left, right = sight_bounds(
        speeding_up.position, np.zeros(3), speeding_up, 0.0, (VIEW,), PARAMS)
    assert left.least == pytest.approx(-0.8 * 1.5 / 0.3 + 0.5)
    assert right.least == pytest.approx(-0.8 * 1.5 / 0.3 - 0.5)


def test_left_and_right_of_an_image_that_is_not_symmetric() -> None:
    view = FieldOfView(0.5, 0.3, 0.4, 0.4)
    assert [view.angle_outside(bearing) for bearing in (0.4, -0.2)] == [0.0, 0.0]
    assert view.angle_outside(0.6) == pytest.approx(0.1)
    assert view.angle_outside(-0.6) == pytest.approx(0.3)


@pytest.mark.parametrize('side', [1.0, -1.0])
@pytest.mark.parametrize(('role', 'widest'), [(LEADER, MARKER_ANGLE), (FOLLOWER, COLUMN_ANGLE)])
def test_it_moves_round_to_the_face_of_the_marker(side: float, role: str, widest: float) -> None:
    it = expected(np.array([2.0, 0.0, 0.0]))  # the marker is at its back
    (free,) = marker_bounds(it.position, np.zeros(3), it, side * 0.9 * widest, Member(role),
                            PARAMS)
    (bound,) = marker_bounds(it.position, np.zeros(3), it, side * 1.1 * widest, Member(role),
                             PARAMS)
    assert free.least < 0.0 < bound.least
    np.testing.assert_allclose(bound.normal, [0.0, -side, 0.0], atol=1e-12)


def test_separation_goes_before_sight() -> None:
    it = expected(np.array([0.9, 0.0, 0.5]))  # above, and too near: back, though it gets lost
    sight = sight_bounds(it.position, np.zeros(3), it, 0.0, (VIEW,), PARAMS)
    near = in_sight(it, np.zeros(3), np.zeros(3), True, True, PARAMS)
    a = guard(np.zeros(3), np.zeros(3), sort_bounds(near, (), sight), 5.0, PARAMS.v_max, 0.1)
    assert a.acceleration[0] < -1.0
    assert 'separation' in a.reason


def test_the_camera_on_its_side_says_how_high_it_may_be() -> None:
    view = tuple(FieldOfView.of_camera(info(), rpy, True)
                 for rpy in ([0.0, 0.0, 0.0], [0.0, -0.4, math.pi / 2]))
    it = expected(np.array([0.0, 1.5, 0.0]))
    for yaw, up in ((math.pi / 2, VIEW.up), (0.0, VIEW.up + 0.4)):
        faster = sight_bounds(it.position, np.zeros(3), it, yaw, view, PARAMS)[0]
        assert -faster.least == pytest.approx(GRAVITY * math.tan(up - 0.05))


def test_a_camera_that_looks_down_keeps_no_neighbor_in_sight() -> None:
    for model in ('plumb_bob', 'equidistant'):
        with pytest.raises(ValueError, match='a camera that looks up or down'):
            FieldOfView.of_camera(info(model=model), [0.0, 1.5, 0.0], True)


AHEAD = (FieldOfView(0.5, 0.5, 0.35, 0.35),)
ME = own(1.0)


def leader(stamp: float, x: float = 2.0, y: float = 0.0, z: float = 2.0) -> Neighbor:
    return seen(stamp, (x, y, z))


def frames(*stamps: float) -> list[float]:
    return [0.6, 0.7, *stamps]


def test_three_images_in_a_row_without_it_make_it_occluded() -> None:
    assert occlusion(None, leader(0.7), ME, frames(0.8, 0.9), AHEAD, 0.0) is None
    assert occlusion(None, leader(0.7), ME, frames(0.8, 0.9, 1.0), AHEAD, 0.0) == Occlusion(0.7)
    # What is not ahead of the camera, or too near to the edge, has left the image.
    for beside in (leader(0.7, y=1.0), leader(0.7, y=-1.0), leader(0.7, z=2.8),
                   leader(0.7, z=1.2), leader(0.7, x=-2.0), leader(0.7, x=0.3)):
        assert occlusion(None, beside, ME, frames(0.8, 0.9, 1.0), AHEAD, 0.0) is None


def test_of_another_detector_five_missed_images_make_it_occluded() -> None:
    bare, late = leader(0.7)._replace(member=Member(faces=())), own(1.15)
    four = frames(0.8, 0.9, 1.0, 1.1)
    assert occlusion(None, bare, late, four, AHEAD, 0.0) is None
    assert occlusion(None, bare, late, [*four, 1.12], AHEAD, 0.0) == Occlusion(0.7)


@given(st.lists(st.floats(0.3, 2.4), max_size=12), st.floats(0.3, 2.4))
def test_occlusion_of_another_detector_waits_only_for_a_while(
        stamps: list[float], newest: float) -> None:
    """Never earlier than with a marker; from MOST_PATIENT on, at the same time."""
    me, images = own(2.4), sorted(stamps)
    marked = leader(newest)
    bare = occlusion(None, marked._replace(member=Member(faces=())), me, images, AHEAD, 0.0)
    strict = occlusion(None, marked, me, images, AHEAD, 0.0)
    assert bare == strict if me.stamp - newest >= MOST_PATIENT else bare in (None, strict)


def test_camera_tilted_by_acceleration_looks_elsewhere() -> None:
    high, images = leader(0.7, z=2.25), frames(0.8, 0.9, 1.0)
    assert occlusion(None, high, ME, images, AHEAD, 0.0)
    assert occlusion(None, high, ME, images, AHEAD, 2.5) is None
    assert occlusion(None, high, ME, images, AHEAD, -2.5)


def test_nothing_is_occluded_without_calibration_or_sighting() -> None:
    images = frames(0.8, 0.9, 1.0)
    assert occlusion(None, leader(0.7), ME, images, (), 0.0) is None
    assert occlusion(None, None, ME, images, AHEAD, 0.0) is None
    reported = seen(0.7, received=True)
    assert occlusion(None, reported, ME, images, AHEAD, 0.0) is None


def test_three_detections_in_a_row_end_it() -> None:
    before = occlusion(Occlusion(0.2), leader(0.8), ME, frames(0.8), AHEAD, 0.0)
    assert before == Occlusion(0.2, 0.8)
    before = occlusion(before, leader(0.9), ME, frames(0.8, 0.9), AHEAD, 0.0)
    assert before == Occlusion(0.2, 0.8)
    assert occlusion(before, leader(1.0), ME, frames(0.8, 0.9, 1.0), AHEAD, 0.0) is None
    assert occlusion(before, leader(0.9), ME, frames(0.8, 0.9, 1.0, 1.1, 1.2), AHEAD, 0.0) == (
        Occlusion(0.9))
    assert occlusion(Occlusion(0.7), leader(0.7), ME, frames(0.8), AHEAD, 0.0) == Occlusion(0.7)


@pytest.mark.parametrize('heading', [0.0, math.pi / 2.0, math.pi, -math.pi / 2.0])
def test_of_several_cameras_the_one_that_should_show_it_counts(heading: float) -> None:
    sides = tuple(FieldOfView(0.6, 0.6, 0.4, 0.4, at) for at in (0.0, math.pi / 2.0, math.pi))
    there = leader(0.7, 2.0 * math.cos(heading), 2.0 * math.sin(heading))
    found = occlusion(None, there, ME, frames(0.8, 0.9, 1.0), sides, 0.0)
    assert (found is not None) == (heading >= 0.0)


def test_it_brakes_at_once_and_follows_again() -> None:
    """Behind a leader that is hidden from 1 to 2 s."""
    follower, speed, stamps = Follower(PlannerParams(v_max=2.0)), np.array([0.5, 0.0, 0.0]), []
    follower.velocity, follower.now, states = speed, 0.1, []
    for tick in range(1, 40):
        now = follower.now
        stamps += [now - 0.1 + 0.033 * k for k in range(1, 4)]
        decision = follower.tick(*[
            seen(s, np.array([2.1, 0.0, 2.0]) + s * speed, speed) for s in stamps[-3:]
            if s < 1.0 or s > 2.0], looked=now, view=AHEAD, frames=stamps[-20:])
        states.append(decision.state)
        if tick == 19:
            assert abs(follower.velocity[0]) < 0.15
    assert states[:10] == [State.TRACK] * 10 and states[10:20] == [State.HOLD] * 10
    assert State.TRACK in states[20:23] and states[-1] is State.TRACK


def test_one_image_that_shows_it_again_ends_the_retreat() -> None:
    """Its place is known again; three images end the occlusion."""
    follower, place = Follower(PlannerParams(v_max=2.0)), (1.8, 0.0, 2.0)
    stamps = list[float]()
    for tick in range(30):
        stamps.append(follower.now)
        back = max(tick - 23, 0)
        shown = [seen(follower.now, place)] if tick < 10 or back > 0 else []
        decision = follower.tick(
            *shown, looked=follower.now, view=AHEAD, frames=stamps[-20:])
        if tick == 23:
            assert decision.state is State.HOLD and follower.velocity[0] < -0.5
        if back in (1, 2):
            assert decision.state is State.HOLD
            assert decision.acceleration is not None and decision.acceleration[0] > 1.5
    assert decision.state is State.TRACK
