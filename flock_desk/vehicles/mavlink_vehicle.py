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

"""The MAVLink 2 face of the simulated vehicle: commands, intervals, parameters, time."""

from __future__ import annotations

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.equipment import Equipment
from flock_desk.vehicles.flight_controller import (
    ACCEPTED,
    FAILED,
    FlightController,
    FORCE,
    UNSUPPORTED,
)
from flock_desk.vehicles.vehicle_telemetry import (
    CURRENT_MODE,
    EKF_STATUS_REPORT,
    VehicleTelemetry,
)
from flock_desk.vehicles.vehicle_words import VehicleWords
from flock_follower.ranges import Range

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
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE})
#: PX4 sends CURRENT_MODE by default, and at the most where the mode stays, every so many seconds.
CURRENT_MODE_PERIODS: Final[tuple[float, float]] = 2.0, 0.5
#: What each has besides: PX4's by default, ArduPilot's once it is asked for.
_OWN: Final[dict[int, dict[int, float]]] = {
    mavlink.MAV_AUTOPILOT_PX4: {
        mavlink.MAVLINK_MSG_ID_ALTITUDE: 10.0, mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
        mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 1.0, mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5},
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: {EKF_STATUS_REPORT: 0.0}}
#: ArduPilot's streams (MAV_DATA_STREAM) that hold what is sent here; REQUEST_DATA_STREAM, as
#: MAVProxy sends it, sets the rate of all that is in one. The rest is in none.
_STREAMS: Final[dict[int, tuple[int, ...]]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: (mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE,),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (mavlink.MAVLINK_MSG_ID_SYS_STATUS,),
    mavlink.MAV_DATA_STREAM_POSITION: (
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT),
    mavlink.MAV_DATA_STREAM_EXTRA3: (
        mavlink.MAVLINK_MSG_ID_BATTERY_STATUS, EKF_STATUS_REPORT)}
_PARAMETERS: Final[tuple[str, ...]] = ('PARAM_REQUEST_READ', 'PARAM_REQUEST_LIST', 'PARAM_SET')
_MODE_COMMANDS: Final[dict[int, dict[int, str]]] = {
    mavlink.MAV_AUTOPILOT_PX4: {
        mavlink.MAV_CMD_NAV_LAND: 'AUTO.LAND', mavlink.MAV_CMD_NAV_LOITER_UNLIM: 'AUTO.LOITER',
        mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: 'AUTO.RTL'},
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: {
        mavlink.MAV_CMD_NAV_LAND: 'LAND', mavlink.MAV_CMD_NAV_LOITER_UNLIM: 'LOITER',
        mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: 'RTL'},
}
_LONGEST_WAY: Final[int] = 1_000_000_000  # ns from a TIMESYNC question to its answer


class MavlinkVehicle:
    """
    The MAVLink face of a flight controller and its equipment; no socket, no clock.

    :param now: monotonic time, s; messages carry times since then.
    """

    def __init__(self, controller: FlightController, equipment: Equipment, now: float, *,
                 system_id: int = 1) -> None:
        SYSTEM_IDS.check('system_id', system_id)
        self.controller = controller
        self.system_id = system_id
        #: Commands that are refused, a fault for tests: MAV_RESULT and the reason to give.
        self.refusals: dict[int, tuple[int, str]] = {}
        self._start = now
        self._rates = {**RATES, **_OWN[controller.AUTOPILOT]}
        if equipment.rangefinder:  # PX4's rate by default
            self._rates[mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR] = 10.0
        self._intervals = {message: 1.0 / rate for message, rate in self._rates.items() if rate}
        self._intervals[mavlink.MAVLINK_MSG_ID_TIMESYNC] = 1.0 / controller.TIMESYNC_RATE
        self._due = dict.fromkeys(self._intervals, now)
        self._px4 = controller.AUTOPILOT == mavlink.MAV_AUTOPILOT_PX4
        self._mode = controller.custom_mode
        self._mode_told, self._mode_interval = now, CURRENT_MODE_PERIODS[0]
        self._mode_is_news = False
        self._clock_offset: float | None = None
        self._telemetry = VehicleTelemetry(controller, equipment, now)
        self._words = VehicleWords(controller, now)

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
        elif kind == 'HEARTBEAT':
            self._words.hear(message, now)
        elif kind == 'SET_GPS_GLOBAL_ORIGIN':
            self.controller.set_origin()
            return [self._telemetry.origin(message, now)]
        elif kind == 'REQUEST_DATA_STREAM' and not self._px4:
            self._set_streams(message, now)
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
        messages = [*self._words.messages(now), *self.controller.parameters.step(),
                    *self._mode_news(now)]
        for message_id, due in self._due.items():
            if now >= due - 0.5 * STEP:
                messages += self._telemetry.messages(message_id, now)
                # From the time it was due: the mean rate is exact.
                interval = self._intervals[message_id]
                self._due[message_id] = due + interval * max(1, (now - due) // interval)
        return messages

    def _mode_news(self, now: float) -> list[Any]:
        """Return what tells of the mode when it changes: measured on PX4 1.16, ArduCopter 4.7."""
        changed, self._mode = self._mode != self.controller.custom_mode, (
            self.controller.custom_mode)
        if not self._px4:
            return [self._telemetry.heartbeat()] if changed else []
        since = now - self._mode_told
        self._mode_is_news |= changed or since >= CURRENT_MODE_PERIODS[1]
        if not self._mode_is_news or since < self._mode_interval - 0.5 * STEP:
            return []
        self._mode_told, self._mode_is_news = now, False
        return self._telemetry.messages(CURRENT_MODE, now)

    def _command(self, message: Any, now: float) -> list[Any]:
        refusal = self.refusals.get(message.command)
        results = self._obey(message, now) if refusal is None else [refusal[0]]
        if refusal is not None and refusal[1]:
            self.controller.say(mavlink.MAV_SEVERITY_CRITICAL, refusal[1])
        messages = self._words.messages(now)
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
            return [ACCEPTED if message.param1 in {*self._rates, *ON_REQUEST} else UNSUPPORTED]
        if command == mavlink.MAV_CMD_RUN_PREARM_CHECKS:
            return [controller.run_checks(now)]
        return [UNSUPPORTED]

    def _requested(self, message: Any, now: float) -> list[Any]:
        if message.command != mavlink.MAV_CMD_REQUEST_MESSAGE:
            return []
        return self._telemetry.messages(int(message.param1), now)

    def _set_interval(self, message_id: float, microseconds: float, now: float) -> int:
        if self._px4 and message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return FAILED  # it stays at 1 Hz
        if self._px4 and message_id == CURRENT_MODE and microseconds > 0:
            self._mode_interval = microseconds * 1e-6
            return ACCEPTED
        if message_id not in {*self._rates, *ON_REQUEST} or math.isnan(microseconds):
            if not self._px4:
                self.controller.say(mavlink.MAV_SEVERITY_INFO,
                                    f'No ap_message for mavlink id ({message_id:g})')
            return self.controller.UNKNOWN_MESSAGE
        rate = self._rates.get(int(message_id), 0.0)
        default = 1.0 / rate if rate else math.inf
        interval = default if microseconds == 0 else microseconds * 1e-6
        silent = interval < 0 or math.isinf(interval)
        self._intervals[int(message_id)] = math.inf if silent else max(interval, STEP)
        self._due[int(message_id)] = math.inf if silent else now
        return ACCEPTED

    def _set_streams(self, message: Any, now: float) -> None:
        """Set the rates that somebody on the link, be it not the bridge, asks for."""
        wanted = message.req_message_rate if message.start_stop else 0
        for stream, ids in _STREAMS.items():
            if message.req_stream_id in (mavlink.MAV_DATA_STREAM_ALL, stream):
                for message_id in ids:
                    self._set_interval(message_id, 1e6 / wanted if wanted else -1.0, now)
