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

"""Simulated odometry: errors that are as large as its covariances say."""

import math

import numpy as np
import pytest

from flock_desk.scenarios.scenario import VioErrors
from flock_desk.scenarios.trajectories import fly
from flock_desk.sensors.vio import Due, odometry, true_odometry
from flock_follower.geometry import (
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
)

TIMES = np.arange(0.0, 8.0, 0.05)
RUNS = 60


@pytest.fixture(scope='module')
def track():
    return fly(8.0)[1]


@pytest.fixture(scope='module')
def runs(track):
    return [odometry(track, TIMES, VioErrors(), seed) for seed in range(RUNS)]


def pose_error(estimate, true):
    turn = quaternion_multiply(estimate.quaternion, quaternion_conjugate(true.quaternion))
    return np.concatenate([estimate.position - true.position,
                           quaternion_to_rotation_vector(turn)])


def test_truth_has_twist_in_child_frame_and_no_covariance(track):
    true = true_odometry(track, 5.0)
    np.testing.assert_allclose(quaternion_to_matrix(true.quaternion) @ true.linear,
                               track.velocity(5.0), atol=1e-6)
    assert true.linear[0] > 0.5 and abs(true.linear[1]) < 0.6  # it flies forwards
    assert not true.pose_covariance.any() and not true.twist_covariance.any()


@pytest.mark.parametrize('k', [40, 159])
def test_errors_are_as_large_as_the_covariances_say(track, runs, k):
    true = true_odometry(track, TIMES[k])
    errors = [(pose_error(run[k], true), run[k].pose_covariance) for run in runs], [
        (np.concatenate([run[k].linear - true.linear, run[k].angular - true.angular]),
         run[k].twist_covariance) for run in runs]
    for each in errors:
        # Mean of 60 chi-squared values of 6 degrees of freedom: 6 +- 0.45.
        assert 4.6 < np.mean([e @ np.linalg.solve(c, e) for e, c in each]) < 7.4


def test_position_and_yaw_drift_as_root_of_time_tilt_does_not(track, runs):
    errors = np.array([[pose_error(run[k], true_odometry(track, TIMES[k])) for run in runs]
                       for k in (40, 159)])
    early, late = errors.std(axis=1)
    np.testing.assert_allclose(late[[0, 1, 2, 5]] / early[[0, 1, 2, 5]], 2.0, rtol=0.35)
    np.testing.assert_allclose(
        late[3:5], math.hypot(VioErrors().tilt, VioErrors().tilt_bias), rtol=0.25)


@pytest.mark.parametrize(('rate', 'gaps'), [
    (200.0, {1}), (100.0, {1}), (50.0, {2}), (20.0, {5}), (30.0, {3, 4})])
def test_samples_come_at_mean_rate_not_above_step_rate(rate, gaps):
    due = Due(rate)
    taken = [k for k in range(1000) if due.at(0.01 * k)]
    assert {*np.diff(taken).tolist()} == gaps and taken[0] == 0
    assert len(taken) == pytest.approx(10.0 * min(rate, 100.0), abs=1)
