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

"""All of perception on rendered scenes: frames, signs, stages of detection, prints."""

from __future__ import annotations

from typing import Any

from marker_images import CONFIG, DICTIONARY, Hovering, make_camera, render, SIDE, TAIL
import numpy as np
import pytest

from flock_follower.geometry import Array, quaternion_from_rpy, quaternion_to_matrix, Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.odometry.buffer import Missing, OdometrySample
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception import search
from flock_follower.perception import tracker as tracker_module
from flock_follower.perception.images import GrayImage
from flock_follower.perception.look import reported
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.neighbor_filter import Estimate, FilterParams
from flock_follower.perception.tracker import (
    camera_mounting,
    MIRRORED_EVERY,
    SETTLED_MARGIN,
    Tracker,
)

CAMERA = make_camera()
MOUNTING = camera_mounting([0.10, 0.0, 0.02], [0.0, 0.1, 0.0])  # looking 6 deg down
# The ego pose, with a little roll and pitch, facing north; the leader's, ahead and turned left.
OWN = Transform.from_quaternion([0.0, 0.0, 1.0], quaternion_from_rpy(0.05, -0.03, np.pi / 2))
LEADER = Transform.from_quaternion([0.3, 2.2, 1.1], quaternion_from_rpy(0.0, 0.1, np.pi / 2 + 0.3))
VELOCITY = np.array([0.4, 1.2, -0.1])
EMPTY = render(CAMERA, {})


def own(stamp: float, jump: Array | float = 0.0) -> OdometrySample:
    """Return the ego odometry of a flight that is at OWN at stamp 0."""
    return OdometrySample(stamp, OWN.translation + stamp * VELOCITY + jump, OWN.quaternion,
                          VELOCITY, np.zeros(3))


def seen(markers: dict[int, Transform]) -> GrayImage:
    """Return the image from OWN of markers on the tails of bodies, T_odom_body by id."""
    T_camera_odom = (OWN @ MOUNTING).inverse()
    return render(CAMERA, {k: T_camera_odom @ body @ TAIL for k, body in markers.items()}, rays=3)


@pytest.fixture(scope='module')
def image() -> GrayImage:
    """Return the image of the leader from OWN: and ever after, if both fly alike."""
    return seen({0: LEADER})


def aside(east: float, north: float = 0.0, up: float = 0.0) -> Transform:
    """Return LEADER moved, m."""
    return Transform(LEADER.rotation, LEADER.translation + np.array([east, north, up]))


def hovering(config: NeighborConfig = CONFIG, period: float = 0.05) -> Hovering:
    return Hovering(CAMERA, MOUNTING, OWN, config, period)


def test_the_leader_is_where_it_is_in_odom(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING, FilterParams(attitude_noise=0.0))
    assert tracker.missing(0.0) is Missing.EMPTY
    dropped = tracker.process_image(0.0, image, CAMERA)
    assert (dropped.estimates, dropped.rejections) == ({}, [(Missing.EMPTY.value, '')])
    tracker.feed_odometry(own(0.0))
    assert (tracker.missing(0.0), tracker.missing(0.02)) == (None, Missing.TOO_NEW)
    sighting = tracker.process_image(0.0, image, CAMERA)
    assert sighting.rejections == []
    leader = sighting.estimates['leader']
    np.testing.assert_allclose(leader.position, LEADER.translation, atol=0.01)
    np.testing.assert_allclose(leader.rotation, LEADER.rotation, atol=0.05)
    # Its distance is less certain than its direction, as seen along the line of sight (north).
    assert leader.covariance[1, 1] > leader.covariance[0, 0]


def test_the_noise_of_the_own_state_widens_a_reported_state() -> None:
    state = Estimate(0.0, np.array([2.0, 0.0, 0.0]), np.zeros(3), np.eye(3), np.zeros(3),
                     np.zeros(3), np.eye(15))
    noisy = reported(state, 0.0, own(0.0), 0.01, 0.3).covariance
    np.testing.assert_allclose(np.diag(noisy)[:6], [1.0, 1.04, 1.04, 1.3, 1.3, 1.3])


def test_formation_leader_has_own_velocity_through_jumps(
        image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING)
    for k in range(360):
        stamp, jump = k / 200, np.array([2.0, -1.0, 0.5]) if k > 300 else 0.0
        tracker.feed_odometry(own(stamp, jump))
        if k % 10:
            continue
        sighting = tracker.process_image(stamp, image, CAMERA)
        leader = sighting.estimates['leader']
        assert sighting.rejections == []
        np.testing.assert_allclose(
            leader.position, LEADER.translation + stamp * VELOCITY + jump, atol=0.02)
        if stamp > 1.2:
            np.testing.assert_allclose(leader.velocity, VELOCITY, atol=0.05)
    assert tracker.feed_odometry(own(0.0))  # time jumped back
    leader = tracker.process_image(0.0, image, CAMERA).estimates['leader']
    np.testing.assert_allclose(leader.position, LEADER.translation, atol=0.01)
    np.testing.assert_array_equal(leader.velocity, 0.0)


# Stages


def test_the_cheapest_stage_that_finds_the_neighbor_is_used(image: GrayImage) -> None:
    drone, moved = hovering(), seen({0: aside(0.1)})  # by nearly 4 cells in 50 ms
    for stage, picture, place in ('full', image, LEADER), ('roi', moved, aside(0.1)):
        sighting = drone.see(picture)
        assert (sighting.stage, sighting.stages) == (stage, {'leader': stage})
        assert sighting.rejections == []
        np.testing.assert_allclose(sighting.measurements['leader'].T_camera_body.translation,
                                   (OWN @ MOUNTING).inverse().apply(place.translation), atol=0.015)
    drone = hovering()
    drone.see(image)
    for _ in range(8):
        sighting = drone.see(EMPTY)
        assert (sighting.estimates, sighting.measurements) == ({}, {})
    elsewhere = seen({0: aside(-0.5)})  # the whole image is searched in every other one
    found = drone.see(elsewhere).estimates or drone.see(elsewhere).estimates
    np.testing.assert_allclose(found['leader'].position, aside(-0.5).translation, atol=0.02)


@pytest.mark.parametrize(('period', 'stages'), [
    (1 / 30, ['roi', 'full', 'roi', 'full']), (0.2, ['full'] * 4)])
def test_near_search_alternates_with_portions_unless_rare(
        image: GrayImage, period: float, stages: list[str]) -> None:
    drone = hovering(period=period)
    drone.see(image)
    assert [drone.see(EMPTY).stage for _ in stages] == stages


@pytest.mark.parametrize(('rate', 'every', 'most'), [(60.0, 2, 1), (30.0, 1, 1), (7.0, 1, 4)])
def test_whole_images_are_searched_in_portions_at_a_limited_rate(
        monkeypatch: pytest.MonkeyPatch, rate: float, every: int, most: int) -> None:
    drone, done = hovering(period=1.0 / rate), list[tuple[float, int]]()
    portion = search.portion

    def watched(image: GrayImage, dictionary: str, markers: Any, number: int,
                border: int) -> Any:
        done.append((drone.stamp, number))
        return portion(image, dictionary, markers, number, border)

    monkeypatch.setattr(search, 'portion', watched)
    stages = [drone.see(EMPTY).stage for _ in range(21)]
    assert stages == ['track' if k % every else 'full' for k in range(21)]
    assert [number for _, number in done] == [k % search.N_PORTIONS for k in range(len(done))]
    stamps = [stamp for stamp, _ in done]
    assert {stamps.count(stamp) for stamp in stamps[1:]} == {most}


def test_lost_track_is_not_searched_in_all_portions_at_once(
        monkeypatch: pytest.MonkeyPatch, image: GrayImage) -> None:
    drone, searched = hovering(period=1.0 / 30.0), list[int]()
    portion = search.portion

    def counted(*arguments: Any) -> Any:
        searched[-1] += 1
        return portion(*arguments)

    monkeypatch.setattr(search, 'portion', counted)
    for seen in [image] * 15 + [EMPTY] * 12:
        searched.append(0)
        drone.see(seen)
    assert searched[15:] == [0, 1] * 6


def test_mirror_image_of_clear_attitude_is_checked_at_times(
        monkeypatch: pytest.MonkeyPatch, image: GrayImage) -> None:
    drone, done, track = hovering(), list[bool](), tracker_module.track

    def watched(*arguments: Any) -> Any:
        found, check = track(*arguments), arguments[5]
        if arguments[3].pose is not None:
            done.append(check)
        return found and found._replace(margin=SETTLED_MARGIN + 1.0 if check else None)

    monkeypatch.setattr(tracker_module, 'track', watched)
    for _ in range(2 * MIRRORED_EVERY + 2):
        drone.see(image)
    assert done == ([True] + [False] * (MIRRORED_EVERY - 1)) * 2 + [True]


def test_detection_turns_track_that_only_smear_fits_confirm(
        monkeypatch: pytest.MonkeyPatch, image: GrayImage) -> None:
    drone, truth = hovering(), hovering().see(image).estimates['leader'].rotation
    locate, track = tracker_module.locate, tracker_module.track
    turn = rotation_vector_to_matrix([0.0, 0.7, 0.0])

    def turned(found: Measurement) -> Measurement:
        pose = found.T_camera_body
        rotation = turn @ pose.rotation
        place = pose.apply(found.reference) - rotation @ found.reference
        return found._replace(T_camera_body=Transform(rotation, place), spacing=None)

    def confirming(*arguments: Any) -> Any:
        found = track(*arguments)
        return found and turned(found)

    def off() -> float:
        estimate = drone.see(image).estimates['leader'].rotation @ truth.T
        return float(np.linalg.norm(matrix_to_rotation_vector(estimate)))

    monkeypatch.setattr(tracker_module, 'track', confirming)
    with monkeypatch.context() as begun:
        begun.setattr(tracker_module, 'locate', lambda *arguments: turned(locate(*arguments)))
        assert off() > 0.5
    after = [off() for _ in range(12)]  # 0.6 s
    assert after[0] > 0.5
    assert max(after[6:]) < 0.05


# Several neighbors, several markers, and others


def test_two_neighbors_are_told_apart_and_tracked() -> None:
    drone = hovering(NeighborConfig(DICTIONARY, (
        *CONFIG.neighbors, MarkedNeighbor('wing', (Marker(1, SIDE, TAIL),)))))
    wing = aside(-0.8, 0.4, 0.2)
    both = seen({0: LEADER, 1: wing})
    for stage in ('full', 'track'):
        sighting = drone.see(both)
        assert sighting.stages == {'leader': stage, 'wing': stage}
        for name, truth in (('leader', LEADER), ('wing', wing)):
            np.testing.assert_allclose(sighting.estimates[name].position, truth.translation,
                                       atol=0.02)
    assert drone.see(seen({1: wing})).stages == {'wing': 'track'}
    # The one that is back is detected, the other need not be.
    back = [drone.see(both).stages for _ in range(3)]
    assert all(stages['wing'] == 'track' for stages in back) and back[-1]['leader'] == 'track'


def test_markers_of_no_neighbor_are_named_once() -> None:
    others, drone = seen({7: aside(-0.7), 5: aside(0.4, 0.5), 0: LEADER}), hovering()
    assert drone.see(others).other_ids == [5, 7]
    assert drone.see(others).other_ids == []  # nobody missing: nothing was searched


@pytest.mark.parametrize('known', [True, False])
def test_a_print_on_a_wall_is_not_taken_for_a_hidden_leader(image: GrayImage, known: bool) -> None:
    wall = aside(-1.0, 0.9)
    on_the_wall = seen({0: wall})
    both = np.ascontiguousarray(np.where(np.arange(640) < 260, on_the_wall, image))
    drone = hovering()
    for _ in range(10):
        drone.see(both if known else image)
    hidden = [drone.see(on_the_wall) for _ in range(30)]
    assert [sighting.estimates for sighting in hidden] == [{}] * 30
    np.testing.assert_allclose(hidden[-1].duplicates['leader/duplicate'].position,
                               wall.translation, atol=0.04)
    back = [drone.see(both) for _ in range(10)][-1]
    np.testing.assert_allclose(back.estimates['leader'].position, LEADER.translation, atol=0.02)
    assert set(back.duplicates) == {'leader/duplicate'}


def test_a_detection_without_a_pose_is_rejected_with_the_reason(
        monkeypatch: pytest.MonkeyPatch, image: GrayImage) -> None:
    monkeypatch.setattr(tracker_module, 'locate', lambda *_: None)
    sighting = hovering().see(image)
    assert sighting.estimates == {}
    assert sighting.rejections == [('no pose suits the marker', 'leader, 0')]


@pytest.mark.parametrize(('rpy', 'ahead'), [
    ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), ([0.0, 0.0, np.pi / 2], [0.0, 1.0, 0.0]),
    ([0.0, np.pi / 2, 0.0], [0.0, 0.0, -1.0]), ([np.pi, 0.0, 0.0], [1.0, 0.0, 0.0])])
def test_camera_angles_are_those_of_its_link(rpy: list[float], ahead: list[float]) -> None:
    mounting = camera_mounting([0.1, 0.2, 0.3], rpy)
    np.testing.assert_allclose(mounting.rotation @ [0.0, 0.0, 1.0], ahead, atol=1e-12)
    np.testing.assert_allclose(mounting.translation, [0.1, 0.2, 0.3])
    down = quaternion_to_matrix(quaternion_from_rpy(*rpy)) @ [0.0, 0.0, -1.0]
    np.testing.assert_allclose(mounting.rotation @ [0.0, 1.0, 0.0], down, atol=1e-12)
