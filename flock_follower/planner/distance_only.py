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

from collections.abc import Iterable
import math

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.guard import Edges, radial_bounds, RadialBounds
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.neighborhood import hulls
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.prediction import expected

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
