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

``HeightEstimator`` estimates the height above the place of arming by a sensor that our odometry is
not fused into: the autopilot's barometer, or its rangefinder if no barometer is reported. An
observer with two poles at -BANDWIDTH follows the sensor. Between two samples it integrates a
vertical velocity of the vehicle, whose constant error it estimates. If the sensor jumps and that
velocity does not (a gust, a door, a table below), the reference is shifted by the jump. If another
sensor takes over, its altitudes are shifted: they have another zero.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math
from typing import Final, NamedTuple

from flock_follower.gate.obstacle import Obstacle
from flock_follower.geometry import Array
from flock_follower.messages import FASTEST_OWN, SANE
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


#: 1/s. White noise of 0.09 m at 20 Hz (PX4 1.16, SIH) leaves 0.02 m in the height.
BANDWIDTH: Final[float] = 1.0
#: s: until then the observer does not know the vertical velocity by the sensor alone.
SETTLING: Final[float] = 3.0
#: m/s: a larger error of a vertical velocity is not corrected: the sensor may be the wrong one.
MAX_CORRECTION: Final[float] = 1.0
#: A height older than this, s, is not known any more.
HEIGHT_TIMEOUT: Final[float] = 1.0
#: The sensor has jumped if its newest samples differ on average by more than this from the height
#: expected, m.
STEP: Final[float] = 0.25
#: They differ by more than this from the samples before, too, m: a climb that the other source
#: denies grows more slowly.
STEP_CHANGE: Final[float] = 0.2
#: Newest samples are those of this time, s. Meanwhile the observer follows a sixth of a jump of
#: 0.3 m.
STEP_TIME: Final[float] = 0.2
#: Least number of newest samples.
STEP_SAMPLES: Final[int] = 3
#: For this long, s, after a jump the vehicle brakes.
STEP_PAUSE: Final[float] = 1.0
#: Change between two altitudes, m, that the sensor alone can make: a table, a wall, a door.
SENSOR_LEAP: Final[float] = 0.5
#: Pressure of the standard atmosphere (ISO 2533) at sea level, hPa.
SEA_LEVEL_PRESSURE: Final[float] = 1013.25
#: Altitude at which the formula of that atmosphere has no pressure, m.
_ZERO_PRESSURE_ALTITUDE: Final[float] = 44330.77
#: Exponent of the pressure in that formula.
_EXPONENT: Final[float] = 0.190263


def pressure_altitude(pressure: float) -> float:
    """Return the altitude, m, of a pressure, hPa, in the standard atmosphere; or NaN."""
    if not 0.0 < pressure < 2000.0:
        return math.nan
    return _ZERO_PRESSURE_ALTITUDE * (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** _EXPONENT)


class HeightEstimator:
    """The height of one vehicle; times are monotonic, s."""

    def __init__(self) -> None:
        self.stepped = -math.inf
        """Time of the last jump of the sensor, and so of the reference, s."""
        self.leapt = -math.inf
        """Time of the last two successive altitudes that differed by more than SENSOR_LEAP, s."""
        self._newest = math.nan  # altitude by the sensor, m
        self._altitude = 0.0
        self._velocity_error = 0.0
        self._source_error: float | None = None  # when the other source was lost last, m/s
        self._reported: float | None = None
        self._time = self._began = -math.inf
        self._sensor = ''
        self._zero = 0.0  # altitude of the sensor at altitude 0
        self._reference: float | None = None
        self._referred = False  # whether there was a reference since the last ``refer``
        self._differences: deque[tuple[float, float]] = deque()

    def take(self, altitude: float, climb_rate: float | None, now: float, sensor: str = ''
             ) -> str:
        """
        Take an altitude of a sensor, m; return '' or the reason why it is refused.

        :param climb_rate: of the vehicle, m/s, by another source; None if unknown.
        :param sensor: its name.
        """
        elapsed = now - self._time
        # Written so that NaN fails.
        if refused := first_reason((not abs(altitude) <= SANE, 'not plausible'),
                                   (not elapsed > 0.0, 'not newer')):
            return refused
        if climb_rate is not None and not abs(climb_rate) <= FASTEST_OWN:
            climb_rate = None
        if sensor != self._sensor:
            before, self._sensor = self.altitude(now), sensor
            self._zero = 0.0 if before is None else altitude - before
            if before is None:
                self._reference = None
        altitude -= self._zero
        self.leapt = now if abs(altitude - self._newest) > SENSOR_LEAP else self.leapt
        self._newest = altitude
        if elapsed > HEIGHT_TIMEOUT:
            # A sensor that returns is used again, with the same reference.
            self._altitude, self._velocity_error, self._began = altitude, 0.0, now
            self._differences.clear()
        else:
            self._follow(altitude, climb_rate, elapsed, now)
        self._reported, self._time = climb_rate, now
        return ''

    def _follow(self, altitude: float, climb_rate: float | None, elapsed: float,
                now: float) -> None:
        if (climb_rate is None) != (self._reported is None):
            if climb_rate is None:  # the rate stays; only its components change
                self._source_error, self._velocity_error = self._velocity_error, self.climb_rate
            elif self._source_error is not None:
                # The sensor alone knows the rate late: not in a descent, nor after a touchdown.
                self._velocity_error = self._source_error
            else:
                settled = now - self._began >= SETTLING
                self._velocity_error = self.climb_rate - climb_rate if settled else 0.0
        expected = self._altitude + elapsed * ((climb_rate or 0.0) + self._velocity_error)
        difference = altitude - expected
        self._differences.append((now, difference))
        while now - self._differences[0][0] > 2.0 * STEP_TIME:
            self._differences.popleft()
        if climb_rate is not None and self._has_jumped(now):
            self.stepped = now
            self._differences.clear()
            self._altitude = expected + difference
            if self._reference is not None:
                self._reference += difference
            return
        share = min(2.0 * BANDWIDTH * elapsed, 1.0)
        self._altitude = expected + share * difference
        self._velocity_error += BANDWIDTH ** 2 * elapsed * difference

    def _has_jumped(self, now: float) -> bool:
        new = [d for time, d in self._differences if now - time <= STEP_TIME]
        old = [d for time, d in self._differences if now - time > STEP_TIME]
        if len(new) < STEP_SAMPLES or not old:
            return False
        mean = math.fsum(new) / len(new)
        return abs(mean) > STEP and abs(mean - math.fsum(old) / len(old)) > STEP_CHANGE

    @property
    def climb_rate(self) -> float:
        """Return the vertical velocity of the vehicle by the sensor, m/s."""
        return (self._reported or 0.0) + self._velocity_error

    def correct(self, climb_rate: float, now: float) -> float:
        """Return a vertical velocity of odometry, m/s, corrected by at most MAX_CORRECTION."""
        known = self._reported is not None and now - self._time <= HEIGHT_TIMEOUT
        error = min(max(self._velocity_error, -MAX_CORRECTION), MAX_CORRECTION)
        return climb_rate + (error if known else 0.0)

    def altitude(self, now: float) -> float | None:
        """Return the altitude by the sensor, m, at ``now``; None if none is known."""
        if now - self._time > HEIGHT_TIMEOUT:
            return None
        return self._altitude + max(now - self._time, 0.0) * self.climb_rate

    def height(self, now: float) -> float | None:
        """Return the height above the reference, m, at ``now``; None if none is known."""
        altitude = self.altitude(now)
        known = altitude is not None and self._reference is not None
        return altitude - self._reference if known else None  # type: ignore[operator]

    @property
    def has_reference(self) -> bool:
        """Return whether the altitude of height 0 is known."""
        return self._reference is not None

    def refer(self, height: float | None, now: float) -> None:
        """Set the reference so that the present height is a given height, m; None forgets it."""
        altitude = self.altitude(now)
        self._reference = None if height is None or altitude is None else altitude - height
        self._referred = self.has_reference

    def is_missing(self, now: float) -> bool:
        """Return whether the height was known before, but is not received any more."""
        return self._referred and self.height(now) is None

    def obstacle(self, now: float) -> Obstacle | None:
        """Return why a height that was known before cannot be used at ``now``, or None."""
        if self.is_missing(now):
            return Obstacle.HEIGHT_STALE
        jumped = self._reference is not None and now - self.stepped < STEP_PAUSE
        return Obstacle.HEIGHT_JUMPED if jumped else None
