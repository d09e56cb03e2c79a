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

"""What the filter of a neighbor refuses, doubts, or takes for a mirrored attitude."""

from __future__ import annotations

import math

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
    TAIL,
    tracked,
    truth,
    update,
    VELOCITY,
)

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)
from flock_follower.perception.innovation import to_body
from flock_follower.perception.neighbor_filter import (
    FilterParams,
    GATE_CHI2,
    NeighborFilter,
    UpdateOutcome,
)


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


@pytest.mark.parametrize(('rate', 'images'), [(30.0, 6), (15.0, 4), (10.0, 3), (7.0, 3)])
def test_a_contradicted_attitude_is_dropped_within_0_3_s(rate: float, images: int) -> None:
    tracker, period = NeighborFilter(), 1.0 / rate
    for k in range(20):
        update(tracker, k * period, mirrored(measured(truth(k * period))))
    outcomes = [update(tracker, k * period, measured(truth(k * period)))
                for k in range(20, 20 + images)]
    assert outcomes == [UpdateOutcome.POSITION_ONLY] * (images - 1) + [UpdateOutcome.STARTED]
    assert (images - 1) * period < 0.3


def test_a_new_track_drops_its_attitude_as_soon_as_an_old_one() -> None:
    tracker, period = NeighborFilter(), 1.0 / 15.0
    update(tracker, 0.0, mirrored(truth(0.0)))
    outcomes = [update(tracker, k * period, truth(k * period)) for k in range(1, 5)]
    assert outcomes == [UpdateOutcome.POSITION_ONLY] * 3 + [UpdateOutcome.STARTED]


def gated(off: float, tracker: NeighborFilter | None = None, t: float = 1.0 + DT,
          reach: float = math.inf) -> tuple[UpdateOutcome, Array, float]:
    """
    Return what a measurement sideways does whose chi^2 is ``off`` times the gate's.

    These are the outcome, how far it moves the state, and the way measured, m. A negative ``off``
    is the same on the other side.
    """
    tracker = tracker or tracked(1.0)
    before = now(tracker, t)
    # The position of the body: the lever adds the noise of the attitude.
    lever = to_body(before.rotation @ TAIL)
    spread = before.covariance[:3, :3] + (lever @ NOISE @ lever.T)[:3, :3]
    way = np.array([0.0, 1.0, 0.0])
    way *= math.copysign(
        math.sqrt(abs(off) * GATE_CHI2 / (way @ np.linalg.solve(spread, way))), off)
    there = Transform(before.rotation, before.position + way)
    outcome = tracker.update(t, there, TAIL, NOISE, reach)
    return outcome, now(tracker, t).position - before.position, float(way[1])


@pytest.mark.parametrize(('off', 'outcome'), [
    (0.999, UpdateOutcome.USED), (1.001, UpdateOutcome.SURPRISING),
    (9.999, UpdateOutcome.SURPRISING), (10.001, UpdateOutcome.OUTLIER)])
def test_the_gate_is_one_chi2_and_refuses_ten(off: float, outcome: UpdateOutcome) -> None:
    assert gated(off)[0] is outcome


@pytest.mark.parametrize(('off', 'outcome'), [
    (0.999, UpdateOutcome.USED), (1.001, UpdateOutcome.OUTLIER)])
def test_reach_bounds_only_what_is_outside_the_gate(off: float, outcome: UpdateOutcome) -> None:
    assert gated(off, reach=0.0)[0] is outcome


def test_the_gate_holds_999_of_1000_good_measurements() -> None:
    # The distribution of chi^2 with 3 degrees of freedom.
    share = math.erf(math.sqrt(0.5 * GATE_CHI2)) - math.sqrt(
        2.0 * GATE_CHI2 / math.pi) * math.exp(-0.5 * GATE_CHI2)
    assert share == pytest.approx(0.999, abs=1e-5)


@pytest.mark.parametrize('off', [0.5, 1.5, 6.0])
def test_a_surprise_leaves_the_covariance_of_its_weight(off: float) -> None:
    tracker, t = tracked(1.0), 1.0 + DT
    before = now(tracker, t)
    gated(off, tracker, t)
    lever = to_body(before.rotation @ TAIL)
    spread = max(off, 1.0) * (before.pose_covariance + lever @ NOISE @ lever.T)
    across = before.covariance[np.r_[0:3, 6:9]]
    np.testing.assert_allclose(
        now(tracker, t).covariance,
        before.covariance - across.T @ np.linalg.solve(spread, across), rtol=1e-5, atol=1e-10)


def test_a_first_surprise_weighs_as_much_as_one_on_the_gate() -> None:
    _, on_gate, way = gated(1.0)
    for off in (2.0, 4.0, 9.0):
        _, moved_by, farther = gated(off)
        assert farther == pytest.approx(math.sqrt(off) * way)
        # The weight falls with the square of the way: so does the move with the way.
        np.testing.assert_allclose(moved_by, on_gate / math.sqrt(off), rtol=1e-6)


@pytest.mark.parametrize('off', [1.2, 5.0])
def test_any_second_surprise_on_the_same_side_weighs_more(off: float) -> None:
    shares = []
    for side in (1.0, -1.0):
        tracker = tracked(1.0)
        gated(off, tracker)
        _, moved_by, way = gated(side * off, tracker, 1.0 + 2.0 * DT)
        shares.append(float(moved_by[1]) / way)
    assert shares[0] > 1.15 * shares[1] > 0.0


def test_what_holds_nan_is_refused_and_changes_nothing() -> None:
    tracker, t = tracked(1.0), 1.0 + DT
    before = now(tracker, t)
    for body, covariance in ((moved(truth(t), math.nan, 0.0, 0.0), NOISE),
                             (truth(t), np.full((6, 6), math.nan))):
        assert tracker.update(t, body, TAIL, covariance) is UpdateOutcome.OUTLIER
        assert tracker.change is None
        np.testing.assert_array_equal(now(tracker, t).position, before.position)


def turned(body: Transform, angle: float) -> Transform:
    """Return a body turned by an angle, rad, about its tail."""
    rotation = rotation_vector_to_matrix([0.0, 0.0, angle]) @ body.rotation
    return Transform(rotation, body.apply(TAIL[None])[0] - rotation @ TAIL)


def test_second_surprising_attitude_counts_on_the_same_side_only() -> None:
    shares = []
    for side in (1.0, -1.0):
        tracker, t = tracked(1.0), 1.0 + DT
        spread = now(tracker, t).covariance[8, 8] + NOISE[5, 5]
        angle = math.sqrt(4.0 * GATE_CHI2 * spread)
        assert angle < 0.3  # else it counts as mirrored
        assert update(tracker, t, turned(truth(t), angle)) is not UpdateOutcome.POSITION_ONLY
        before = now(tracker, t + DT).rotation
        update(tracker, t + DT, turned(truth(t + DT), side * angle))
        after = now(tracker, t + DT).rotation
        shares.append(side * matrix_to_rotation_vector(after @ before.T)[2] / angle)
    assert shares[0] > 1.5 * shares[1] > 0.0


def test_a_first_surprising_attitude_weighs_as_one_on_the_gate() -> None:
    turns = []
    for off in (0.999, 4.0):
        tracker, t = NeighborFilter(), 31 * DT
        for k in range(31):  # without a lever no position depends on the attitude
            tracker.update(k * DT, truth(k * DT), np.zeros(3), NOISE)
        before = now(tracker, t)
        angle = math.sqrt(off * GATE_CHI2 * (before.covariance[8, 8] + NOISE[5, 5]))
        turn = rotation_vector_to_matrix([0.0, 0.0, angle])
        tracker.update(t, Transform(turn @ before.rotation, before.position), np.zeros(3), NOISE)
        turns.append(matrix_to_rotation_vector(now(tracker, t).rotation @ before.rotation.T)[2])
    assert turns[1] == pytest.approx(0.5 * turns[0], rel=2e-3) and turns[0] > 0.005


@pytest.mark.parametrize(('angle', 'outcome'), [
    (0.29, UpdateOutcome.USED), (0.31, UpdateOutcome.POSITION_ONLY)])
def test_attitude_outside_the_gate_is_mirrored_from_0_3_rad(
        angle: float, outcome: UpdateOutcome) -> None:
    tracker, t = tracked(1.0), 1.0 + DT
    body = truth(t)
    before, noise = now(tracker, t), NOISE + np.diag([0.0, 0.0, 0.0, 0.03, 0.03, 0.03])**2
    spread = before.covariance[8, 8] + noise[5, 5]
    assert GATE_CHI2 < angle**2 / spread < 10.0 * GATE_CHI2
    there = Transform(rotation_vector_to_matrix([0.0, 0.0, angle]) @ before.rotation,
                      body.translation)
    assert tracker.update(t, there, np.zeros(3), noise) is outcome


def test_many_contradictions_restart_a_fast_camera_early() -> None:
    tracker, period = tracked(1.0, params=FilterParams(max_rejections=4)), 0.002
    outcomes = [update(tracker, 1.0 + k * period, mirrored(truth(1.0 + k * period)))
                for k in range(1, 5)]
    assert outcomes == [UpdateOutcome.POSITION_ONLY] * 3 + [UpdateOutcome.STARTED]


def test_an_agreeing_attitude_ends_a_row_of_contradictions() -> None:
    tracker, t = tracked(1.0), 1.0
    for contradicts in (True, True, False) * 8:
        t += 0.1
        body = mirrored(truth(t)) if contradicts else truth(t)
        assert update(tracker, t, body) is (
            UpdateOutcome.POSITION_ONLY if contradicts else UpdateOutcome.USED)


@pytest.mark.parametrize(('distance', 'outcomes'), [
    # Too long by a detour: refused. Too short: used with care, and with more weight the second
    # time.
    (4.0, [UpdateOutcome.OUTLIER] * 2), (-0.6, [UpdateOutcome.SURPRISING] * 2)])
def test_a_distance_outside_its_gate(distance: float, outcomes: list[UpdateOutcome]) -> None:
    tracker, found, moves = tracked(1.0), [], []
    for t in (1.1, 1.2):
        before = now(tracker, t).position
        length = float(np.linalg.norm(before))
        found.append(tracker.update_range(t, length + distance, np.zeros(3), 0.01))
        moves.append(length - float(np.linalg.norm(now(tracker, t).position)))
    assert found == outcomes
    assert moves[0] == pytest.approx(0.0) if distance > 0.0 else 0.0 < 2.0 * moves[0] < moves[1]
