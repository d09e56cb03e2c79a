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

"""The neighbour filter: convergence, consistency, gating, late frames, time jumps, levers."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import (
    Array,
    matrix_to_rotation_vector,
    quaternion_from_yaw,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
    Transform,
)
from flock_follower.perception.neighbor_filter import (
    Estimate,
    FilterParams,
    NeighborFilter,
    Outcome,
)

TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.05]))
NOISE = np.diag([0.005, 0.005, 0.01, 0.02, 0.02, 0.01])**2
START, VELOCITY, RATE = np.array([3.0, 1.0, 2.0]), np.array([0.8, -0.4, 0.1]), 0.5
DT = 1.0 / 30.0


def truth(t: float) -> Transform:
    """Return T_odom_body of a neighbour in steady flight, turning about z."""
    return Transform(quaternion_to_matrix(quaternion_from_yaw(0.3 + RATE * t)),
                     START + t * VELOCITY)


def measured(body: Transform, rng: np.random.Generator | None = None) -> Transform:
    """Return T_odom_marker, with noise of the covariance NOISE if rng is given."""
    marker = body @ TAIL
    if rng is None:
        return marker
    e = rng.multivariate_normal(np.zeros(6), NOISE)
    return Transform(rotation_vector_to_matrix(e[3:]) @ marker.rotation,
                     marker.translation + e[:3])


def error(estimate: Estimate, body: Transform, velocity: Array) -> Array:
    """Return the error state (12,) of an estimate."""
    return np.concatenate([
        body.translation - estimate.position, velocity - estimate.velocity,
        matrix_to_rotation_vector(body.rotation @ estimate.rotation.T),
        np.array([0.0, 0.0, RATE]) - estimate.angular_velocity])


def moved(body: Transform, *offset: float) -> Transform:
    return Transform(body.rotation, body.translation + np.array(offset))


def tracked(seconds: float, noisy: bool = True,
            params: FilterParams | None = None) -> NeighborFilter:
    """Return a filter that has followed the steady flight from 0 to ``seconds``."""
    rng = np.random.default_rng(0) if noisy else None
    tracker = NeighborFilter(TAIL, params)
    for k in range(round(seconds / DT) + 1):
        tracker.update(k * DT, measured(truth(k * DT), rng), NOISE)
    return tracker


def now(tracker: NeighborFilter, t: float) -> Estimate:
    estimate = tracker.predict(t)
    assert estimate is not None
    return estimate


def test_steady_flight_is_estimated_through_noise() -> None:
    estimate = now(tracked(3.0), 3.0)
    e = error(estimate, truth(3.0), VELOCITY)
    assert np.linalg.norm(e[:3]) < 0.02
    assert np.linalg.norm(e[3:6]) < 0.3
    assert np.linalg.norm(e[6:9]) < 0.04
    assert np.linalg.norm(e[9:]) < 0.6
    assert e @ np.linalg.solve(estimate.covariance, e) < 32.9  # chi^2, 12 dof, 0.999


def test_steady_flight_without_noise_is_found_exactly() -> None:
    estimate = now(tracked(5.0, noisy=False), 5.0)
    np.testing.assert_allclose(error(estimate, truth(5.0), VELOCITY), 0.0, atol=1e-4)


def test_without_noise_position_of_the_body_not_the_marker_is_found() -> None:
    tracker = NeighborFilter(TAIL)
    assert tracker.update(0.0, measured(truth(0.0)), NOISE) is Outcome.STARTED
    np.testing.assert_allclose(now(tracker, 0.0).position, START, atol=1e-12)
    np.testing.assert_allclose(now(tracker, 0.0).rotation, truth(0.0).rotation, atol=1e-12)


def test_errors_agree_with_the_covariance() -> None:
    # A neighbour that moves as the filter believes: white acceleration, linear and angular.
    params = FilterParams(acceleration_noise=0.7, angular_noise=1.0)
    nees = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        body, velocity, rate = truth(0.0), rng.normal(0, 1.0, 3), rng.normal(0, 0.5, 3)
        tracker = NeighborFilter(TAIL, params)
        steps = 10
        for k in range(45):
            tracker.update(k * DT, measured(body, rng), NOISE)
            if k == 44:
                estimate = now(tracker, k * DT)
                e = np.concatenate([
                    body.translation - estimate.position, velocity - estimate.velocity,
                    matrix_to_rotation_vector(body.rotation @ estimate.rotation.T),
                    rate - estimate.angular_velocity])
                nees.append(e @ np.linalg.solve(estimate.covariance, e))
            for _ in range(steps):
                dt = DT / steps
                body = Transform(rotation_vector_to_matrix(dt * rate) @ body.rotation,
                                 body.translation + dt * velocity)
                velocity = velocity + rng.normal(0, 0.7 * dt**0.5, 3)
                rate = rate + rng.normal(0, 1.0 * dt**0.5, 3)
    # The mean of 25 chi^2 with 12 degrees of freedom has the deviation sqrt(24 / 25).
    assert np.mean(nees) == pytest.approx(12.0, abs=3.5)


def test_prediction_does_not_alter_the_filter() -> None:
    tracker = tracked(1.0)
    before = now(tracker, 1.0)
    ahead = now(tracker, 1.6)
    after = now(tracker, 1.0)
    np.testing.assert_array_equal(before.position, after.position)
    np.testing.assert_array_equal(before.covariance, after.covariance)
    np.testing.assert_allclose(ahead.position, before.position + 0.6 * before.velocity)
    assert np.all(np.diag(ahead.covariance)[:9] > np.diag(before.covariance)[:9])


def test_prediction_reaches_only_so_far() -> None:
    tracker = tracked(1.0)
    assert tracker.predict(3.1) is None
    assert tracker.predict(0.5) is None
    assert NeighborFilter(TAIL).predict(0.0) is None


def test_the_first_velocity_is_unknown_and_says_so() -> None:
    estimate = now(tracked(0.0, params=FilterParams(initial_speed=1.5)), 0.0)
    np.testing.assert_array_equal(estimate.velocity, 0.0)
    np.testing.assert_allclose(np.diag(estimate.covariance)[3:6], 1.5**2)


def test_a_lever_turns_attitude_noise_into_position_noise() -> None:
    arm = 0.4
    tracker = NeighborFilter(Transform(np.eye(3), np.array([arm, 0.0, 0.0])))
    noise = np.diag([1e-6, 1e-6, 1e-6, 0.0, 0.1**2, 0.2**2])
    tracker.update(0.0, Transform(), noise)
    covariance = now(tracker, 0.0).pose_covariance
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)[:3]), [0.001, 0.2 * arm, 0.1 * arm],
                               rtol=0.01)
    # Turning about +z swings a body behind its marker towards -y: correlated accordingly.
    assert covariance[1, 5] == pytest.approx(-arm * 0.2**2)


def test_a_single_outlier_is_ignored() -> None:
    tracker = tracked(1.0)
    t = 1.0 + DT
    wrong = measured(moved(truth(t), 0.0, 1.5, 0.0))
    assert tracker.update(t, wrong, NOISE) is Outcome.OUTLIER
    assert np.linalg.norm(now(tracker, t).position - truth(t).translation) < 0.03
    assert tracker.update(t + DT, measured(truth(t + DT)), NOISE) is Outcome.USED


def test_six_outliers_in_a_row_restart_the_filter() -> None:
    tracker = tracked(1.0)
    times = 1.0 + DT * np.arange(1, 8)
    outcomes = [tracker.update(t, measured(moved(truth(t), 0.0, 3.0, 0.0)), NOISE) for t in times]
    assert outcomes == [Outcome.OUTLIER] * 5 + [Outcome.STARTED, Outcome.USED]
    expected = moved(truth(times[-1]), 0.0, 3.0, 0.0).translation
    np.testing.assert_allclose(now(tracker, times[-1]).position, expected, atol=0.02)


def test_outliers_between_good_measurements_never_restart() -> None:
    tracker = tracked(1.0)
    for k in range(1, 31):
        body = truth(1.0 + k * DT)
        if k % 3:
            body = moved(body, 0.0, 1.5, 0.0)
        outcome = tracker.update(1.0 + k * DT, measured(body), NOISE)
        assert outcome is (Outcome.OUTLIER if k % 3 else Outcome.USED)


def mirrored(marker: Transform) -> Transform:
    return Transform(rotation_vector_to_matrix([0.0, 0.0, 0.9]) @ marker.rotation,
                     marker.translation)


def test_a_mirrored_attitude_leaves_the_position_usable() -> None:
    tracker = tracked(1.0)
    t = 1.0 + DT
    assert tracker.update(t, mirrored(measured(truth(t))), NOISE) is Outcome.POSITION_ONLY
    e = error(now(tracker, t), truth(t), VELOCITY)
    assert np.linalg.norm(e[:3]) < 0.02
    assert np.linalg.norm(e[6:9]) < 0.05


def test_a_track_begun_mirrored_turns_round_and_keeps_its_velocity() -> None:
    tracker = NeighborFilter(TAIL)
    times = DT * np.arange(66)
    for t in times[:60]:
        tracker.update(t, mirrored(measured(truth(t))), NOISE)
    outcomes = [tracker.update(t, measured(truth(t)), NOISE) for t in times[60:]]
    assert outcomes == [Outcome.POSITION_ONLY] * 5 + [Outcome.STARTED]
    e = error(now(tracker, times[-1]), truth(times[-1]), VELOCITY)
    np.testing.assert_allclose(e[:3], 0.0, atol=1e-9)
    np.testing.assert_allclose(e[6:9], 0.0, atol=1e-9)
    assert np.linalg.norm(e[3:6]) < 0.3


def test_late_and_repeated_frames_are_dropped() -> None:
    tracker = tracked(1.0)
    before = now(tracker, 1.0)
    assert tracker.update(0.9, measured(truth(0.9)), NOISE) is Outcome.LATE
    assert tracker.update(1.0, measured(truth(1.0)), NOISE) is Outcome.LATE
    np.testing.assert_array_equal(now(tracker, 1.0).position, before.position)


def test_a_jump_back_in_time_starts_anew() -> None:
    tracker = tracked(2.0)
    assert tracker.update(0.1, measured(truth(0.1)), NOISE) is Outcome.STARTED
    np.testing.assert_allclose(now(tracker, 0.1).position, truth(0.1).translation, atol=1e-9)


def test_after_a_long_gap_the_filter_starts_anew() -> None:
    tracker = tracked(1.0)
    assert tracker.update(3.5, measured(truth(3.5)), NOISE) is Outcome.STARTED
    assert tracked(1.0).update(2.0, measured(truth(2.0)), NOISE) is Outcome.USED


def test_twist_is_given_in_the_neighbours_body() -> None:
    twist = now(tracked(5.0, noisy=False), 5.0).child_twist
    np.testing.assert_allclose(twist[:3], truth(5.0).rotation.T @ VELOCITY, atol=1e-3)
    np.testing.assert_allclose(twist[3:], [0.0, 0.0, RATE], atol=1e-3)


def test_twist_covariance_is_that_of_perturbed_states() -> None:
    estimate = now(tracked(0.2), 0.2)
    rng = np.random.default_rng(1)
    twists = []
    for e in rng.multivariate_normal(np.zeros(12), 1e-4 * estimate.covariance, 20000):
        rotation = rotation_vector_to_matrix(e[6:9]) @ estimate.rotation
        twists.append(np.concatenate([rotation.T @ (estimate.velocity + e[3:6]),
                                      rotation.T @ (estimate.angular_velocity + e[9:])]))
    actual = 1e4 * np.cov(np.transpose(twists))
    ratios = np.linalg.eigvals(np.linalg.solve(actual, estimate.child_twist_covariance)).real
    assert ratios.min() > 0.9
    assert ratios.max() < 1.1


def test_covariances_stay_symmetric_and_positive() -> None:
    covariance = now(tracked(20.0), 20.0).covariance
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


@pytest.mark.parametrize(('name', 'value'), [
    ('acceleration_noise', 0.0), ('angular_noise', -1.0), ('initial_speed', float('nan')),
    ('attitude_noise', -0.1), ('max_rejections', 0), ('max_gap', 61.0)])
def test_bad_parameters_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f'{name} = {value}: must be in'):
        FilterParams(**{name: value})
