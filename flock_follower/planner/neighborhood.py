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

The nominal command is that of the law for the neighbors selected. Edges are those of
``flock.neighbor_graph``; neighbors to avoid are no part of it. All distances are between hulls.

A leader that left the view is searched for while the positions of other neighbors are still
received: only the vehicle's own camera can find a leader without a radio. The vehicle that saw
it last looks where it was, to both sides, then all round. Meanwhile it follows the others by
their messages, and keeps clear of where the leader may be as it would alone. Otherwise the
vehicle would turn to another follower, and the whole flock would hover without its leader.

Warnings name what is beyond the follower's means, and members of the flock whose position is
unknown.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.flock import neighbor_graph
from flock_follower.flock.neighbor_graph import attended, HELD
from flock_follower.flocking import acceleration
from flock_follower.geometry import Array
from flock_follower.planner.inputs import at, Neighbor, OwnState
from flock_follower.planner.limits import limit_norm
from flock_follower.planner.memory import Fading, Memory, SmoothedMotion, Tie
from flock_follower.planner.params import AVOID, LEADER, member, PlannerParams

ALONE = Tie(True, 1.0)
HULLS_APART = 1e-3  # m: hulls that touch or overlap are taken to be this far apart


class Known(NamedTuple):
    """A neighbour at hand, as it is told to people."""

    name: str
    seen: bool
    """In sight; else another vehicle reported it."""
    role: str
    edge: bool
    """Whether it is attended to; else it is only kept clear of."""


class Neighborhood(NamedTuple):
    """The neighbors at hand, all at one time, and their relations to the own vehicle."""

    flock: Sequence[Neighbor]
    ties: Mapping[str, Tie]
    faced: Neighbor | None
    """Whom it faces and keeps in sight."""
    level: Neighbor | None
    """Whose altitude it follows."""
    peers: Sequence[Neighbor] = ()
    """Those at the ends of its edges, to meet at one altitude, where no leader is at hand."""

    @property
    def edges(self) -> tuple[str, ...]:
        """Return the names at the other ends of one's edges."""
        return tuple(sorted(name for name, tie in self.ties.items() if tie.edge))

    def known(self, params: PlannerParams) -> tuple[Known, ...]:
        """Return who is at hand, by name."""
        return tuple(Known(n.name, not n.heard, role(n, params), self.ties[n.name].edge)
                     for n in sorted(self.flock, key=lambda n: n.name))


def role(n: Neighbor, params: PlannerParams) -> str:
    """Return the role of a neighbour."""
    return member(params.vehicles, n.name, n.heard).role


def radii_sum(n: Neighbor, params: PlannerParams) -> float:
    """Return the sum of the radii of a neighbor and the own vehicle, m."""
    return params.radius + member(params.vehicles, n.name, n.heard).radius


def apart(n: Neighbor, me: OwnState, params: PlannerParams) -> float:
    """Return the distance between the own hull and a neighbor's, m."""
    distance = math.dist(n.position, me.position)
    thick = radii_sum(n, params)
    return distance if thick == 0.0 else max(distance - thick, 0.0)


def followed(flock: Iterable[Neighbor], params: PlannerParams) -> list[Neighbor]:
    """Return those that may be followed."""
    return [n for n in flock if role(n, params) != AVOID]


def gathered(before: Mapping[str, Tie], faced: str, me: OwnState,
             flock: Sequence[Neighbor], params: PlannerParams,
             elapsed: float) -> Neighborhood:
    """
    Return the relations of the neighbors at hand to the own vehicle.

    :param before: the ties of the step before, ``elapsed`` seconds ago; empty at the beginning.
    :param faced: the name of the neighbor that it faced then, or ''.
    :param flock: everyone at hand, carried to one time; at least one of them can be followed.
    """
    if len(flock) == 1:  # most often; one to avoid is nobody's only neighbour
        return Neighborhood(flock, {flock[0].name: ALONE}, flock[0], flock[0])
    joined = edges({name for name, tie in before.items() if tie.edge}, me, flock, params)
    change = elapsed / max(params.handover_time, params.period)
    ties = {}
    for n in flock:
        edge = n.name in joined
        share = before[n.name].share if n.name in before else 0.0
        ties[n.name] = Tie(edge, float(edge) if not before else
                           min(max(share + (change if edge else -change), 0.0), 1.0))
    follow = followed(flock, params)
    leaders = [n for n in follow if role(n, params) == LEADER]
    ends = [n for n in follow if n.name in joined]
    seen = [[n for n in some if not n.heard] for some in (leaders, ends)]
    # Eyes first: of those only heard none is worth turning away from one that is seen.
    facing = _nearest(me, faced, next(filter(None, [*seen, leaders, ends]), []))
    return Neighborhood(flock, ties, facing, _nearest(me, faced, leaders) or facing,
                        () if leaders or len(ends) < 2 else ends)


def edges(held: set[str], me: OwnState, flock: Sequence[Neighbor],
          params: PlannerParams) -> set[str]:
    """
    Return the names at the other ends of one's edges.

    :param held: those of before.
    """
    follow = followed(flock, params)
    if len(follow) < 2:
        return {n.name for n in follow}
    there = neighbor_graph.edges(
        me.position, np.array([n.position for n in follow]),
        np.array([radii_sum(n, params) for n in follow]), params.radius,
        np.array([n.name in held for n in follow]))
    joined = {n.name for n, edge in zip(follow, there) if edge}
    seen = [n for n in follow if not n.heard]
    if len(seen) == 1 and role(seen[0], params) == LEADER:
        joined.add(seen[0].name)  # words never part it from the one it sees
    return joined


def _nearest(me: OwnState, held: str, flock: Sequence[Neighbor]
             ) -> Neighbor | None:
    """Return the nearest, or the one that was, until another is clearly nearer."""
    distances = {n.name: math.dist(n.position, me.position) for n in flock}
    least = min(distances.values(), default=0.0)
    return next((n for n in flock if n.name == held and distances[held] <= HELD * least),
                min(flock, key=lambda n: distances[n.name], default=None))


KEPT_UP_WITH = 1.05  # times v_max: what noise adds to a leader at v_max is no news
GUARDED_ACCELERATION = 1.0  # m/s^2 of the leader up to which the guard holds the band
REPORTED_ACCELERATION = 1.2  # m/s^2, above by more than the noise


def reports(neighbors: Neighborhood, motions: Mapping[str, SmoothedMotion], me: OwnState,
            params: PlannerParams) -> tuple[str, ...]:
    """Return what is beyond the follower's means; () if nothing is."""
    v_max, most = params.v_max, params.climb_rate
    near, far = math.sqrt(params.law.d0), math.sqrt(params.law.d1)
    found = list[str]()
    for n in neighbors.flock:
        motion, edge = motions[n.name], neighbors.ties[n.name].edge
        speed, climb = math.hypot(*motion.velocity), float(motion.velocity[2])
        acceleration, distance = math.hypot(*motion.acceleration), apart(n, me, params)
        climbs = edge and params.altitude_mode == 'follow' and abs(climb) > KEPT_UP_WITH * most
        found += [f'{n.name} {text}' for applies, text in (
            (edge and speed > KEPT_UP_WITH * v_max,
             f'at {speed:.1f} m/s, v_max {v_max:g} m/s: cannot keep up'),
            (climbs, f'{"climbs" if climb > 0.0 else "descends"} at {abs(climb):.1f} m/s, '
                     f'followed at {most:g} m/s at most: may get out of sight'),
            (acceleration > REPORTED_ACCELERATION,
             f'accelerates at {acceleration:.1f} m/s^2: the band is held up to about '
             f'{GUARDED_ACCELERATION:g} m/s^2'),
            (distance < near,
             f'{distance:.2f} m away, the band begins at {near:.2f} m: too close'),
            (edge and distance > far,
             f'{distance:.2f} m away, the band ends at {far:.2f} m: too far')) if applies]
    return tuple(found)


class LostLeader(NamedTuple):
    """A leader that left the view, and is looked for."""

    last: Neighbor
    """What was known of it last."""
    age: float
    """How long ago, s."""

    def expected(self, params: PlannerParams) -> Neighbor:
        """Return where it is by now, or was after ``coast_timeout``: beyond is a guess."""
        return at(self.last, self.last.stamp + min(self.age, params.coast_timeout))


def sought(memory: Memory, neighbors: Neighborhood, me: OwnState,
           params: PlannerParams) -> LostLeader | None:
    """
    Return the leader to look for, up to ``resume_timeout`` after it was known of last.

    It begins within ``coast_timeout``, where everyone else is only heard of: who has another one
    in view stays with that. It ends where a leader is at hand again, seen or heard of.
    """
    last = memory.leader
    if last is None or _leaders(neighbors, params):
        return None
    age = me.stamp - last.stamp
    if not memory.looking and (age > params.coast_timeout
                               or any(not n.heard for n in neighbors.flock)):
        return None
    return LostLeader(last, age) if age <= params.resume_timeout else None


def last_known(memory: Memory, neighbors: Neighborhood,
               params: PlannerParams) -> Neighbor | None:
    """Return the newest estimate of a leader that it has seen and faced."""
    faced = neighbors.faced
    if faced is not None and not faced.heard and role(faced, params) == LEADER:
        return faced
    if memory.leader is None:
        return None
    return next((n for n in _leaders(neighbors, params) if n.name == memory.leader.name),
                memory.leader)


def _leaders(neighbors: Neighborhood, params: PlannerParams) -> list[Neighbor]:
    return [n for n in neighbors.flock if role(n, params) == LEADER]


def unknown(memory: Memory, neighbors: Neighborhood, me: OwnState,
            params: PlannerParams) -> tuple[str, ...]:
    """
    Return that somebody who flies along is not known of, while others are; () where all are.

    Who flies along is told beforehand, or was known in this flight up to ``resume_timeout`` ago.
    """
    missing = {name for name, who in params.vehicles.items() if who.role != AVOID}
    missing.update(name for name, n in memory.met.items()
                   if me.stamp - n.stamp <= params.resume_timeout)
    missing -= memory.flock.keys()  # with those lost a moment ago
    if not missing:
        return ()
    help_wanted = '' if any(n.heard for n in neighbors.flock) else (
        ': not a formation for what its cameras see; more of them, or words, would help')
    return (f'{", ".join(sorted(missing))} neither seen nor heard of, and not kept clear of'
            f'{help_wanted}',)


def nominal(memory: Memory, me: OwnState, neighbors: Neighborhood,
            params: PlannerParams) -> tuple[Array, Fading | None]:
    """Return the command of the law (3,), m/s^2, or of the fade-in to it, and the fade-in."""
    offsets = np.array([_offset(n, me, params) for n in neighbors.flock])
    differences = np.array([n.velocity - me.velocity for n in neighbors.flock])
    if len(neighbors.flock) == 1:
        law = acceleration(offsets, differences, params.law)
    else:
        share = np.array([neighbors.ties[n.name].share for n in neighbors.flock])
        others = np.array([role(n, params) == AVOID for n in neighbors.flock])
        law = attended(offsets, differences, share, others, params.law, params.a_max)
    fading = memory.fading
    if any(apart(n, me, params) ** 2 <= params.law.d0 for n in neighbors.flock):
        return law, None  # too near already: at once
    if memory.params is not params and memory.params != params:
        fading = Fading(np.zeros(3) if memory.command is None else memory.command, me.stamp)
    if fading is None:
        return law, None
    done = (me.stamp - fading.since + params.period) / max(params.handover_time, params.period)
    if done >= 1.0 - 1e-9:
        return law, None
    within = limit_norm(law, params.a_max)
    return fading.command + max(done, 0.0) * (within - fading.command), fading


def _offset(n: Neighbor, me: OwnState, params: PlannerParams) -> Array:
    """Return the vector (3,), m, from the own hull to a neighbor's."""
    offset: Array = n.position - me.position
    thick = radii_sum(n, params)
    if thick == 0.0:
        return offset
    distance = math.hypot(*offset.tolist())
    return offset * (max(distance - thick, HULLS_APART) / max(distance, HULLS_APART))
