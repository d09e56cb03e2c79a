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

"""All of perception: frames, signs and stages on rendered scenes, and the sample bag."""

from __future__ import annotations

from typing import Any

from marker_images import DICTIONARY, make_camera, render, SIDE
import numpy as np
import pytest

from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    Transform,
)
from flock_follower.odometry.buffer import Missing, OdometrySample
from flock_follower.perception import tracker as tracker_module
from flock_follower.perception.camera_schedule import SEARCH_PERIOD
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception.neighbor_filter import Estimate, FilterParams
from flock_follower.perception.tracker import (
    camera_mounting,
    MARGIN,
    MIRRORED_EVERY,
    Sighting,
    Tracker,
)

TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
CONFIG = NeighborConfig(DICTIONARY, (MarkedNeighbor('leader', (Marker(0, SIDE, TAIL),)),))
CAMERA = make_camera()
MOUNTING = camera_mounting([0.10, 0.0, 0.02], [0.0, 0.1, 0.0])  # looking 6 deg down
# Own attitude: a little roll and pitch, facing north; and the leader's, ahead and turning left.
OWN = quaternion_from_rpy(0.05, -0.03, np.pi / 2)
LEADER = Transform.from_quaternion([0.3, 2.2, 1.1], quaternion_from_rpy(0.0, 0.1, np.pi / 2 + 0.3))
VELOCITY = np.array([0.4, 1.2, -0.1])


def own(stamp: float, offset: Array | None = None) -> OdometrySample:
    """Return own odometry of a flight through (0, 0, 1) at stamp 0."""
    position = np.array([0.0, 0.0, 1.0]) + stamp * VELOCITY
    return OdometrySample(stamp, position if offset is None else position + offset, OWN, VELOCITY,
                          np.zeros(3))


@pytest.fixture(scope='module')
def image() -> GrayImage:
    """Return what the camera sees at stamp 0: and ever after, if both fly alike."""
    return seen({0: LEADER @ TAIL})


def seen(markers: dict[int, Transform]) -> GrayImage:
    """Return what the camera sees at stamp 0 of markers in odom, T_odom_marker by id."""
    T_odom_camera = Transform.from_quaternion([0.0, 0.0, 1.0], OWN) @ MOUNTING
    return render(CAMERA, {k: T_odom_camera.inverse() @ pose for k, pose in markers.items()},
                  rays=3)


def aside(east: float, north: float = 0.0, up: float = 0.0) -> Transform:
    """Return LEADER moved, m."""
    return Transform(LEADER.rotation, LEADER.translation + np.array([east, north, up]))


EMPTY = render(CAMERA, {})


class Hovering:
    """A drone that hovers at its place at stamp 0, and sees an image every ``period`` s."""

    def __init__(self, config: NeighborConfig = CONFIG, period: float = 0.05) -> None:
        self.tracker = Tracker(config, MOUNTING)
        self.period = period
        self.count = -1

    @property
    def stamp(self) -> float:
        return self.count * self.period

    def see(self, image: GrayImage) -> Sighting:
        self.count += 1
        self.tracker.feed_odometry(OdometrySample(
            self.stamp, np.array([0.0, 0.0, 1.0]), OWN, np.zeros(3), np.zeros(3)))
        return self.tracker.process_image(self.stamp, image, CAMERA)


def test_the_leader_is_where_it_is_in_odom(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING, FilterParams(attitude_noise=0.0))
    tracker.feed_odometry(own(0.0))
    sighting = tracker.process_image(0.0, image, CAMERA)
    assert sighting.rejections == []
    leader = sighting.estimates['leader']
    np.testing.assert_allclose(leader.position, LEADER.translation, atol=0.01)
    np.testing.assert_allclose(leader.rotation, LEADER.rotation, atol=0.05)
    # Its distance is less certain than its direction, as seen along the line of sight (north).
    assert leader.covariance[1, 1] > leader.covariance[0, 0]


def fly(tracker: Tracker, image: GrayImage, start: float, stop: float,
        offset: Array | None = None) -> dict[float, Estimate]:
    """Fly in formation: odometry at 200 Hz, the same image at 20 Hz; return the estimates."""
    estimates = {}
    for k in range(round(start * 200), round(stop * 200)):
        stamp = k / 200
        tracker.feed_odometry(own(stamp, offset))
        if k % 10 == 0:
            sighting = tracker.process_image(stamp, image, CAMERA)
            assert sighting.rejections == []
            estimates[stamp] = sighting.estimates['leader']
    return estimates


def test_a_leader_in_formation_has_ones_own_velocity(image: GrayImage) -> None:
    stamp, leader = fly(Tracker(CONFIG, MOUNTING), image, 0.0, 1.5).popitem()
    np.testing.assert_allclose(leader.velocity, VELOCITY, atol=0.05)
    np.testing.assert_allclose(leader.position, LEADER.translation + stamp * VELOCITY, atol=0.02)


def test_a_jump_of_the_own_odometry_moves_the_leader_alike(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING)
    fly(tracker, image, 0.0, 1.0)
    jump = np.array([2.0, -1.0, 0.5])
    for stamp, leader in fly(tracker, image, 1.0, 1.3, jump).items():
        np.testing.assert_allclose(leader.position, LEADER.translation + stamp * VELOCITY + jump,
                                   atol=0.02)
        np.testing.assert_allclose(leader.velocity, VELOCITY, atol=0.05)


def test_images_without_odometry_are_dropped_with_the_reason(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING)
    assert tracker.missing(0.0) is Missing.EMPTY
    sighting = tracker.process_image(0.0, image, CAMERA)
    assert (sighting.estimates, sighting.rejections) == ({}, [(Missing.EMPTY.value, '')])
    tracker.feed_odometry(own(0.0))
    assert tracker.missing(0.0) is None
    assert tracker.missing(0.02) is Missing.TOO_NEW


def test_time_that_jumps_back_restarts_the_tracks(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING)
    fly(tracker, image, 5.0, 5.3)
    assert tracker.feed_odometry(own(0.0))
    leader = tracker.process_image(0.0, image, CAMERA).estimates['leader']
    np.testing.assert_allclose(leader.position, LEADER.translation, atol=0.01)
    np.testing.assert_array_equal(leader.velocity, 0.0)


# Stages


def test_what_was_found_once_is_tracked_from_the_second_image_on(image: GrayImage) -> None:
    drone = Hovering()
    stages = [drone.see(image) for _ in range(4)]
    assert [s.stage for s in stages] == ['full', 'track', 'track', 'track']
    assert [s.stages for s in stages] == [{'leader': s.stage} for s in stages]
    assert [s.measurements['leader'].stage for s in stages] == ['full', 'track', 'track', 'track']
    for sighting in stages:
        np.testing.assert_allclose(sighting.estimates['leader'].position, LEADER.translation,
                                   atol=0.01)


def test_after_a_jump_the_neighbour_is_detected_near_its_place(image: GrayImage) -> None:
    drone = Hovering()
    drone.see(image)
    sighting = drone.see(seen({0: aside(0.1) @ TAIL}))  # nearly 4 cells in 50 ms
    assert (sighting.stage, sighting.stages) == ('roi', {'leader': 'roi'})
    assert sighting.rejections == []
    np.testing.assert_allclose(sighting.measurements['leader'].T_camera_body.translation,
                               (Transform.from_quaternion([0.0, 0.0, 1.0], OWN) @ MOUNTING)
                               .inverse().apply(aside(0.1).translation), atol=0.015)


def test_a_neighbour_that_comes_back_elsewhere_is_found_in_the_whole_image(
        image: GrayImage) -> None:
    drone = Hovering()
    drone.see(image)
    for _ in range(8):
        assert drone.see(EMPTY).estimates == {}
    there = seen({0: aside(-0.5) @ TAIL})
    sighting = drone.see(there)
    if not sighting.stages:  # the whole image is searched in every other one
        sighting = drone.see(there)
    assert sighting.stages == {'leader': 'full'}
    np.testing.assert_allclose(sighting.estimates['leader'].position,
                               aside(-0.5).translation, atol=0.02)


def test_a_neighbour_not_seen_has_no_estimate(image: GrayImage) -> None:
    drone = Hovering()
    for _ in range(3):
        assert set(drone.see(image).estimates) == {'leader'}
    for _ in range(4):
        sighting = drone.see(EMPTY)
        assert (sighting.estimates, sighting.measurements, sighting.stages) == ({}, {}, {})
        assert sighting.stage in ('roi', 'full')
    again = drone.see(image)
    assert again.stages['leader'] in ('track', 'roi')
    assert again.estimates['leader'].stamp == drone.stamp


def searches(monkeypatch: pytest.MonkeyPatch, drone: Hovering) -> list[tuple[float, bool]]:
    """Return a list that fills with when whole images are searched, and whether thoroughly."""
    done: list[tuple[float, bool]] = []
    everywhere = tracker_module.search.everywhere

    def watched(image: GrayImage, dictionary: str, markers: Any = None) -> Any:
        done.append((drone.stamp, markers is not None))
        return everywhere(image, dictionary, markers)

    monkeypatch.setattr(tracker_module.search, 'everywhere', watched)
    return done


@pytest.mark.parametrize('rate', [30.0, 7.0])
def test_whole_images_are_searched_at_a_limited_rate_in_turns(
        monkeypatch: pytest.MonkeyPatch, rate: float) -> None:
    drone = Hovering(period=1.0 / rate)
    done = searches(monkeypatch, drone)
    for _ in range(21):
        sighting = drone.see(EMPTY)
        looked = bool(done) and done[-1][0] == drone.stamp
        assert sighting.stage == ('full' if looked else 'track')
    # The first image is searched in both ways.
    stamps, thorough = [d[0] for d in done][1:], [d[1] for d in done]
    every = 3 if rate == 30.0 else 1
    np.testing.assert_allclose(stamps, np.arange(0, 21, every) / rate, atol=1e-9)
    assert np.diff(stamps).min() > SEARCH_PERIOD - 1e-3
    assert done[0][0] == stamps[0]
    assert thorough == [k % 2 == 1 for k in range(len(done))]


def checks(monkeypatch: pytest.MonkeyPatch, margin: float) -> list[bool]:
    """Return a list that fills with whether the mirrored attitude is looked at."""
    done: list[bool] = []
    track = tracker_module.track

    def watched(*arguments: Any) -> Any:
        found = track(*arguments)
        if arguments[3].pose is not None:
            done.append(arguments[5])
        return found and found._replace(margin=margin if arguments[5] else None)

    monkeypatch.setattr(tracker_module, 'track', watched)
    return done


def test_a_clear_attitude_is_looked_at_now_and_then(monkeypatch: pytest.MonkeyPatch,
                                                    image: GrayImage) -> None:
    drone = Hovering()
    done = checks(monkeypatch, MARGIN + 1.0)
    for _ in range(2 * MIRRORED_EVERY + 2):
        drone.see(image)
    assert done == ([True] + [False] * (MIRRORED_EVERY - 1)) * 2 + [True]


# Several neighbours, several markers, and others


PAIR = NeighborConfig(DICTIONARY, (MarkedNeighbor('leader', (Marker(0, SIDE, TAIL),)),
                                   MarkedNeighbor('wing', (Marker(1, SIDE, TAIL),))))


def test_two_neighbours_are_told_apart_and_tracked() -> None:
    drone = Hovering(PAIR)
    wing = aside(-0.8, 0.4, 0.2)
    both = seen({0: LEADER @ TAIL, 1: wing @ TAIL})
    for stage in ('full', 'track', 'track'):
        sighting = drone.see(both)
        assert sighting.stages == {'leader': stage, 'wing': stage}
        for name, truth in (('leader', LEADER), ('wing', wing)):
            np.testing.assert_allclose(sighting.estimates[name].position, truth.translation,
                                       atol=0.02)
    alone = drone.see(seen({1: wing @ TAIL}))
    assert alone.stages == {'wing': 'track'}
    assert set(alone.estimates) == {'wing'}
    # The one that is back is detected, the other need not be.
    back = [drone.see(both) for _ in range(3)]
    assert back[-1].stages == {'leader': 'track', 'wing': 'track'}
    assert all(s.stages['wing'] == 'track' for s in back)


def test_markers_of_nobody_are_named_once(image: GrayImage) -> None:
    others = seen({7: aside(-0.7) @ TAIL, 5: aside(0.4, 0.5) @ TAIL, 0: LEADER @ TAIL})
    drone = Hovering()
    assert drone.see(others).other_ids == [5, 7]
    assert drone.see(others).other_ids == []  # nobody missing: nothing was searched


@pytest.mark.parametrize('known', [True, False])
def test_a_print_on_a_wall_is_not_taken_for_a_hidden_leader(image: GrayImage, known: bool) -> None:
    wall = aside(-1.0, 0.9)
    on_the_wall = seen({0: wall @ TAIL})
    both = np.ascontiguousarray(np.where(np.arange(640) < 260, on_the_wall, image))
    drone = Hovering()
    for _ in range(10):
        drone.see(both if known else image)
    hidden = [drone.see(on_the_wall) for _ in range(30)]
    assert [sighting.estimates for sighting in hidden] == [{}] * 30
    np.testing.assert_allclose(hidden[-1].duplicates['leader/duplicate'].position,
                               wall.translation, atol=0.04)
    back = [drone.see(both) for _ in range(10)][-1]
    np.testing.assert_allclose(back.estimates['leader'].position, LEADER.translation, atol=0.02)
    assert set(back.duplicates) == {'leader/duplicate'}


def test_a_detection_that_no_pose_suits_is_told(monkeypatch: pytest.MonkeyPatch,
                                                image: GrayImage) -> None:
    monkeypatch.setattr(tracker_module, 'locate', lambda *_: None)
    sighting = Hovering().see(image)
    assert sighting.estimates == {}
    # The first image is searched in both ways.
    assert sighting.rejections == [('no pose suits the marker', 'leader, 0')] * 2


@pytest.mark.parametrize(('rpy', 'ahead'), [
    ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), ([0.0, 0.0, np.pi / 2], [0.0, 1.0, 0.0]),
    ([0.0, np.pi / 2, 0.0], [0.0, 0.0, -1.0]), ([np.pi, 0.0, 0.0], [1.0, 0.0, 0.0])])
def test_camera_angles_are_those_of_its_link(rpy: list[float], ahead: list[float]) -> None:
    mounting = camera_mounting([0.1, 0.2, 0.3], rpy)
    np.testing.assert_allclose(mounting.rotation @ [0.0, 0.0, 1.0], ahead, atol=1e-12)
    np.testing.assert_allclose(mounting.apply([0.0, 0.0, 0.0]), [0.1, 0.2, 0.3])
    down = mounting.rotation @ [0.0, 1.0, 0.0]
    level = quaternion_to_matrix(quaternion_from_rpy(*rpy)) @ [0.0, 0.0, -1.0]
    np.testing.assert_allclose(down, level, atol=1e-12)
