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
Texts of the autopilot: STATUSTEXT messages, and the EVENTs of PX4.

PX4 sends STATUSTEXT only to links on which it receives a ground station, and none at all if it
refuses a mode. PX4 reports its arming checks by EVENTs on every link: one for each failed check,
with the modes concerned, between two summaries. PX4 sends them after a change, and after
MAV_CMD_RUN_PREARM_CHECKS. An EVENT is a number, the hash of a name; the texts for the names are
here. Measured on 1.16.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
import struct
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

#: The message; common.xml has it, no pymavlink yet.
MESSAGE_ID: Final[int] = 410
#: A report that names more checks than this has lost its end.
MOST_FAILURES: Final[int] = 100
#: The bits of modes, as EVENTs name them: PX4's navigation states.
_MODES: Final[Mapping[str, int]] = MappingProxyType({
    'MANUAL': 0, 'ALTCTL': 1, 'POSCTL': 2, 'AUTO.MISSION': 3, 'AUTO.LOITER': 4, 'AUTO.RTL': 5,
    'ACRO': 10, 'OFFBOARD': 14, 'STABILIZED': 15, 'AUTO.TAKEOFF': 17, 'AUTO.LAND': 18,
    'AUTO.FOLLOW_TARGET': 19, 'AUTO.PRECLAND': 20})
_EVERY_MODE: Final[int] = 0xFFFFFFFF
_PILOT_MODES: Final[tuple[str, ...]] = ('MANUAL', 'ALTCTL', 'POSCTL', 'ACRO', 'STABILIZED')
_STICKS: Final[str] = 'check_modes_manual_control'
#: The worst level of a check that is only a remark.
_WARNING: Final[int] = mavlink.MAV_SEVERITY_WARNING
_BEGIN, _END = 'commander_arming_check_summary', 'commander_health_summary'
#: Texts of the events that are reported.
_MEANINGS: Final[Mapping[str, str]] = MappingProxyType({
    'check_modes_angular_velocity': 'no angular velocity',
    'check_modes_attitude': 'no attitude estimate',
    'check_modes_local_pos': 'no valid position estimate',
    'check_modes_global_pos': 'no global position (neither GPS nor an origin)',
    'check_modes_local_alt': 'no valid altitude estimate',
    'check_modes_mission': 'no mission',
    'check_modes_offboard_signal': 'no setpoint stream',
    'check_modes_home_position': 'no home position',
    _STICKS: 'no transmitter',
    'check_modes_cannot_takeoff': 'it does not arm in this mode',
    'check_rc_dl_no_dllink': 'no ground station',
    'check_system_arm_auth_failed': 'arm authorization denied',
    'check_system_safety_button': 'press the safety button',
    'check_man_control_kill_engaged': 'the kill switch is on',
    'commander_arm_denied_throttle_center': 'arming denied: throttle above its centre',
    'commander_arm_denied_throttle_high': 'arming denied: throttle too high',
    'commander_arm_denied_calibrating': 'arming denied: calibrating',
    'commander_disarm_denied_not_landed': 'disarming denied: not landed',
    'commander_gcs_lost': 'the ground station is lost',
    'commander_mission_comp_lost': 'this computer is lost',
    'commander_rc_lost': 'the transmitter is lost',
})
#: More of its checks, 'check_' left out; the name has the words.
_MORE: Final[str] = """
accel_missing accel_no_data accel_not_calibrated armable_configuration avionics_power_high
avionics_power_low avionics_power_missing avionics_power_redundancy baro_missing baro_no_data
battery_critical battery_disconnected battery_emergency battery_fault battery_low battery_missing
battery_rem_flight_time_low battery_unhealthy cpuload_too_high distance_sensor_invalid
distance_sensor_missing escs_fault escs_offline escs_telem_missing estimator_gnss_fault
estimator_gps_fix_too_low estimator_gps_generic estimator_gps_hor_pos_drift_too_high
estimator_gps_hor_pos_err_too_high estimator_gps_hor_speed_drift_too_high
estimator_gps_jamming_critical estimator_gps_not_fusing estimator_gps_num_sats_too_low
estimator_gps_pdop_too_high estimator_gps_speed_acc_too_low estimator_gps_spoofed
estimator_gps_vert_pos_drift_too_high estimator_gps_vert_pos_err_too_high
estimator_gps_vert_speed_drift_too_high estimator_heading_not_stable estimator_hgt_not_stable
estimator_high_accel_bias estimator_high_gyro_bias estimator_hor_pos_not_stable
estimator_hor_vel_not_stable estimator_low_position_accuracy estimator_mag_fault
estimator_mag_interference estimator_missing_data estimator_vert_vel_not_stable
external_modes_unavailable external_modes_unresponsive failure_detector_alt
failure_detector_arm_esc failure_detector_ext failure_detector_imbalanced_prop
failure_detector_motor failure_detector_pitch failure_detector_roll flight_time_limit gf_no_home
gf_violation_custom_gf gf_violation_max_alt gf_violation_max_hor_dist gyro_missing gyro_no_data
gyro_not_calibrated hardfault_present imu_accel_inconsistent imu_gyro_inconsistent mag_consistency
mag_fault mag_missing mag_no_data mag_not_calibrated mag_sys_has_mag_missing
man_control_rtl_engaged missing_cpuload missing_fmu_sdcard missing_system_power mission_failure
navigator_failure_hagl optical_flow_sensor_invalid ram_usage_too_high rc_dz_too_high
rc_max_too_high rc_min_too_small rc_trim_too_high rc_trim_too_small system_flight_term_active
system_no_global_pos system_no_home_pos system_usb_connected wind_too_high"""
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


_BY_NUMBER: Final[Mapping[int, str]] = MappingProxyType(
    {event_number(name): name for name in (
        *_MEANINGS, *_ENTERS, _BEGIN, _END, *(f'check_{text}' for text in _MORE.split()))})


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
    """The modes that it applies to, one bit each."""
    level: int
    """MAV_SEVERITY."""


class ArmingChecks:
    """The newest report of the arming checks of PX4."""

    def __init__(self) -> None:
        self._failures: tuple[Failure, ...] = ()
        self._coming: list[Failure] | None = None

    def take(self, message: Any) -> str:
        """Take an EVENT; return its text if it has one by itself, or ''."""
        name = _BY_NUMBER.get(message.number % 2**24, '')
        level, arguments = message.log_levels & 0xF, bytes(message.arguments)
        if name == _BEGIN:
            self._coming = []
        elif name == _END:
            if self._coming is not None:
                self._failures = tuple(self._coming)
            self._coming = None
        elif name in _ENTERS:
            return f'failsafe: action {arguments[4]} of PX4'
        elif name.startswith('commander_'):
            return _MEANINGS[name]
        elif self._coming is not None and len(self._coming) < MOST_FAILURES:
            text = _MEANINGS.get(name) or name.removeprefix('check_').replace('_', ' ')
            self._coming.append(Failure(text or f'event {message.number % 2**24}',
                                        int.from_bytes(arguments[:4], 'little'), level))
        return ''

    def against(self, mode: str) -> list[str]:
        """Return the failed checks for a mode (named as in ``dialects.PX4``) or arming in it."""
        return [failure.text for failure in self._failures
                if mode in _MODES and failure.modes >> _MODES[mode] & 1
                # For every mode come remarks, too, that keep it from nothing,
                and (failure.modes != _EVERY_MODE or failure.level < _WARNING
                     # and this one, which keeps it from the pilot's.
                     or (failure.text == _MEANINGS[_STICKS] and mode in _PILOT_MODES))]


#: ArduPilot repeats what keeps it from arming, marked so, every 30 s.
PREARM: Final[str] = 'PreArm: '
PREARM_PERIOD: Final[float] = 35.0


class AutopilotText(NamedTuple):
    """One text, or one chunk of 50 characters of a longer one."""

    time: float
    """Time of reception, s."""
    severity: int
    """MAV_SEVERITY: the smaller, the worse."""
    text: str


class StatusTexts:
    """The recent texts; ``add`` takes messages, ``since`` and ``new`` return texts."""

    def __init__(self) -> None:
        self.checks = ArmingChecks()
        self._has_texts = False
        self._texts: deque[AutopilotText] = deque(maxlen=50)
        self._new: deque[AutopilotText] = deque(maxlen=200)

    def add(self, message: Any, now: float) -> None:
        """Take a STATUSTEXT."""
        self._has_texts = True
        self._take(message.severity, str(message.text), now)

    def add_event(self, message: Any, now: float) -> None:
        """Take an EVENT; its text is used only if no STATUSTEXTs come."""
        text = self.checks.take(message)
        if text and not self._has_texts:
            self._take(message.log_levels & 0xF, text, now)

    def _take(self, severity: int, text: str, now: float) -> None:
        # PX4 ends texts with a tab if it also sends them as events.
        taken = AutopilotText(now, severity, text.strip('\x00\t\n '))
        self._texts.append(taken)
        self._new.append(taken)

    def why(self, time: float, mode: str) -> list[str]:
        """Return the texts since ``time``, and the newest failed checks for a mode."""
        return list(dict.fromkeys([*self.since(time), *self.checks.against(mode)]))

    def unready(self, now: float, mode: str) -> str:
        """Return recent texts and the newest failed checks against arming in a mode, or ''."""
        reported = [text.text.partition(PREARM)[2] for text in list(self._texts)
                    if PREARM in text.text and now - text.time <= PREARM_PERIOD]
        return '; '.join(dict.fromkeys([*reported, *self.checks.against(mode)]))

    def since(self, time: float, worst: int = mavlink.MAV_SEVERITY_NOTICE) -> list[str]:
        """Return the distinct texts from ``time`` on, of the given severity or worse."""
        return list(dict.fromkeys(
            text for t, severity, text in self._texts if t >= time and severity <= worst))

    def new(self) -> list[AutopilotText]:
        """Return the texts since the last call."""
        texts = list(self._new)
        self._new.clear()
        return texts
