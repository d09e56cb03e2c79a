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
Accelerations of the vehicle besides its setpoints: the wind, and an error of the hover thrust.

An acceleration setpoint is flown by a tilt and a thrust that depend on it alone. PX4 does not
compare the result with the setpoint: in a wind the vehicle drifts instead of hovering, and with a
wrong hover thrust it sinks or climbs. ArduPilot closes the horizontal loop itself if GUID_OPTIONS
is 0; there the estimate stays small.

The estimate is that of a Luenberger observer with the states velocity and disturbance, both poles
at -BANDWIDTH: v' = response + d + 2 w (v_measured - v), d' = w^2 (v_measured - v).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.limits import limit_norm

#: 1/s: slower than the loops that it acts in (braking: 3 1/s).
BANDWIDTH: Final[float] = 1.0
#: From the setpoint to 63 % of the tilt, s; measured on PX4 0.23, on ArduCopter 0.27.
RESPONSE_TIME: Final[float] = 0.25
#: After a longer pause between two steps, s, nothing is concluded.
LONGEST_STEP: Final[float] = 0.2
#: Estimates are at most this long, horizontally and vertically, m/s^2.
WIND_MAX: Final[float] = 1.0
THRUST_ERROR_MAX: Final[float] = 3.0
#: The share of the vertical one that setpoints offset, m/s^2; planners offset as much.
OFFSET_MAX: Final[float] = 1.2
#: A horizontal velocity that differs from the expected one by this, m/s, for this long, s,
#: contradicts the setpoints: they are not flown, so no wind is learnt from them.
CONTRADICTION: Final[float] = 0.5
CONTRADICTION_TIME: Final[float] = 1.0
#: So long, s, the thrust has to be wrong beyond OFFSET_MAX until it is a warning, and is handed
#: over.
WARNING_TIME: Final[float] = 1.0
HANDOVER_TIME: Final[float] = 3.0


class DisturbanceObserver:
    """Estimates a disturbance from the setpoints sent and the velocity measured."""

    def __init__(self) -> None:
        self._time = -math.inf
        self._forget()

    def _forget(self) -> None:
        self.acceleration: Array = np.zeros(3)
        """The estimate (3,), m/s^2, ENU."""
        self.excess_since = math.inf
        """Since when the error of the thrust exceeds OFFSET_MAX, s; infinite: it does not."""
        self._velocity: Array | None = None
        self._response: Array = np.zeros(3)
        self._contradicted_since = math.inf

    @property
    def offset(self) -> float:
        """Return the upward acceleration, m/s^2, that offsets the error of the thrust."""
        return min(max(-float(self.acceleration[2]), -OFFSET_MAX), OFFSET_MAX)

    def step(self, sent: Array | None, velocity: Array | None, now: float) -> None:
        """
        Take what has happened since the last step, until ``now``, s.

        :param sent: acceleration (3,), m/s^2, that was flown; None: none of ours, which forgets.
        :param velocity: measured (3,), m/s; None where none is known, which waits.
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
        # Of finite velocities even the difference may be beyond every number.
        error = np.clip(velocity, -1e6, 1e6) - np.clip(self._velocity, -1e6, 1e6)
        self._velocity = self._velocity + elapsed * (
            self._response + self.acceleration + 2.0 * BANDWIDTH * error)
        estimate = self.acceleration + elapsed * BANDWIDTH ** 2 * error
        contradicted = math.hypot(*error[:2].tolist()) > CONTRADICTION
        self._contradicted_since = min(self._contradicted_since, now) if contradicted else math.inf
        frozen = now - self._contradicted_since >= CONTRADICTION_TIME
        wind = self.acceleration[:2] if frozen else limit_norm(estimate[:2], WIND_MAX)
        up = min(max(float(estimate[2]), -THRUST_ERROR_MAX), THRUST_ERROR_MAX)
        self.acceleration = np.array([*wind, up])
        self.excess_since = min(self.excess_since, now) if abs(up) > OFFSET_MAX else math.inf
