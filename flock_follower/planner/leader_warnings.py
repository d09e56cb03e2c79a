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


"""What neighbours do that the follower cannot do anything about, said in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.inputs import NeighborEstimate, OwnState
from flock_follower.planner.neighborhood import apart, Neighborhood
from flock_follower.planner.params import PlannerParams

SMOOTHING = 0.4  # s: the noise of a filtered velocity, 0.03 m/s, becomes less than 0.1 m/s^2
LONGEST_GAP = 1.0  # s without an estimate after which the smoothing begins anew
KEPT_UP_WITH = 1.05  # times v_max: what noise adds to a leader at v_max is no news
GUARDED_ACCELERATION = 1.0  # m/s^2 of the leader up to which the guard holds the band
REPORTED_ACCELERATION = 1.2  # m/s^2, above by more than the noise


class SmoothedMotion(NamedTuple):
    """A neighbour's velocity (3,), m/s, at a stamp, s: smoothed, and how fast it changes."""

    stamp: float
    velocity: Array
    acceleration: Array
    """(3,), m/s^2."""


def observed(motions: Mapping[str, SmoothedMotion],
             neighbors: Iterable[NeighborEstimate]) -> dict[str, SmoothedMotion]:
    """
    Return the motions of the neighbours, brought up to their newest estimates.

    The smoothed velocity u follows the estimated one with du/dt = (v - u) / SMOOTHING; under a
    constant acceleration it changes as fast as v does. An acceleration that the estimate has
    itself is taken instead: it lags less.
    """
    updated = {}
    for n in neighbors:
        last = motions.get(n.name)
        if last is not None and last.stamp == n.stamp:
            updated[n.name] = last
        elif last is None or not 0.0 <= n.stamp - last.stamp <= LONGEST_GAP:
            updated[n.name] = SmoothedMotion(
                n.stamp, n.velocity, np.zeros(3) if n.acceleration is None else n.acceleration)
        else:
            behind = n.velocity - last.velocity
            elapsed = n.stamp - last.stamp
            change = -math.expm1(-elapsed / SMOOTHING) * behind
            updated[n.name] = SmoothedMotion(
                n.stamp, last.velocity + change,
                change / elapsed if n.acceleration is None else n.acceleration)
    return updated


def reports(hood: Neighborhood, motions: Mapping[str, SmoothedMotion], me: OwnState,
            params: PlannerParams) -> tuple[str, ...]:
    """Return what is beyond the follower's means; () where nothing is."""
    law, v_max = params.law, params.v_max
    said = []
    for n in hood.flock:
        motion, edge = motions[n.name], hood.ties[n.name].edge
        speed = math.hypot(*motion.velocity)
        distance = apart(n, me, params)
        if edge and speed > KEPT_UP_WITH * v_max:
            said.append(f'{n.name} at {speed:.1f} m/s, v_max {v_max:g} m/s: cannot keep up')
        climb, most = float(motion.velocity[2]), params.climb_rate
        if edge and params.altitude_mode == 'follow' and abs(climb) > KEPT_UP_WITH * most:
            said.append(f'{n.name} {"climbs" if climb > 0.0 else "descends"} at '
                        f'{abs(climb):.1f} m/s, followed at {most:g} m/s at most: may get out of '
                        'sight')
        acceleration = math.hypot(*motion.acceleration)
        if acceleration > REPORTED_ACCELERATION:
            said.append(f'{n.name} accelerates at {acceleration:.1f} m/s^2: the band is '
                        f'held up to about {GUARDED_ACCELERATION:g} m/s^2')
        if distance < math.sqrt(law.d0):
            said.append(f'{n.name} {distance:.2f} m away, the band begins at '
                        f'{math.sqrt(law.d0):.2f} m: too close')
        elif edge and distance > math.sqrt(law.d1):
            said.append(f'{n.name} {distance:.2f} m away, the band ends at '
                        f'{math.sqrt(law.d1):.2f} m: too far')
    return tuple(said)
