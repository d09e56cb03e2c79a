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

"""Several cameras on one drone: who is looked for where, and how one hands over to the other."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

from marker_images import DICTIONARY, make_camera, render, SIDE
import numpy as np
import pytest

from flock_follower.geometry import (
    Array,
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
)
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception import tracker as tracker_module
from flock_follower.perception.camera_schedule import SEARCH_PERIOD
from flock_follower.perception.edge_fit import marker_corners
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.time_offset import MountedCamera, TimeOffset
from flock_follower.perception.tracker import camera_mounting, Sighting, Tracker

TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
CONFIG = NeighborConfig(DICTIONARY, (MarkedNeighbor('leader', (Marker(0, SIDE, TAIL),)),))
MODEL = make_camera()
#: Each sees 55 degrees: 15 of them are in both images.
FRONT = camera_mounting([0.10, 0.0, 0.0], [0.0, 0.0, 0.0])
LEFT = camera_mounting([0.05, 0.08, 0.0], [0.0, 0.0, np.radians(40.0)])
BACK = camera_mounting([-0.10, 0.0, 0.0], [0.0, 0.0, np.pi])
EMPTY = render(MODEL, {})
FLYING = np.array([0.3, -0.1, 0.05])  # m/s


def body(stamp: float) -> Transform:
    return Transform(np.eye(3), np.array([1.0, 2.0, 3.0]) + stamp * FLYING)


class Drone:
    """A drone with cameras that flies evenly, and what its cameras see."""

    def __init__(self, config: NeighborConfig = CONFIG, **mountings: Transform) -> None:
        self.mountings = mountings
        self.tracker = Tracker(config, {
            name: MountedCamera(place) for name, place in mountings.items()})
        self.odometry = -1

    def feed(self, stamp: float) -> None:
        """Take the odometry, 200 Hz, up to a stamp."""
        while self.odometry < np.ceil(stamp * 200.0):
            self.odometry += 1
            now = self.odometry / 200.0
            self.tracker.feed_odometry(OdometrySample(
                now, body(now).translation, np.array([0.0, 0.0, 0.0, 1.0]), FLYING, np.zeros(3)))

    def see(self, camera: str, stamp: float, image: GrayImage) -> Sighting:
        self.feed(stamp)
        if not self.tracker.wanted(stamp, MODEL, camera):
            return Sighting()
        return self.tracker.process_image(stamp, image, MODEL, camera)

    def image(self, camera: str, stamp: float, **markers: Transform) -> GrayImage:
        """Return what a camera sees of bodies, T_odom_body by 'm' and the marker's id."""
        T_camera_odom = (body(stamp) @ self.mountings[camera]).inverse()
        seen = {int(name[1:]): T_camera_odom @ pose @ TAIL for name, pose in markers.items()}
        return render(MODEL, {k: pose for k, pose in seen.items() if shown(pose)}, rays=2,
                      seed=round(1000.0 * stamp))


def shown(T_camera_marker: Transform) -> bool:
    """Return whether a marker is in the image, be it in part."""
    outline = MODEL.project(T_camera_marker.apply(marker_corners(SIDE)))
    low, high = outline.min(axis=0), outline.max(axis=0)
    return bool(np.isfinite(outline).all() and (high > 10.0).all()
                and (low < (MODEL.width - 10.0, MODEL.height - 10.0)).all())


def ahead(distance: float, left: float = 0.0, up: float = 0.0) -> Transform:
    """Return the pose of a neighbour about which the drone flies at stamp 0, facing away."""
    return Transform(np.eye(3), body(0.0).translation + np.array([distance, left, up]))


def flown(pose: Transform, stamp: float, velocity: Array) -> Transform:
    return Transform(pose.rotation, pose.translation + stamp * velocity)


class Report(NamedTuple):
    stamp: float
    camera: str
    off: Array  # m, from where it is
    velocity: Array


@pytest.mark.parametrize('later', [0.0, 0.023], ids=['at once', 'in turns'])
def test_a_neighbour_passes_from_one_image_to_the_next_without_a_gap_or_a_step(
        later: float) -> None:
    # Above, and seen aslant: both attitudes of a marker that is seen straight on look the same.
    drone, start = Drone(front=FRONT, left=LEFT), Transform.from_quaternion(
        ahead(2.3, -0.5, 0.4).translation, quaternion_from_yaw(-0.25))
    velocity = FLYING + np.array([0.0, 0.9, 0.0])
    reported: list[Report] = []
    for k in range(60):
        found = set()
        for camera, stamp in (('front', 0.05 * k), ('left', 0.05 * k + later)):
            leader = flown(start, stamp, velocity)
            sighting = drone.see(camera, stamp, drone.image(camera, stamp, m0=leader))
            assert sighting.rejections == []
            for estimate in sighting.estimates.values():
                found.add(camera)
                reported.append(Report(stamp, camera, estimate.position - leader.translation,
                                 estimate.velocity))
        assert found, f'nobody in sight at {0.05 * k:.2f} s'
    cameras = [one.camera for one in reported]
    assert cameras[:5] == ['front'] * 5 and cameras[-5:] == ['left'] * 5
    both = sum(a != b for a, b in pairwise(cameras))
    assert both > 4, 'in the overlap both see it'
    settled = [one for one in reported if one.stamp > 0.7]
    assert max(np.abs(one.off).max() for one in settled) < 0.008
    assert max(np.abs(one.velocity - velocity).max() for one in settled) < 0.06
    for a, b in pairwise(settled):
        assert np.abs(a.off - b.off).max() < 0.006
        assert np.abs(a.velocity - b.velocity).max() < 0.05


def watched(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[int]:
    """Return a list that fills with an entry for every call of a function of perception."""
    calls: list[int] = []
    function = getattr(module, name)

    def counted(*arguments: Any) -> Any:
        calls.append(len(calls))
        return function(*arguments)

    monkeypatch.setattr(module, name, counted)
    return calls


def test_a_tracked_neighbor_is_not_looked_for_where_it_is_not_expected(
        monkeypatch: pytest.MonkeyPatch) -> None:
    drone, leader = Drone(front=FRONT, back=BACK), ahead(2.0)
    drone.see('front', 0.0, drone.image('front', 0.0, m0=leader))
    tracked = watched(monkeypatch, tracker_module, 'track')
    whole = watched(monkeypatch, tracker_module.search, 'everywhere')
    for k in range(1, 19):
        stamp = 0.05 * k
        image = drone.image('front', stamp, m0=flown(leader, stamp, FLYING))
        assert drone.see('front', stamp, image).estimates
        drone.feed(stamp + 0.01)
        assert not drone.tracker.wanted(stamp + 0.01, MODEL, 'back')
    assert (len(tracked), len(whole)) == (18, 0)  # in the images of the front camera


def test_more_cameras_search_no_more_whole_images(monkeypatch: pytest.MonkeyPatch) -> None:
    drone = Drone(front=FRONT, left=LEFT, back=BACK)
    whole = watched(monkeypatch, tracker_module.search, 'everywhere')
    for k in range(60):
        for name in drone.mountings:
            drone.see(name, k / 30.0, EMPTY)
    # Each one's first time in both ways.
    assert len(whole) == pytest.approx(2.0 / SEARCH_PERIOD + 3, abs=3)


def test_who_leaves_all_images_is_searched_for_in_all_and_found() -> None:
    drone, leader = Drone(front=FRONT, back=BACK), ahead(2.0)
    for k in range(10):
        stamp = 0.05 * k
        image = drone.image('front', stamp, m0=flown(leader, stamp, FLYING))
        drone.see('front', stamp, image)
    found = None
    for k in range(60, 100):  # now it is behind, and its tail is turned to there
        stamp = 0.05 * k
        behind = Transform(np.diag([-1.0, -1.0, 1.0]),
                           body(stamp).translation + np.array([-2.0, 0.1, 0.0]))
        drone.see('front', stamp, EMPTY)
        sighting = drone.see('back', stamp, drone.image('back', stamp, m0=behind))
        if sighting.estimates and found is None:
            found = stamp
    assert found is not None and found <= 3.0 + 4 * SEARCH_PERIOD + 0.05


def test_a_frozen_or_late_image_of_another_camera_is_left_alone() -> None:
    drone, leader = Drone(front=FRONT, left=LEFT), ahead(2.0, 0.75)
    for k in range(5):
        stamp = 0.05 * k
        seen = flown(leader, stamp, FLYING)
        drone.see('front', stamp, drone.image('front', stamp, m0=seen))
    stamp = 0.17  # older than what the front camera has seen
    assert not drone.tracker.wanted(stamp, MODEL, 'left')


def test_each_camera_finds_out_its_own_offset_of_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    offsets = {'front': 0.0, 'left': 0.02}
    tracker = turning(monkeypatch, offsets)
    applied = {name: camera.time_offset.applied for name, camera in tracker.cameras.items()}
    assert applied['left'] == pytest.approx(0.02, abs=0.003)
    assert abs(applied['front']) < 0.003


def turning(monkeypatch: pytest.MonkeyPatch, offsets: dict[str, float]) -> Tracker:
    """Return a tracker that has seen a neighbour at rest while it turned to and fro."""
    rng = np.random.default_rng(3)
    leader = ahead(2.0, 0.75)
    mountings = {'front': FRONT, 'left': LEFT}
    tracker = Tracker(CONFIG, {name: MountedCamera(place, TimeOffset())
                               for name, place in mountings.items()})

    def attitude(now: float) -> Array:
        return quaternion_from_yaw(0.15 * np.sin(1.7 * now) + 0.05 * np.sin(11.0 * now))

    def measured(name: str, now: float) -> Measurement:
        own = Transform(quaternion_to_matrix(attitude(now)), body(0.0).translation)
        pose = (own @ mountings[name]).inverse() @ leader
        noisy = Transform(pose.rotation, pose.translation + rng.normal(0.0, 0.001, 3))
        return Measurement('leader', noisy, TAIL.translation, np.diag([1e-6] * 3 + [1e-4] * 3),
                           0.1, None)

    now: dict[str, Any] = {}
    monkeypatch.setattr(tracker_module, 'track', lambda *_: measured(**now))
    monkeypatch.setattr(tracker_module, 'locate', lambda *_: measured(**now))
    first = render(MODEL, {0: (Transform(np.eye(3), body(0.0).translation) @ FRONT).inverse()
                           @ leader @ TAIL})
    for k in range(2000):
        stamp = k / 200.0
        tracker.feed_odometry(OdometrySample(
            stamp, body(0.0).translation, attitude(stamp), np.zeros(3),
            np.array([0.0, 0.0, 0.255 * np.cos(1.7 * stamp) + 0.55 * np.cos(11.0 * stamp)])))
        name = 'front' if k % 8 == 0 else 'left' if k % 8 == 4 else ''
        if name and stamp > 0.1:
            exposed = stamp - 0.05
            now.update(name=name, now=exposed)
            tracker.process_image(exposed - offsets[name], first, MODEL, name)
    return tracker
