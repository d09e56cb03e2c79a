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

"""What the guard makes of a command: the bounds of everyone near, of the fences and of sight."""

from __future__ import annotations

import math

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.distance_only import clear_of_sphere
from flock_follower.planner.guard import (
    FENCE,
    guard,
    HalfSpace,
    ordered,
    RadialBounds,
    SEPARATION,
)
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.keeping_clear import fences, in_sight, retreating
from flock_follower.planner.limits import LimitedCommand
from flock_follower.planner.memory import Memory
from flock_follower.planner.neighborhood import hulls, Neighborhood, role
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.prediction import Expected, expected, SEEN
from flock_follower.planner.roles import AVOID, member
from flock_follower.planner.sight import FieldOfView, marker_bounds

SURE = 2.0  # standard deviations of what is heard that count as where somebody may be


def guarded(command: LimitedCommand, memory: Memory, me: OwnState, velocity: Array,
            hood: Neighborhood, view: FieldOfView | None, blinded: bool,
            params: PlannerParams) -> LimitedCommand:
    """
    Return the command as the guard allows it; of those lost it only keeps clear.

    Without a camera whoever was seen last may be anywhere: from then on it just brakes.

    :param velocity: one's own when the command acts (3,), m/s.
    :param hood: those followed; nobody where none is.
    :param blinded: whether no images are processed.
    """
    near, sight = list[RadialBounds](), list[HalfSpace]()
    ranged = {name: n for name, n in memory.ranged.items() if name not in memory.neighbors}
    for n in ranged.values():
        if sphere := clear_of_sphere(n, memory.flock.get(n.name), me, velocity, params):
            near.append(sphere)
    for n in memory.flock.values():
        if n.name in ranged:
            continue  # where it is not, its distance says
        # What is told of comes late and with gaps: an acceleration made of it is of long ago.
        its = np.zeros(3) if n.heard else memory.motions[n.name].acceleration
        age = me.stamp - n.stamp
        it = _spread(expected(n, its, age, params), n, age, me)
        here, hull = n.name in memory.neighbors, hulls(n, params)
        if blinded and not (here or n.heard):
            continue
        seen = here and (memory.lost is None or bool(hood.flock) or role(n, params) == AVOID)
        tie = hood.ties.get(n.name)
        joined = here and tie is not None and tie.edge
        guess = [] if age <= SEEN or n.heard else [
            _spread(expected(n, np.zeros(3), age, params), n, age, me)]
        found = in_sight(it, me.position, velocity, seen, joined and not guess, params, hull)
        for steady in guess:
            found += in_sight(steady, me.position, velocity, seen, joined, params, hull)
        if memory.lost is not None and not (seen or n.heard):
            found = [retreating(each, memory.lost, me.position, velocity, params)
                     for each in found]
        # Bounds of those seen go before bounds of those only heard of.
        near += [each._replace(seen=False) for each in found] if n.heard else found
        if hood.guide is not None and view is not None and n.name == hood.guide.name and (
                not n.heard):
            offset = it.position - me.position
            sight = view.bounds(offset, velocity, it, params)
            if n.yaw is not None:
                faces = member(params.vehicles, n.name, False).faces
                sight = [*sight, *marker_bounds(offset, velocity, it, n.yaw, faces, params)]
    fence = fences(memory.home, memory.lost, me.position, velocity, params)
    bounds = ordered(near, fence, sight)
    allowed = guard(command.acceleration, velocity, bounds, params.a_max, params.v_max,
                    params.period)
    if (params.strongest, params.fastest) != (params.a_max, params.v_max):
        # Limits that were lowered bound what is wanted, and nothing that keeps clear.
        clear = guard(allowed.acceleration, velocity, [
            each for each in bounds if each.reason in (SEPARATION, FENCE)], params.strongest,
            params.fastest, params.period)
        allowed = clear if clear.limited else allowed
    if not allowed.limited:
        return command
    reasons = ', '.join(filter(None, [command.reason, allowed.reason]))
    return LimitedCommand(allowed.acceleration, True, reasons, allowed.away)


def _spread(it: Expected, n: NeighborEstimate, age: float, me: OwnState) -> Expected:
    """Return what to expect of a neighbour, in all places where one that is heard of may be."""
    if not n.heard:
        return it  # what the eyes err by is part of the guard's margin
    offset = it.position - me.position
    distance = math.hypot(*offset.tolist())
    if distance == 0.0:
        return it
    along = offset / distance
    variance = along @ (n.position_covariance + age ** 2 * n.velocity_covariance) @ along
    return it._replace(spread=it.spread + SURE * math.sqrt(max(float(variance), 0.0)))
