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

"""The neighbor filter: motion, consistency, gating, late frames, time jumps, levers."""

from __future__ import annotations

import math

from marker_images import known
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
from flock_follower.perception.innovation import ALIKE_TIME
from flock_follower.perception.neighbor_filter import (
    Estimate,
    FilterParams,
    GATE_CHI2,
    NeighborFilter,
    UpdateOutcome,
)

TAIL = np.array([-0.2, 0.0, 0.05])  # what is measured: where the marker is on the body
NOISE = np.diag([0.005, 0.005, 0.01, 0.02, 0.02, 0.01])**2
START, VELOCITY, RATE = np.array([3.0, 1.0, 2.0]), np.array([0.8, -0.4, 0.1]), 0.5
DT = 1.0 / 30.0


def truth(t: float) -> Transform:
    """Return T_odom_body of a neighbor in steady flight, turning about z."""
    return Transform(quaternion_to_matrix(quaternion_from_yaw(0.3 + RATE * t)),
                     START + t * VELOCITY)


def measured(body: Transform, rng: np.random.Generator | None = None) -> Transform:
    """Return T_odom_body, with noise of the covariance NOISE at the tail if rng is given."""
    if rng is None:
        return body
    e = rng.multivariate_normal(np.zeros(6), NOISE)
    rotation = rotation_vector_to_matrix(e[3:]) @ body.rotation
    return Transform(rotation, body.apply(TAIL[None])[0] + e[:3] - rotation @ TAIL)


def error(estimate: Estimate, body: Transform, velocity: Array) -> Array:
    """Return the error state (15,) of an estimate of a neighbor that does not accelerate."""
    return np.concatenate([
        body.translation - estimate.position, velocity - estimate.velocity,
        matrix_to_rotation_vector(body.rotation @ estimate.rotation.T),
        np.array([0.0, 0.0, RATE]) - estimate.angular_velocity, -estimate.acceleration])


def moved(body: Transform, *offset: float) -> Transform:
    return Transform(body.rotation, body.translation + np.array(offset))


def update(tracker: NeighborFilter, t: float, body: Transform) -> UpdateOutcome:
    return tracker.update(t, body, TAIL, NOISE)


def tracked(seconds: float, noisy: bool = True,
            params: FilterParams | None = None) -> NeighborFilter:
    """Return a filter that has followed the steady flight from 0 to ``seconds``."""
    rng = np.random.default_rng(0) if noisy else None
    tracker = NeighborFilter(params)
    for k in range(round(seconds / DT) + 1):
        update(tracker, k * DT, measured(truth(k * DT), rng))
    return tracker


def now(tracker: NeighborFilter, t: float) -> Estimate:
    return known(tracker.predict(t))


def test_steady_flight_without_noise_is_found_exactly() -> None:
    estimate = now(tracked(8.0, noisy=False), 8.0)
    np.testing.assert_allclose(error(estimate, truth(8.0), VELOCITY), 0.0, atol=2e-3)


def test_errors_agree_with_the_covariance() -> None:
    # A neighbor that moves as the filter believes: Singer's acceleration, white angular one.
    params = FilterParams(acceleration=0.7, acceleration_time=1.5, angular_noise=1.0,
                          odometry_noise=1e-3)
    nees = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        body, velocity, rate = truth(0.0), rng.normal(0, 1.0, 3), rng.normal(0, 0.5, 3)
        acceleration = rng.normal(0, 0.7, 3)
        tracker = NeighborFilter(params)
        steps = 10
        for k in range(45):
            update(tracker, k * DT, measured(body, rng))
            if k % 22 == 0:
                estimate = now(tracker, k * DT)
                e = np.concatenate([
                    body.translation - estimate.position, velocity - estimate.velocity,
                    matrix_to_rotation_vector(body.rotation @ estimate.rotation.T),
                    rate - estimate.angular_velocity, acceleration - estimate.acceleration])
                nees.append(e @ np.linalg.solve(estimate.covariance, e))
            for _ in range(steps):
                dt = DT / steps
                body = Transform(rotation_vector_to_matrix(dt * rate) @ body.rotation,
                                 body.translation + dt * velocity)
                velocity = velocity + dt * acceleration
                acceleration = (1.0 - dt / 1.5) * acceleration + rng.normal(
                    0, 0.7 * (2.0 * dt / 1.5)**0.5, 3)
                rate = rate + rng.normal(0, 1.0 * dt**0.5, 3)
    # At the start, after 0.7 s and after 1.5 s. The mean of 40 chi^2 with 15 degrees of freedom
    # has the deviation sqrt(30 / 40).
    for at_once in np.reshape(nees, (40, 3)).T:
        assert np.mean(at_once) == pytest.approx(15.0, abs=3.0)


def test_prediction_reaches_only_so_far() -> None:
    tracker = tracked(1.0)
    assert tracker.predict(3.1) is None
    assert tracker.predict(0.5) is None
    assert NeighborFilter().predict(0.0) is None
    tracker.reset()
    assert tracker.predict(1.0) is None


def test_a_lever_turns_attitude_noise_into_position_noise() -> None:
    arm = 0.4
    tracker = NeighborFilter()
    noise = np.diag([1e-6, 1e-6, 1e-6, 0.0, 0.1**2, 0.2**2])
    # A marker 0.4 m ahead of the body's origin, where it is seen.
    tracker.update(0.0, Transform(np.eye(3), np.array([-arm, 0.0, 0.0])),
                   np.array([arm, 0.0, 0.0]), noise)
    covariance = now(tracker, 0.0).pose_covariance
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)[:3]), [0.001, 0.2 * arm, 0.1 * arm],
                               rtol=0.01)
    # Turning about +z swings a body behind its marker towards -y: correlated accordingly.
    assert covariance[1, 5] == pytest.approx(-arm * 0.2**2)


def test_a_single_outlier_is_ignored() -> None:
    tracker = tracked(1.0)
    t = 1.0 + DT
    wrong = measured(moved(truth(t), 0.0, 1.5, 0.0))
    assert update(tracker, t, wrong) is UpdateOutcome.OUTLIER
    assert np.linalg.norm(now(tracker, t).position - truth(t).translation) < 0.03
    assert update(tracker, t + DT, measured(truth(t + DT))) is UpdateOutcome.USED


@pytest.mark.parametrize(('reach', 'outcome'), [
    (0.9, UpdateOutcome.SURPRISING), (0.5, UpdateOutcome.OUTLIER)])
def test_what_is_out_of_reach_is_refused_though_the_gate_is_wide(
        reach: float, outcome: UpdateOutcome) -> None:
    tracker, t = tracked(1.0), 1.8
    off = moved(truth(1.0), 0.0, 0.7, 0.0)
    assert tracker.update(t, off, TAIL, NOISE, reach) is outcome


def surprising(off: float) -> tuple[NeighborFilter, float, Array]:
    """Return a filter that was surprised, the time, and by how much, so many times the gate."""
    tracker, t = tracked(1.0), 1.0 + DT
    spread = now(tracker, t).covariance[:3, :3] + NOISE[:3, :3]
    way = np.array([0.0, np.sqrt(off * GATE_CHI2 * spread[1, 1]), 0.0])
    assert update(tracker, t, moved(truth(t), *way)) is UpdateOutcome.SURPRISING
    return tracker, t, way


def test_second_surprise_counts_on_same_side_only() -> None:
    shares = []
    for side in (1.0, -1.0):
        tracker, t, way = surprising(4.0)
        before = now(tracker, t + DT).position
        there = moved(truth(t + DT), *(side * way))
        update(tracker, t + DT, there)
        moved_by = now(tracker, t + DT).position - before
        shares.append(float(moved_by @ (side * way) / (way @ way)))
    assert shares[0] > 0.6
    assert shares[1] < 0.3


def mirrored(body: Transform) -> Transform:
    """Return a body turned about its tail."""
    rotation = rotation_vector_to_matrix([0.0, 0.0, 0.9]) @ body.rotation
    return Transform(rotation, body.apply(TAIL[None])[0] - rotation @ TAIL)


def test_a_mirrored_attitude_leaves_the_position_usable() -> None:
    tracker = tracked(1.0)
    t = 1.0 + DT
    assert update(tracker, t, mirrored(measured(truth(t)))) is UpdateOutcome.POSITION_ONLY
    e = error(now(tracker, t), truth(t), VELOCITY)
    assert np.linalg.norm(e[:3]) < 0.02
    assert np.linalg.norm(e[6:9]) < 0.05


def test_track_begun_mirrored_turns_and_keeps_velocity() -> None:
    tracker = NeighborFilter()
    times = DT * np.arange(66)
    for t in times[:60]:
        update(tracker, t, mirrored(measured(truth(t))))
    outcomes = [update(tracker, t, measured(truth(t))) for t in times[60:]]
    assert outcomes == [UpdateOutcome.POSITION_ONLY] * 5 + [UpdateOutcome.STARTED]
    e = error(now(tracker, times[-1]), truth(times[-1]), VELOCITY)
    np.testing.assert_allclose(e[:3], 0.0, atol=1e-9)
    np.testing.assert_allclose(e[6:9], 0.0, atol=1e-9)
    assert np.linalg.norm(e[3:6]) < 0.3


@pytest.mark.parametrize(('modeled', 'least', 'most'), [(True, 2.0, 4.0), (False, 5.0, 10.0)])
def test_errors_alike_between_images_do_not_average_out(
        modeled: bool, least: float, most: float) -> None:
    alike, squares = 0.8 * NOISE, []
    for seed in range(16):
        rng, tracker, same = np.random.default_rng(seed), NeighborFilter(), np.zeros(6)
        for k in range(25):
            kept = math.exp(-DT / ALIKE_TIME) if k else 0.0
            same = kept * same + rng.multivariate_normal(np.zeros(6), (1.0 - kept**2) * alike)
            e = same + rng.multivariate_normal(np.zeros(6), NOISE - alike)
            body = truth(k * DT)
            rotation = rotation_vector_to_matrix(e[3:]) @ body.rotation
            seen = Transform(rotation, body.apply(TAIL[None])[0] + e[:3] - rotation @ TAIL)
            tracker.update(k * DT, seen, TAIL, NOISE, alike=alike if modeled else None)
        estimate = known(tracker.newest)
        np.linalg.cholesky(estimate.covariance)
        off = error(estimate, body, VELOCITY)[:3]
        squares.append(off @ np.linalg.solve(estimate.covariance[:3, :3], off))
    assert least < np.mean(squares) < most


def test_alike_errors_are_forgotten_once_measurements_have_none() -> None:
    with_some, without = NeighborFilter(), NeighborFilter()
    for k in range(90):
        seen = measured(truth(k * DT))
        with_some.update(k * DT, seen, TAIL, NOISE, alike=0.8 * NOISE if k < 30 else None)
        update(without, k * DT, seen)
        if k == 29:
            assert (known(with_some.newest).covariance[0, 0]
                    > 2.0 * known(without.newest).covariance[0, 0])
    np.testing.assert_allclose(known(with_some.newest).covariance[:3, :3],
                               known(without.newest).covariance[:3, :3], rtol=0.1, atol=1e-7)


@pytest.mark.parametrize(('rate', 'images'), [(30.0, 6), (15.0, 4), (10.0, 3), (7.0, 3)])
def test_a_contradicted_attitude_is_dropped_within_0_3_s(rate: float, images: int) -> None:
    tracker, period = NeighborFilter(), 1.0 / rate
    for k in range(20):
        update(tracker, k * period, mirrored(measured(truth(k * period))))
    outcomes = [update(tracker, k * period, measured(truth(k * period)))
                for k in range(20, 20 + images)]
    assert outcomes == [UpdateOutcome.POSITION_ONLY] * (images - 1) + [UpdateOutcome.STARTED]
    assert (images - 1) * period < 0.3


@pytest.mark.parametrize(('t', 'outcome'), [
    (1.9, UpdateOutcome.OLDER), (2.0, UpdateOutcome.OLDER), (3.0, UpdateOutcome.USED),
    (4.5, UpdateOutcome.STARTED), (0.1, UpdateOutcome.STARTED)])  # a gap; a jump back in time
def test_late_and_repeated_frames_are_dropped_jumps_restart(
        t: float, outcome: UpdateOutcome) -> None:
    tracker = tracked(2.0)
    before = now(tracker, 2.0)
    assert update(tracker, t, truth(t)) is outcome
    if outcome is UpdateOutcome.OLDER:
        np.testing.assert_array_equal(now(tracker, 2.0).position, before.position)
    if outcome is UpdateOutcome.STARTED:
        np.testing.assert_allclose(now(tracker, t).position, truth(t).translation, atol=1e-9)


def test_twist_is_given_in_the_neighbors_body() -> None:
    twist = now(tracked(5.0, noisy=False), 5.0).child_twist
    np.testing.assert_allclose(twist[:3], truth(5.0).rotation.T @ VELOCITY, atol=3e-3)
    np.testing.assert_allclose(twist[3:], [0.0, 0.0, RATE], atol=3e-3)


def test_twist_covariance_is_that_of_perturbed_states() -> None:
    estimate = now(tracked(0.2), 0.2)
    rng = np.random.default_rng(1)
    twists = []
    for e in rng.multivariate_normal(np.zeros(15), 1e-4 * estimate.covariance, 20000):
        rotation = rotation_vector_to_matrix(e[6:9]) @ estimate.rotation
        twists.append(np.concatenate([rotation.T @ (estimate.velocity + e[3:6]),
                                      rotation.T @ (estimate.angular_velocity + e[9:12])]))
    actual = 1e4 * np.cov(np.transpose(twists))
    ratios = np.linalg.eigvals(np.linalg.solve(actual, estimate.child_twist_covariance)).real
    assert ratios.min() > 0.9
    assert ratios.max() < 1.1
