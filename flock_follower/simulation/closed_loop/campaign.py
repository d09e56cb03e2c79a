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

"""
Flights in lock step: leader, air, vehicle and sensors around the real planner and setpoint gate.

No clock, no rendering, no messages: what is flown is ``planner.step`` at 10 Hz and
``SetpointGate.decide`` at 20 Hz, the functions of the nodes. The world around them advances by
STEP for many runs at once. The neighbour filter is that of ``sensing``, fed at 30 Hz with
positions whose noise has the covariance it is told; the marker is taken to be visible from
everywhere in the field of view.

============  ========  =======================================================
what          rate, Hz  remark
============  ========  =======================================================
vehicle, air  120       first the vehicle moves, then everything looks
odometry      60        arrives within the step
images        30        estimates arrive ``latency`` later
planner       10        from ENGAGED on
gate          20        the vehicle obeys at once, with its lags
============  ========  =======================================================
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flock_follower.geometry import Array
from flock_follower.mavlink.gate import AUTOPILOT, GateLimits, ODOM
from flock_follower.mavlink.setpoint_gate import SetpointGate
from flock_follower.planner.step import (
    Decision,
    Memory,
    NeighborEstimate,
    OwnState,
    State,
    step,
)
from flock_follower.simulation.closed_loop.world import GATE_STEPS, World
from flock_follower.simulation.scenarios.leader import STEP
from flock_follower.simulation.scenarios.scenario import Scenario
from flock_follower.simulation.sensors.sensing import PerceptionNoise

ENGAGED = 1.0  # s: when the planner is engaged
PLANNER_STEPS = 12
STATES = tuple(State)


@dataclass(frozen=True)
class Flights:
    """
    What n runs of a scenario did, from engaging on, every planner tick (k of them).

    Everything is true, not estimated; vectors are ENU.
    """

    scenario: Scenario
    times: Array
    """(k,), s."""
    leader: Array
    """(n, k, 3), m."""
    follower: Array
    """(n, k, 3), m."""
    leader_velocity: Array
    """(n, k, 3), m/s."""
    velocity: Array
    """(n, k, 3), m/s."""
    nearest: Array
    """(n, k), least distance up to the next tick, m."""
    farthest: Array
    """(n, k), greatest distance up to the next tick, m."""
    outside: Array
    """(n, k), time out of the band up to the next tick, s."""
    command: Array
    """(n, k, 3), commanded acceleration, m/s^2; NaN where there was none."""
    state: Any
    """(n, k), index into ``STATES``."""
    guarded: Any
    """(n, k), whether the guard altered the command."""
    seen: Any
    """(n, k), whether an image since the last tick showed the leader."""


def fly(scenario: Scenario, runs: Sequence[int], guard: bool,
        noise: PerceptionNoise | None = None,
        progress: Callable[[float], None] | None = None) -> Flights:
    """
    Fly some runs of a scenario and return what they did.

    :param runs: their numbers, which seed everything random in them.
    :param guard: whether the planner's guard is on.
    :param progress: called with the share that is done, now and then.
    """
    world = World(scenario, runs, noise or PerceptionNoise())
    followers = [_Follower(scenario, guard) for _ in runs]
    count = round(scenario.duration / STEP)
    record = _Record(len(runs))
    for k in range(1, count + 1):
        now = k * STEP
        world.advance(k)
        record.distances(world.distance, scenario)
        if k % PLANNER_STEPS == 0 and now >= ENGAGED - 1e-9:
            odometry, estimates = world.odometry(now), world.estimates(now)
            decisions = [follower.plan(now, own, seen) for follower, own, seen in zip(
                followers, odometry, estimates)]
            record.tick(now, world, decisions)
            if progress is not None and k % (20 * PLANNER_STEPS) == 0:
                progress(k / count)
        if k % GATE_STEPS == GATE_STEPS // 2:
            world.obey([follower.setpoint(now, *known) for follower, known in zip(
                followers, world.velocities(now))])
    return record.flights(scenario)


class _Follower:
    """One run's planner and setpoint gate."""

    def __init__(self, scenario: Scenario, guard: bool) -> None:
        self._params = scenario.flight.planner(guard)
        self._memory = Memory()
        self._gate = SetpointGate(GateLimits(a_max=scenario.flight.a_max,
                                             v_max=scenario.flight.v_max))

    def plan(self, now: float, own: OwnState | None,
             seen: list[NeighborEstimate]) -> Decision:
        self._memory, decision = step(self._memory, now, True, own, seen, self._params)
        if decision.acceleration is not None and decision.yaw is not None:
            source = now if decision.stamp is None else decision.stamp
            self._gate.accept_command(decision.acceleration, decision.yaw, 0.0, now,
                                      source_age=now - source)
        return decision

    def setpoint(self, now: float, own: OwnState | None,
                 velocity: Array) -> tuple[Array, float | None]:
        if own is not None:
            self._gate.update_velocity(ODOM, own.velocity, now - own.stamp, now)
        self._gate.update_velocity(AUTOPILOT, velocity, 0.0, now)
        sent = self._gate.decide(now).setpoint
        return sent.acceleration, sent.yaw


class _Record:
    """Collects what the flights did."""

    def __init__(self, count: int) -> None:
        self._rows: dict[str, list[Any]] = {name: [] for name in (
            'times', 'leader', 'follower', 'leader_velocity', 'velocity', 'nearest', 'farthest',
            'outside', 'command', 'state', 'guarded', 'seen')}
        self._count = count
        self._nearest: Array = np.zeros(count)
        self._farthest: Array = np.zeros(count)
        self._outside: Array = np.zeros(count)

    def distances(self, distance: Array, scenario: Scenario) -> None:
        self._nearest = np.minimum(self._nearest, distance)
        self._farthest = np.maximum(self._farthest, distance)
        out = (distance ** 2 <= scenario.flight.d0) | (distance ** 2 >= scenario.flight.d1)
        self._outside = self._outside + STEP * out

    def tick(self, now: float, world: World, decisions: list[Decision]) -> None:
        self._close()
        add = {
            'times': now, 'leader': world.leader, 'follower': world.vehicle.position,
            'leader_velocity': world.leader_velocity, 'velocity': world.vehicle.velocity,
            'command': np.array([np.full(3, np.nan) if d.acceleration is None else d.acceleration
                                 for d in decisions]),
            'state': np.array([STATES.index(d.state) for d in decisions]),
            'guarded': np.array(['separation' in d.limits or 'cohesion' in d.limits
                                 for d in decisions]),
            'seen': world.seen}
        for name, value in add.items():
            self._rows[name].append(value)
        world.seen = np.zeros(self._count, dtype=bool)
        self._nearest = self._farthest = world.distance
        self._outside = np.zeros(self._count)

    def _close(self) -> None:
        """End the interval since the last tick; what was before the first does not count."""
        if self._rows['times']:
            for name, value in (('nearest', self._nearest), ('farthest', self._farthest),
                                ('outside', self._outside)):
                self._rows[name].append(value)

    def flights(self, scenario: Scenario) -> Flights:
        self._close()
        times = np.array(self._rows.pop('times'))
        return Flights(scenario, times, **{
            name: np.stack(rows, axis=1) for name, rows in self._rows.items()})
