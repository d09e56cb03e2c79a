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

"""Slow odometry is flown on steadily; lost odometry is braked on as soon as it is overdue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.geometry import IDENTITY_QUATERNION
from flock_follower.messages import from_odometry, odometry, OdometryState
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.step import Decision

PARAMS = PlannerParams()
TIMEOUT = PARAMS.odom_timeout
SECOND = 10**9
START = 1_700_000_000 * SECOND


@dataclass
class Source:
    """Odometry at a rate, Hz, that arrives ``latency`` +- ``jitter``, s, after its stamp."""

    rate: float
    latency: float = 0.06
    jitter: float = 0.0
    phase: float = 0.0
    """s by which the first stamp comes after the first tick."""

    def arrivals(self, seconds: float) -> list[tuple[int, int]]:
        """Return arrival and stamp, ns, of all that is sent in this time, in order."""
        rng = np.random.default_rng(4)
        sent, arrival = [], 0
        for k in range(round(seconds * self.rate)):
            stamp = START + round((self.phase + k / self.rate) * SECOND)
            late = self.latency + rng.uniform(-self.jitter, self.jitter)
            arrival = max(arrival, stamp + round(late * SECOND))  # none overtakes another
            sent.append((arrival, stamp))
        return sent


def take(loop: PlannerLoop, stamp: int, arrival: int) -> None:
    loop.take_odometry(OdometryState(
        stamp, 'odom', 'base_link', np.array([0.0, 0.0, 2.0]), IDENTITY_QUATERNION, np.zeros(3),
        np.zeros(3), np.zeros((6, 6)), np.zeros((6, 6)), np.eye(3)), arrival)


def fly(source: Source, seconds: float = 10.0,
        lost: float = np.inf) -> list[tuple[float, Decision]]:
    """
    Return the decisions of ticks at 10 Hz beside a leader who is always in sight, by their times.

    :param lost: from when on no odometry arrives any more, s.
    """
    loop = PlannerLoop(require_bridge=False)
    loop.engage(True)
    waiting = [(arrival, stamp) for arrival, stamp in source.arrivals(seconds)
               if arrival < START + lost * SECOND]
    decisions = []
    for tick in range(1, round(seconds * 10)):
        now = START + tick * SECOND // 10
        while waiting and waiting[0][0] <= now:
            arrival, stamp = waiting.pop(0)
            take(loop, stamp, arrival)
        loop.take_neighbor(from_odometry(odometry(
            empty, now, 'odom', 'leader', (2.0, 0.0, 2.0), IDENTITY_QUATERNION, (0.0, 0.1, 0.0))))
        decisions.append((tick / 10, loop.tick(now, PARAMS)[0]))
    return decisions


def changes(decisions: list[tuple[float, Decision]]) -> list[State]:
    """Return the states in their order, each once for as long as it lasts."""
    states = [decision.state for _, decision in decisions]
    return [state for k, state in enumerate(states) if k == 0 or state is not states[k - 1]]


@pytest.mark.parametrize('source', [
    Source(10.0, phase=0.05, jitter=0.001), Source(9.9), Source(10.0, 0.1),
    Source(15.0, 0.08, jitter=0.03), Source(6.0), Source(10.0, jitter=0.04), Source(60.0, 0.01),
    Source(30.0, 0.06, jitter=0.05)], ids=str)
def test_slow_odometry_is_followed_on_steadily(source: Source) -> None:
    decisions = fly(source)
    # Until the second one arrives nothing is known of its rhythm.
    assert {d.state for time, d in decisions if time > 0.4} == {State.TRACK}
    assert len(changes(decisions)) <= 3


@pytest.mark.parametrize('source', [
    Source(4.5, jitter=0.02), Source(10.0, 0.17), Source(60.0, 0.16)], ids=str)
def test_odometry_too_slow_to_fly_on_brakes_steadily_and_says_so(source: Source) -> None:
    decisions = fly(source)
    assert len(changes(decisions)) <= 4
    late = [decision for time, decision in decisions if time > 2.0]
    assert len({d.state for d in late}) == 1
    assert late[0].state in (State.HOLD, State.SEARCH)
    assert any(d.reason.startswith('odometry too slow (0.') for d in late)


@pytest.mark.parametrize(('source', 'most'), [
    (Source(60.0, 0.007), 0.15), (Source(20.0, 0.06), 0.15), (Source(7.0, 0.06), 0.24),
    (Source(10.0, 0.06, jitter=0.02), 0.18 * 1.2)], ids=str)
@pytest.mark.parametrize('lost', [5.98, 6.04])
def test_lost_odometry_is_braked_on_at_the_first_tick_after_it_is_overdue(
        source: Source, most: float, lost: float) -> None:
    last = max(stamp for arrival, stamp in source.arrivals(8.0)
               if arrival < START + lost * SECOND)
    ended = (last - START) / SECOND
    for time, decision in fly(source, 8.0, lost=lost):
        if time > ended + most + 1e-6:
            assert decision.state is State.HOLD
            assert decision.reason.startswith(('odometry late', 'odometry too old'))
        if time > ended + TIMEOUT + 1e-6:
            assert decision.acceleration is None


def test_the_same_odometry_again_tells_no_rhythm_and_a_jump_back_ends_it() -> None:
    loop = PlannerLoop(require_bridge=False)
    arrived = [(0, 0), (0, 1), (0, 2), (1, 3), (1, 4), (2, 4), (-1, 5)]  # stamp and arrival, s
    for (stamp, arrival), spans in zip(arrived, ([], [], [], [(0, 3)], [(0, 3)],
                                                 [(0, 3), (2, 3)], [])):
        take(loop, START + stamp * SECOND, START + arrival * SECOND)
        assert list(loop._spans) == spans
