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

"""A detector without odometry: poses and velocities relative to a camera in a hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

from marker_images import make_camera, render, TAIL
import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.geometry import quaternion_from_rpy, quaternion_from_yaw, Transform
from flock_follower.messages import to_nanoseconds
from flock_follower.messages.poses import from_pose
from flock_follower.messages.state_reader import from_odometry
from flock_follower.parameters.files import check_values
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.parameter_table import tracker
from flock_follower.perception.pending_images import Perceiver
from flock_follower.perception.tracker import camera_mounting

RATE, IMAGES = 30.0, 60
LEADER = Transform.from_quaternion([2.0, 0.0, 0.1], quaternion_from_yaw(0.3))
LENS = camera_mounting([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])


def seen_at(t: float) -> Transform:
    """Return the leader as a camera sees it that a hand moves, and rolls by 0.6 rad."""
    hand = Transform.from_quaternion(
        [0.05 * math.sin(5.0 * t), 0.1 * math.sin(3.0 * t), 0.05 * math.sin(4.0 * t)],
        quaternion_from_rpy(0.6 + 0.1 * math.sin(4.0 * t), 0.06 * math.sin(6.0 * t),
                            0.08 * math.sin(5.0 * t + 1.0)))
    return (hand @ LENS).inverse() @ LEADER


def test_poses_and_velocities_relative_to_a_camera_in_a_hand() -> None:
    camera = make_camera()
    perceiver = Perceiver(tracker(check_values(TABLE['relative_pose'], {'odometry': 'none'})),
                          max_wait=0.35)
    perceiver.take_camera_info(info(camera))
    errors, velocities, nees, nees_velocity, frames = [], [], [], [], set()
    for k in range(IMAGES):
        t = k / RATE
        image = render(camera, {0: seen_at(t) @ TAIL})
        perceiver.take_image(image, to_nanoseconds(100.0 + t), t)
        seen = perceiver.process(t)
        assert seen is not None
        for name, estimate in seen.sighting.estimates.items():
            state = from_odometry(perceiver.messages(
                empty, seen.image.stamp_ns, name, estimate)[0])
            off = state.position - seen_at(t).translation
            velocity = (seen_at(t + 1e-4).translation - seen_at(t - 1e-4).translation) / 2e-4
            errors.append(off)
            frames.add(state.frame)
            nees.append(off @ np.linalg.solve(state.pose_covariance[:3, :3], off))
            if t > 0.5:
                velocities.append(state.velocity - velocity)
                nees_velocity.append(velocities[-1] @ np.linalg.solve(
                    state.velocity_covariance, velocities[-1]))
        for _, message in perceiver.poses(empty, seen):
            assert from_pose(message).frame == 'optical'
    figures = (len(errors), np.sqrt(np.mean(np.square(errors))), np.mean(nees),
               np.sqrt(np.mean(np.square(velocities))), np.mean(nees_velocity))
    print(figures)  # shown with -s
    assert len(errors) == IMAGES and frames == {'optical'}
    assert figures[1] < 0.02 and figures[2] < 4.5
    assert figures[3] < 0.15 and figures[4] < 4.5


def info(camera: CameraModel) -> SimpleNamespace:
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    matrix = camera.matrix
    return SimpleNamespace(
        header=SimpleNamespace(frame_id='optical'), k=matrix.ravel(),
        d=camera.distortion, p=np.hstack([matrix, np.zeros((3, 1))]).ravel(),
        distortion_model='plumb_bob', width=640, height=480, binning_x=0, binning_y=0, roi=roi)


def test_several_cameras_need_odometry() -> None:
    values = check_values(TABLE['relative_pose'], {
        'odometry': 'none', 'cameras': ['front', 'left']})
    with pytest.raises(ValueError, match='odometry = none'):
        tracker(values)
