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
Determines who has taken over the vehicle: a pilot, or which failsafe of the autopilot.

PX4 reports in CURRENT_MODE the flown mode and the chosen mode: a failsafe changes only the flown
mode, a pilot changes the chosen mode. PX4 names the cause in EVENTs. ArduPilot reports no chosen
mode, but announces a failsafe by STATUSTEXT; some modes are never entered by a failsafe. An
unknown cause counts as a pilot. Times are s.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
import re
from types import MappingProxyType
from typing import Any, Final

from flock_follower.gate.permission import Taker, UNKNOWN
from flock_follower.mavlink.dialects import Dialect
from flock_follower.mavlink.status_texts import event_number

PILOT: Final[Taker] = Taker('the pilot took over', True)
BATTERY, FENCE, STREAM = 'low battery', 'fence', 'no setpoint stream'
TRANSMITTER, STATION, ESTIMATE = 'transmitter lost', 'ground station lost', 'no position estimate'
UNNAMED: Final[str] = 'unknown cause'
#: Evidence is used from this long before the mode was left, s.
BEFORE: Final[float] = 3.0
#: It is used until this long after, s.
EVIDENCE_AFTER: Final[float] = 2.0
#: The bridge stops its stream when the mode is left: a later report of a missing stream, s, is
#: its effect.
STREAM_AFTER: Final[float] = 0.3
#: PX4's ``failsafe_cause_t``; 0 is any other cause (sources of 1.16 and 1.18).
_CAUSES: Final[Mapping[int, str]] = MappingProxyType({
    1: TRANSMITTER, 2: STATION, 3: BATTERY, 4: BATTERY, 5: BATTERY, 6: BATTERY})
#: Place of the cause in the arguments of PX4's failsafe events.
_CAUSE_AT: Final[Mapping[int, int]] = MappingProxyType({
    event_number('commander_failsafe_enter'): 5,
    event_number('commander_failsafe_enter_hold'): 7})
#: Other events of PX4 that name a cause; the first one that was reported counts.
_CHECKS: Final[Mapping[int, str]] = MappingProxyType({
    event_number(name): cause for cause, names in (
        (FENCE, ('check_gf_violation_custom_gf', 'check_gf_violation_max_alt',
                 'check_gf_violation_max_hor_dist')),
        (STREAM, ('check_modes_offboard_signal',)),
        (TRANSMITTER, ('commander_rc_lost',)), (STATION, ('commander_gcs_lost',)),
        (ESTIMATE, ('check_modes_local_pos',)))
    for name in names})
_ORDER: Final[tuple[str, ...]] = tuple(dict.fromkeys(_CHECKS.values()))
#: Texts of ArduPilot when a failsafe changes the mode.
_TEXTS: Final = tuple((re.compile(pattern, re.IGNORECASE), cause) for pattern, cause in (
    (r'battery failsafe', BATTERY), (r'radio failsafe', TRANSMITTER),
    (r'fence.* breached', FENCE), (r'gcs failsafe', STATION),
    (r'(ekf|deadreckon) failsafe|ekf variance', ESTIMATE)))
_NO_CHANGE: Final = re.compile(r'continuing|cleared|recovered', re.IGNORECASE)


def failsafe(why: str) -> Taker:
    """Return the taker for a failsafe."""
    return Taker(f'failsafe: {why}', False)


class TakeoverWatch:
    """Collects the evidence of who changes the mode."""

    def __init__(self) -> None:
        self._mode = '', -math.inf  # not ours, with its time
        self._chosen = '', -math.inf  # while another mode than ours is flown
        self._named = '', -math.inf  # by a failsafe event, or text
        self._checks: dict[str, float] = {}

    def take(self, message: Any, dialect: Dialect | None, now: float) -> None:
        """Take any message of the autopilot."""
        kind = message.get_type()
        if kind == 'EVENT':
            self._take_event(message.number % 2**24, bytes(message.arguments), now)
        elif kind == 'STATUSTEXT':
            text = str(message.text)
            for pattern, cause in _TEXTS:
                if pattern.search(text) and not _NO_CHANGE.search(text):
                    self._named = cause, now
        elif dialect is not None and kind in ('HEARTBEAT', 'CURRENT_MODE'):
            mode = dialect.mode_name(message.custom_mode)
            if mode == dialect.offboard:
                return
            self._mode = mode, now
            if kind == 'CURRENT_MODE' and message.intended_custom_mode:
                self._chosen = dialect.mode_name(message.intended_custom_mode), now

    def _take_event(self, number: int, arguments: bytes, now: float) -> None:
        if number in _CAUSE_AT:
            cause = _CAUSES.get(arguments[_CAUSE_AT[number]], '')
            self._named = (cause, now) if cause else self._named
        elif number in _CHECKS:
            self._checks[_CHECKS[number]] = now

    def taker(self, dialect: Dialect, left: float) -> Taker:
        """Return who left the offboard mode at a time, s, by the evidence so far."""
        (mode, mode_time), (chosen, chosen_time) = self._mode, self._chosen
        if chosen_time >= left:
            return PILOT if chosen != dialect.offboard else failsafe(self._name(left) or UNNAMED)
        if mode_time >= left and mode in dialect.pilot_modes:
            return PILOT
        named = self._name(left)
        return failsafe(named) if named else UNKNOWN

    def _name(self, left: float) -> str:
        """Return the cause of a failsafe at a time, s, or ''."""
        named, time = self._named
        if left - BEFORE <= time <= left + EVIDENCE_AFTER:
            return named
        return next((cause for cause in _ORDER
                     if left - BEFORE <= self._checks.get(cause, -math.inf) <= left + (
                         STREAM_AFTER if cause == STREAM else EVIDENCE_AFTER)), '')
