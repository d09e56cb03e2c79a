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
How far, how fast and how high the follower moves away from a neighbor that it cannot see.

While a neighbor is out of sight, the guard's bounds move the follower by at most ``retreat``, and
``overflight`` lets an approaching neighbor pass below. If odometry is lost, there are no commands:
the gate brakes to ``fallback_retreat``. No function reads a clock.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, SHORTEST
from flock_follower.messages.commands import ODOMETRY_GAP
from flock_follower.planner.inputs import ACCELERATION_NOISE, Neighbor
from flock_follower.planner.memory import Loss, max_age, Memory
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.scene import Scene
from flock_follower.planner.vectors import difference, scalar_product

APPROACH_NOISE = 0.1  # m/s: a slower neighbor does not count as approaching
RETREAT_TIME = 2.0  # s of v_max: no retreat is longer, nor longer than retreat_max
DRIFT_SPEED = 0.2  # m/s by which the velocity of the autopilot is wrong without odometry
UNKNOWN_PLACE = 1.0  # m: the same if the place of the neighbor is unknown, as odometry jumped
STOPPING_TIME = 0.6  # s at its own speed that a vehicle goes on when odometry is lost
YIELD_TIME = 2.0  # s of the approach speed by which the retreat is longer
YIELD_MAX = 3.0  # m by which the retreat is longer at most
CLIMB_TIME = 2.5  # s: if an approaching neighbor uses up the retreat earlier, it is overflown
OVERFLIGHT_CLIMB = 1.0  # m of climb above a neighbor that is overflown
MAX_HEIGHT_ABOVE = 0.3  # m: a neighbor lost higher than the vehicle by more may come down on it


def retreat(lost: Loss, params: PlannerParams) -> float:
    """
    Return the largest retreat from a neighbor out of sight, m.

    A leader is assumed to be no faster than ``v_max``: so the retreat is shorter for a small
    ``v_max``. A leader that was lost above the vehicle is out of view until it comes down,
    possibly on the vehicle: for this leader, the retreat does not depend on ``v_max``. If the
    leader was lost beyond the band, the retreat is shorter by the distance beyond the band.
    """
    distance = lost.free - float(lost.towards @ lost.origin)
    beyond = max(distance - math.sqrt(params.law.d1), 0.0)
    known = math.inf if lost.name else UNKNOWN_PLACE
    lasting = math.inf if _is_above(lost) else RETREAT_TIME
    return max(_longest_retreat(lost.approach, params, known, lasting) - beyond, 0.0)


def _is_above(lost: Loss) -> bool:
    """Return whether the neighbor was lost so high above the vehicle that it may come over it."""
    return lost.height > float(lost.origin[2]) + MAX_HEIGHT_ABOVE


def _longest_retreat(approach: float, params: PlannerParams, known: float = math.inf,
                     lasting: float = RETREAT_TIME) -> float:
    """Return the largest retreat, m, from a neighbor that approached at a speed, m/s."""
    coming = params.retreat_max > 0.0 and approach > APPROACH_NOISE
    return min(params.retreat_max, lasting * params.fastest, known) + (
        coming * min(YIELD_TIME * approach, YIELD_MAX))


class FallbackRetreat(NamedTuple):
    """The retreat that begins if odometry is lost now."""

    velocity: Array
    """Velocity (3,), m/s, to brake to."""
    approach: float
    """Speed, m/s, at which the neighbor may approach meanwhile."""


def fallback_retreat(memory: Memory, scene: Scene,
                     params: PlannerParams) -> FallbackRetreat | None:
    """
    Return the retreat that keeps the distance to a neighbor while odometry is lost, or None.

    The retreat is from the nearest neighbor that approaches, or will approach within TRUSTED_TIME.
    A neighbor that has begun to accelerate towards the vehicle also counts, if it would come
    nearer than the margin within ODOMETRY_GAP, see ``turned_path``; the speed of the retreat then
    keeps the margin. The length of the retreat is limited as for a neighbor out of sight.
    """
    if not params.guard or params.retreat_max == 0.0:
        return None
    around, position = list[tuple[float, str, Sequence[float]]](), scene.me.position.tolist()
    for n in memory.flock.values():
        if scene.me.stamp - n.stamp <= max_age(n, params):
            x, y, _ = difference(position, scene.predictions[n.name].position)
            distance = math.hypot(x, y)
            length = max(distance, SHORTEST)
            around.append((distance - params.radius - n.member.radius - params.edges.near
                           - params.edges.margin, n.name, (x / length, y / length, 0.0)))
    for gap, name, away in sorted(around):
        n, it = memory.flock[name], scene.predictions[name]
        approach, speed = max(scalar_product(away, it.velocity),
                              scalar_product(away, it.later)), 0.0
        if approach > APPROACH_NOISE:
            speed = approach + DRIFT_SPEED - min(
                params.guarding.closing_speed(gap)[0], 0.0)
        if scalar_product(away, _newest_acceleration(n, memory)) > ACCELERATION_NOISE:
            now = scalar_product(away, n.velocity.tolist())
            own = max(-scalar_product(away, scene.me.velocity.tolist()), 0.0)
            lacking = turned_path(now, params) + STOPPING_TIME * own - gap
            if lacking > 0.0:
                speed = max(speed, DRIFT_SPEED + lacking / (ODOMETRY_GAP - STOPPING_TIME))
                approach = max(approach, min(
                    now + ODOMETRY_GAP * params.leader_acceleration_max, params.fastest))
        if speed > 0.0:
            speed = min(speed, params.fastest, _longest_retreat(approach, params) / ODOMETRY_GAP)
            return FallbackRetreat(speed * np.array(away), approach)
    return None


def _newest_acceleration(n: Neighbor, memory: Memory) -> list[float]:
    """Return the acceleration of the newest estimate (3,), m/s^2: smoothed it comes too late."""
    return memory.acceleration(n) if n.received or n.acceleration is None else (
        n.acceleration.tolist())


def turned_path(approach: float, params: PlannerParams) -> float:
    """
    Return by how much a neighbor that turns may be nearer after ODOMETRY_GAP, m.

    The neighbor accelerates towards the vehicle by ``leader_acceleration_max``, up to ``v_max``.

    :param approach: its speed towards the vehicle now, m/s; negative if it flies away.
    """
    most = params.leader_acceleration_max
    lasting = min(max(params.fastest - approach, 0.0) / most, ODOMETRY_GAP) if most > 0.0 else 0.0
    return approach * ODOMETRY_GAP + most * lasting * (ODOMETRY_GAP - 0.5 * lasting)


def overflight(lost: Loss, position: Array, held: float, params: PlannerParams) -> float:
    """
    Return the least height, m, at which an approaching neighbor out of sight may pass below.

    Without a ceiling (the default of ``altitude_max``), or with a ``retreat_max`` of 0, the result
    is -inf.

    :param held: altitude to hold, m.
    """
    left = retreat(lost, params) - lost.retreat_distance(position)
    overtaken = lost.approach > APPROACH_NOISE and left <= CLIMB_TIME * lost.approach
    if (params.altitude_max >= PlannerParams.altitude_max or params.retreat_max == 0.0
            or not overtaken or _is_above(lost)):
        return -math.inf
    return held + OVERFLIGHT_CLIMB
