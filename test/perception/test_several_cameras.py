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
from typing import Any

from marker_images import CONFIG, make_camera, render, SIDE, TAIL
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
from flock_follower.perception.camera_schedule import PORTION_PERIOD, SEARCH_PERIOD
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.time_offset import MountedCamera
from flock_follower.perception.tracker import camera_mounting, Sighting, Tracker

MODEL = make_camera()
#: Each sees 55 degrees: 15 of them are in both images.
FRONT = camera_mounting([0.10, 0.0, 0.0], [0.0, 0.0, 0.0])
LEFT = camera_mounting([0.05, 0.08, 0.0], [0.0, 0.0, np.radians(40.0)])
BACK = camera_mounting([-0.10, 0.0, 0.0], [0.0, 0.0, np.pi])
EMPTY = render(MODEL, {})
PLACE, FLYING = np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.1, 0.05])  # m, m/s


def body(stamp: float) -> Transform:
    return Transform(np.eye(3), PLACE + stamp * FLYING)


def ahead(distance: float, left: float, stamp: float = 0.0, up: float = 0.0) -> Transform:
    """Return the pose of a neighbor ahead of the drone at a stamp, facing away."""
    return Transform(np.eye(3), body(stamp).translation + np.array([distance, left, up]))


class Drone:
    """A drone with cameras that flies evenly, and what its cameras see."""

    def __init__(self, **mountings: Transform) -> None:
        self.mountings = mountings
        self.tracker = Tracker(CONFIG, {
            name: MountedCamera(place) for name, place in mountings.items()})
        self.odometry = -1

    def feed(self, stamp: float) -> None:
        """Take the odometry, 200 Hz, up to a stamp."""
        while self.odometry < np.ceil(stamp * 200.0):
            self.odometry += 1
            now = self.odometry / 200.0
            self.tracker.feed_odometry(OdometrySample(
                now, body(now).translation, np.array([0.0, 0.0, 0.0, 1.0]), FLYING, np.zeros(3)))

    def see(self, camera: str, stamp: float, leader: Transform | None = None) -> Sighting:
        """Return what a camera sees of the leader, T_odom_body."""
        self.feed(stamp)
        if not self.tracker.wanted(stamp, MODEL, camera):
            return Sighting()
        image = EMPTY if leader is None else self.image(camera, stamp, leader)
        return self.tracker.process_image(stamp, image, MODEL, camera)

    def image(self, camera: str, stamp: float, leader: Transform) -> GrayImage:
        T_camera_marker = (body(stamp) @ self.mountings[camera]).inverse() @ leader @ TAIL
        outline = MODEL.project(T_camera_marker.apply(marker_corners(SIDE)))
        low, high = outline.min(axis=0), outline.max(axis=0)
        shown = np.isfinite(outline).all() and (high > 10.0).all() and (
            low < (MODEL.width - 10.0, MODEL.height - 10.0)).all()
        return rendered(T_camera_marker if shown else None, round(1000.0 * stamp))


#: Images by the place of the marker and their seed: tests show the same ones.
RENDERED: dict[tuple[bytes, int], GrayImage] = {}


def rendered(pose: Transform | None, seed: int) -> GrayImage:
    key = b'' if pose is None else (
        pose.rotation.tobytes() + pose.translation.tobytes()), seed
    if key not in RENDERED:
        RENDERED[key] = render(MODEL, {} if pose is None else {0: pose}, rays=2, seed=seed)
    return RENDERED[key]


@pytest.mark.parametrize('later', [0.0, 0.023], ids=['at once', 'in turns'])
def test_neighbor_passes_between_images_without_gap_or_step(
        later: float) -> None:
    # Above, and seen aslant: both attitudes of a marker that is seen straight on look the same.
    drone, start = Drone(front=FRONT, left=LEFT), Transform.from_quaternion(
        ahead(2.3, -0.5, up=0.4).translation, quaternion_from_yaw(-0.25))
    velocity, cameras = FLYING + np.array([0.0, 0.9, 0.0]), list[str]()
    off: list[Array] = []  # errors of place, m, and velocity, m/s, (6,), once settled
    sigmas: list[Array] = []  # of both
    for k in range(60):
        for camera, stamp in (('front', 0.05 * k), ('left', 0.05 * k + later)):
            leader = Transform(start.rotation, start.translation + stamp * velocity)
            sighting = drone.see(camera, stamp, leader)
            assert sighting.rejections == []
            for estimate in sighting.estimates.values():
                cameras.append(camera)
                if stamp > 0.7:
                    off.append(np.concatenate([estimate.position - leader.translation,
                                               estimate.velocity - velocity]))
                    sigmas.append(np.sqrt(estimate.covariance.diagonal()[:6]))
        assert sighting.estimates or cameras[-1] == 'front', f'not in sight at {0.05 * k:.2f} s'
    assert cameras[:5] == ['front'] * 5 and cameras[-5:] == ['left'] * 5
    assert sum(a != b for a, b in pairwise(cameras)) > 4, 'in the overlap both see it'
    steps = np.abs(np.diff(off, axis=0))
    # Aslant by more than 60 degrees at last, 3 px per cell: OpenCV 4 and 5 measure it unlike.
    assert np.all(steps < np.maximum([0.006] * 3 + [0.05] * 3, 2.0 * np.array(sigmas[1:])))
    assert np.abs(off).max(axis=0) == pytest.approx(0.0, abs=0.06)
    assert np.abs(off).max(axis=0)[:3].max() < 0.008


def watched(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[int]:
    """Return a list that fills with an entry for every call of a function of perception."""
    calls: list[int] = []
    function = getattr(module, name)

    def counted(*arguments: Any) -> Any:
        calls.append(len(calls))
        return function(*arguments)

    monkeypatch.setattr(module, name, counted)
    return calls


def test_tracked_neighbor_is_not_searched_where_unexpected(
        monkeypatch: pytest.MonkeyPatch) -> None:
    drone = Drone(front=FRONT, back=BACK)
    drone.see('front', 0.0, ahead(2.0, 0.0))
    tracked = watched(monkeypatch, tracker_module, 'track')
    whole = watched(monkeypatch, tracker_module.search, 'portion')
    for k in range(1, 19):
        assert drone.see('front', 0.05 * k, ahead(2.0, 0.0, 0.05 * k)).estimates
        drone.feed(0.05 * k + 0.01)
        assert not drone.tracker.wanted(0.05 * k + 0.01, MODEL, 'back')
    assert (len(tracked), len(whole)) == (18, 0)  # in the images of the front camera


def test_neighbor_covered_once_is_searched_there_now_and_then(
        monkeypatch: pytest.MonkeyPatch) -> None:
    drone, tracked = Drone(front=FRONT, left=LEFT), watched(monkeypatch, tracker_module, 'track')
    for k in range(50):
        drone.see('front', 0.02 * k, ahead(2.0, 0.75, 0.02 * k))
        drone.see('left', 0.02 * k + 0.01)
    assert len(tracked) - 50 == pytest.approx(1.0 / SEARCH_PERIOD, abs=2)


def test_an_image_older_than_that_of_another_camera_is_not_used() -> None:
    drone = Drone(front=FRONT, left=LEFT)
    for k in range(5):
        drone.see('front', 0.05 * k, ahead(2.0, 0.75, 0.05 * k))
    assert not drone.tracker.wanted(0.17, MODEL, 'left')


def test_more_cameras_search_no_more_whole_images(monkeypatch: pytest.MonkeyPatch) -> None:
    drone = Drone(front=FRONT, left=LEFT, back=BACK)
    portions = watched(monkeypatch, tracker_module.search, 'portion')
    for k in range(60):
        for name in drone.mountings:
            drone.see(name, k / 30.0)
    assert len(portions) == pytest.approx(2.0 / PORTION_PERIOD, abs=3)


def test_neighbor_that_leaves_all_images_is_searched_and_found() -> None:
    drone, found = Drone(front=FRONT, back=BACK), list[float]()
    for k in range(10):
        drone.see('front', 0.05 * k, ahead(2.0, 0.0, 0.05 * k))
    for k in range(60, 70):  # now it is behind, and its tail is turned to there
        stamp = 0.05 * k
        drone.see('front', stamp)
        behind = Transform(np.diag([-1.0, -1.0, 1.0]), ahead(-2.0, 0.1, stamp).translation)
        found += [stamp] * bool(drone.see('back', stamp, behind).estimates)
    assert found and found[0] <= 3.0 + 4 * SEARCH_PERIOD + 0.05


def test_each_camera_finds_its_stamp_offset_track_follows(
        monkeypatch: pytest.MonkeyPatch) -> None:
    offsets, rng = {'front': 0.0, 'left': 0.02}, np.random.default_rng(3)
    drone, exposed = Drone(front=FRONT, left=LEFT), ['', 0.0]
    off: list[Array] = []  # errors of place at an image's stamp, m, once an offset is applied

    def attitude(now: float) -> Array:
        return quaternion_from_yaw(0.15 * np.sin(1.7 * now) + 0.05 * np.sin(11.0 * now))

    def measured(*_: Any) -> Measurement:
        name, now = exposed
        own = Transform(quaternion_to_matrix(attitude(now)), body(now).translation)
        pose = (own @ drone.mountings[name]).inverse() @ ahead(2.0, 0.75, now)
        noisy = Transform(pose.rotation, pose.translation + rng.normal(0.0, 0.001, 3))
        return Measurement('leader', noisy, TAIL.translation, np.diag([1e-6] * 3 + [1e-4] * 3),
                           0.1, None)

    monkeypatch.setattr(tracker_module, 'track', measured)
    monkeypatch.setattr(tracker_module, 'locate', measured)
    first, cameras = drone.image('front', 0.0, ahead(2.0, 0.75)), drone.tracker.cameras
    for k in range(2000):
        now = k / 200.0
        drone.tracker.feed_odometry(OdometrySample(
            now, body(now).translation, attitude(now), FLYING,
            np.array([0.0, 0.0, 0.255 * np.cos(1.7 * now) + 0.55 * np.cos(11.0 * now)])))
        name = 'front' if k % 8 == 0 else 'left' if k % 8 == 4 else ''
        if name and now > 0.1:
            exposed[:] = name, now - 0.05
            stamp = now - 0.05 - offsets[name]
            sighting = drone.tracker.process_image(stamp, first, MODEL, name)
            if cameras['left'].time_offset.applied:
                off += [estimate.position - ahead(2.0, 0.75, stamp).translation
                        for estimate in sighting.estimates.values()]
    applied = [cameras[name].time_offset.applied for name in offsets]
    assert applied == pytest.approx([0.0, 0.02], abs=0.003)
    assert np.sqrt(np.mean(np.square(off[3:]), axis=0)).max() < 0.0025
