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
What keeps the follower clear of others, and within its fences: bounds on its acceleration.

Below and above another vehicle the air is disturbed, so the horizontal distance counts by itself,
at 0.9 of the band's inner edge. Whom one does not see may have climbed or descended: of those only
the horizontal distance is sure.

What the guard makes of a command: the bounds of everyone near, of the fences and of sight.
"""

from __future__ import annotations

from collections.abc import Iterable
import math

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.guard import (
    Edges,
    FENCE,
    guard,
    GuardParams,
    HalfSpace,
    ordered,
    radial_bounds,
    RadialBounds,
    SEPARATION,
)
from flock_follower.planner.inputs import Expected, expected, NeighborEstimate, OwnState, SEEN
from flock_follower.planner.limits import LimitedCommand
from flock_follower.planner.memory import Loss, Memory
from flock_follower.planner.neighborhood import clear_of_sphere, hulls, Neighborhood, role
from flock_follower.planner.params import AVOID, member, PlannerParams, replace
from flock_follower.planner.sight import FieldOfView, marker_bounds

DOWNWASH = 0.9  # of sqrt(d0): the least horizontal distance, whatever the height
ALIKE = 0.35  # of the horizontal distance: with less height between them the distance says it all
#: Of one that was coming it moves out of the way farther, by the way of so many s, at most so far,
#: m; a slower one, m/s, is not coming.
YIELD_TIME, YIELD_MAX, APPROACH_NOISE = 2.0, 3.0, 0.1
STOP_SHARE = 0.6  # of a_max, with which it stops where nobody is
#: A closing one that may arrive in so many s after the retreat ends is left upwards, so far, m,
#: but not if it is more than so much, m, higher.
CLIMB_TIME, CLIMB_MAX, HIGHER = 2.5, 1.0, 0.3
SIDEWAYS = 2.0  # of the direction away from a closing one, as the retreat ends
CLOSE = 1.6  # m: nearer than this the climb gets what backing off leaves
_LEVEL = np.array([1.0, 1.0, 0.0])


def in_sight(it: Expected, position: Array, velocity: Array, seen: bool, followed: bool,
             params: PlannerParams, hulls: float = 0.0) -> list[RadialBounds]:
    """
    Return the bounds for one neighbour.

    :param position: one's own (3,), m; :param velocity: one's own when the command acts (3,).
    :param seen: whether it is there; else the height that it was seen at last says little.
    :param followed: whether it is to be followed; else it is only kept clear of.
    :param hulls: how much of the distance is inside of its hull and one's own, m.
    """
    inner = Edges.of(params.law, params.guarding)
    band = inner._replace(near=inner.near + hulls, far=inner.far + hulls if followed else math.inf,
                          spread=it.spread, spreading=it.spreading)
    bounds = []
    if seen:
        bounds.append(_bounds(it, position, velocity, np.ones(3), band, params.guarding))
    x, y, z = (it.position - position).tolist()
    if not (seen and abs(z) < ALIKE * math.hypot(x, y)):
        near = (DOWNWASH if seen else 1.0) * inner.near + hulls
        bounds.append(_bounds(it, position, velocity, _LEVEL,
                              band._replace(near=near, far=math.inf), params.guarding))
    return [each._replace(seen=seen) for each in bounds if each is not None]


def climb_range(neighbors: Iterable[NeighborEstimate], me: OwnState,
                params: PlannerParams) -> tuple[float, float]:
    """
    Return the least and the greatest vertical speed, m/s, beside those in sight.

    Above and below one that is nearer horizontally than it should be no horizontal command helps:
    the height between does not shrink. One that is near and comes nearer is backed away from
    first: the climb gets the rest of ``v_max``.
    """
    edges, least, most = Edges.of(params.law, params.guarding), -math.inf, math.inf
    near = edges.near
    for n in neighbors:
        x, y, z = (n.position - me.position).tolist()
        level, climb = math.hypot(x, y), float(n.velocity[2])
        if level < DOWNWASH * near:
            gap = abs(z) - math.sqrt(near ** 2 - level ** 2)
            speed = min(params.guarding.closing_speed(gap), 0.0)
            if z > 0.0:
                most = min(most, climb + speed)
            else:
                least = max(least, climb - speed)
        approach, away = (-(x * float(v[0]) + y * float(v[1])) / max(level, 1e-6)
                          for v in (n.velocity, me.velocity))
        needed = approach - params.guarding.closing_speed(level - near - edges.margin)
        beneath = level < DOWNWASH * near and approach <= APPROACH_NOISE
        away = 0.0 if beneath else max(approach, needed, away if needed > 0.0 else 0.0)
        if math.hypot(level, z) < CLOSE and away > APPROACH_NOISE:
            rest = math.sqrt(max(params.fastest ** 2 - away ** 2, 0.0))
            least, most = max(least, -rest), min(most, rest)
    return least, most


def fences(home: Array | None, lost: Loss | None, position: Array, velocity: Array,
           params: PlannerParams) -> list[HalfSpace]:
    """Return the bounds that keep it near home and, out of sight, from moving on unseeing."""
    bounds = []
    if home is not None:
        fence = radial_bounds(_LEVEL * (position - home), _LEVEL * velocity,
                              Edges(-math.inf, params.range_max), params.guarding)
        if fence is not None:
            bounds.append(fence.cohesion._replace(reason=FENCE))
    if lost is not None:
        away = _LEVEL * (position - lost.origin)
        distance = math.hypot(*away.tolist())
        if distance > 1e-6:
            left = retreat(lost, params) - distance
            bounds.append(_stop(away / distance, left, velocity, params))
        left = lost.free - params.guarding.m - float(lost.towards @ position)
        bounds.append(_stop(lost.towards, left, velocity, params))
    return bounds


def retreating(bound: RadialBounds, lost: Loss, position: Array, velocity: Array,
               params: PlannerParams) -> RadialBounds:
    """Return the bound of one out of sight, that it is no reason to move beyond the retreat."""
    far, offset = retreat(lost, params), _LEVEL * (position - lost.origin)
    direction = bound.direction
    if lost.approach > APPROACH_NOISE and far > 0.0:
        direction = _LEVEL * direction + (
            SIDEWAYS * min(lost.retreated(position) / far, 1.0) * lost.side)
        direction = direction / max(math.hypot(*direction.tolist()), 1e-6)
    along = float(direction @ offset)
    left = math.sqrt(max(along ** 2 + far ** 2 - float(offset @ offset), 0.0)) - along
    most = -_stop(direction, left, velocity, params).least
    return bound._replace(direction=direction, lowest=min(bound.lowest, most))


def retreat(lost: Loss, params: PlannerParams) -> float:
    """Return how far it may move out of the way of one that it no longer sees, m."""
    coming = params.retreat_max > 0.0 and lost.approach > APPROACH_NOISE
    return params.retreat_max + coming * min(YIELD_TIME * lost.approach, YIELD_MAX)


def overflight(lost: Loss, position: Array, params: PlannerParams) -> float:
    """
    Return the least height, m, at which to let a closing neighbour pass that is out of sight.

    Without an explicit ceiling there is none: -inf. The default of ``altitude_max`` is none.
    """
    left = retreat(lost, params) - lost.retreated(position)
    origin = float(lost.origin[2])
    if (params.altitude_max >= PlannerParams.altitude_max or not _overtaken(lost, left)
            or lost.height > origin + HIGHER):
        return -math.inf
    return origin + CLIMB_MAX


def _overtaken(lost: Loss, left: float) -> bool:
    """Return whether a closing one uses up soon what is left of the retreat, m."""
    return lost.approach > APPROACH_NOISE and left <= CLIMB_TIME * lost.approach


def beside(velocity: Array, offset: Array) -> Array:
    """
    Return the horizontal unit vector (3,) across a path, towards oneself; zero without a path.

    :param velocity: of the neighbour (3,), m/s.
    :param offset: own position minus the neighbour's (3,), m.
    """
    x, y, _ = velocity.tolist()
    length = math.hypot(x, y)
    if length < 1e-6:
        return np.zeros(3)
    across = np.array([-y, x, 0.0]) / length
    return math.copysign(1.0, float(across @ offset)) * across


def _stop(along: Array, left: float, velocity: Array, params: PlannerParams) -> HalfSpace:
    """Return the bound that stops it along a unit vector within so much, m."""
    guarding, rate = params.guarding, float(along @ velocity)
    guarding = replace(guarding, b=max(guarding.b, STOP_SHARE * params.strongest))
    # Until the command acts it goes on as it does.
    left -= max(rate, 0.0) * params.response_time
    speed = max(guarding.closing_speed(left), 0.0)
    return HalfSpace(-along, (rate - speed) / guarding.T_g
                     + guarding.closing_slope(left) * max(rate, 0.0), FENCE)


def _bounds(it: Expected, position: Array, velocity: Array, along: Array, edges: Edges,
            params: GuardParams) -> RadialBounds | None:
    return radial_bounds(along * (position - it.position), along * (velocity - it.velocity),
                         edges, params, along * it.acceleration)


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
