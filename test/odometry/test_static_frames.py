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


"""Frames of tf_static, composed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flock_follower.geometry import quaternion_from_rpy, Transform
from flock_follower.odometry.static_frames import StaticFrames

A = Transform.from_quaternion([1.0, 0.0, 0.5], quaternion_from_rpy(0.0, 0.0, 1.0))
B = Transform.from_quaternion([0.0, 2.0, 0.0], quaternion_from_rpy(0.3, 0.0, 0.0))


def tree() -> StaticFrames:
    frames = StaticFrames()
    frames.add('base_link', 'camera', A)
    frames.add('camera', 'imu', B)
    frames.add('base_link', 'gps', B)
    return frames


def test_a_frame_is_found_up_down_and_across_the_tree() -> None:
    point = np.array([0.3, -0.2, 0.1])
    for frame, on, expected in (('imu', 'base_link', A @ B), ('camera', 'base_link', A),
                                ('base_link', 'imu', (A @ B).inverse()),
                                ('imu', 'gps', B.inverse() @ A @ B), ('imu', 'imu', Transform())):
        pose = tree().pose(frame, on)
        assert pose is not None
        np.testing.assert_allclose(pose.apply(point), expected.apply(point), atol=1e-12)


@pytest.mark.parametrize('translation', [[math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0], [1e9] * 3])
def test_place_that_is_no_number_of_meters_is_refused(translation: list[float]) -> None:
    frames = tree()
    with pytest.raises(ValueError, match='imu in camera'):
        frames.add('camera', 'imu', Transform(np.eye(3), np.array(translation)))
    assert frames.pose('imu', 'base_link') is not None  # that of before


def test_unconnected_frames_are_not_guessed_circle_ends() -> None:
    frames = tree()
    for parent, child in (('world', 'elsewhere'), ('a', 'b'), ('b', 'a')):
        frames.add(parent, child, A)
    assert frames.pose('b', 'a') is not None
    for frame, on in (('elsewhere', 'base_link'), ('unheard of', 'base_link'), ('b', 'c')):
        assert frames.pose(frame, on) is None
