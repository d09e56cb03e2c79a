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

"""What the simulated vehicle says in words: STATUSTEXT, and PX4's EVENTs."""

from __future__ import annotations

from collections import deque
import math
import struct
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.flight_controller import (
    Event,
    FlightController,
    StatusText,
)

TEXT_CHUNK: Final[int] = 50  # bytes of a STATUSTEXT
#: PX4 counts a ground station as heard for this long, s, and tells it nothing that is older.
GCS_TIMEOUT: Final[float] = 2.5
OLDEST_TEXT: Final[float] = 5.0
# PX4's EVENT goes to every link. Its number is the hash of its name.
_EVENT: Final[int] = 410
_CRC_EXTRA: Final[int] = 160
_LAYOUT: Final[struct.Struct] = struct.Struct('<IIHBBB40s')
_COMPONENT: Final[int] = 1 << 24  # the autopilot's own events


class VehicleWords:
    """
    Passes on what a flight controller has said.

    :param now: monotonic time, s; messages carry times since then.
    """

    def __init__(self, controller: FlightController, now: float) -> None:
        self._controller = controller
        self._start = now
        self._gcs_heard = -math.inf
        self._waiting: deque[tuple[float, StatusText]] = deque()
        self._texts_sent = self._events_sent = 0

    def hear(self, heartbeat: Any, now: float) -> None:
        """Take the HEARTBEAT of somebody else."""
        if heartbeat.type == mavlink.MAV_TYPE_GCS:
            self._gcs_heard = now

    def messages(self, now: float) -> list[Any]:
        """Return what is to be said now."""
        controller = self._controller
        controller.gcs_heard = now - self._gcs_heard <= GCS_TIMEOUT
        self._waiting += [(now, text) for text in controller.said]
        controller.said = []
        if not controller.TALKS_TO_GCS_ONLY or controller.gcs_heard:
            messages = [message for said, text in self._waiting if now - said <= OLDEST_TEXT
                        for message in self._chunks(text)]
            self._waiting.clear()
        else:
            messages = []
            while self._waiting and now - self._waiting[0][0] > OLDEST_TEXT:
                self._waiting.popleft()
        events, controller.events = controller.events, []
        for event in events:
            messages.append(SentEvent(
                event, round((now - self._start) * 1e3), self._events_sent))
            self._events_sent += 1
        return messages

    def _chunks(self, text: StatusText) -> list[Any]:
        # A chunk that is full means that another follows.
        data = f'{text.text}{self._controller.TEXT_END}'.encode()
        self._texts_sent += 1
        number = self._texts_sent % 0xFFFF + 1 if len(data) > TEXT_CHUNK else 0
        return [mavlink.MAVLink_statustext_message(
            text.severity, data[i:i + TEXT_CHUNK], number, i // TEXT_CHUNK)
            for i in range(0, len(data) + (number > 0), TEXT_CHUNK)]


def event_number(name: str) -> int:
    """Return the number of an event: 24 bits of the 32-bit FNV-1a hash of its name."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return value & 0xFFFFFF | _COMPONENT


class SentEvent(mavlink.MAVLink_message):  # type: ignore[misc]
    """EVENT (410), which no pymavlink knows, to everybody."""

    def __init__(self, event: Event, boot_ms: int, sequence: int) -> None:
        super().__init__(_EVENT, 'EVENT')
        self._payload_bytes = _LAYOUT.pack(
            event_number(event.name), boot_ms, sequence % 2**16, 0, 0,
            event.level << 4 | event.level, event.arguments)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> Any:
        """Return the bytes that ``mav`` sends for it."""
        return self._pack(mav, _CRC_EXTRA, self._payload_bytes, force_mavlink1)
