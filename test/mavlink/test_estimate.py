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


"""The autopilot's position and attitude become one estimate, valid at one time."""

import numpy as np
import pytest

from flock_follower.geometry import quaternion_from_yaw, yaw_from_quaternion
from flock_follower.mavlink.telemetry import Attitude, ATTITUDE_TIMEOUT, estimate, LocalPosition

NORTH = np.array([0.0, 1.0, 0.0])


def position(time=10.0, boot_ms=5000):
    return LocalPosition(time, np.array([1.0, 2.0, 3.0]), NORTH, boot_ms)


def attitude(time=10.0, boot_ms=5000, yaw=np.pi / 2, rate=0.0):
    return Attitude(time, quaternion_from_yaw(yaw), np.array([0.0, 0.0, rate]), boot_ms)


def test_it_is_that_of_when_the_position_was_valid():
    found = estimate(position(), attitude(), 0.05)
    assert found.time == pytest.approx(9.95)
    np.testing.assert_allclose(found.position, [1, 2, 3])
    np.testing.assert_allclose(found.velocity, [1, 0, 0], atol=1e-9)  # it faces north


@pytest.mark.parametrize('age', [0.0, -0.02])
def test_it_is_never_from_the_future(age):
    assert estimate(position(), attitude(), age).time == 10.0


@pytest.mark.parametrize('attitude_ms', [4980, 5000, 5015])
def test_an_attitude_measured_before_or_after_is_turned_to_the_time_of_the_position(attitude_ms):
    # It turns left at 2 rad/s, and faces north at 5000 ms.
    measured = attitude(10.01, attitude_ms, np.pi / 2 + 2.0 * (attitude_ms - 5000) * 1e-3, 2.0)
    found = estimate(position(), measured, 0.0)
    assert yaw_from_quaternion(found.quaternion) == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(found.velocity, [1, 0, 0], atol=1e-9)


@pytest.mark.parametrize(('position_ms', 'attitude_ms'), [(0, 4990), (5000, 0), (0, 0),
                                                          (5000, 4_000_000)])
def test_stamps_that_say_nothing_turn_nothing(position_ms, attitude_ms):
    found = estimate(position(boot_ms=position_ms), attitude(boot_ms=attitude_ms, rate=2.0), 0.0)
    assert yaw_from_quaternion(found.quaternion) == pytest.approx(np.pi / 2)


def test_an_attitude_that_came_long_before_is_no_part_of_it():
    assert estimate(position(), attitude(10.0 - 1.01 * ATTITUDE_TIMEOUT), 0.0) is None
    assert estimate(position(), attitude(10.0 - 0.99 * ATTITUDE_TIMEOUT), 0.0) is not None
