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
Whom to attend to: the edges of the neighbour graph, which every vehicle chooses for itself.

Two vehicles are joined where nobody is nearer to both than they are to each other: the relative
neighbourhood graph (Toussaint, Pattern Recognition 12, 1980). It holds the minimum spanning tree,
so it is connected; it is a local rule that both ends decide alike, where both know the same; and
it has few edges, each as long as the flock's spacing. An edge that is there goes only where
somebody is nearer to both by HELD: every graph between the two is connected as well.

Whoever is to be avoided is no part of it. All lengths are between hulls.

A neighbour of which only the distance is known: kept clear of, and not followed.

Where sight is lost ranges may go on (``perception.range_tracking``). They bound its estimate
along the line to it; across that it grows as uncertain as the neighbour may move, so it may be
anywhere on a sphere around oneself. What is left to do is not to let that sphere become smaller
than the band's inner edge, by backing away from where it was known to be last.

That helps as long as it cannot have come round to the other side. Whoever is followed flies no
faster than ``v_max``, so in a time t it has come no farther than v_max t from where it was. As
long as that is less than sqrt(r^2 + d^2), r being how far that place is away now and d the
distance measured, it is still on that side. Beyond, to back away is a guess, and the fences go
before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.flock import neighbor_graph
from flock_follower.flock.neighbor_graph import HELD
from flock_follower.geometry import Array
from flock_follower.planner.guard import Edges, radial_bounds, RadialBounds
from flock_follower.planner.inputs import expected, NeighborEstimate, OwnState
from flock_follower.planner.params import AVOID, LEADER, member, PlannerParams


class Known(NamedTuple):
    """A neighbour at hand, as it is told to people."""

    name: str
    seen: bool
    """With one's own eyes; else another vehicle told of it."""
    role: str
    edge: bool
    """Whether it is attended to; else it is only kept clear of."""


class Tie(NamedTuple):
    """How a neighbour is attended to."""

    edge: bool
    share: float
    """From 0 for none to 1 for an edge: it changes over the time of a handover."""


ALONE = Tie(True, 1.0)


class Neighborhood(NamedTuple):
    """Those at hand, all at one time, and what they are to oneself."""

    flock: Sequence[NeighborEstimate]
    ties: Mapping[str, Tie]
    guide: NeighborEstimate | None
    """Whom it faces and keeps in sight."""
    level: NeighborEstimate | None
    """Whose altitude it follows."""
    abreast: Sequence[NeighborEstimate] = ()
    """Those at the ends of its edges, to meet at one altitude, where no leader is at hand."""

    @property
    def edges(self) -> tuple[str, ...]:
        """Return the names at the other ends of one's edges."""
        return tuple(sorted(name for name, tie in self.ties.items() if tie.edge))

    def known(self, params: PlannerParams) -> tuple[Known, ...]:
        """Return who is at hand, by name."""
        return tuple(Known(n.name, not n.heard, role(n, params), self.ties[n.name].edge)
                     for n in sorted(self.flock, key=lambda n: n.name))


def role(n: NeighborEstimate, params: PlannerParams) -> str:
    """Return the role of a neighbour."""
    return member(params.vehicles, n.name, n.heard).role


def hulls(n: NeighborEstimate, params: PlannerParams) -> float:
    """Return what the hulls of a neighbour and oneself take of the distance between, m."""
    return params.radius + member(params.vehicles, n.name, n.heard).radius


def apart(n: NeighborEstimate, me: OwnState, params: PlannerParams) -> float:
    """Return the distance between one's own hull and a neighbour's, m."""
    distance = math.dist(n.position, me.position)
    thick = hulls(n, params)
    return distance if thick == 0.0 else max(distance - thick, 0.0)


def followed(flock: Iterable[NeighborEstimate], params: PlannerParams) -> list[NeighborEstimate]:
    """Return those that may be followed."""
    return [n for n in flock if role(n, params) != AVOID]


def gathered(before: Mapping[str, Tie], guide: str, me: OwnState,
             flock: Sequence[NeighborEstimate], params: PlannerParams,
             elapsed: float) -> Neighborhood:
    """
    Return what those at hand are to oneself.

    :param before: the ties of the step before, ``elapsed`` seconds ago; empty at the beginning.
    :param guide: the name of whom it faced then, or ''.
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
    facing = _nearest(me, guide, next(filter(None, [*seen, leaders, ends]), []))
    return Neighborhood(flock, ties, facing, _nearest(me, guide, leaders) or facing,
                        () if leaders or len(ends) < 2 else ends)


def edges(held: set[str], me: OwnState, flock: Sequence[NeighborEstimate],
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
        np.array([hulls(n, params) for n in follow]), params.radius,
        np.array([n.name in held for n in follow]))
    joined = {n.name for n, edge in zip(follow, there) if edge}
    seen = [n for n in follow if not n.heard]
    if len(seen) == 1 and role(seen[0], params) == LEADER:
        joined.add(seen[0].name)  # words never part it from the one it sees
    return joined


def _nearest(me: OwnState, held: str, flock: Sequence[NeighborEstimate]
             ) -> NeighborEstimate | None:
    """Return the nearest, or the one that was, until another is clearly nearer."""
    distances = {n.name: math.dist(n.position, me.position) for n in flock}
    least = min(distances.values(), default=0.0)
    return next((n for n in flock if n.name == held and distances[held] <= HELD * least),
                min(flock, key=lambda n: distances[n.name], default=None))


DEVIATIONS = 2.0  # standard ones by which the distance may be less than measured
#: Farther away than one in sight, m: once it is seen again, v_max goes into its altitude first.
BLIND = 0.3
TOUCHING = 1e-6  # m: nearer than this there is no direction


def distance_known(n: NeighborEstimate, own: OwnState | None, max_position_std: float) -> bool:
    """
    Return whether the distance is known of one whose position is too uncertain.

    It is where its variance is at most a third of what is admitted of a position's three axes: of
    what is equally uncertain in all of them nothing is known.
    """
    if own is None:
        return False
    sight = n.position - own.position - (n.stamp - own.stamp) * own.velocity
    distance, most = math.hypot(*sight.tolist()), max_position_std ** 2
    if not (distance > TOUCHING and float(n.position_covariance.trace()) > most):
        return False
    return 0.0 <= _variance(n, sight / distance) <= most / 3.0


def clear_of_sphere(n: NeighborEstimate, known: NeighborEstimate | None, me: OwnState,
                    velocity: Array, params: PlannerParams) -> RadialBounds | None:
    """
    Return the bound that keeps at the distance that is known.

    :param known: the last estimate that said where it is; None where there was none.
    :param velocity: one's own when the command acts (3,), m/s.
    """
    its = np.zeros(3) if n.acceleration is None else n.acceleration
    it = expected(n, its, me.stamp - n.stamp, params)
    sight = it.position - me.position
    distance, level = math.hypot(*sight.tolist()), math.hypot(*sight[:2].tolist())
    if not level > TOUCHING:
        return None
    along = sight / distance
    towards, sure = np.array([sight[0], sight[1], 0.0]) / level, False
    if known is not None:
        x, y, _ = (known.position - me.position).tolist()
        away = math.hypot(x, y)
        if away > TOUCHING:
            towards = np.array([x, y, 0.0]) / away
            sure = params.fastest * (me.stamp - known.stamp) <= math.hypot(away, distance)
    # As measured; what changes until the command acts is one's own motion on the line backwards.
    rate = float(along @ (it.velocity - me.velocity) - towards @ (velocity - me.velocity))
    inner = Edges.of(params.law, params.guarding)
    band = inner._replace(
        near=inner.near + hulls(n, params), far=math.inf, spreading=it.spreading,
        spread=it.spread + BLIND + DEVIATIONS * math.sqrt(max(_variance(n, along), 0.0)))
    found = radial_bounds(-distance * towards, -rate * towards, band, params.guarding,
                          float(along @ it.acceleration) * towards)
    return None if found is None else found._replace(seen=sure)


def said(ranged: Iterable[NeighborEstimate], me: OwnState) -> tuple[str, ...]:
    """Return in words how far those are of whom only that is known."""
    return tuple(f'{n.name} out of sight, {math.dist(n.position, me.position):.1f} m away by '
                 'its ranges' for n in ranged)


def _variance(n: NeighborEstimate, along: Array) -> float:
    return float(along @ n.position_covariance @ along)
