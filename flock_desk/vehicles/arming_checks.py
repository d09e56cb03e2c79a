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
What PX4 checks before it arms and before it changes the mode, and how it reports that.

Measured on PX4 1.16: it reports to every link, as EVENTs between two summaries, when something
changes (at most every 2 s) and when MAV_CMD_RUN_PREARM_CHECKS asks for it. Disarmed, any mode may
be chosen; arming then looks at what the chosen one needs. Which modes a check concerns are the
bits of PX4's navigation states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import struct
from types import MappingProxyType
from typing import Final, NamedTuple

from flock_desk.vehicles.flight_controller import Event

#: The bit of a mode.
BITS: Final[Mapping[str, int]] = MappingProxyType({
    'MANUAL': 0, 'ALTCTL': 1, 'POSCTL': 2, 'AUTO.LOITER': 4, 'AUTO.RTL': 5, 'OFFBOARD': 14,
    'STABILIZED': 15, 'AUTO.TAKEOFF': 17, 'AUTO.LAND': 18})
#: All that this quadrotor has; some modes more than are simulated.
_ALL: Final[int] = 0x807FFFFF
_EVERY: Final[int] = 0xFFFFFFFF  # so a check is reported that concerns no mode in particular
ERROR, WARNING, INFORMATION, PROTOCOL = 3, 4, 6, 8
REPORT_PERIOD: Final[float] = 2.0  # s between reports of changes, at least


class Check(NamedTuple):
    """A check that fails."""

    event: str
    component: int
    """The number of what is not well, as PX4 counts its parts."""
    level: int
    reported: int
    """The modes that it is reported for."""
    arming: int
    """The modes in which it forbids arming."""
    running: int = 0
    """The modes that it forbids."""


_LOCAL_MODES, _GLOBAL_MODES, _MANUAL_MODES, _LANDING_MODES = 0x7E007C, 0x38, 0x8447, 0x3C3020
LOCAL_POSITION: Final[Check] = Check(
    'check_modes_local_pos', 17, ERROR, _LOCAL_MODES, _LOCAL_MODES, _LOCAL_MODES)
GLOBAL_POSITION: Final[Check] = Check(
    'check_modes_global_pos', 24, ERROR, _GLOBAL_MODES, _GLOBAL_MODES, _GLOBAL_MODES)
MISSION: Final[Check] = Check('check_modes_mission', 20, INFORMATION, 0x8, 0x8, 0x8)
OFFBOARD_SIGNAL: Final[Check] = Check(
    'check_modes_offboard_signal', 20, ERROR, 0x4000, 0x4000, 0x4000)
STICKS: Final[Check] = Check(
    'check_modes_manual_control', 7, WARNING, _EVERY, _MANUAL_MODES, _MANUAL_MODES)
NOT_FOR_ARMING: Final[Check] = Check(
    'check_modes_cannot_takeoff', 20, INFORMATION, _LANDING_MODES, _LANDING_MODES)
GROUND_STATION: Final[Check] = Check('check_rc_dl_no_dllink', 12, INFORMATION, _EVERY, 0)
DENIAL: Final[Check] = Check('check_system_arm_auth_failed', 20, ERROR, _EVERY, _EVERY)


def may_arm(failing: Sequence[Check], mode: str) -> bool:
    """Return whether it arms in a mode."""
    return not any(check.arming >> BITS[mode] & 1 for check in failing)


def may_run(failing: Sequence[Check], mode: str) -> bool:
    """Return whether a mode may be flown."""
    return not any(check.running >> BITS[mode] & 1 for check in failing)


def report(failing: Sequence[Check]) -> list[Event]:
    """Return the events of a whole report."""
    arming = running = errors = warnings = 0
    for check in failing:
        arming, running = arming | check.arming, running | check.running
        errors |= (check.level <= ERROR) << check.component
        warnings |= (check.level == WARNING) << check.component
    able = [_ALL & ~modes & 0xFFFFFFFF for modes in (arming, running)]
    return [
        Event('commander_arming_check_summary', PROTOCOL, struct.pack(
            '<BIIII', 0, errors, warnings, *able)),
        *(Event(check.event, check.level, struct.pack('<IB', check.reported, check.component))
          for check in failing),
        Event('commander_health_summary', PROTOCOL, struct.pack('<BIII', 0, 0, 0, 0))]
