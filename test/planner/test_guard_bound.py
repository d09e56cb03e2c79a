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

"""How near a leader with an unknown acceleration can come: the bound of docs/guard.md."""

from __future__ import annotations

from collections import deque
import math

import numpy as np
import pytest

from flock_follower.flocking import FlockingParams
from flock_follower.planner.bound_keeping import keep_bounds as guard
from flock_follower.planner.bounds import radial_bounds
from flock_follower.planner.guard import sort_bounds
from flock_follower.planner.params import EDGE_RETURN_SPEED, Edges, GuardParams

PARAMS = GuardParams()
BAND = Edges.of(FlockingParams(beta=0.25, d1=8.0), PARAMS)
PERIOD, STEPS = 0.1, 10  # s between commands, and steps of the motion in one
AHEAD = np.array([1.0, 0.0, 0.0])


def bound(unknown: float, delay: float, velocity_error: float, range_error: float) -> float:
    """Return by how much, m, the gap to the margin may be negative; infinite where unbounded."""
    rate = velocity_error + unknown * delay
    gap = range_error + 0.5 * unknown * delay ** 2
    beyond = (unknown * PARAMS.T_g + rate * (1.0 + PARAMS.T_g / PARAMS.tau) + gap / PARAMS.tau)
    return PARAMS.tau * beyond if beyond <= EDGE_RETURN_SPEED else math.inf


def least_gap(unknown: float, delay: float, velocity_error: float, range_error: float,
              side: float) -> float:
    """
    Return the least gap, m, to the margin of an edge in 30 s, once the follower has come to it.

    The follower wants towards the edge as hard as it can. Its commands act ``delay`` later, which
    it counts with; the leader accelerates towards that edge all the time, of which it knows
    nothing, and velocity and distance are wrong to the worse side.

    :param side: 1 for the near edge, -1 for the far one.
    """
    count = round(delay / PERIOD)
    queue = deque([np.zeros(3)] * count)
    edge = BAND.near + BAND.margin if side > 0 else BAND.far - BAND.margin
    distance, rate = edge + side * 0.3, 0.0  # of the leader ahead, and how fast that changes
    own, least = 0.0, math.inf
    for tick in range(300):
        pending = PERIOD * sum((a[0] for a in queue), 0.0)
        reported = distance + side * range_error
        closing = rate + side * velocity_error - pending
        found = radial_bounds(-reported * AHEAD, -closing * AHEAD, BAND, PARAMS)
        queue.append(guard(side * 5.0 * AHEAD, np.zeros(3), sort_bounds(found), 20.0, 90.0,
                           PERIOD).acceleration)
        acceleration = queue.popleft()
        for _ in range(STEPS):
            rate += (-side * unknown - acceleration[0]) * PERIOD / STEPS
            distance += rate * PERIOD / STEPS
            own += acceleration[0] * PERIOD / STEPS
            if tick > 50:
                least = min(least, side * (distance - edge))
    return least


@pytest.mark.parametrize('side', [1.0, -1.0], ids=['near', 'far'])
@pytest.mark.parametrize('delay', [0.0, 0.1, 0.2, 0.3])
@pytest.mark.parametrize('unknown', [0.0, 0.1, 0.2, 0.3])
@pytest.mark.parametrize(('velocity_error', 'range_error'), [(0.0, 0.0), (0.03, 0.01)])
def test_no_leader_comes_nearer_than_the_bound_says(
        unknown: float, delay: float, velocity_error: float, range_error: float,
        side: float) -> None:
    allowed = bound(unknown, delay, velocity_error, range_error)
    assert allowed < PARAMS.m
    gap = least_gap(unknown, delay, velocity_error, range_error, side)
    assert gap >= -allowed - 0.01  # the motion is stepped
    if unknown >= 0.2 and delay == 0.0:
        assert gap < -0.3 * allowed  # and the bound is not far off
