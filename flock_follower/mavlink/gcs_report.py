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
Reports to the pilot's ground station: the planner's state as STATUSTEXT, the distance as a number.

The texts are broadcast on the autopilot's link. ArduPilot forwards them to the ground station; PX4
does so if the port of the companion has MAV_n_FORWARD 1. Times are s on a monotonic clock.
"""

from __future__ import annotations

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

#: A state is reported once it has lasted this long, s: COAST for one image is no news.
HELD: Final[float] = 1.0
#: Least time between two texts, s, and between two distances, s.
TEXT_PERIOD: Final[float] = 2.0
DISTANCE_PERIOD: Final[float] = 1.0
#: Largest length of a STATUSTEXT in one message, bytes.
LONGEST_TEXT: Final[int] = 50
#: Name of the NAMED_VALUE_FLOAT, at most 10 bytes.
DISTANCE_NAME: Final[bytes] = b'flock_dist'
FOLLOWS: Final[tuple[str, ...]] = ('TRACK', 'COAST', 'RELATIVE')
SEVERITIES: Final[dict[str, int]] = dict.fromkeys(
    ('HOLD', 'RELATIVE'), mavlink.MAV_SEVERITY_WARNING)


class GroundStationReport:
    """The messages that are due for the ground station."""

    def __init__(self) -> None:
        self._state, self._state_time = '', -math.inf
        self._reported = ''
        self._handed_over: str | None = None
        self._neighbor, self._distance, self._distance_time = '', math.nan, -math.inf
        self._last_text = self._last_distance = -math.inf

    def take_state(self, state: str, now: float) -> None:
        """Take a state of the planner, as ``planner/state`` has it."""
        if state != self._state:
            self._state, self._state_time = state, now

    def take_distance(self, neighbor: str, distance: float, now: float) -> None:
        """Take the distance, m, to the neighbour that the planner faces."""
        self._neighbor, self._distance, self._distance_time = neighbor, distance, now

    def take_handover(self, reason: str) -> None:
        """Take the reason for which the bridge ends the flight; it is the next text."""
        self._handed_over = reason

    def due(self, time_boot_ms: int, now: float) -> list[Any]:
        """Return the STATUSTEXT and NAMED_VALUE_FLOAT to send at ``now``; at most one of each."""
        messages = []
        known = math.isfinite(self._distance) and now - self._distance_time <= DISTANCE_PERIOD
        if known and now - self._last_distance >= DISTANCE_PERIOD:
            self._last_distance = now
            messages.append(mavlink.MAVLink_named_value_float_message(
                time_boot_ms, DISTANCE_NAME, self._distance))
        if now - self._last_text < TEXT_PERIOD:
            return messages
        if self._handed_over is not None:
            severity, text = mavlink.MAV_SEVERITY_CRITICAL, f'hands over: {self._handed_over}'
            self._handed_over = None
        elif self._state != self._reported and now - self._state_time >= HELD:
            severity = SEVERITIES.get(self._state, mavlink.MAV_SEVERITY_INFO)
            text = self._reported = self._state
            if known and self._state in FOLLOWS:
                text += f' {self._neighbor} {self._distance:.1f} m'
        else:
            return messages
        self._last_text = now
        data = f'flock: {text}'.encode('ascii', 'replace')[:LONGEST_TEXT]
        return [*messages, mavlink.MAVLink_statustext_message(severity, data)]
