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
The disturbance: acceleration that was not commanded, from a wrong hover thrust and wind.

An autopilot flies an acceleration setpoint by a tilt and a thrust that depend on the setpoint
alone. PX4 does not compare the result with the setpoint: in wind the vehicle drifts, and with a
wrong hover thrust it sinks or climbs. ArduPilot compensates wind and thrust itself, so its
disturbance stays small. Only the gate offsets the disturbance; the planner's command does not
contain the offset.

``DisturbanceObserver`` is a Luenberger observer with the states velocity and disturbance, both
poles of an axis at -w (BANDWIDTH): v' = response + d + 2 w (v_measured - v), d' = w^2 (v_measured
- v). ``HeightWatch`` detects that the height departs from the commanded height, without the
  estimate.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from flock_follower.gate.relative_flight import LONGEST_STEP
from flock_follower.geometry import Array
from flock_follower.messages import SANE
from flock_follower.planner.limits import limit_norm
from flock_follower.ranges import THRUST_OFFSET_MAX

#: 1/s. With 1.0 a thrust that changes by 1 m/s^2 at once moves the vehicle by 0.5 m at a v_max of
#: 0.1 m/s, with 2.0 by 0.3 m; with 2.5 the height sways if the odometry is 0.15 s late.
BANDWIDTH: Final[float] = 2.0
#: From the setpoint to 63 % of the tilt, s; measured on PX4 0.23, on ArduCopter 0.27.
RESPONSE_TIME: Final[float] = 0.25
#: Largest horizontal estimate, m/s^2.
WIND_MAX: Final[float] = 1.0
#: Largest vertical estimate, m/s^2.
THRUST_ERROR_MAX: Final[float] = 3.0
#: An estimate that exceeds THRUST_OFFSET_MAX by more than its noise, m/s^2, is excessive.
ESTIMATE_NOISE: Final[float] = 0.1
#: A horizontal velocity that differs from the expected one by this, m/s, contradicts the
#: setpoints: they are not flown.
CONTRADICTION: Final[float] = 0.5
#: The estimate of the wind is frozen after a contradiction of this duration, s.
CONTRADICTION_TIME: Final[float] = 1.0
#: An excessive error of the thrust is a warning after this time, s.
WARNING_TIME: Final[float] = 1.0
#: It hands the vehicle over after this time, s.
THRUST_HANDOVER_TIME: Final[float] = 3.0


class DisturbanceObserver:
    """Estimates the disturbance from the setpoints sent and the velocity measured."""

    def __init__(self) -> None:
        self._time = -math.inf
        self._forget()

    def _forget(self) -> None:
        self.acceleration: Array = np.zeros(3)
        """The estimate (3,), m/s^2, ENU."""
        self.excess_since = math.inf
        """Time since which the thrust error has been excessive, s; infinite if it is not."""
        self._velocity: Array | None = None
        self._response: Array = np.zeros(3)
        self._contradicted_since = math.inf

    def offset(self, wind: bool) -> Array:
        """
        Return the acceleration (3,), m/s^2, that offsets the disturbance.

        :param wind: whether the horizontal part is offset, too.
        """
        east, north, up = (0.0 - self.acceleration).tolist()
        up = min(max(up, -THRUST_OFFSET_MAX), THRUST_OFFSET_MAX)
        return np.array([east, north, up] if wind else [0.0, 0.0, up])

    @property
    def expected_climb(self) -> float | None:
        """Return the expected vertical acceleration, m/s^2; None if not known."""
        return None if self._velocity is None else float(self._response[2] + self.acceleration[2])

    def step(self, sent: Array | None, velocity: Array | None, now: float) -> None:
        """
        Update the estimate to ``now``, s.

        :param sent: acceleration (3,), m/s^2, flown since the last step; None if the vehicle did
            not fly our setpoints: this resets the estimate.
        :param velocity: measured (3,), m/s; None if unknown: the estimate does not change.
        """
        elapsed, self._time = now - self._time, now
        if sent is None:
            self._forget()
            return
        usable = 0.0 < elapsed <= LONGEST_STEP
        if usable:
            self._response = self._response + (sent - self._response) * -math.expm1(
                -elapsed / RESPONSE_TIME)
        if velocity is None or self._velocity is None or not usable:
            self._velocity = velocity
            return
        # The difference of two finite velocities may overflow.
        error = _sane(velocity) - _sane(self._velocity)
        self._velocity = self._velocity + elapsed * (
            self._response + self.acceleration + 2.0 * BANDWIDTH * error)
        estimate = self.acceleration + elapsed * BANDWIDTH ** 2 * error
        contradicted = math.hypot(*error[:2].tolist()) > CONTRADICTION
        self._contradicted_since = min(self._contradicted_since, now) if contradicted else math.inf
        frozen = now - self._contradicted_since >= CONTRADICTION_TIME
        wind = self.acceleration[:2] if frozen else limit_norm(estimate[:2], WIND_MAX)
        up = min(max(float(estimate[2]), -THRUST_ERROR_MAX), THRUST_ERROR_MAX)
        self.acceleration = np.array([*wind, up])
        excessive = abs(up) > THRUST_OFFSET_MAX + ESTIMATE_NOISE
        self.excess_since = min(self.excess_since, now) if excessive else math.inf


def _sane(velocity: Array) -> Array:
    """Return a velocity (3,), each component within SANE: np.clip takes three times as long."""
    return np.minimum(np.maximum(velocity, -SANE), SANE)


#: Up to this difference, m, the vehicle counts as at the commanded height.
HEIGHT_KEPT: Final[float] = 0.6
#: A vehicle that moves on by this, m, away from the commanded height leaves it.
HEIGHT_LEFT: Final[float] = 0.2


class HeightWatch:
    """Detects that the height departs from the commanded height, by an unknown thrust error."""

    def __init__(self) -> None:
        self.reason = ''
        """Why the vehicle must be handed over, or ''."""
        self._kept: float | None = None  # height when it was last at the commanded one, m

    def step(self, height: float | None, commanded: float | None) -> None:
        """
        Compare the height with the commanded height, m; None if one of them is unknown.

        A difference that grows because the commanded height moves away does not count.
        """
        self.reason = ''
        if height is None or commanded is None or not math.isfinite(height - commanded):
            self._kept = None
            return
        error = height - commanded
        if self._kept is None or abs(error) <= HEIGHT_KEPT:
            self._kept = height
        elif math.copysign(1.0, error) * (height - self._kept) > HEIGHT_LEFT:
            self.reason = f'height {height:.2f} m, {error:+.1f} m off the commanded one'
