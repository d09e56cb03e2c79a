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

"""A flock of followers behind a leader, each with a planner of its own, as points of one lag."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import FOLLOWER, LEADER, Member, PlannerParams
from flock_follower.planner.step import Decision, step

LAG = 0.3  # s in which an acceleration follows its command to 63 %
TICK, DT = 0.1, 0.02  # s
POSITION_NOISE, VELOCITY_NOISE = 0.01, 0.03  # m, m/s: standard deviations of each axis
SPEED = 0.3  # m/s of the leader

Telling = Callable[[int, int, float], 'bool | None']
"""Whether one vehicle sees (True) or hears of (False) another at a time, s; None: neither."""


def everybody_seen(_: int, __: int, ___: float) -> bool:
    """Let everyone see everyone."""
    return True


class Flown(NamedTuple):
    """What became of a flight of n followers; index 0 is the leader."""

    nearest: float
    """m, of all pairs at all times."""
    in_band: float
    """Share of edges and ticks inside of the band."""
    longest: float
    """m, of all edges after the first seconds."""
    tracked: float
    """Share of followers and ticks in TRACK."""
    changes: int
    """How often an edge came or went."""
    rms_acceleration: float
    """m/s^2."""
    rms_jerk: float
    """m/s^3, of the commands."""
    positions: Array
    """(ticks, n + 1, 3), m."""
    decisions: Sequence[Mapping[int, Decision]]
    """Of each tick, by follower."""


@dataclass
class Course:
    """A leader that flies slowly on, turning to and fro, and stops for a while."""

    speed: float = SPEED
    turn: float = 0.15  # rad/s
    stop: tuple[float, float] = (8.0, 11.0)  # s

    def velocity(self, now: float) -> Array:
        angle = self.turn * 5.0 * math.sin(now / 5.0)
        speed = 0.0 if self.stop[0] <= now <= self.stop[1] else self.speed
        return speed * np.array([math.cos(angle), math.sin(angle), 0.0])


@dataclass
class Flight:
    """A flight; ``starts`` (n, 3), m, are the followers', the leader's is the origin."""

    starts: Array
    params: PlannerParams = field(default_factory=PlannerParams)
    seed: int = 0
    duration: float = 20.0
    telling: Telling = everybody_seen
    gone: dict[int, float] = field(default_factory=dict)
    """Who falls silent, and is nowhere any more, at which time, s."""
    course: Course = field(default_factory=Course)

    def fly(self) -> Flown:
        """Fly it."""
        rng = np.random.default_rng(self.seed)
        count = len(self.starts)
        names = ['leader', *(f'follower_{k}' for k in range(1, count + 1))]
        vehicles = {name: Member(FOLLOWER if k else LEADER) for k, name in enumerate(names)}
        x: Array = np.vstack([np.zeros(3), self.starts])
        x[:, 2] += 2.0
        v, a = np.zeros_like(x), np.zeros_like(x)
        u, memories = np.zeros_like(x), [Memory()] * (count + 1)
        yaws = np.zeros(count + 1)
        params = [replace(self.params, vehicles={
            name: who for name, who in vehicles.items() if name != own}) for own in names]
        nearest, inside, edges, longest, tracked, changes = math.inf, 0, 0, 0.0, 0, 0
        squares, jerks = 0.0, 0.0
        flown, decisions = list[Array](), list[Mapping[int, Decision]]()
        low, high = math.sqrt(self.params.law.d0), math.sqrt(self.params.law.d1)
        ticks = round(self.duration / TICK)
        for tick in range(ticks):
            now = tick * TICK
            here = [k for k in range(count + 1) if now < self.gone.get(k, math.inf)]
            seen = {(i, j): Neighbor(
                names[j], now, x[j] + rng.normal(0.0, POSITION_NOISE, 3),
                v[j] + rng.normal(0.0, VELOCITY_NOISE, 3), np.eye(3) * POSITION_NOISE ** 2,
                np.eye(3) * VELOCITY_NOISE ** 2, heard=not self.telling(i, j, now))
                for i in here if i for j in here
                if i != j and self.telling(i, j, now) is not None}
            told = []
            for i in here[1:]:
                before = decisions[-1][i].edges if decisions and decisions[-1][i].edges else None
                memories[i], decision = step(
                    memories[i], now, True, OwnState(now, x[i].copy(), v[i].copy(), yaws[i]),
                    [n for (who, _), n in seen.items() if who == i], params[i])
                assert decision.acceleration is not None and decision.yaw is not None
                jerks += float(np.sum((decision.acceleration - u[i]) ** 2)) / TICK ** 2
                u[i], yaws[i] = decision.acceleration, decision.yaw
                squares += float(u[i] @ u[i])
                tracked += decision.state is State.TRACK
                for name in decision.edges:
                    r = math.dist(x[i], x[names.index(name)])
                    inside, edges = inside + (low < r < high), edges + 1
                    longest = max(longest, r) if now > 5.0 else longest
                if before is not None:
                    changes += len({*before} ^ {*decision.edges})
                told.append(decision)
            decisions.append(dict(zip(here[1:], told)))
            flown.append(x.copy())
            for k in range(round(TICK / DT)):
                a += DT / LAG * (u - a)
                v += DT * a
                v[0] = self.course.velocity(now + k * DT)
                x += DT * v
                apart = np.linalg.norm(x[here, None] - x[None, here], axis=2)
                nearest = min(nearest, float(apart[np.triu_indices(len(here), 1)].min()))
        all_ticks = max(sum(len(told) for told in decisions), 1)
        return Flown(nearest, inside / max(edges, 1), longest, tracked / all_ticks, changes,
                     math.sqrt(squares / all_ticks), math.sqrt(jerks / all_ticks),
                     np.array(flown), decisions)


def line(count: int, spacing: float = 2.0) -> Array:
    """Return the places of followers one behind the other."""
    return np.array([[-spacing * k, 0.0, 0.0] for k in range(1, count + 1)])


def ring(count: int, spacing: float = 2.0) -> Array:
    """Return the places of followers around the leader, so far from each other and from it."""
    radius = max(spacing, 0.5 * spacing / math.sin(math.pi / count))
    angles = np.arange(count) * 2.0 * math.pi / count
    return radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)


def wedge(count: int, spacing: float = 2.0) -> Array:
    """Return the places of followers in a V behind the leader, 90 degrees wide."""
    rows = np.array([(k + 1) // 2 for k in range(1, count + 1)])
    sides = np.array([1.0 if k % 2 else -1.0 for k in range(1, count + 1)])
    return spacing * math.sqrt(0.5) * np.stack([-rows, rows * sides, 0.0 * rows], axis=1)


def grid(count: int, spacing: float = 2.0) -> Array:
    """Return the places of followers in rows of three behind the leader."""
    return np.array([[-spacing * (1 + k // 3), spacing * (k % 3 - 1), 0.0]
                     for k in range(count)])
