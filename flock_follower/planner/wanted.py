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

"""What the law asks for, of those at hand, and how it is faded in."""

from __future__ import annotations

import math

import numpy as np

from flock_follower.flocking import acceleration
from flock_follower.geometry import Array
from flock_follower.planner.flock_graph import attended
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.limits import limit_norm
from flock_follower.planner.memory import Fading, Memory
from flock_follower.planner.neighborhood import apart, hulls, Neighborhood, role
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.roles import AVOID

TOUCHING = 1e-3  # m: hulls that touch or overlap are taken to be this far apart


def law(me: OwnState, hood: Neighborhood, params: PlannerParams) -> Array:
    """Return the acceleration (3,), m/s^2, that the law commands."""
    offsets = np.array([_offset(n, me, params) for n in hood.flock])
    differences = np.array([n.velocity - me.velocity for n in hood.flock])
    if len(hood.flock) == 1:
        return acceleration(offsets, differences, params.law)
    share = np.array([hood.ties[n.name].share for n in hood.flock])
    others = np.array([role(n, params) == AVOID for n in hood.flock])
    return attended(offsets, differences, share, others, params.law, params.a_max)


def faded(wanted: Array, memory: Memory, hood: Neighborhood, me: OwnState, now: float,
          params: PlannerParams) -> tuple[Array, Fading | None]:
    """Return the law's command, or what leads to it where it is still being faded in."""
    fading = memory.fading
    if any(apart(n, me, params) ** 2 <= params.law.d0 for n in hood.flock):
        return wanted, None  # too near already: at once
    if memory.params is not params and memory.params != params:
        fading = Fading(np.zeros(3) if memory.command is None else memory.command, now)
    if fading is None:
        return wanted, None
    done = (now - fading.since + params.period) / max(params.handover_time, params.period)
    if done >= 1.0 - 1e-9:
        return wanted, None
    within = limit_norm(wanted, params.a_max)
    return fading.command + max(done, 0.0) * (within - fading.command), fading


def _offset(n: NeighborEstimate, me: OwnState, params: PlannerParams) -> Array:
    """Return the way (3,), m, from one's own hull to a neighbour's."""
    offset: Array = n.position - me.position
    thick = hulls(n, params)
    if thick == 0.0:
        return offset
    distance = math.hypot(*offset.tolist())
    return offset * (max(distance - thick, TOUCHING) / max(distance, TOUCHING))
