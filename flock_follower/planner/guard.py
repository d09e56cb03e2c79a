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
The guard: the order of all bounds on a command, and the command within them.

Order of the bounds, most important first: separation from neighbors in sight, the fences,
separation from neighbors out of sight, sight of the faced neighbor, cohesion. Lower-priority
bounds never relax higher ones, and no bound relaxes ``a_max`` or ``v_max``. The vertical part of a
command is limited before (``climb_rates``, ``overflight``).

The bounds of one neighbor are those of :mod:`flock_follower.planner.bounds`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math

import numpy as np

from flock_follower.geometry import Array, SHORTEST
from flock_follower.planner.bound_keeping import (
    Bound,
    COHESION,
    FENCE,
    keep_bounds,
    limit_horizontal,
    SEPARATION,
)
from flock_follower.planner.bounds import (
    clear_of_sphere,
    DOWNWASH_SHARE,
    in_sight,
    marker_bounds,
    sight_bounds,
    stop,
    STOP_SHARE,
)
from flock_follower.planner.inputs import (
    MAX_ACCELERATION_AGE,
    Neighbor,
    OwnState,
    predict,
    Prediction,
)
from flock_follower.planner.limits import limit_command, LimitedCommand
from flock_follower.planner.memory import Loss, Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import AVOID, FOLLOWER, PlannerParams
from flock_follower.planner.retreat import APPROACH_NOISE, retreat
from flock_follower.planner.scene import RECEIVED_SIGMAS, Scene, silent
from flock_follower.planner.sight import FieldsOfView
from flock_follower.planner.vectors import difference, ZERO_VECTOR

HORIZONTAL_AXES = np.array([1.0, 1.0, 0.0])  # factors of x, y, z

# Fixed numbers of the guard; those of one neighbor's bounds are in planner/bounds.py.
CLOSE = 1.75  # m: nearer than this the climb gets the rest of v_max after backing off
DRAG_SHARE = 0.05  # of v_max: largest speed lost to drag that is offset
SIDESTEP_WEIGHT = 2.0  # of the step aside, at the end of the retreat; 1.0 is that straight away
SIDESTEP_DEADZONE = 0.3  # share of the distance: no step aside to a neighbor so far on that side
FAILING_TIME = 0.5  # s that a follower whose computer failed flies on before it stops and hovers
COVER_WIDTH = 0.8  # m off the line of sight up to which one in sight covers another


def sort_bounds(bounds: Iterable[Bound], fences: Sequence[Bound] = (),
                sight: Sequence[Bound] = ()) -> list[Bound]:
    """
    Return all bounds in the order of their importance.

    Order: separation from neighbors in sight (the nearest first), fences, separation from
    neighbors out of sight, sight, cohesion (the farthest first). So cohesion never relaxes
    separation or sight.
    """
    near = sorted(bounds, key=lambda each: each.distance)
    apart = [each for each in near if each.reason == SEPARATION]
    return [*(each for each in apart if each.seen), *fences,
            *(each for each in apart if not each.seen), *sight,
            *(each for each in reversed(near) if each.reason == COHESION)]


def climb_rates(neighbors: Iterable[Neighbor], me: OwnState,
                params: PlannerParams) -> tuple[float, float]:
    """
    Return the least and greatest vertical speed, m/s, that neighbors in sight permit.

    If a neighbor is too near horizontally, above or below, the height difference does not shrink.
    If a neighbor is near and approaches, the retreat has priority, and the climb gets the rest of
    ``v_max``.
    """
    edges, least, most = params.edges, -math.inf, math.inf
    rest, here = math.inf, me.position.tolist()
    for n in neighbors:
        radii_sum = params.radius + n.member.radius
        near = edges.near + radii_sum
        x, y, z = difference(n.position.tolist(), here)
        vx, vy, climb = n.velocity.tolist()
        level = math.hypot(x, y)
        if level < DOWNWASH_SHARE * near:
            gap = abs(z) - math.sqrt(near ** 2 - level ** 2)
            speed = min(params.guarding.closing_speed(gap)[0], 0.0)
            if z > 0.0:
                most = min(most, climb + speed)
            else:
                least = max(least, climb - speed)
        if math.hypot(level, z) >= CLOSE + radii_sum:
            continue
        approach = -(x * vx + y * vy) / max(level, SHORTEST)
        vx, vy, _ = me.velocity.tolist()
        leaving = -(x * vx + y * vy) / max(level, SHORTEST)
        needed = approach - params.guarding.closing_speed(level - near - edges.margin)[0]
        beneath = level < DOWNWASH_SHARE * near and approach <= APPROACH_NOISE
        leaving = 0.0 if beneath else max(approach, needed, leaving if needed > 0.0 else 0.0)
        if leaving > APPROACH_NOISE:
            rest = min(rest, math.sqrt(max(params.fastest ** 2 - leaving ** 2, 0.0)))
    # The height between has priority over the rest of v_max.
    return max(least, min(-rest, most)), min(most, max(rest, least))


def fences(lost: Loss | None, position: Array, velocity: Array,
           params: PlannerParams) -> list[Bound]:
    """Return the bounds on motion while the lost neighbor is out of sight."""
    if lost is None:
        return []
    # The full m in a narrow band, too: nothing beyond the last line of sight was seen free.
    left = lost.free - params.guarding.m - float(lost.towards @ position)
    onward = stop(lost.towards.tolist(), left, velocity.tolist(), params)
    offset = HORIZONTAL_AXES * (position - lost.origin)
    distance = math.hypot(*offset.tolist())
    if distance <= SHORTEST:
        return [onward]
    left = retreat(lost, params) - distance
    return [stop((offset / distance).tolist(), left, velocity.tolist(), params), onward]


def limit_to_retreat(bound: Bound, lost: Loss, position: Array, velocity: Sequence[float],
                     params: PlannerParams, sideways: bool = True) -> Bound:
    """
    Return the bound for a neighbor out of sight, limited by the retreat.

    :param sideways: whether the vehicle also leaves the neighbor's path, as for the lost neighbor.
    """
    far, offset = retreat(lost, params), HORIZONTAL_AXES * (position - lost.origin)
    direction = np.array(bound.normal)
    # Not towards a neighbor that has moved to that side.
    sideways = sideways and float(direction @ lost.side) > -SIDESTEP_DEADZONE
    if sideways and lost.approach > APPROACH_NOISE and far > 0.0:
        direction = HORIZONTAL_AXES * direction + (
            SIDESTEP_WEIGHT * min(lost.retreat_distance(position) / far, 1.0) * lost.side)
        direction = direction / max(math.hypot(*direction.tolist()), SHORTEST)
    along = float(direction @ offset)
    left = math.sqrt(max(along ** 2 + far ** 2 - float(offset @ offset), 0.0)) - along
    most = -stop(direction.tolist(), left, velocity, params).least
    return bound._replace(normal=direction.tolist(), least=min(bound.least, most))


def constrain(nominal: Array, vertical: float, climb: float, memory: Memory, scene: Scene,
              velocity: Array, view: FieldsOfView, params: PlannerParams) -> LimitedCommand:
    """
    Return the nearest command within all limits and bounds.

    :param nominal: nominal acceleration (3,), m/s^2, without limits; its horizontal part is used.
    :param vertical: vertical acceleration, m/s^2; :param climb: rate of the altitude to hold, m/s.
    :param velocity: ego velocity when the command acts (3,), m/s.
    """
    # Limits lowered in flight bind the law and coasting, not braking and keeping clear.
    lowered, start = (params.a_max, params.v_max), (params.strongest, params.fastest)
    limits = lowered if scene.state in (State.TRACK, State.COAST) else start
    more = _lost_to_drag(memory, velocity, params)
    rising = max(abs(float(scene.me.velocity[2])), abs(climb))
    command = limit_horizontal(nominal, vertical, velocity, limits[0], limits[1] + more,
                               params.period, rising, memory.drag if params.guard else None)
    if params.guard and (scene.state is not State.SEARCH or memory.flock):
        bounds = _bounds(memory, scene, velocity, view, params)
        allowed = keep_bounds(command.acceleration, velocity, bounds, params.a_max,
                              params.v_max + more, params.period, memory.drag)
        if start != lowered:
            clear = keep_bounds(allowed.acceleration, velocity, [
                each for each in bounds if each.reason in (SEPARATION, FENCE)],
                params.strongest, params.fastest + more, params.period)
            allowed = clear if clear.reason else allowed
        if allowed.reason:
            command = allowed._replace(reason=', '.join(filter(None, [
                command.reason, allowed.reason])))
    # The velocity of commands not yet flown is a guess: the measured velocity is limited, too.
    if SEPARATION in command.reason or FENCE in command.reason:
        limits = start
    final = limit_command(command.acceleration, scene.me.velocity, *limits, params.period,
                          command.separation_axis)
    reason = command.reason if final.reason in command.reason else ', '.join(
        filter(None, [final.reason, command.reason]))
    return LimitedCommand(final.acceleration, reason, command.separation_axis)


def _lost_to_drag(memory: Memory, velocity: Array, params: PlannerParams) -> float:
    """Return the error, m/s, of the predicted speed that drag causes."""
    speed = math.hypot(*velocity.tolist())
    slower = params.response_time * float(memory.drag @ velocity) / speed if speed > 0.0 else 0.0
    return min(max(slower, 0.0), DRAG_SHARE * params.v_max)


def _bounds(memory: Memory, scene: Scene, velocity: Array, view: FieldsOfView,
            params: PlannerParams) -> list[Bound]:
    """
    Return all bounds in their order.

    Without a camera a lost neighbor may be anywhere: the follower does not back away.
    """
    near, me, moving = list[Bound](), scene.me, velocity.tolist()
    for name, n in memory.ranged.items():
        if name not in memory.neighbors:
            near += clear_of_sphere(n, memory.flock.get(name), me, moving, params)
    for name, n in memory.flock.items():
        here = name in memory.neighbors
        if here or not (name in memory.ranged or (scene.blinded and not n.received)):
            near += _neighbor_bounds(n, memory, scene, moving, here, params)
    return sort_bounds(near, fences(memory.lost, me.position, velocity, params),
                       _sight_bounds(memory, scene, moving, view, params))


def _is_covered(it: Prediction, scene: Scene) -> bool:
    """
    Return whether a lost neighbor is expected behind one in sight, on the line of sight.

    A covered neighbor comes no nearer than the visible one, which has its own bound.
    """
    sight = np.subtract(it.position, scene.me.position)
    distance = math.hypot(*sight.tolist())
    for each in scene.neighbors.flock:
        offset = each.position - scene.me.position
        along = float(offset @ sight) / max(distance, SHORTEST)
        aside = math.sqrt(max(float(offset @ offset) - along ** 2, 0.0))
        if not each.received and 0.0 < along < distance and aside < COVER_WIDTH:
            return True
    return False


def _neighbor_bounds(n: Neighbor, memory: Memory, scene: Scene, velocity: Sequence[float],
                     here: bool, params: PlannerParams) -> list[Bound]:
    """Return the bounds for one neighbor; ``here``: it is in sight or received, not lost."""
    me, neighbors = scene.me, scene.neighbors
    age, radii_sum = me.stamp - n.stamp, params.radius + n.member.radius
    seen = here and (memory.lost is None or bool(neighbors.flock) or n.member.role == AVOID)
    joined = here and n.name in neighbors.edges
    has_failed = silent(n, me.stamp, params)
    places = [_hover_place(n, params) if has_failed else scene.predictions[n.name]]
    if age > MAX_ACCELERATION_AGE and not n.received:  # its acceleration is a guess: never chase
        places.append(predict(n, ZERO_VECTOR, age, params))
    if not (here or n.received):
        places = [it._replace(spread=0.0, spreading=0.0) if _is_covered(it, scene) else it
                  for it in places]
    # A follower in sight may go back at any time, as fast and as hard as the ego vehicle can.
    headway = params.guarding.tau if n.member.role == FOLLOWER and not n.received else 0.0
    found: list[Bound] = []
    for place in places:
        found += in_sight(place, me.position.tolist(), velocity, seen,
                          joined and place is places[-1], params, radii_sum, headway)
    if memory.lost is not None and not (seen or n.received):
        found = [limit_to_retreat(each, memory.lost, me.position, velocity, params,
                                  n.name == memory.lost.name) for each in found]
    if has_failed:
        found += [each._replace(normal=_pass_beside(each.normal)) for each in found]
    # Bounds of neighbors that are seen rank above bounds of received ones.
    return [each._replace(seen=False) for each in found] if n.received else found


def _hover_place(n: Neighbor, params: PlannerParams) -> Prediction:
    """Return the hover position of a silent follower whose computer may have failed."""
    along = n.velocity / max(math.hypot(*n.velocity.tolist()), SHORTEST)
    stops = FAILING_TIME * n.velocity + 0.5 * float(n.velocity @ n.velocity) / (
        STOP_SHARE * params.strongest) * along
    variance = float(n.position_covariance.trace())
    return Prediction((n.position + stops).tolist(), [*ZERO_VECTOR], [*ZERO_VECTOR],
                      RECEIVED_SIGMAS * math.sqrt(max(variance, 0.0) / 3.0), 0.0, [*ZERO_VECTOR])


def _pass_beside(away: Sequence[float]) -> list[float]:
    """Return a unit vector between "away from a place" and "across", to pass beside it."""
    x, y, _ = away
    return [math.sqrt(0.5) * (x - y), math.sqrt(0.5) * (y + x), 0.0]


def _sight_bounds(memory: Memory, scene: Scene, velocity: Sequence[float], view: FieldsOfView,
                  params: PlannerParams) -> list[Bound]:
    """Return the bounds that keep the marker of the faced neighbor in sight, if it is seen."""
    me, faced = scene.me, scene.neighbors.faced
    if faced is None or not view or faced.received:
        return []
    n = memory.flock[faced.name]
    it = scene.predictions[faced.name]
    offset = difference(it.position, me.position.tolist())
    bounds = sight_bounds(offset, velocity, it, me.yaw, view, params)
    if n.yaw is not None:
        bounds += marker_bounds(offset, velocity, it, n.yaw, n.member, params)
    return bounds
