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

"""The MAVLink 2 face of the simulated vehicle: telemetry, commands, parameters, time."""

from __future__ import annotations

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.geometry import enu_to_ned, flu_to_frd, quaternion_enu_flu_to_ned_frd
from flock_follower.ranges import Range
from flock_follower.simulation.vehicles.flight_controller import (
    ACCEPTED,
    FlightController,
    FORCE,
    GROUND_AMSL,
    UNSUPPORTED,
)

STEP: Final[float] = 0.01  # s
SYSTEM_IDS: Final[Range] = Range(1, 255, whole=True)
#: Message rates, Hz; SET_MESSAGE_INTERVAL changes them up to the rate of the steps.
RATES: Final[dict[int, float]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
}
#: Messages that come once they are asked for, by SET_MESSAGE_INTERVAL or REQUEST_MESSAGE.
ON_REQUEST: Final[frozenset[int]] = frozenset({
    mavlink.MAVLINK_MSG_ID_ALTITUDE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT})
CURRENT_MODE: Final[int] = mavlink.MAVLINK_MSG_ID_CURRENT_MODE
#: PX4 sends CURRENT_MODE by default, and at the most where the mode stays, every so many seconds.
CURRENT_MODE_PERIODS: Final[tuple[float, float]] = 2.0, 0.5
TEXT_CHUNK: Final[int] = 50  # bytes of a STATUSTEXT
_PARAMETERS: Final[tuple[str, ...]] = ('PARAM_REQUEST_READ', 'PARAM_REQUEST_LIST', 'PARAM_SET')
_MODE_COMMANDS: Final[dict[int, dict[int, str]]] = {
    mavlink.MAV_AUTOPILOT_PX4: {
        mavlink.MAV_CMD_NAV_LAND: 'AUTO.LAND', mavlink.MAV_CMD_NAV_LOITER_UNLIM: 'AUTO.LOITER',
        mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: 'AUTO.RTL'},
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: {
        mavlink.MAV_CMD_NAV_LAND: 'LAND', mavlink.MAV_CMD_NAV_LOITER_UNLIM: 'LOITER',
        mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: 'RTL'},
}
_CELLS: Final[int] = 4
_CAPACITY: Final[float] = 5.2  # Ah
_CURRENT: Final[float] = 18.0  # A in flight
_LATITUDE, _LONGITUDE = 47.397742, 8.545594  # degrees, of the local origin
_LONGEST_WAY: Final[int] = 1_000_000_000  # ns from a TIMESYNC question to its answer
_DEGREE: Final[float] = 111_320.0  # m along a meridian


class MavlinkVehicle:
    """
    The MAVLink face of a flight controller; no socket, no clock.

    :param now: monotonic time, s; messages carry times since then.
    """

    def __init__(self, controller: FlightController, now: float, *, system_id: int = 1) -> None:
        SYSTEM_IDS.check('system_id', system_id)
        self.controller = controller
        self.system_id = system_id
        #: Commands that are refused, a fault for tests: MAV_RESULT and the reason to give.
        self.refusals: dict[int, tuple[int, str]] = {}
        self._start = now
        self._intervals = {message: 1.0 / rate for message, rate in RATES.items()}
        self._intervals[mavlink.MAVLINK_MSG_ID_TIMESYNC] = 1.0 / controller.TIMESYNC_RATE
        self._due = dict.fromkeys(self._intervals, now)
        self._px4 = controller.AUTOPILOT == mavlink.MAV_AUTOPILOT_PX4
        self._mode = controller.custom_mode
        self._mode_told, self._mode_interval = now, CURRENT_MODE_PERIODS[0]
        self._mode_is_news = False
        self._clock_offset: float | None = None
        self._charge_used = 0.0
        self._texts_sent = 0
        self._time = now

    def handle(self, message: Any, now: float) -> list[Any]:
        """Take a message received at ``now`` and return the answers."""
        kind = message.get_type()
        if getattr(message, 'target_system', 0) not in (0, self.system_id):
            return []
        if kind == 'SET_POSITION_TARGET_LOCAL_NED':
            self.controller.on_setpoint(message, now)
        elif kind == 'ODOMETRY':
            self.controller.on_odometry(message, now, self._age(message, now))
        elif kind in _PARAMETERS:
            return self.controller.parameters.handle(message)
        elif kind == 'TIMESYNC':
            return self._timesync(message, now)
        elif kind in ('COMMAND_LONG', 'COMMAND_INT'):
            return self._command(message, now)
        return []

    def _timesync(self, message: Any, now: float) -> list[Any]:
        # Zero would make an answer a question, and two polite ends talk for ever.
        nanoseconds = max(1, round((now - self._start) * 1e9))
        if message.tc1 == 0:
            return [mavlink.MAVLink_timesync_message(nanoseconds, message.ts1)]
        if 0 <= nanoseconds - message.ts1 < _LONGEST_WAY:
            # Whoever answered did so half way between question and answer.
            self._clock_offset = (0.5 * (message.ts1 + nanoseconds) - message.tc1) * 1e-9
        return []

    def _age(self, odometry: Any, now: float) -> float:
        """Return the age of an ODOMETRY, s; before the sender's clock is learnt it is new."""
        if self._clock_offset is None:
            return 0.0
        return now - self._start - odometry.time_usec * 1e-6 - self._clock_offset

    def step(self, now: float) -> list[Any]:
        """Fly on to ``now`` and return the messages that are due."""
        self.controller.step(now)
        if self.controller.armed:
            self._charge_used += _CURRENT * (now - self._time) / 3600.0
        self._time = now
        messages = [*self._texts(), *self.controller.parameters.step(), *self._mode_news(now)]
        for message_id, due in self._due.items():
            if now >= due - 0.5 * STEP:
                messages += self._telemetry(message_id, now)
                # From the time it was due: the mean rate is exact.
                interval = self._intervals[message_id]
                self._due[message_id] = due + interval * max(1, (now - due) // interval)
        return messages

    def _mode_news(self, now: float) -> list[Any]:
        """Return what tells of the mode when it changes: measured on PX4 1.16, ArduCopter 4.7."""
        changed, self._mode = self._mode != self.controller.custom_mode, (
            self.controller.custom_mode)
        if not self._px4:
            return [self._heartbeat()] if changed else []
        since = now - self._mode_told
        self._mode_is_news |= changed or since >= CURRENT_MODE_PERIODS[1]
        if not self._mode_is_news or since < self._mode_interval - 0.5 * STEP:
            return []
        self._mode_told, self._mode_is_news = now, False
        return [mavlink.MAVLink_current_mode_message(0, self._mode, self._mode)]

    def _texts(self) -> list[Any]:
        said, self.controller.said = self.controller.said, []
        messages = []
        for text in said:
            # A chunk that is full means that another follows.
            data = f'{text.text}{self.controller.TEXT_END}'.encode()
            self._texts_sent += 1
            number = self._texts_sent % 0xFFFF + 1 if len(data) > TEXT_CHUNK else 0
            messages += [mavlink.MAVLink_statustext_message(
                text.severity, data[i:i + TEXT_CHUNK], number, i // TEXT_CHUNK)
                for i in range(0, len(data) + (number > 0), TEXT_CHUNK)]
        return messages

    def _command(self, message: Any, now: float) -> list[Any]:
        refusal = self.refusals.get(message.command)
        results = self._obey(message, now) if refusal is None else [refusal[0]]
        messages = self._texts()
        if refusal is not None and refusal[1]:
            messages.append(mavlink.MAVLink_statustext_message(
                mavlink.MAV_SEVERITY_CRITICAL, refusal[1].encode()[:TEXT_CHUNK]))
        # Answers follow the acknowledgement of a MAV_CMD_REQUEST_MESSAGE.
        extra = self._requested(message, now) if ACCEPTED in results else []
        return [*messages, *(mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent())
            for result in results), *extra]

    def _obey(self, message: Any, now: float) -> list[int]:
        controller, command = self.controller, message.command
        modes = _MODE_COMMANDS[controller.AUTOPILOT]
        if command == mavlink.MAV_CMD_DO_SET_MODE:
            return controller.command_mode((message.param1, message.param2, message.param3), now)
        if command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            return [controller.arm(message.param1 > 0.5, message.param2 == FORCE, now)]
        if command == mavlink.MAV_CMD_NAV_TAKEOFF:
            altitude = message.z if message.get_type() == 'COMMAND_INT' else message.param7
            return [controller.take_off(altitude, now)]
        if command in modes:
            return [controller.change_mode(modes[command], now)]
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return [self._set_interval(message.param1, message.param2, now)]
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return [ACCEPTED if message.param1 in {*RATES, *ON_REQUEST} else UNSUPPORTED]
        return [UNSUPPORTED]

    def _requested(self, message: Any, now: float) -> list[Any]:
        if message.command != mavlink.MAV_CMD_REQUEST_MESSAGE:
            return []
        return self._telemetry(int(message.param1), now)

    def _set_interval(self, message_id: float, microseconds: float, now: float) -> int:
        if self._px4 and message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return int(mavlink.MAV_RESULT_FAILED)
        if self._px4 and message_id == CURRENT_MODE and microseconds > 0:
            self._mode_interval = microseconds * 1e-6
            return ACCEPTED
        if message_id not in {*RATES, *ON_REQUEST} or math.isnan(microseconds):
            return UNSUPPORTED
        default = 1.0 / RATES[int(message_id)] if message_id in RATES else math.inf
        interval = default if microseconds == 0 else microseconds * 1e-6
        silent = interval < 0 or math.isinf(interval)
        self._intervals[int(message_id)] = math.inf if silent else max(interval, STEP)
        self._due[int(message_id)] = math.inf if silent else now
        return ACCEPTED

    def _telemetry(self, message_id: int, now: float) -> list[Any]:
        vehicle, estimate = self.controller.vehicle, self.controller.estimator
        boot = round((now - self._start) * 1e3)
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return [self._heartbeat()]
        if message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            return [mavlink.MAVLink_timesync_message(
                0, max(1, round((now - self._start) * 1e9)))]
        if message_id == mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            # Without an estimate of the position an autopilot sends none.
            return [mavlink.MAVLink_local_position_ned_message(
                boot, *enu_to_ned(estimate.position).tolist(),
                *enu_to_ned(estimate.velocity).tolist())] if self.controller.position_known(
                    now) else []
        if message_id == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            x, y, z, w = quaternion_enu_flu_to_ned_frd(estimate.quaternion).tolist()
            return [mavlink.MAVLink_attitude_quaternion_message(
                boot, w, x, y, z, *flu_to_frd(vehicle.angular_velocity).tolist())]
        if message_id == mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            return [mavlink.MAVLink_extended_sys_state_message(
                mavlink.MAV_VTOL_STATE_UNDEFINED, self.controller.landed_state)]
        if message_id == mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
            return self._global_position(boot, now)
        if message_id == mavlink.MAVLINK_MSG_ID_ALTITUDE:
            height = float(estimate.position[2])
            return [mavlink.MAVLink_altitude_message(
                boot * 1000, height + GROUND_AMSL, height + GROUND_AMSL, height, height,
                math.nan, math.nan)]
        if message_id == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            return [self._version()]
        return [self._battery(message_id)]

    def _global_position(self, boot: int, now: float) -> list[Any]:
        estimate = self.controller.estimator
        if estimate.uses_vision or not self.controller.position_known(now):
            return []  # vision says nothing of where on earth it is
        east, north, up = estimate.position.tolist()
        across = _DEGREE * math.cos(math.radians(_LATITUDE))
        velocity = (enu_to_ned(estimate.velocity) * 100.0).round().astype(int).tolist()
        heading = round(math.degrees(math.pi / 2.0 - estimate.yaw) % 360.0 * 100.0) % 36000
        return [mavlink.MAVLink_global_position_int_message(
            boot, round((_LATITUDE + north / _DEGREE) * 1e7),
            round((_LONGITUDE + east / across) * 1e7), round((up + GROUND_AMSL) * 1e3),
            round(up * 1e3), *velocity, heading)]

    def _battery(self, message_id: int) -> Any:
        remaining = max(0.0, 1.0 - self._charge_used / _CAPACITY)
        cell = round(1e3 * (3.5 + 0.7 * remaining))  # mV
        current = round(1e2 * (_CURRENT if self.controller.armed else 0.5))  # cA
        percent = round(1e2 * remaining)
        if message_id == mavlink.MAVLINK_MSG_ID_SYS_STATUS:
            return mavlink.MAVLink_sys_status_message(
                0, 0, 0, 250, _CELLS * cell, current, percent, 0, 0, 0, 0, 0, 0)
        voltages = [cell] * _CELLS + [65535] * (10 - _CELLS)
        return mavlink.MAVLink_battery_status_message(
            0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, 32767, voltages,
            current, round(1e3 * self._charge_used), -1, percent)

    def _heartbeat(self) -> Any:
        controller = self.controller
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, controller.AUTOPILOT, controller.base_mode,
            controller.custom_mode, controller.system_status, 3)

    def _version(self) -> Any:
        encoding = (mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE if self._px4
                    else mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST)
        major, minor = (1, 16) if self._px4 else (4, 7)
        return mavlink.MAVLink_autopilot_version_message(
            encoding | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED,
            major << 24 | minor << 16 | 255, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)
