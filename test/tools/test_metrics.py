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

import numpy as np
import pytest

from flock_follower.geometry import quaternion_from_yaw, Transform
from flock_follower.tools.metrics import mean_rate, relative_errors, States

SECOND = 10**9


def straight(n, offset, yaw=0.0, hertz=10):
    """Return n states moving along x at 1 m/s from an offset, all turned by a yaw (drift)."""
    t = np.arange(n) / hertz
    turn = Transform.from_quaternion([0.0, 0.0, 0.0], quaternion_from_yaw(yaw))
    positions = turn.apply(np.array(offset) + np.outer(t, [1.0, 0.0, 0.0]))
    velocities = np.tile(turn.apply([1.0, 0.0, 0.0]), (n, 1))
    return States((t * SECOND).round().astype(np.int64), positions,
                  np.tile(quaternion_from_yaw(yaw), (n, 1)), velocities)


def test_drift_common_to_both_is_no_error():
    errors = relative_errors(straight(20, [2.0, 0.5, 0.0], yaw=0.3), straight(20, [0, 0, 0], 0.3),
                             straight(20, [7.0, 0.5, 1.0]), straight(20, [5.0, 0, 1.0]))
    assert errors.recall == 1.0
    assert errors.position_rms == pytest.approx(0.0, abs=1e-9)
    assert errors.velocity_rms == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(errors.distance, np.hypot(2.0, 0.5))


def test_an_offset_of_the_neighbour_is_the_error():
    wrong = straight(20, [2.0, 0.0, 0.0])
    wrong = wrong._replace(velocities=wrong.velocities + np.array([0.0, 0.1, 0.0]))
    errors = relative_errors(wrong, straight(20, [0, 0, 0]),
                             straight(20, [2.03, 0.04, 0.0]), straight(20, [0, 0, 0]))
    assert errors.position_rms == pytest.approx(0.05)
    assert errors.velocity_rms == pytest.approx(0.1)


def test_a_missing_estimate_lowers_recall_only():
    some = straight(20, [2.0, 0, 0])
    some = States(*(column[::2] for column in some))
    truth = straight(20, [2.0, 0, 0]), straight(20, [0, 0, 0])
    assert relative_errors(some, truth[1], *truth).recall == 0.5
    nothing = States(*(column[:0] for column in some))
    assert relative_errors(nothing, truth[1], *truth).recall == 0.0


def test_states_between_two_stamps_are_interpolated():
    position, rotation, velocity = straight(5, [0, 0, 0]).at(SECOND // 4)
    np.testing.assert_allclose(position, [0.25, 0, 0])
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(velocity, [1.0, 0, 0])


def test_mean_rate_counts_intervals():
    assert mean_rate(np.arange(11) * 0.1) == pytest.approx(10.0)
    assert mean_rate(np.array([1.0])) == 0.0
