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

"""The neighbor filter: motion, consistency, late frames, time jumps, levers, distances."""

from __future__ import annotations

import math

from marker_images import known
import numpy as np
import pytest
from tracked_neighbor import (
    DT,
    error,
    measured,
    mirrored,
    moved,
    NOISE,
    now,
    RATE,
    TAIL,
    tracked,
    truth,
    update,
    VELOCITY,
)

from flock_follower.geometry import Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.perception.innovation import ALIKE_TIME
from flock_follower.perception.neighbor_filter import (
    FilterParams,
    NeighborFilter,
    UpdateOutcome,
)


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


def test_alike_errors_of_a_mirrored_attitude_are_of_the_place() -> None:
    tracker, alike = NeighborFilter(), 0.8 * NOISE
    for k in range(10):
        tracker.update(k * DT, measured(truth(k * DT)), TAIL, NOISE, alike=alike)
    body = mirrored(measured(truth(10 * DT)))
    assert tracker.update(10 * DT, body, TAIL, NOISE, alike=alike) is UpdateOutcome.POSITION_ONLY
    np.linalg.cholesky(known(tracker.newest).covariance)


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


def test_a_track_begins_with_the_deviations_of_its_parameters() -> None:
    params = FilterParams(initial_speed=0.7, acceleration=0.4)
    tracker = NeighborFilter(params)
    assert update(tracker, 0.0, truth(0.0)) is UpdateOutcome.STARTED
    begun = now(tracker, 0.0)
    np.testing.assert_allclose(np.sqrt(np.diag(begun.covariance)[3:]), [
        0.7, 0.7, 0.7, 0.02, 0.02, 0.01, 0.5, 0.5, 0.5, 0.4, 0.4, 0.4])
    np.testing.assert_array_equal(np.concatenate(
        [begun.velocity, begun.angular_velocity, begun.acceleration]), np.zeros(9))
    np.testing.assert_array_equal(begun.position, truth(0.0).translation)
    np.testing.assert_array_equal(begun.rotation, truth(0.0).rotation)


def test_restart_of_an_attitude_keeps_what_is_known_of_motion() -> None:
    tracker = NeighborFilter()
    for k in range(60):
        update(tracker, k * DT, mirrored(measured(truth(k * DT))))
    for k in range(60, 66):
        expected = now(tracker, k * DT)
        outcome = update(tracker, k * DT, measured(truth(k * DT)))
    assert outcome is UpdateOutcome.STARTED
    begun, motion = now(tracker, 65 * DT), np.r_[3:6, 12:15]
    np.testing.assert_array_equal(begun.velocity, expected.velocity)
    np.testing.assert_array_equal(begun.acceleration, expected.acceleration)
    np.testing.assert_array_equal(begun.covariance[np.ix_(motion, motion)],
                                  expected.covariance[np.ix_(motion, motion)])
    np.testing.assert_array_equal(begun.covariance[9:12, 9:12], 0.5**2 * np.eye(3))


def test_a_place_is_the_last_one_moved_by_the_velocity() -> None:
    tracker = tracked(1.0)
    assert NeighborFilter().place(0.0) is None
    last = now(tracker, 1.0)
    for t in (1.0, 1.5, 3.0):
        place = known(tracker.place(t))
        np.testing.assert_allclose(place.translation, last.position + (t - 1.0) * last.velocity)
        np.testing.assert_array_equal(place.rotation, last.rotation)
    assert tracker.place(0.99) is None and tracker.place(3.01) is None  # max_gap is 2 s


def test_a_state_near_the_last_one_is_known_before_and_after() -> None:
    assert NeighborFilter().near(1.0) is None
    tracker = tracked(2.0, noisy=False)
    assert tracker.near(2.0) is tracker.newest
    for t in (1.9, 2.1):
        estimate = known(tracker.near(t))
        assert estimate.stamp == t
        np.testing.assert_allclose(estimate.position, truth(t).translation, atol=5e-3)
    np.testing.assert_array_equal(estimate.covariance, now(tracker, 2.1).covariance)


def test_a_continued_filter_bridges_longer_gaps() -> None:
    tracker = tracked(10.0)  # a steady flight: it learns that little changes
    tracker.walk = 0.02
    other = tracker.continued(5.0)
    assert tracker.predict(14.0) is None and other.predict(14.0) is not None
    assert other.newest is tracker.newest
    assert tracker.predict(12.0) is not None and other.params.max_rejections == 6
    soon, of_other = now(tracker, 10.2), now(other, 10.2)
    np.testing.assert_array_equal(of_other.position, soon.position)
    for k in range(6):
        assert of_other.covariance[k, k] > soon.covariance[k, k]
    # The drift of the ego position is kept, too.
    still = tracked(10.0).continued(5.0)
    drift = of_other.covariance - now(still, 10.2).covariance
    np.testing.assert_allclose(drift[:3, :3], 0.02**2 * 0.2 * np.eye(3), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(drift[3:], 0.0, atol=1e-12)


def test_an_error_found_elsewhere_moves_the_state_and_widens_it() -> None:
    NeighborFilter().add_error(np.ones(15))  # without a track it has no effect
    tracker = tracked(1.0)
    before, wrong = known(tracker.newest), np.zeros(15)
    wrong[:3] = 0.03, -0.04, 0.0
    now(tracker, 1.1)  # what was predicted before does not stay
    tracker.add_error(wrong)
    after = known(tracker.newest)
    assert after.stamp == before.stamp
    np.testing.assert_allclose(after.position, before.position + wrong[:3])
    assert now(tracker, 1.1).position[0] > before.position[0] + 0.1 * before.velocity[0] + 0.02
    widened = np.outer(wrong, wrong)
    widened[3:6, 3:6] += (0.05 / 0.2)**2 * np.eye(3)
    np.testing.assert_allclose(after.covariance - before.covariance, widened, atol=1e-12)
    update(tracker, 1.0 + DT, truth(1.0 + DT))
    assert tracker.change is None  # the innovation before had the error


def test_a_change_is_that_of_two_innovations_in_a_row() -> None:
    tracker = NeighborFilter()
    innovations, spreads = [], []
    for k, offset in enumerate((0.0, 0.004, -0.003)):
        body = moved(truth(k * DT), offset, 0.0, 0.0)
        expected = tracker.predict(k * DT)
        tracker.update(k * DT, body, np.zeros(3), NOISE)
        if expected is None:
            assert tracker.change is None
            continue
        innovations.append(np.concatenate([
            body.translation - expected.position,
            matrix_to_rotation_vector(body.rotation @ expected.rotation.T)]))
        spreads.append(expected.pose_covariance + NOISE)
        assert (tracker.change is None) == (k < 2)
    change = known(tracker.change)
    np.testing.assert_allclose(change.difference, innovations[1] - innovations[0], atol=1e-12)
    np.testing.assert_allclose(change.covariance, spreads[0] + spreads[1], atol=1e-12)


def test_a_change_without_attitude_is_of_the_position() -> None:
    tracker, t = tracked(1.0), 1.0 + DT
    for body in (mirrored(truth(t)), truth(t + DT)):  # either of the two lacks the attitude
        update(tracker, t, body)
        change = known(tracker.change)
        assert change.difference.shape == (3,) and change.covariance.shape == (3, 3)
        t += DT
    update(tracker, t, truth(t))
    assert known(tracker.change).difference.shape == (6,)


@pytest.mark.parametrize(('gap', 'known_change'), [(0.29, True), (0.31, False)])
def test_a_change_over_a_gap_is_unknown(gap: float, known_change: bool) -> None:
    tracker = tracked(1.0)
    update(tracker, 1.0 + gap, truth(1.0 + gap))
    assert (tracker.change is not None) == known_change


def test_a_distance_makes_the_state_that_of_two_measurements() -> None:
    tracker, t, variance = tracked(2.0), 2.1, 0.02**2
    before = now(tracker, t)
    own = np.array([0.5, -1.0, 1.0])
    sight = before.position - own
    length = float(np.linalg.norm(sight))
    along = sight / length
    tracker.update_range(t, length + 0.01, own, variance)
    after = known(tracker.newest)
    prior = float(along @ before.covariance[:3, :3] @ along)
    gain = prior / (prior + variance)
    assert along @ (after.position - before.position) == pytest.approx(0.01 * gain)
    assert along @ after.covariance[:3, :3] @ along == pytest.approx((1.0 - gain) * prior)
    # Velocity and acceleration follow, along the line of sight only.
    of_velocity = float(along @ before.covariance[3:6, :3] @ along) / (prior + variance)
    np.testing.assert_allclose(after.velocity - before.velocity, 0.01 * of_velocity * along)
    assert (after.acceleration - before.acceleration) @ along > 0.0
    assert tracker.change is None and after.stamp == t
    np.testing.assert_array_equal(after.rotation, before.rotation)
    np.testing.assert_allclose(after.covariance, after.covariance.T, atol=1e-15)


@pytest.mark.parametrize('turns', [0.1, 3.0])  # rad: known, and unknown
def test_an_antenna_off_the_line_makes_a_distance_less_certain(turns: float) -> None:
    noise, arm = np.diag([0.01, 0.01, 0.01, turns, turns, turns])**2, np.array([0.0, 0.3, 0.0])
    tracker = NeighborFilter()
    tracker.update(0.0, Transform(translation=np.array([2.0, 0.0, 0.0])), np.zeros(3), noise)
    place = np.array([2.0, 0.3, 0.0])
    length = float(np.linalg.norm(place))
    along = place / length
    prior = now(tracker, 0.1).covariance
    swing = np.cross(arm, along)
    spread = float(along @ prior[:3, :3] @ along)
    noise_of_distance = 0.01 + min(float(swing @ prior[6:9, 6:9] @ swing), 0.3**2)
    tracker.update_range(0.1, length + 0.05, np.zeros(3), 0.01, arm)
    moved_by = float(along @ (known(tracker.newest).position - [2.0, 0.0, 0.0]))
    assert moved_by == pytest.approx(0.05 * spread / (spread + noise_of_distance))


def test_a_distance_to_where_one_is_has_no_direction() -> None:
    tracker = tracked(1.0)
    before, place = known(tracker.newest), now(tracker, 1.1).position
    for off, outcome in ((0.009, UpdateOutcome.OUTLIER), (0.011, UpdateOutcome.USED)):
        own = place - np.array([off, 0.0, 0.0])
        assert tracker.update_range(1.1, off, own, 0.01) is outcome
        assert (tracker.newest is before) == (outcome is UpdateOutcome.OUTLIER)
