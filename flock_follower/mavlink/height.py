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
Height above the place of arming, by a sensor that no odometry of ours is fused into.

That is the autopilot's barometer, or its rangefinder where no barometer is reported. An observer
with two poles at -BANDWIDTH follows the sensor. Between two samples it goes by a vertical velocity
of the vehicle, whose constant error it finds. A sensor that jumps while that velocity does not (a
gust, a door, a table below) is taken to be wrong by the jump: the reference is shifted.
"""

from __future__ import annotations

from collections import deque
import math
from typing import Final

#: 1/s. White noise of 0.09 m at 20 Hz (PX4 1.16, SIH) leaves 0.02 m in the height.
BANDWIDTH: Final[float] = 1.0
#: A height older than this, s, is not known any more.
TIMEOUT: Final[float] = 1.0
#: The sensor has jumped if its samples of STEP_TIME, s, STEP_SAMPLES at least, differ on average
#: by more than STEP, m, from the height expected, and by more than CHANGE, m, from those of the
#: STEP_TIME before: a climb that the other source denies grows more slowly. Of a jump of 0.3 m the
#: observer follows a sixth meanwhile.
STEP: Final[float] = 0.25
CHANGE: Final[float] = 0.2
STEP_TIME: Final[float] = 0.2
STEP_SAMPLES: Final[int] = 3
#: For this long, s, after a jump the vehicle brakes.
STEP_PAUSE: Final[float] = 1.0
#: Altitudes beyond this, m, and velocities beyond the next, m/s, are no measurements.
HIGHEST: Final[float] = 1e5
FASTEST: Final[float] = 100.0
#: The standard atmosphere (ISO 2533): pressure at sea level, hPa, scale height, m, and exponent.
SEA_LEVEL_PRESSURE: Final[float] = 1013.25
_SCALE: Final[float] = 44330.77
_EXPONENT: Final[float] = 0.190263


def pressure_altitude(pressure: float) -> float:
    """Return the altitude, m, at which the standard atmosphere has a pressure, hPa; or NaN."""
    if not 0.0 < pressure < 2000.0:
        return math.nan
    return _SCALE * (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** _EXPONENT)


class HeightEstimator:
    """The height of one vehicle; times are monotonic, s."""

    def __init__(self) -> None:
        self.steps = 0
        """How often the sensor has jumped, and the reference with it."""
        self._altitude = 0.0
        self._velocity_error = 0.0
        self._reported: float | None = None
        self._time = -math.inf
        self._reference: float | None = None
        self._differences: deque[tuple[float, float]] = deque()
        self._stepped = -math.inf

    def take(self, altitude: float, climb_rate: float | None, now: float) -> str:
        """
        Take an altitude of the sensor, m; return '' or the reason why it is refused.

        :param climb_rate: of the vehicle, m/s, by another source; None if none is known.
        """
        if not abs(altitude) <= HIGHEST:  # written so that NaN fails
            return 'not finite'
        if climb_rate is not None and not abs(climb_rate) <= FASTEST:
            climb_rate = None
        elapsed = now - self._time
        if not elapsed > 0.0:
            return 'not newer'
        if elapsed > TIMEOUT:
            # A sensor that comes back is believed, with the reference as it was.
            self._altitude, self._velocity_error = altitude, 0.0
            self._differences.clear()
        else:
            self._follow(altitude, climb_rate, elapsed, now)
        self._reported, self._time = climb_rate, now
        return ''

    def _follow(self, altitude: float, climb_rate: float | None, elapsed: float,
                now: float) -> None:
        if (climb_rate is None) != (self._reported is None):
            # The rate stays: only what it is made of changes.
            self._velocity_error = self.climb_rate - (climb_rate or 0.0)
        expected = self._altitude + elapsed * ((climb_rate or 0.0) + self._velocity_error)
        difference = altitude - expected
        self._differences.append((now, difference))
        while now - self._differences[0][0] > 2.0 * STEP_TIME:
            self._differences.popleft()
        if climb_rate is not None and self._jumped(now):
            self.steps += 1
            self._stepped = now
            self._differences.clear()
            self._altitude = expected + difference
            if self._reference is not None:
                self._reference += difference
            return
        share = min(2.0 * BANDWIDTH * elapsed, 1.0)
        self._altitude = expected + share * difference
        self._velocity_error += BANDWIDTH ** 2 * elapsed * difference

    def _jumped(self, now: float) -> bool:
        new = [d for time, d in self._differences if now - time <= STEP_TIME]
        old = [d for time, d in self._differences if now - time > STEP_TIME]
        if len(new) < STEP_SAMPLES or not old:
            return False
        mean = math.fsum(new) / len(new)
        return abs(mean) > STEP and abs(mean - math.fsum(old) / len(old)) > CHANGE

    @property
    def climb_rate(self) -> float:
        """Return the vertical velocity of the vehicle by the sensor, m/s."""
        return (self._reported or 0.0) + self._velocity_error

    def corrected(self, climb_rate: float, now: float) -> float:
        """Return a vertical velocity by the other source, m/s, with its error taken out."""
        known = self._reported is not None and now - self._time <= TIMEOUT
        return climb_rate + (self._velocity_error if known else 0.0)

    def altitude(self, now: float) -> float | None:
        """Return the altitude by the sensor, m, at ``now``; None if none is known."""
        if now - self._time > TIMEOUT:
            return None
        return self._altitude + max(now - self._time, 0.0) * self.climb_rate

    def height(self, now: float) -> float | None:
        """Return the height above the reference, m, at ``now``; None if none is known."""
        altitude = self.altitude(now)
        known = altitude is not None and self._reference is not None
        return altitude - self._reference if known else None  # type: ignore[operator]

    @property
    def referenced(self) -> bool:
        """Return whether the altitude of height 0 is known."""
        return self._reference is not None

    def refer(self, height: float | None, now: float) -> None:
        """Take the present height, m, as known; None forgets the reference."""
        altitude = self.altitude(now)
        self._reference = None if height is None or altitude is None else altitude - height

    def missing(self, now: float) -> bool:
        """Return whether a height that was known is not received any more."""
        return self._reference is not None and now - self._time > TIMEOUT

    def lost(self, now: float) -> str:
        """Return why a height that was known cannot be believed at ``now``, or ''."""
        if self.missing(now):
            return 'height stale'
        jumped = self._reference is not None and now - self._stepped < STEP_PAUSE
        return 'height jumped' if jumped else ''
