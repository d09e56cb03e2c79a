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
What accelerates the vehicle besides its setpoints: the wind, above all.

An acceleration setpoint is flown by tilting so far, and no further: PX4 does not look whether the
vehicle then accelerates so. In a wind it drifts instead of hovering, and is faster than ``v_max``
with it. ArduPilot closes that loop itself where GUID_OPTIONS is 0; there the estimate stays small.

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


class WindObserver:
    """Estimates a horizontal disturbance from the setpoints sent and the velocity measured."""

    def __init__(self) -> None:
        self.acceleration: Array = np.zeros(3)
        """The estimate (3,), m/s^2, ENU; its third component is 0."""
        self._velocity: Array | None = None
        self._response: Array = np.zeros(3)
        self._time = -math.inf

    def step(self, sent: Array | None, velocity: Array | None, largest: float,
             now: float) -> None:
        """
        Take what has happened since the last step, until ``now``, s.

        :param sent: acceleration (3,), m/s^2, that was flown; None: none of ours, which forgets.
        :param velocity: measured (3,), m/s; None where none is known, which waits.
        :param largest: the estimate is at most this long, m/s^2; 0 estimates none.
        """
        elapsed, self._time = now - self._time, now
        if sent is None or largest == 0.0:
            self.acceleration, self._response = np.zeros(3), np.zeros(3)
            self._velocity = None
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
        estimate = self.acceleration + elapsed * BANDWIDTH**2 * error
        self.acceleration = limit_norm(estimate * [1.0, 1.0, 0.0], largest)
