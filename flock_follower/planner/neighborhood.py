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
Neighbor selection: which neighbors the vehicle follows, faces and only keeps clear of.

The nominal command is the law's command for the selected neighbors. Edges are those of
``flock.neighbor_graph``; this graph does not contain neighbors to avoid. All distances are between
hulls.

If a leader has left the view, the vehicle that saw it last searches for it, even while the
positions of other neighbors are received, because only a camera can find a leader without a radio.
The vehicle turns to the last place of the leader, to both sides, then all round. Meanwhile it
follows the other neighbors by their messages, and keeps clear of the places where the leader may
be. Without this search the vehicle would turn to another follower, and the whole flock would hover
without its leader.

Warnings name neighbors that cannot be followed, and vehicles of the neighbors' file whose position
is unknown.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import chain
import math
from typing import NamedTuple

import numpy as np

from flock_follower.flock import neighbor_graph
from flock_follower.flock.neighbor_graph import graph_law, HELD_FACTOR
from flock_follower.geometry import Array
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.limits import brake, limit_norm
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import AVOID, LEADER, PlannerParams

GAP_MIN = 1e-3  # m: least distance of hulls for the law, if they touch or overlap


class Neighborhood(NamedTuple):
    """The known neighbors, all at one time, and their relations to the ego vehicle."""

    flock: Sequence[Neighbor]
    offsets: Array
    """From the ego hull to those of the flock (n, 3), m."""
    velocities: Array
    """Velocities of the flock (n, 3), m/s."""
    clearances: Sequence[float]
    """Distances between the ego hull and the neighbors' (n,), m."""
    shares: Mapping[str, float]
    """1 with an edge, 0 without; in between while an edge fades in or out."""
    edges: frozenset[str]
    """Names of the neighbors with an edge; the vehicle only keeps clear of the others."""
    faced: Neighbor | None
    """The neighbor that the vehicle faces and keeps in sight."""
    level: Neighbor | None
    """The neighbor whose altitude the vehicle follows; None: the altitude is held."""

NOBODY = Neighborhood(
    (), np.zeros((0, 3)), np.zeros((0, 3)), (), {}, frozenset(), None, None)


def build_neighborhood(memory: Memory, me: OwnState, flock: Sequence[Neighbor],
                       params: PlannerParams, elapsed: float) -> Neighborhood:
    """
    Return the relations of the present neighbors to this vehicle.

    :param memory: has the relations of the previous step, ``elapsed`` seconds ago.
    :param flock: all present neighbors; at least one of them can be followed.
    """
    here, places = me.position.tolist(), [_place_at(me.stamp, n) for n in flock]
    distances = [max(math.dist(there, here), GAP_MIN) for there in places]
    gaps = [distance - (params.radius + n.member.radius) for n, distance in zip(flock, distances)]
    positions, shortened = np.array(places), np.array([
        [max(gap, GAP_MIN) / distance] for gap, distance in zip(gaps, distances)])
    flock = [n._replace(stamp=me.stamp, position=there) for n, there in zip(flock, positions)]
    around = (flock, shortened * (positions - me.position), np.array([n.velocity for n in flock]),
              [max(gap, 0.0) for gap in gaps])
    if len(flock) == 1:  # most often; one to avoid is never the only neighbor
        only = flock[0]
        return Neighborhood(*around, {only.name: 1.0}, frozenset([only.name]), only, only)
    joined = edges(memory.edges, me, flock, params)
    change, before = elapsed / max(params.handover_time, params.period), memory.shares
    shares = {n.name: min(max(before.get(n.name, 0.0) + (
        change if n.name in joined else -change), 0.0), 1.0) if before else float(n.name in joined)
        for n in flock}
    away = {n.name: distance for n, distance in zip(flock, distances)}
    follow = [n for n in flock if n.member.role != AVOID]
    leaders = [n for n in follow if n.member.role == LEADER]
    ends = [n for n in follow if n.name in joined]
    # A leader without an edge has another vehicle before it, which must not leave the view.
    ahead = [n for n in leaders if n.name in joined]
    seen = ([n for n in some if not n.received] for some in (ahead, ends, leaders))
    # Never turn away from a neighbor in sight to one that is only received.
    first = next(filter(None, chain(seen, (ahead, leaders, ends))), [])
    faced = _find_nearest(away, memory.faced, first)
    # Several followers without a leader would follow their own motion if they followed each other.
    level = _find_nearest(away, memory.faced, leaders) or (faced if len(ends) < 2 else None)
    return Neighborhood(*around, shares, joined, faced, level)


def _place_at(time: float, n: Neighbor) -> list[float]:
    """Return the position (3,), m, of a neighbor at a time, s, with constant velocity."""
    age, (x, y, z), (vx, vy, vz) = time - n.stamp, n.position.tolist(), n.velocity.tolist()
    return [x + age * vx, y + age * vy, z + age * vz]


def edges(held: Collection[str], me: OwnState, flock: Sequence[Neighbor],
          params: PlannerParams) -> frozenset[str]:
    """
    Return the names of the neighbors with an edge to this vehicle.

    :param held: the edges of the previous step.
    """
    follow = [n for n in flock if n.member.role != AVOID]
    if len(follow) < 2:
        return frozenset(n.name for n in follow)
    joined = neighbor_graph.edges(
        me.position.tolist(), [n.position.tolist() for n in follow],
        [params.radius + n.member.radius for n in follow], params.radius,
        [n.name in held for n in follow])
    seen = [n for n in follow if not n.received]
    # A received position never removes the edge to the only leader in sight. Beyond the band such
    # an edge does not begin beside others: it would pull past the vehicle between.
    kept = [n.name for n in seen if len(seen) == 1 and n.member.role == LEADER and (
        not held or n.name in held
        or max(math.dist(n.position, me.position) - (params.radius + n.member.radius), 0.0) ** 2
        < params.law.d1)]
    return frozenset(n.name for n, edge in zip(follow, joined) if edge or n.name in kept)


def _find_nearest(distances: Mapping[str, float], held: str,
                  flock: Sequence[Neighbor]) -> Neighbor | None:
    """Return the nearest neighbor, or the one held, unless another is clearly nearer."""
    return min(flock, default=None, key=lambda n: (
        distances[n.name] / (HELD_FACTOR if n.name == held else 1.0), n.name))


KEPT_UP_WITH = 1.1  # times v_max: noise of a leader at v_max is no warning


def reports(memory: Memory, neighbors: Neighborhood, params: PlannerParams) -> list[str]:
    """Return warnings about neighbors that cannot be followed, or whose position is unknown."""
    v_max, near, far = params.v_max, math.sqrt(params.law.d0), math.sqrt(params.law.d1)
    found = list[str]()
    for n, distance in zip(neighbors.flock, neighbors.clearances):
        edge = n.name in neighbors.edges
        speed = math.hypot(*n.velocity.tolist())
        if edge and speed > KEPT_UP_WITH * v_max:
            found.append(f'{n.name} at {speed:.1f} m/s, v_max {v_max:g} m/s: cannot keep up')
        if distance < near:
            found.append(f'{n.name} is too close: {distance:.2f} m, the band begins at '
                         f'{near:.2f} m')
        if edge and distance > far:
            found.append(f'{n.name} is too far: {distance:.2f} m, the band ends at {far:.2f} m')
    missing = {name for name, each in params.vehicles.items() if each.role != AVOID}
    missing -= memory.flock.keys()  # with those lost a moment ago
    return [*found, *(f'{name} neither seen nor received: no distance to it is kept'
                      for name in sorted(missing))]


def lost_leader(memory: Memory, neighbors: Neighborhood, me: OwnState,
                params: PlannerParams) -> Neighbor | None:
    """
    Return the last estimate of a lost leader to search for, at most ``resume_timeout`` old.

    The search begins if no neighbor is in view: otherwise the vehicle stays with the neighbor in
    view. The search ends when a leader is present again.
    """
    last = memory.leader
    if last is None or any(n.member.role == LEADER for n in neighbors.flock):
        return None
    begins = all(n.received for n in neighbors.flock)
    return last if (memory.looking or begins) and (
        me.stamp - last.stamp <= params.resume_timeout) else None


def last_known(memory: Memory, neighbors: Neighborhood) -> Neighbor | None:
    """Return the newest estimate of a leader, first of the faced one, then of the last one."""
    names = [each.name for each in (neighbors.faced, memory.leader) if each]
    return min((n for n in neighbors.flock if n.member.role == LEADER), default=memory.leader,
               key=lambda n: (names.index(n.name) if n.name in names else len(names), n.name))


def nominal(memory: Memory, state: State, me: OwnState, velocity: Array,
            neighbors: Neighborhood, params: PlannerParams
            ) -> tuple[Array, tuple[Array, float] | None]:
    """
    Return the acceleration (3,), m/s^2, without limits, and the fade-in to that of the law.

    In TRACK it is the acceleration of the law, or of the fade-in; in COAST zero; otherwise it
    brakes to a hover. If odometry jumped while a neighbor approached, it retreats until a neighbor
    is in sight.

    :param velocity: ego velocity when the command acts (3,), m/s.
    """
    if state is not State.TRACK:
        lost = memory.lost
        retreating = lost.approach * lost.towards if lost and not lost.name else np.zeros(3)
        return (np.zeros(3) if state is State.COAST else brake(
            velocity + retreating, params.strongest, params.brake_time_constant)), None
    flock = neighbors.flock
    differences = neighbors.velocities - me.velocity
    if len(flock) == 1:
        law = params.law.command(neighbors.offsets, differences)
    else:
        share = np.array([neighbors.shares[n.name] for n in flock])
        others = np.array([n.member.role == AVOID for n in flock])
        law = graph_law(
            neighbors.offsets, differences, share, others, params.law, params.a_max)
    fading = memory.fading
    if min(neighbors.clearances) ** 2 <= params.law.d0:
        return law, None  # too near already: no fade-in
    if memory.params is not params and memory.params != params:
        fading = np.zeros(3) if memory.command is None else memory.command, me.stamp
    if fading is None:
        return law, None
    command, since = fading
    done = (me.stamp - since + params.period) / max(params.handover_time, params.period)
    if done >= 1.0 - 1e-9:
        return law, None
    return command + max(done, 0.0) * (limit_norm(law, params.a_max) - command), fading
