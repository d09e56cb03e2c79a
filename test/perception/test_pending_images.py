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

"""The queue of images: what waits, for how long, and what is dropped with which reason."""

from __future__ import annotations

from typing import Any

from marker_images import CONFIG, make_camera, render, TAIL
import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.geometry import IDENTITY_QUATERNION, Transform
from flock_follower.messages import OdometryState
from flock_follower.odometry.buffer import Missing
from flock_follower.perception.observed_wait import N_OBSERVED
from flock_follower.perception.pending_images import (
    INVALID_IMAGE,
    MOST_PENDING,
    NO_CAMERA,
    Perceiver,
    Processed,
)
from flock_follower.perception.tracker import camera_mounting, Tracker

CAMERA = make_camera()
MOUNTING = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
LEADER = Transform(np.eye(3), np.array([2.2, 0.1, 0.1]))
PIXELS = render(CAMERA, {0: MOUNTING.inverse() @ LEADER @ TAIL}, rays=3)


class Queue:
    """A perceiver, and messages to it at a time in s."""

    def __init__(self, calibrated: bool = True) -> None:
        self.perceiver = Perceiver(Tracker(CONFIG, MOUNTING), max_wait=0.3)
        if calibrated:
            self.calibrate(CAMERA.matrix)

    def calibrate(self, K: Any, P: float = 0.0) -> bool:
        info = empty('sensor_msgs/msg/CameraInfo')
        info.width, info.height, info.distortion_model = 640, 480, CAMERA.model
        info.k, info.d, info.p = np.ravel(K), CAMERA.distortion, np.full(12, P)
        return self.perceiver.take_camera_info(info)

    def odometry(self, *stamps: float) -> bool:
        return [self.perceiver.take_odometry(OdometryState(
            round(1e9 * stamp), 'odom', 'base_link', np.zeros(3), IDENTITY_QUATERNION, np.zeros(3),
            np.zeros(3), np.eye(6), np.eye(6), np.eye(3))) for stamp in stamps][-1]

    def image(self, stamp: float, now: float = 0.0, encoding: str = 'mono8') -> bool:
        """Return whether another image was dropped for this one."""
        image = empty('sensor_msgs/msg/Image')
        image.height, image.width, image.step, image.encoding = 480, 640, 640, encoding
        image.data = PIXELS.ravel()
        return self.perceiver.take_image(image, round(1e9 * stamp), now) is not None

    def processed(self, now: float) -> list[Processed]:
        found = []
        while (one := self.perceiver.process(now)) is not None:
            found.append(one)
        return found


def test_an_image_waits_until_odometry_has_reached_its_stamp() -> None:
    queue = Queue()
    queue.odometry(0.0)
    queue.image(0.012)
    queue.odometry(0.010)
    assert queue.processed(0.1) == [] and queue.perceiver.overdue == pytest.approx(0.3)
    queue.odometry(0.015)
    (one,) = queue.processed(0.1)
    assert one.usable and one.image.stamp_ns == 12_000_000 and queue.perceiver.overdue is None
    np.testing.assert_allclose(one.sighting.estimates['leader'].position, LEADER.translation,
                               atol=0.02)


def test_image_without_odometry_is_extrapolated_or_dropped() -> None:
    queue = Queue()
    queue.odometry(0.0)
    queue.image(0.025)
    queue.image(0.1)
    near, far = queue.processed(0.31)
    assert 'leader' in near.sighting.estimates  # 25 ms are extrapolated
    assert [reason for reason, _ in far.sighting.rejections] == [Missing.TOO_NEW.value]
    assert not far.usable


def test_images_wait_little_longer_than_recent_odometry_delay() -> None:
    queue = Queue()
    for k in range(N_OBSERVED):
        stamp = 0.01 * k
        queue.image(stamp, now=stamp)
        queue.odometry(stamp)
        assert len(queue.processed(stamp + 0.04)) == 1
    for now, wait in (1.0, 0.09), (2.0, 0.3):  # odometry ends: it may come later from now on
        queue.image(1.0, now)
        assert queue.perceiver.overdue == pytest.approx(now + wait)
        assert queue.processed(now + wait - 0.01) == []
        (one,) = queue.processed(now + wait + 0.01)
        assert not one.usable


def test_image_from_future_delays_none_oldest_is_dropped() -> None:
    queue = Queue()
    queue.odometry(0.0, 0.02)
    queue.image(5.0)
    queue.image(0.01)
    assert [one.image.stamp_ns for one in queue.processed(0.0)] == [10_000_000]
    assert [queue.image(1.0 + 0.001 * k) for k in range(MOST_PENDING)] == (
        [False] * (MOST_PENDING - 1) + [True])


def test_image_waits_for_calibration_then_is_dropped_with_reason() -> None:
    queue = Queue(calibrated=False)
    queue.odometry(0.0)
    queue.image(0.0)
    assert queue.processed(0.1) == []
    queue.calibrate(CAMERA.matrix)
    assert [one.usable for one in queue.processed(0.1)] == [True]
    with pytest.raises(ValueError, match='not calibrated'):
        queue.calibrate(np.zeros(9))
    queue.image(0.0)
    (one,) = queue.processed(0.4)
    assert one.sighting.rejections[0][0] == NO_CAMERA and one.pixels is None and not one.usable


@pytest.mark.parametrize(('odometry', 'encoding', 'reason'), [
    (False, 'mono8', Missing.EMPTY.value), (True, 'theora', INVALID_IMAGE)])
def test_an_unusable_image_is_dropped_with_the_reason(
        odometry: bool, encoding: str, reason: str) -> None:
    queue = Queue()
    if odometry:
        queue.odometry(0.0)
    queue.image(0.0, encoding=encoding)
    (one,) = queue.processed(1.0)
    assert [name for name, _ in one.sighting.rejections] == [reason] and not one.usable


def test_a_repeated_calibration_is_no_new_one() -> None:
    queue = Queue(calibrated=False)
    assert [queue.calibrate(CAMERA.matrix, np.nan) for _ in range(3)] == [True, False, False]
    assert queue.calibrate(CAMERA.matrix * [[1.1], [1.1], [1.0]], np.nan)


def test_time_that_jumps_back_forgets_the_images_that_wait() -> None:
    queue = Queue()
    queue.odometry(100.0)
    queue.image(100.1)
    assert queue.odometry(0.0)
    assert queue.processed(9.0) == [] and queue.perceiver.overdue is None
