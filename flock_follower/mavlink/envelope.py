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
The safety envelope: heights and a radius that no setpoint leads out of, whatever is commanded.

Each bound limits the acceleration towards it, so that the vehicle can still stop in front of it. A
vehicle that is beyond a bound all the same is to be handed to the autopilot's hold mode. Vectors
are ENU; height is above the place of arming, see ``height``.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from flock_follower.geometry import Array
from flock_follower.mavlink.gate_limits import GateLimits
from flock_follower.planner.projection import product, Side

#: The share of ``a_max`` that a stop at a bound is planned with: the rest is for errors of thrust.
BRAKING_SHARE: Final[float] = 0.4
#: Time from a decision to the acceleration that it asks for, s: attitude, sending, velocity.
REACTION_TIME: Final[float] = 0.4
#: Time constant and largest speed of the way back from beyond a bound, s and m/s.
RETURN_TIME: Final[float] = 1.0
RETURN_SPEED: Final[float] = 0.3
#: Beyond a bound by more than this, m, the vehicle is handed over: 5 sigma of the height.
TOLERANCE: Final[float] = 0.15


class Location(NamedTuple):
    """Where the vehicle is in its envelope."""

    height: float | None = None
    """m; None where it is not known: then nothing bounds it."""
    climb_rate: float = 0.0
    """m/s, by the source of the height."""
    offset: Array | None = None
    """(2,), m, horizontally from where it became ACTIVE; None before."""


NOWHERE: Final[Location] = Location()


def approach_speed(distance: float, deceleration: float) -> float:
    """
    Return the largest speed, m/s, towards a bound from which the vehicle still stops before it.

    It flies on for REACTION_TIME and then brakes; beyond the bound the speed is negative: it
    returns.

    :param distance: to the bound, m; negative beyond it.
    :param deceleration: m/s^2.
    """
    if distance <= 0.0:
        return max(distance / RETURN_TIME, -RETURN_SPEED)
    lost = deceleration * REACTION_TIME
    return math.sqrt(lost * lost + 2.0 * deceleration * distance) - lost


def vertical_range(limits: GateLimits, place: Location, climb_rate: float, offset: float,
                   horizon: float) -> tuple[float, float]:
    """
    Return the least and the greatest vertical acceleration, m/s^2, by the heights.

    :param climb_rate: by the odometry, m/s: the rate that is worse for a bound counts.
    :param offset: upward acceleration, m/s^2, by which setpoints offset an error of the thrust.
    :param horizon: time in which the speed is to be reached, s.
    """
    if place.height is None:
        return -math.inf, math.inf
    braking = BRAKING_SHARE * limits.a_max
    falling = approach_speed(place.height - limits.height_min, braking)
    rising = approach_speed(limits.height_max - place.height, braking)
    lowest, highest = sorted((climb_rate, place.climb_rate))
    return ((-falling - lowest) / horizon + offset, (rising - highest) / horizon + offset)


def inward(limits: GateLimits, place: Location, velocity: Array, horizon: float) -> Side | None:
    """
    Return the bound of the horizontal acceleration, m/s^2, by ``radius_max``; None far from it.

    :param velocity: (3,), m/s.
    :param horizon: time in which the speed is to be reached, s.
    """
    if place.offset is None:
        return None
    offset = complex(*place.offset.tolist())
    distance = abs(offset)
    if distance <= 0.5 * limits.radius_max:
        return None  # at the centre no direction is outwards
    outward = offset / distance
    speed = approach_speed(limits.radius_max - distance, BRAKING_SHARE * limits.a_max)
    closing = product(outward, complex(float(velocity[0]), float(velocity[1])))
    return -outward, (closing - speed) / horizon


def exceeded(limits: GateLimits, place: Location) -> str:
    """Return which bound the vehicle is beyond, in words, or ''."""
    if place.height is not None:
        if place.height < limits.height_min - TOLERANCE:
            return f'height {place.height:.2f} m: below height_min = {limits.height_min:g} m'
        if place.height > limits.height_max + TOLERANCE:
            return f'height {place.height:.2f} m: above height_max = {limits.height_max:g} m'
    if place.offset is not None:
        distance = math.hypot(*place.offset.tolist())
        if distance > limits.radius_max + TOLERANCE:
            return (f'{distance:.2f} m from where it became ACTIVE: beyond radius_max = '
                    f'{limits.radius_max:g} m')
    return ''


def outside(limits: GateLimits, height: float | None) -> str:
    """Return why a vehicle of a height, m, may not fly our setpoints, or ''."""
    if height is None:
        return ('the height above the place of arming is not known: neither barometer '
                '(SCALED_PRESSURE) nor rangefinder (DISTANCE_SENSOR), or armed before the bridge '
                'started and no HOME_POSITION')
    if height < limits.height_min:
        return f'height = {height:.2f} m: must be at least height_min = {limits.height_min:g} m'
    if height > limits.height_max:
        return f'height = {height:.2f} m: must be at most height_max = {limits.height_max:g} m'
    return ''
