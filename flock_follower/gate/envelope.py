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
The limits of the gate, and the safety envelope: setpoints stay within heights and a radius.

Each bound limits the acceleration towards it, so that the vehicle can still stop in front of it. A
vehicle beyond a bound is handed to the autopilot's hold mode. Vectors are ENU.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Final, NamedTuple

from flock_follower.geometry import Array
from flock_follower.planner.projection import product, Side
from flock_follower.ranges import (
    A_MAX,
    Checked,
    first_reason,
    ODOM_TIMEOUT,
    parameter,
    Range,
    V_MAX,
)

#: Tolerance of the difference between two velocities, as a share of v_max, if no limit is set.
VELOCITY_TOLERANCE_SHARE: Final[float] = 0.5
#: The tolerance is at least this, m/s: the healthy estimate of PX4 1.16 (SIH, odometry forwarded)
#: errs by up to 0.25, averaged.
MIN_VELOCITY_TOLERANCE: Final[float] = 0.4


@dataclass(frozen=True)
class GateLimits(Checked):
    """Limits and timeouts of the gate; a ValueError names parameter, value and valid range."""

    a_max: float = parameter(
        2.5, A_MAX, 'largest magnitude of the acceleration', live=True)
    v_max: float = parameter(0.5, V_MAX, 'largest speed', live=True)
    planner_timeout: float = parameter(
        0.2, Range(0.15, 1.0, 's'), 'largest age of a command; the planner sends one every 0.1 s',
        live=False)
    odom_timeout: float = parameter(0.3, ODOM_TIMEOUT, 'largest age of a velocity', live=True)
    link_timeout: float = parameter(
        1.0, Range(0.2, 5.0, 's'), 'silence of the autopilot before braking', live=True)
    blind_timeout: float = parameter(
        2.0, Range(0.2, 10.0, 's'),
        'After this long without a velocity that was known before, the stream stops, s; sooner '
        'if there is one that cannot be used, see ``velocity_check.LOSS_TIMEOUT``.')
    speed_horizon: float = parameter(
        0.3, Range(0.02, 2.0, 's'),
        "The speed is predicted this far ahead, s: twice a quadrotor's attitude lag, so that a "
        'vehicle which answers late does not overshoot ``v_max``; further where the velocity is '
        'late.')
    brake_time: float = parameter(
        0.3, Range(0.02, 2.0, 's'),
        'Time constant of braking, s; longer where the velocity is late.')
    yaw_disagreement: float = parameter(
        0.35, Range(0.01, 3.2, 'rad'),
        'difference between the yaws of odom and autopilot above which the bridge brakes, and '
        'refuses offboard', live=True)
    velocity_disagreement: float = parameter(
        0.0, Range(0.0, 100.0, 'm/s'),
        'difference between the velocities of odom and autopilot above which neither is used, if '
        'odom is the velocity source; 0: half of v_max, and 0.4 at least', live=True)
    height_min: float = parameter(
        0.5, Range(0.3, 100.0, 'm'),
        'least height of setpoints above the place of arming, by barometer or '
        'rangefinder', live=False)
    height_max: float = parameter(
        10.0, Range(0.5, 1000.0, 'm'), 'greatest height above the place of arming', live=False)
    radius_max: float = parameter(
        50.0, Range(1.0, 10000.0, 'm'),
        'greatest horizontal distance from the place where the bridge became ACTIVE', live=False)
    relative_flight: bool = parameter(
        False, None,
        'follow the marker without odometry while that is lost or contradicted: without a bound '
        'of the speed over the ground, see docs/fly.md', live=False)
    relative_timeout: float = parameter(
        30.0, Range(1.0, 60.0, 's'), 'longest flight without odometry', live=False)

    def __post_init__(self) -> None:
        """Check the fields, and that the heights are in order."""
        super().__post_init__()
        if self.height_max <= self.height_min:
            raise ValueError(f'height_max = {self.height_max:g}: must be a number in '
                             f'({self.height_min:g}, 1000] m, where height_min = '
                             f'{self.height_min:g}')

    @property
    def velocity_tolerance(self) -> float:
        """Return the largest difference between the velocities of odom and autopilot, m/s."""
        return self.velocity_disagreement or max(VELOCITY_TOLERANCE_SHARE * self.v_max,
                                                 MIN_VELOCITY_TOLERANCE)


#: The share of ``a_max`` that a stop at a bound is planned with: the rest is for errors of thrust.
BRAKING_SHARE: Final[float] = 0.4
#: Time from a decision to the commanded acceleration, s: attitude, sending, velocity.
REACTION_TIME: Final[float] = 0.4
#: Time constant of the return from beyond a bound of the envelope, s.
ENVELOPE_RETURN_TIME: Final[float] = 1.0
#: Largest speed of that return, m/s.
ENVELOPE_RETURN_SPEED: Final[float] = 0.3
#: Beyond a bound by more than this, m, the vehicle is handed over: 5 sigma of the height.
TOLERANCE: Final[float] = 0.15


class Location(NamedTuple):
    """The vehicle's location in its envelope."""

    height: float | None = None
    """Height, m; None if unknown: then no height bound acts."""
    climb_rate: float = 0.0
    """Climb rate, m/s, by the sensor of the height."""
    offset: Array | None = None
    """Horizontal offset (2,), m, from the position at ACTIVE; None before."""

    @property
    def known_height(self) -> float | None:
        """Return the height, m; None if the height or the climb rate is unknown."""
        known = self.height is not None and math.isfinite(self.height + self.climb_rate)
        return self.height if known else None


def approach_speed(distance: float, deceleration: float) -> float:
    """
    Return the largest speed, m/s, towards a bound from which the vehicle still stops before it.

    The vehicle flies on for REACTION_TIME and then brakes. Beyond the bound the speed is
    negative: the vehicle returns.

    :param distance: to the bound, m; negative beyond it.
    :param deceleration: m/s^2.
    """
    if distance <= 0.0:
        return max(distance / ENVELOPE_RETURN_TIME, -ENVELOPE_RETURN_SPEED)
    lost = deceleration * REACTION_TIME
    return math.sqrt(lost * lost + 2.0 * deceleration * distance) - lost


def vertical_range(limits: GateLimits, place: Location, climb_rate: float, horizon: float,
                   a_max: float) -> tuple[float, float]:
    """
    Return the least and greatest vertical acceleration, m/s^2, that the height bounds permit.

    :param climb_rate: by the odometry, m/s; each bound takes the worse of this rate and the
        sensor's.
    :param horizon: time in which the speed is reached, s.
    :param a_max: largest magnitude of the acceleration, m/s^2.
    """
    height, braking = place.known_height, BRAKING_SHARE * a_max
    if height is None:
        return -math.inf, math.inf
    falling = approach_speed(height - limits.height_min, braking)
    rising = approach_speed(limits.height_max - height, braking)
    lowest, highest = sorted((climb_rate, place.climb_rate))
    return (-falling - lowest) / horizon, (rising - highest) / horizon


def inward(limits: GateLimits, place: Location, velocity: Array, horizon: float) -> Side | None:
    """
    Return the bound of the horizontal acceleration, m/s^2, near ``radius_max``, else None.

    :param velocity: (3,), m/s.
    :param horizon: time in which the speed is to be reached, s.
    """
    if place.offset is None:
        return None
    distance = math.hypot(*place.offset.tolist())
    if not 0.5 * limits.radius_max < distance < math.inf:
        return None  # at the center no direction is outwards
    outward = complex(*place.offset.tolist()) / distance
    speed = approach_speed(limits.radius_max - distance, BRAKING_SHARE * limits.a_max)
    closing = product(outward, complex(float(velocity[0]), float(velocity[1])))
    return -outward, (closing - speed) / horizon


def find_exceeded_bound(limits: GateLimits, place: Location, tolerance: float = TOLERANCE) -> str:
    """Return the bound that the vehicle exceeds by more than a tolerance, m, as text, or ''."""
    height = limits.height_min if place.height is None else place.height
    distance = 0.0 if place.offset is None else math.hypot(*place.offset.tolist())
    return first_reason(
        (height < limits.height_min - tolerance,
         f'height {height:.2f} m: below height_min = {limits.height_min:g} m'),
        (height > limits.height_max + tolerance,
         f'height {height:.2f} m: above height_max = {limits.height_max:g} m'),
        (distance > limits.radius_max + tolerance,
         f'{distance:.2f} m from where it became ACTIVE: beyond radius_max = '
         f'{limits.radius_max:g} m'))


def refuse_height(limits: GateLimits, height: float | None) -> str:
    """Return why a vehicle at a height, m, may not fly our setpoints, or ''."""
    if height is None:
        return ('the height above the place of arming is not known: neither barometer '
                '(SCALED_PRESSURE) nor rangefinder (DISTANCE_SENSOR), or armed before the bridge '
                'started and no HOME_POSITION')
    return find_exceeded_bound(limits, Location(height), 0.0)
