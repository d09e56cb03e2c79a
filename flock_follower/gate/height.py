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
The height above the place of arming, and the error of odometry's vertical velocity.

The sensor is one that our odometry is not fused into: the autopilot's barometer, or its
rangefinder if no barometer is reported. A Luenberger observer with two poles at -BANDWIDTH follows
the sensor. Between two samples it integrates a vertical velocity of the vehicle by another source,
whose error it estimates.

Both can fail. If the sensor jumps and that velocity does not (a gust, a door, a table below), the
reference is shifted by the jump. If that velocity changes and no setpoint explains it (odometry
that diverges), the change is its error at once. If it errs unnoticed (an autopilot that fuses it
keeps it constant), a second observer, which is faster, contradicts the first one, and replaces its
error for a while. If the sensor is lost, the error stays, and still follows the changes of that
velocity. If another sensor takes over, its altitudes are shifted: they have another zero.
"""

from __future__ import annotations

from collections import deque
import math
from typing import Final, NamedTuple

from flock_follower.gate.obstacle import Obstacle
from flock_follower.messages import FASTEST_OWN, SANE
from flock_follower.ranges import first_reason

#: 1/s. White noise of 0.09 m at 20 Hz (PX4 1.16, SIH) leaves 0.02 m in the height.
BANDWIDTH: Final[float] = 1.0
#: 1/s, of the second observer; that noise leaves 0.05 m/s in its rate.
FAST_BANDWIDTH: Final[float] = 3.0
#: If the errors of both observers differ by more than this, m/s, 5 sigma of the fast one, the fast
#: one counts for SUSPICION_TIME.
RATE_TOLERANCE: Final[float] = 0.25
#: Altitudes by both observers differ by at most this, m: 4 sigma of the fast one.
HEIGHT_TOLERANCE: Final[float] = 0.15
#: A climb rate that changes by more than this, m/s, without explanation has stepped. A hover
#: thrust that is wrong by 1 m/s^2 leaves 0.42 m/s unexplained.
RATE_STEP: Final[float] = 0.5
#: From this unexplained change on, m/s, the source is suspected, so that only a large jump of the
#: sensor counts ...
SUSPICIOUS_CHANGE: Final[float] = 0.3
#: ... for this long, s.
SUSPICION_TIME: Final[float] = 3.0
#: A vehicle that follows a changed correction overshoots: by so many times the change.
RESPONSE: Final[float] = 2.0
#: Unexplained changes are forgotten with this time constant, s: a disturbance is estimated then.
CHANGE_MEMORY: Final[float] = 1.0
#: Largest vertical acceleration of a vehicle whose setpoints are not known, m/s^2.
FASTEST_CHANGE: Final[float] = 4.0
#: An error that a step has proven is one of the sensor's again with this time constant, s.
PROOF_TIME: Final[float] = 10.0
#: s: until then the observer does not know the vertical velocity by the sensor alone.
SETTLING: Final[float] = 3.0
#: m/s: more than this is not corrected beyond the steps of a source: the sensor may be wrong.
MAX_CORRECTION: Final[float] = 2.0
#: From this age of a height on, s, the rate of the other source is watched without it.
SILENCE: Final[float] = 0.08
#: A height older than this, s, is not known any more.
HEIGHT_TIMEOUT: Final[float] = 1.0
#: The sensor has jumped if its newest samples differ on average by more than this from the height
#: expected, m.
STEP: Final[float] = 0.25
#: They differ by more than this from the samples before, too, m: a climb that the other source
#: denies grows more slowly.
STEP_CHANGE: Final[float] = 0.2
#: As much while another source is suspected, m: an error of 2.5 m/s grows more slowly.
SUSPECTED_CHANGE: Final[float] = 0.5
#: Newest samples are those of this time, s. Meanwhile the observer follows a sixth of a jump of
#: 0.3 m.
STEP_TIME: Final[float] = 0.2
#: Least number of newest samples.
STEP_SAMPLES: Final[int] = 3
#: A jump that was noticed may go on for this long, s: that of a door.
REST_TIME: Final[float] = 0.3
#: For this long, s, after a jump the vehicle brakes.
STEP_PAUSE: Final[float] = 1.0
#: Change between two altitudes, m, that the sensor alone can make: a table, a wall, a door.
SENSOR_LEAP: Final[float] = 0.5
#: Larger differences than this, m, count as this in the error of a climb rate.
LEAP: Final[float] = 0.5
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


class RateSteps:
    """Detects that a climb rate changes unlike any vehicle's: then its source has an error."""

    def __init__(self) -> None:
        self.suspected = -math.inf
        """When the last change was suspicious, s."""
        self._changed = 0.0
        self._unexplained = 0.0
        self._corrected = 0.0

    def take(self, change: float, elapsed: float, acceleration: float | None, now: float,
             corrected: float = 0.0) -> float:
        """
        Take a change of the climb rate, m/s, in a time, s; return its step, m/s, or 0.

        :param acceleration: the vertical one that is expected, m/s^2; None if unknown.
        :param corrected: by how much the correction of the rate has changed, m/s: an autopilot
            that fuses the corrected rate changes its own by as much the other way.
        """
        largest = FASTEST_CHANGE * elapsed
        expected = min(max(change, -largest), largest) if acceleration is None else (
            acceleration * elapsed)
        kept = math.exp(-elapsed / CHANGE_MEMORY)
        self._changed = kept * self._changed + change
        self._unexplained = kept * self._unexplained + change - expected
        self._corrected = kept * self._corrected + RESPONSE * corrected
        # A vehicle that does not obey is no error of the source, which has not changed then.
        step = min(max(self._unexplained, min(self._changed, 0.0)), max(self._changed, 0.0))
        step -= min(max(-self._corrected, min(step, 0.0)), max(step, 0.0))
        self.suspected = now if abs(step) > SUSPICIOUS_CHANGE else self.suspected
        if abs(step) <= RATE_STEP:
            return 0.0
        self._changed = self._unexplained = self._corrected = 0.0
        return step


class _Sample(NamedTuple):
    """A sample of the sensor."""

    time: float
    """s."""
    difference: float
    """Altitude minus the expected one, m."""
    error: float
    """Error of the other source's climb rate before the sample, m/s."""
    expected: float
    """The expected altitude, m."""
    path: float
    """Integral of the other source's climb rate, m."""


class _Observer:
    """The altitude by a sensor, and the error of another source's climb rate (Luenberger)."""

    def __init__(self, bandwidth: float) -> None:
        self._bandwidth = bandwidth  # both poles are at minus this, 1/s
        self.altitude = 0.0
        """m."""
        self.error = 0.0
        """Climb rate of the vehicle minus that of the other source, m/s."""

    def step(self, altitude: float, climb_rate: float, elapsed: float) -> float:
        """Take an altitude of the sensor, m, after a time, s; return it minus the expected one."""
        expected = self.altitude + elapsed * (climb_rate + self.error)
        difference = altitude - expected
        self.altitude = expected + min(2.0 * self._bandwidth * elapsed, 1.0) * difference
        self.error += self._bandwidth ** 2 * elapsed * min(max(difference, -LEAP), LEAP)
        return difference


class HeightEstimator:
    """The height of one vehicle; times are monotonic, s."""

    def __init__(self) -> None:
        self.stepped = -math.inf
        """Time of the last jump of the sensor, and so of the reference, s."""
        self.leapt = -math.inf
        """Time of the last two successive altitudes that differed by more than SENSOR_LEAP, s."""
        self._newest = math.nan  # altitude by the sensor, m
        self._steps = RateSteps()
        self._proven = 0.0  # the part of the error that steps have proven, m/s
        self._slow, self._fast = _Observer(BANDWIDTH), _Observer(FAST_BANDWIDTH)
        self._source_error: float | None = None  # when the other source was lost last, m/s
        self._reported: float | None = None
        self._began = math.inf
        self._time = self._rated = self._contradicted = -math.inf
        self._path = 0.0  # integral of the other source's climb rate, m
        self._before = 0.0  # error at the newest climb rate, m/s
        self._sensor = ''
        self._zero = 0.0  # altitude of the sensor at altitude 0
        self._reference: float | None = None
        self._referred = False  # whether there was a reference since the last ``refer``
        self._samples: deque[_Sample] = deque()

    def take(self, altitude: float, climb_rate: float | None, now: float, sensor: str = '',
             acceleration: float | None = None) -> str:
        """
        Take an altitude of a sensor, m; return '' or the reason why it is refused.

        :param climb_rate: of the vehicle, m/s, by another source; None if unknown.
        :param sensor: its name.
        :param acceleration: the vertical one that is expected, m/s^2; None if unknown.
        """
        elapsed = now - self._time
        # Written so that NaN fails.
        if refused := first_reason((not abs(altitude) <= SANE, 'not plausible'),
                                   (not elapsed > 0.0, 'not newer')):
            return refused
        self.take_rate(climb_rate, now, acceleration)
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
            self._set(altitude, 0.0 if self._reported is None else self._slow.error)
            self._began = now
        else:
            self._follow(altitude, elapsed, now)
        self._time = now
        return ''

    def take_rate(self, climb_rate: float | None, now: float,
                  acceleration: float | None = None) -> None:
        """Take the climb rate, m/s, of the other source, which may step; see ``take``."""
        slow, fast, reported = self._slow, self._fast, self._reported
        if climb_rate is not None and not abs(climb_rate) <= FASTEST_OWN:
            climb_rate = None
        if climb_rate is None or reported is None:
            if climb_rate is not reported:
                slow.error = fast.error = self._error_without(climb_rate, now)
        else:
            step = self._steps.take(climb_rate - reported, now - self._rated, acceleration, now,
                                    slow.error - self._before)
            slow.error, fast.error, self._proven = (
                error - step for error in (slow.error, fast.error, self._proven))
            if step:
                self._samples = deque(sample._replace(
                    error=sample.error - step,
                    path=sample.path - step * (self._time - sample.time),
                ) for sample in self._samples)
        self._before, self._rated, self._reported = slow.error, now, climb_rate

    def _set(self, altitude: float, error: float) -> None:
        for observer in (self._slow, self._fast):
            observer.altitude, observer.error = altitude, error
        self._samples.clear()

    def _follow(self, altitude: float, elapsed: float, now: float) -> None:
        slow, fast, climb_rate = self._slow, self._fast, self._reported
        self._proven += (slow.error - self._proven) * min(elapsed / PROOF_TIME, 1.0)
        error = slow.error
        difference = slow.step(altitude, climb_rate or 0.0, elapsed)
        fast.step(altitude, climb_rate or 0.0, elapsed)
        self._path += elapsed * (climb_rate or 0.0)
        self._samples.append(_Sample(now, difference, error, altitude - difference, self._path))
        while now - self._samples[0].time > 2.0 * STEP_TIME:
            self._samples.popleft()
        if climb_rate is None:
            return
        contradicted = now - self._contradicted  # the beginning may be that of a jump
        doubtful = now - self._steps.suspected < SUSPICION_TIME or (
            STEP_TIME < contradicted < SUSPICION_TIME)
        if self._has_jumped(SUSPECTED_CHANGE if doubtful else STEP_CHANGE, now):
            before = [sample for sample in self._samples if sample.time < self.leapt]
            last = before[-1] if before else self._samples[0]
            self.stepped = now
            self._set(altitude, last.error)
            if self._reference is not None:
                self._reference += altitude - last.expected - (self._path - last.path) - (
                    last.error * (now - last.time))
            if contradicted <= STEP_TIME:
                self._contradicted = -math.inf
            return
        # What follows a jump is most often the rest of it.
        if abs(fast.error - slow.error) > RATE_TOLERANCE and (
                now - max(self.leapt, self.stepped + REST_TIME) > STEP_TIME):
            self._contradicted = now
        if now - self._contradicted < SUSPICION_TIME:
            slow.error = fast.error

    def _error_without(self, climb_rate: float | None, now: float) -> float:
        """Return the error, m/s, after the other source was lost (None), or has returned."""
        self._steps = RateSteps()
        if climb_rate is None:  # the rate stays; only its components change
            self._source_error = self._slow.error
            return self.climb_rate
        if self._source_error is not None:
            # The sensor alone knows the rate late: not in a descent, nor after a touchdown.
            return self._source_error
        return self.climb_rate - climb_rate if now - self._began >= SETTLING else 0.0

    def _has_jumped(self, change: float, now: float) -> bool:
        new = [sample.difference for sample in self._samples if now - sample.time <= STEP_TIME]
        old = [sample.difference for sample in self._samples if now - sample.time > STEP_TIME]
        if len(new) < STEP_SAMPLES or not old:
            return False
        mean = math.fsum(new) / len(new)
        return abs(mean) > STEP and abs(mean - math.fsum(old) / len(old)) > change

    @property
    def climb_rate(self) -> float:
        """Return the vertical velocity of the vehicle by the sensor, m/s."""
        return (self._reported or 0.0) + self._slow.error

    def correct(self, climb_rate: float) -> float:
        """Return a vertical velocity of odometry, m/s, corrected: beyond its steps by a limit."""
        rest = self._slow.error - self._proven
        error = self._proven + min(max(rest, -MAX_CORRECTION), MAX_CORRECTION)
        # A sensor that is lost takes nothing back: an error of the source outlasts it.
        return climb_rate + (0.0 if self._reported is None else error)

    def altitude(self, now: float) -> float | None:
        """Return the altitude by the sensor, m, at ``now``; None if none is known."""
        if now - self._time > HEIGHT_TIMEOUT:
            return None
        newest = self._slow.altitude
        if now - self.leapt > STEP_TIME:
            newest = min(max(newest, self._fast.altitude - HEIGHT_TOLERANCE),
                         self._fast.altitude + HEIGHT_TOLERANCE)
        return newest + max(now - self._time, 0.0) * self.climb_rate

    def height(self, now: float) -> float | None:
        """Return the height above the reference, m, at ``now``; None if none is known."""
        altitude = self.altitude(now)
        known = altitude is not None and self._reference is not None
        return altitude - self._reference if known else None  # type: ignore[operator]

    def is_silent(self, now: float) -> bool:
        """Return whether the sensor is silent, but was received before."""
        return SILENCE < now - self._time < math.inf

    @property
    def has_reference(self) -> bool:
        """Return whether the altitude of height 0 is known."""
        return self._reference is not None

    def refer(self, height: float | None, now: float) -> None:
        """Set the reference so that the present height is a given height, m; None forgets it."""
        altitude = self.altitude(now)
        if height is None and altitude is None:  # the next flight begins without an error
            self._proven = self._slow.error = self._fast.error = 0.0
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
