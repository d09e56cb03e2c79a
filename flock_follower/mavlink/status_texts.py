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
Texts of the autopilot, and reports to the pilot's ground station.

``StatusTexts`` joins STATUSTEXT messages from their chunks, and reads the EVENTs of PX4.

PX4 sends STATUSTEXT only to links on which it receives a ground station, and sends no text if it
refuses a mode. PX4 reports its arming checks by EVENTs on every link, after a change and after
MAV_CMD_RUN_PREARM_CHECKS: between two summaries, one EVENT for each failed check, with the
affected modes. An EVENT is a number, the hash of a name; ``px4_events.txt`` has the names and
texts of several versions. An event that is missing there is reported by its number.

``GroundStationReport`` sends the planner's state as STATUSTEXT and the distance as a number, both
as broadcasts on the autopilot's link. ArduPilot forwards these messages to the ground station; PX4
forwards them if the port of the companion has MAV_n_FORWARD 1. Times are s on a monotonic clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
import math
from pathlib import Path
import struct
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

#: Kinds of the rows of ``px4_events.txt``, see there.
CHECK, COMMANDER, ACTION, OTHER = 'check', 'commander', 'action', 'other'
#: The upper byte of the number of an event of the autopilot.
_AUTOPILOT_EVENTS: Final[int] = 1
#: Id of EVENT: in common.xml, and not in pymavlink yet.
MESSAGE_ID: Final[int] = 410
#: The end of a report that names more checks than this was lost.
MOST_FAILURES: Final[int] = 100
#: The bits of modes, as EVENTs name them: PX4's navigation states.
_MODES: Final[Mapping[str, int]] = MappingProxyType({
    'MANUAL': 0, 'ALTCTL': 1, 'POSCTL': 2, 'AUTO.MISSION': 3, 'AUTO.LOITER': 4, 'AUTO.RTL': 5,
    'ACRO': 10, 'OFFBOARD': 14, 'STABILIZED': 15, 'AUTO.TAKEOFF': 17, 'AUTO.LAND': 18,
    'AUTO.FOLLOW_TARGET': 19, 'AUTO.PRECLAND': 20})
_EVERY_MODE: Final[int] = 0xFFFFFFFF
_PILOT_MODES: Final[tuple[str, ...]] = ('MANUAL', 'ALTCTL', 'POSCTL', 'ACRO', 'STABILIZED')
_STICKS: Final[str] = 'check_modes_manual_control'
#: MAV_SEVERITY, the worst level of a check that prevents nothing.
WARNING: Final[int] = mavlink.MAV_SEVERITY_WARNING
_BEGIN, _END = 'commander_arming_check_summary', 'commander_health_summary'
_ENTERS: Final[tuple[str, ...]] = (
    'commander_failsafe_enter', 'commander_failsafe_enter_generic',
    'commander_failsafe_enter_autopilot_disengaged', 'commander_failsafe_enter_hold',
    'commander_failsafe_enter_generic_hold')


def event_number(name: str) -> int:
    """Return the number of an event: 24 bits of the 32-bit FNV-1a hash of its name."""
    value = 0x811C9DC5
    for byte in name.encode('ascii'):
        value = (value ^ byte) * 0x01000193 % 2**32
    return value % 2**24


class EventRow(NamedTuple):
    """A row of ``px4_events.txt``."""

    versions: tuple[str, ...]
    """The versions of PX4 that send it."""
    kind: str
    """CHECK, COMMANDER, ACTION or OTHER."""
    text: str
    """Text for people."""


def read_events() -> dict[str, EventRow]:
    """Return the rows of ``px4_events.txt`` by the names of the events."""
    lines = Path(__file__).with_name('px4_events.txt').read_text(encoding='utf-8').splitlines()
    rows = (line.split(' | ') for line in lines if not line.startswith('#'))
    return {name: EventRow(tuple(versions.split()), kind, text)
            for name, versions, kind, text in rows}


_EVENTS: Final[Mapping[str, EventRow]] = MappingProxyType(read_events())
_BY_NUMBER: Final[Mapping[int, str]] = MappingProxyType(
    {event_number(name): name for name in _EVENTS})


class EventMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """EVENT; loading this module makes pymavlink decode it."""

    msgname = 'EVENT'
    fieldnames: ClassVar[list[str]] = [
        'number', 'event_time_boot_ms', 'sequence', 'destination_component', 'destination_system',
        'log_levels', 'arguments']
    ordered_fieldnames = fieldnames
    lengths: ClassVar[list[int]] = [1, 1, 1, 1, 1, 1, 40]
    orders: ClassVar[list[int]] = [0, 1, 2, 3, 4, 5, 6]
    crc_extra = 160
    unpacker = struct.Struct('<IIHBBB40B')

    def __init__(self, *values: Any) -> None:
        super().__init__(MESSAGE_ID, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field, self._instance_offset = None, -1
        for name, value in zip(self.fieldnames, values):
            setattr(self, name, value)


mavlink.mavlink_map.setdefault(MESSAGE_ID, EventMessage)


class Failure(NamedTuple):
    """A check that fails."""

    text: str
    modes: int
    """The affected modes, one bit for each."""
    level: int
    """MAV_SEVERITY."""


#: ArduPilot repeats its reasons against arming with this prefix every 30 s.
PREARM: Final[str] = 'PreArm: '
PREARM_PERIOD: Final[float] = 35.0
#: Characters of one STATUSTEXT; a shorter chunk is the last of its text.
CHUNK_SIZE: Final[int] = 50
#: A text whose next chunk does not arrive within this, s, is used as it is.
CHUNK_TIMEOUT: Final[float] = 0.4


class AutopilotText(NamedTuple):
    """One complete text."""

    time: float
    """Time at which the end of the text was received, s."""
    severity: int
    """MAV_SEVERITY: the smaller, the worse."""
    text: str


class StatusTexts:
    """The recent texts, and the newest report of the arming checks of PX4."""

    def __init__(self) -> None:
        self._failures: tuple[Failure, ...] = ()
        self._coming: list[Failure] | None = None
        self._has_texts = False
        self._texts: deque[AutopilotText] = deque(maxlen=50)
        self._new: deque[AutopilotText] = deque(maxlen=200)
        self._begun: AutopilotText | None = None  # a text whose end has not come
        self._due = 0, 0  # id and number of its next chunk

    def add(self, message: Any, now: float) -> None:
        """Take a STATUSTEXT."""
        self._has_texts = True
        if (message.id, message.chunk_seq) != self._due:
            self._end()
        text = str(message.text)
        before = '' if self._begun is None else self._begun.text
        self._begun = AutopilotText(now, message.severity, before + text)
        self._due = message.id, message.chunk_seq + 1
        if not message.id or len(text) < CHUNK_SIZE:
            self._end()

    def add_event(self, message: Any, now: float) -> None:
        """Take an EVENT; its text is used only if no STATUSTEXT is received."""
        text = self._check(message)
        if text and not self._has_texts:
            self._begun = AutopilotText(now, message.log_levels & 0xF, text)
            self._end()

    def _check(self, message: Any) -> str:
        """Take an EVENT; return its text if it has one by itself, or ''."""
        number = message.number % 2**24
        name = _BY_NUMBER.get(number, '')
        known = _EVENTS.get(name)
        text = f'event {number}' if known is None else known.text
        level, arguments = message.log_levels & 0xF, bytes(message.arguments)
        if name == _BEGIN:
            self._coming = []
        elif name == _END:
            if self._coming is not None:
                self._failures = tuple(self._coming)
            self._coming = None
        elif name in _ENTERS:
            action = arguments[4]
            row = _EVENTS.get(f'failsafe_action_{action}')
            return f'failsafe: {f"action {action}" if row is None else row.text}'
        elif known is not None and known.kind != CHECK:
            return text if known.kind == COMMANDER else ''
        elif self._coming is not None:
            if len(self._coming) < MOST_FAILURES:
                self._coming.append(
                    Failure(text, int.from_bytes(arguments[:4], 'little'), level))
        elif known is None and message.number >> 24 == _AUTOPILOT_EVENTS:
            return text
        return ''

    def _end(self) -> None:
        """End the text that has begun."""
        if self._begun is not None:
            # PX4 ends texts with a tab if it also sends them as events.
            text = self._begun.text.strip('\x00\t\n ')
            # An escape sequence would act on the terminal that shows the log.
            whole = self._begun._replace(text=''.join(
                character if character.isprintable() else '?' for character in text))
            self._texts.append(whole)
            self._new.append(whole)
        self._begun = None

    def against(self, mode: str) -> list[str]:
        """Return the failed checks for a mode (a name of ``dialects.PX4``), or for its arming."""
        return [failure.text for failure in self._failures
                if mode in _MODES and failure.modes >> _MODES[mode] & 1
                # Reports for every mode include warnings, which prevent none,
                and (failure.modes != _EVERY_MODE or failure.level < WARNING
                     # and this one, which prevents the pilot's modes.
                     or (failure.text == _EVENTS[_STICKS].text and mode in _PILOT_MODES))]

    def why(self, time: float, mode: str) -> list[str]:
        """Return the texts since ``time``, and the newest failed checks for a mode."""
        return list(dict.fromkeys([*self.since(time), *self.against(mode)]))

    def unready(self, now: float, mode: str) -> str:
        """Return recent texts and the newest failed checks against arming in a mode, or ''."""
        reported = [text.text.partition(PREARM)[2] for text in list(self._texts)
                    if PREARM in text.text and now - text.time <= PREARM_PERIOD]
        return '; '.join(dict.fromkeys([*reported, *self.against(mode)]))

    def since(self, time: float) -> list[str]:
        """Return the distinct texts since ``time`` whose severity is above INFO."""
        return list(dict.fromkeys(
            text for t, severity, text in self._texts
            if t >= time and severity < mavlink.MAV_SEVERITY_INFO))

    def new(self, now: float) -> list[AutopilotText]:
        """Return the texts since the last call; incomplete texts after CHUNK_TIMEOUT."""
        if self._begun is not None and now - self._begun.time > CHUNK_TIMEOUT:
            self._end()
        texts = list(self._new)
        self._new.clear()
        return texts


#: A state is reported once it has lasted this long, s: not COAST for one image.
HELD: Final[float] = 1.0
#: Least time between two texts, s.
TEXT_PERIOD: Final[float] = 2.0
#: Least time between two distances, s.
DISTANCE_PERIOD: Final[float] = 1.0
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
        self._warnings: deque[str] = deque(maxlen=10)
        self._neighbor, self._distance, self._distance_time = '', math.nan, -math.inf
        self._last_text = self._last_distance = -math.inf

    def take_state(self, state: str, now: float) -> None:
        """Take a state of the planner, as ``planner/state`` has it."""
        if state != self._state:
            self._state, self._state_time = state, now

    def take_distance(self, neighbor: str, distance: float, now: float) -> None:
        """Take the distance, m, to the neighbor to which the follower turns."""
        self._neighbor, self._distance, self._distance_time = neighbor, distance, now

    def take_handover(self, reason: str) -> None:
        """Take the reason why the bridge ends the flight; it becomes the next text."""
        self._handed_over = reason

    def take_warning(self, text: str) -> None:
        """Take a warning, such as a changed parameter; it becomes one of the next texts."""
        self._warnings.append(text)

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
        elif self._warnings:
            severity, text = mavlink.MAV_SEVERITY_WARNING, self._warnings.popleft()
        elif self._state != self._reported and now - self._state_time >= HELD:
            severity = SEVERITIES.get(self._state, mavlink.MAV_SEVERITY_INFO)
            text = self._reported = self._state
            if known and self._state in FOLLOWS:
                text += f' {self._neighbor} {self._distance:.1f} m'
        else:
            return messages
        self._last_text = now
        data = f'flock: {text}'.encode('ascii', 'replace')[:CHUNK_SIZE]
        return [*messages, mavlink.MAVLink_statustext_message(severity, data)]
