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

"""All of perception: frames and signs on rendered scenes, and the sample bag against its truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
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
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import decode_compressed, GrayImage
from flock_follower.perception.neighbor_filter import Estimate, FilterParams, Outcome
from flock_follower.perception.neighbors import load, Neighbor, NeighborConfig
from flock_follower.perception.odometry import Missing, OdometrySample
from flock_follower.perception.tracker import camera_mounting, Tracker

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / 'bags' / 'sample'
TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
CONFIG = NeighborConfig(DICTIONARY, (Neighbor('leader', 0, SIDE, TAIL),))
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
    T_odom_camera = Transform.from_quaternion([0.0, 0.0, 1.0], OWN) @ MOUNTING
    return render(CAMERA, {0: T_odom_camera.inverse() @ LEADER @ TAIL})


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


def test_uncertain_own_attitude_widens_across_the_line_of_sight(image: GrayImage) -> None:
    covariances = []
    for noise in (0.0, 0.02):
        params = replace(FilterParams(), attitude_noise=noise)
        tracker = Tracker(CONFIG, MOUNTING, params)
        tracker.feed_odometry(own(0.0))
        covariances.append(
            tracker.process_image(0.0, image, CAMERA).estimates['leader'].pose_covariance)
    extra = covariances[1] - covariances[0]
    assert extra[0, 0] == pytest.approx((0.02 * 2.2)**2, rel=0.1)  # east, across
    assert extra[1, 1] < 0.1 * extra[0, 0]  # north, along
    assert extra[5, 5] == pytest.approx(0.02**2, rel=0.01)


def test_images_without_odometry_are_dropped_with_the_reason(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING)
    assert tracker.missing(0.0) is Missing.EMPTY
    sighting = tracker.process_image(0.0, image, CAMERA)
    assert (sighting.estimates, sighting.rejections) == ({}, [(Missing.EMPTY.value, '')])
    tracker.feed_odometry(own(0.0))
    assert tracker.missing(0.0) is None
    assert tracker.missing(0.02) is Missing.TOO_NEW
    assert tracker.missing(0.02, extrapolate=True) is None


def test_time_that_jumps_back_restarts_the_tracks(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING)
    fly(tracker, image, 5.0, 5.3)
    assert tracker.feed_odometry(own(0.0))
    leader = tracker.process_image(0.0, image, CAMERA).estimates['leader']
    np.testing.assert_allclose(leader.position, LEADER.translation, atol=0.01)
    np.testing.assert_array_equal(leader.velocity, 0.0)


def test_a_repeated_image_is_dropped_as_late(image: GrayImage) -> None:
    tracker = Tracker(CONFIG, MOUNTING)
    tracker.feed_odometry(own(0.0))
    tracker.process_image(0.0, image, CAMERA)
    sighting = tracker.process_image(0.0, image, CAMERA)
    assert (sighting.estimates, sighting.rejections) == ({}, [(Outcome.LATE.value, 'leader')])


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


def test_the_sample_bag_is_tracked_within_its_bounds() -> None:
    pytest.importorskip('rosbags')
    from flock_follower.bags import deserialize, open_bag
    from flock_follower.tools.metrics import relative_errors, States, states
    tracker = Tracker(load(ROOT / 'config' / 'neighbors.yaml'),
                      camera_mounting([0.10, 0.0, 0.0], [0.0, 0.0, 0.0]))
    recorded: dict[str, list[Any]] = {'/odom': [], '/truth/odom': [], '/truth/neighbors': []}
    camera: CameraModel | None = None
    waiting: list[tuple[int, Any]] = []
    found: list[tuple[int, Estimate]] = []
    with open_bag(SAMPLE) as bag:
        for item in bag.messages():
            message = deserialize(item.data, item.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if item.topic in recorded:
                recorded[item.topic].append(message)
            if item.topic == '/odom':
                tracker.feed_odometry(_sample(message, stamp))
            elif item.topic == '/camera_info' and camera is None:
                camera = CameraModel.from_calibration(
                    message.k, message.d, message.distortion_model, message.width, message.height)
            elif item.topic == '/image_raw/compressed':
                waiting.append((stamp, message))
            while waiting and tracker.missing(_seconds(waiting[0][0])) is None:
                stamp, image = waiting.pop(0)
                assert camera is not None
                sighting = tracker.process_image(
                    _seconds(stamp), decode_compressed(image.data), camera)
                found += [(stamp, e) for e in sighting.estimates.values()]
    estimates = States(np.array([s for s, _ in found]), np.array([e.position for _, e in found]),
                       np.array([e.quaternion for _, e in found]),
                       np.array([e.velocity for _, e in found]))
    errors = relative_errors(estimates, states(recorded['/odom']),
                             states(recorded['/truth/neighbors']), states(recorded['/truth/odom']))
    assert errors.recall >= 0.99
    assert errors.position_rms <= 0.05
    assert errors.velocity_rms <= 0.15


def _seconds(stamp: int) -> float:
    return (stamp - 1_700_000_000 * 10**9) * 1e-9


def _sample(message: Any, stamp: int) -> OdometrySample:
    p, q = message.pose.pose.position, message.pose.pose.orientation
    v, w = message.twist.twist.linear, message.twist.twist.angular
    quaternion = np.array([q.x, q.y, q.z, q.w])
    return OdometrySample(_seconds(stamp), np.array([p.x, p.y, p.z]), quaternion,
                          quaternion_to_matrix(quaternion) @ [v.x, v.y, v.z],
                          np.array([w.x, w.y, w.z]))
