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
Records simulated flights from engaging on: every planner tick, and the extremes between ticks.

Each array has one row per follower, see ``world``. A single follower follows the leader. In a
flock each follows the edges of its planner; before the first edge, the vehicle ahead of its start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flock_desk.closed_loop.simulated_follower import SimulatedFollower
from flock_desk.closed_loop.world import World
from flock_desk.scenarios.courses import STEP
from flock_desk.scenarios.flock import places
from flock_desk.scenarios.scenario import Scenario
from flock_follower.geometry import Array
from flock_follower.planner.modes import State
from flock_follower.planner.step import Decision

STATES = tuple(State)


@dataclass(frozen=True)
class Flights:
    """
    The motion of n rows of a scenario, from engaging on, at every planner tick (k of them).

    All values are ground truth; vectors are ENU. Each row is a follower: see ``world``.
    """

    scenario: Scenario
    times: Array
    """(k,), s."""
    leader: Array
    """(n, k, 3), the nearest vehicle that each follows, m."""
    follower: Array
    """(n, k, 3), m."""
    leader_velocity: Array
    """(n, k, 3), m/s."""
    velocity: Array
    """(n, k, 3), m/s."""
    nearest: Array
    """(n, k), least distance to any vehicle up to the next tick, m."""
    farthest: Array
    """(n, k), greatest distance to a followed vehicle up to the next tick, m."""
    outside: Array
    """(n, k), time out of the band up to the next tick, s; mean over the followed vehicles."""
    command: Array
    """(n, k, 3), commanded acceleration, m/s^2; NaN without one."""
    state: Any
    """(n, k), index into ``STATES``."""
    guarded: Any
    """(n, k), whether the guard altered the command."""
    seen: Any
    """(n, k), whether an image since the last tick showed a followed vehicle."""
    in_sight: Any
    """(n, k), the same of the newest image, outages and missed detections left out."""
    obeying: Any
    """(n, k), whether the vehicle flies setpoints."""
    unasked: Array
    """(n, k), setpoints sent without an offboard call."""
    shown: Any = None
    """(n, k), how many of the others images since the last tick showed."""
    edges: Any = None
    """(n, k), how many it follows."""
    cpu: Any = None
    """(n, k), CPU time of the tick, s."""
    positions: Any = None
    """(n / m, k, m + 1, 3), of all vehicles, the leader first, m."""


class FlightsLog:
    """Records the flights in a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._rows: dict[str, list[Any]] = {}
        self._times: list[float] = []
        rows, m = len(world.starts), len(world.others)
        flock = world.scenario.flock
        self._names = world.scenario.company.names
        self._others = np.tile(world.others, (rows // m, 1))
        ahead = [0] if flock is None else [place.ahead for place in places(flock)]
        self._edges: Any = self._others == np.tile(ahead, rows // m)[:, None]
        self._nearest: Array = np.zeros(rows)
        self._farthest: Array = np.zeros(rows)
        self._outside: Array = np.zeros(rows)

    def distances(self) -> None:
        """Take the distances after a step."""
        distance = self._world.distances
        band = self._world.scenario.flight
        farthest, edges = self._along(distance)
        self._nearest = np.minimum(self._nearest, distance.min(axis=1))
        self._farthest = np.maximum(self._farthest, farthest)
        out = edges & ((distance ** 2 <= band.d0) | (distance ** 2 >= band.d1))
        many = edges.sum(axis=1)
        # A follower without a vehicle to follow is out of the band.
        share = np.where(many > 0, out.sum(axis=1) / np.maximum(many, 1), 1.0)
        self._outside = self._outside + STEP * share

    def _along(self, distance: Array) -> tuple[Array, Any]:
        """Return the greatest distance (n,), and the edges (n, m), to those present."""
        edges = self._edges & np.isfinite(distance)
        return np.where(edges, distance, 0.0).max(axis=1), edges

    def tick(self, now: float, followers: Sequence[SimulatedFollower]) -> None:
        """Take the outcome of a tick of the planners."""
        self._close()
        world, rows = self._world, np.arange(len(followers))
        decisions = [follower.decision for follower in followers]
        if world.scenario.flock is not None:
            self._take_edges(decisions)
        distance = world.distances
        farthest, edges = self._along(distance)
        # The nearest that it follows.
        followed = np.where(edges, distance, np.inf).argmin(axis=1)
        lookout = world.lookout
        self._times.append(now)
        add = {
            'leader': world.of_others(world.positions)[rows, followed],
            'follower': world.vehicle.position,
            'leader_velocity': world.of_others(world.velocities)[rows, followed],
            'velocity': world.vehicle.velocity,
            'command': np.array([np.full(3, np.nan) if d.acceleration is None else d.acceleration
                                 for d in decisions]),
            'state': np.array([STATES.index(d.state) for d in decisions]),
            'guarded': np.array([d.guarded for d in decisions]),
            'seen': (lookout.seen & edges).any(axis=1),
            'in_sight': (lookout.in_sight & edges).any(axis=1),
            'obeying': np.array([f.vehicle.obeying_since is not None for f in followers]),
            'unasked': np.array([f.vehicle.unasked for f in followers]),
            'shown': lookout.seen.sum(axis=1), 'edges': edges.sum(axis=1),
            'cpu': np.array([f.cpu for f in followers]), 'positions': world.positions}
        for name, value in add.items():
            self._rows.setdefault(name, []).append(value)
        lookout.seen = np.zeros_like(lookout.seen)
        self._nearest, self._farthest = distance.min(axis=1), farthest
        self._outside = np.zeros(len(followers))

    def _take_edges(self, decisions: Sequence[Decision]) -> None:
        for row, decision in enumerate(decisions):
            if decision.edges:
                self._edges[row] = [self._names[v] in decision.edges for v in self._others[row]]

    def _close(self) -> None:
        """End the interval since the last tick; time before the first tick does not count."""
        if self._times:
            for name, value in (('nearest', self._nearest), ('farthest', self._farthest),
                                ('outside', self._outside)):
                self._rows.setdefault(name, []).append(value)

    def flights(self) -> Flights:
        """Return the collected figures."""
        self._close()
        return Flights(self._world.scenario, np.array(self._times), **{
            name: np.stack(rows, axis=1) for name, rows in self._rows.items()})
