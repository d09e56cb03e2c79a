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

"""Figures that evaluate, demo and fly share, each of one definition."""

from __future__ import annotations

import numpy as np
import pytest

from flock_desk.runs.frame_errors import Table
from flock_desk.runs.record import compared, judged
from flock_desk.runs.summary import (
    consistency,
    hold_figures,
    jsonable,
    most,
    rate,
    sight_figures,
    spread,
)
from flock_follower.geometry import Array, quaternion_from_yaw, quaternion_to_matrix, Transform
from flock_follower.messages import OdometryState, RELATIVE
from flock_follower.perception.neighbor_filter import Estimate

SECOND = 10**9
STAMPS = np.arange(20) * SECOND // 10


def straight(offset: list[float], yaw: float = 0.0) -> list[OdometryState]:
    """Return states moving along x at 1 m/s from an offset, all turned by a yaw (drift)."""
    turn = Transform.from_quaternion([0.0, 0.0, 0.0], quaternion_from_yaw(yaw))
    unknown = np.zeros((6, 6))
    return [OdometryState(
        int(stamp), 'odom', 'leader', turn.apply(np.add(offset, [stamp / SECOND, 0.0, 0.0])),
        quaternion_from_yaw(yaw), turn.apply([1.0, 0.0, 0.0]), np.zeros(3), unknown, unknown,
        np.eye(3)) for stamp in STAMPS]


def found(states: list[OdometryState], error: Array | None = None,
          variance: float = 1e-4) -> dict[int, dict[str, Estimate]]:
    """Return estimates of states, their velocities wrong by an error, m/s."""
    error = np.zeros(3) if error is None else error
    return {s.stamp: {'leader': Estimate(
        s.stamp / SECOND, s.position, s.velocity + error, quaternion_to_matrix(s.quaternion),
        np.zeros(3), np.zeros(3), variance * np.eye(15))} for s in states}


def table(estimates: dict[int, dict[str, Estimate]], leader: list[float],
          yaw: float = 0.0, visible: Array | None = None) -> Table:
    """Return the table of estimates where the leader really was at an offset."""
    return compared(estimates, straight([0.0, 0.0, 0.0], yaw), straight([5.0, 0.0, 1.0]),
                    straight(np.add(leader, [5.0, 0.0, 1.0]).tolist()), STAMPS,
                    np.ones(len(STAMPS)) if visible is None else visible, 0)


def test_images_of_flight_without_odometry_are_not_judged() -> None:
    states = straight([2.0, 0.0, 0.0])
    states[1] = states[1]._replace(frame=RELATIVE)
    np.testing.assert_array_equal(
        judged(np.array([True, True, False]), STAMPS[:3], states), [1.0, np.nan, 0.0])


def test_an_offset_of_the_neighbor_is_the_error() -> None:
    estimates = found(straight([2.0, 0.0, 0.0]), np.array([0.0, 0.1, 0.0]))
    figures = sight_figures([table(estimates, [2.03, 0.04, 0.0])], 1.0)
    assert figures['position_rms_m'] == pytest.approx(0.05)
    assert figures['position_bias_m']['x'] == pytest.approx(-0.03)
    assert figures['velocity_rms_m_s'] == pytest.approx(0.1)
    assert figures['distance_rms_m'] == pytest.approx(np.hypot(2.03, 0.04) - 2.0)
    assert figures['true_distance_m']['max'] == pytest.approx(np.hypot(2.03, 0.04))
    # What is published does not tell how consistent the velocity is.
    assert figures['nees_position'] == pytest.approx(25.0) and figures['nees_velocity'] is None


def test_velocity_refused_by_planner_counts_among_all_only() -> None:
    estimates = found(straight([2.0, 0.0, 0.0]))
    first = STAMPS[0]
    estimates[first] = found(straight([2.0, 0, 0])[:1], np.array([4.0, 0.0, 0.0]), 0.5)[first]
    figures = sight_figures([table(estimates, [2.0, 0.0, 0.0])], 1.0)
    assert figures['velocity_rms_m_s'] == pytest.approx(0.0, abs=1e-9)
    assert figures['velocity_rms_of_all_m_s'] == pytest.approx(4.0 / np.sqrt(20))


def test_missing_estimate_lowers_recall_only_in_view() -> None:
    some = found(straight([2.0, 0.0, 0.0])[::2])
    figures = sight_figures([table(some, [2.0, 0.0, 0.0])], 1.0)
    assert figures['recall'] == 0.5 and figures['position_rms_m'] == pytest.approx(0.0, abs=1e-9)
    visible = np.tile([1.0, 0.0], 10)
    figures = sight_figures([table(some, [2.0, 0.0, 0.0], visible=visible)], 1.0)
    assert figures['recall'] == 1.0 and figures['frames_in_view'] == 10
    assert sight_figures([table({}, [2.0, 0.0, 0.0])], 1.0)['recall'] == 0.0


def test_what_is_not_known_is_none() -> None:
    nothing = sight_figures([table({}, [2.0, 0.0, 0.0])], 1.0)
    assert nothing['position_rms_m'] is None and nothing['distance_m']['min'] is None
    assert spread(np.array([1.0, 2.0, 6.0])) == {'min': 1.0, 'mean': 3.0, 'max': 6.0}
    assert most(np.array([1.0, np.inf])) is None and most(np.array([np.nan, 1.0])) is None
    assert jsonable({'a': {'b': np.nan, 'c': float('inf'), 'd': 1.0}}) == {
        'a': {'b': None, 'c': None, 'd': 1.0}}


def test_a_hold_is_told_with_its_length_and_reason() -> None:
    states = [(-1.0, 'IDLE'), (0.2, 'TRACK'), (4.0, 'HOLD'), (6.5, 'TRACK'), (7.0, 'HOLD'),
              (7.1, 'TRACK'), (9.0, 'HOLD')]
    reasons = [(3.5, ''), (4.5, 'no neighbor seen for 2.5 s'), (5.5, 'no neighbor seen for 3.5 s'),
               (9.5, 'odometry too old'), (10.5, 'after the end')]
    figures = hold_figures(states, reasons, 10.0)
    assert figures['planner'] == {'hold_count': 3, 'hold_s': pytest.approx(3.6)}
    assert figures['holds'] == {
        'at_4.0_s': '2.5 s: no neighbor seen for 2.5 s',
        'at_7.0_s': '0.1 s: too short: its reason was not published on /diagnostics',
        'at_9.0_s': '1.0 s: odometry too old'}
    assert hold_figures([], [], 1.0) == {'planner': {'hold_count': 0, 'hold_s': 0.0}, 'holds': {}}


def test_a_rate_counts_intervals_and_a_nees_has_a_verdict() -> None:
    assert rate(np.arange(11) * 0.1) == pytest.approx(10.0)
    assert rate(np.array([1.0])) == 0.0
    assert [consistency(nees) for nees in (None, 1.4, 3.0, 6.1)] == [
        '', 'covariances too large', 'consistent', 'covariances too small']
