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
The whole embedded autopilot without socket and clock: MAVLink 2 bytes in, bytes out.

Fly it in simulated time beside a bridge, in one process::

    autopilot = EmbeddedAutopilot('arducopter', now=0.0, start='landed', ready_after=0.5)
    autopilot.receive(data, now)
    for data in autopilot.step(now): ...   # every STEP
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from types import MappingProxyType
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.arducopter import ArduCopter
from flock_desk.vehicles.estimator import (
    BarometerErrors,
    CAPACITY,
    CURRENT,
    Equipment,
    GROUND_AMSL,
)
from flock_desk.vehicles.flight_controller import ACCEPTED, FlightController
from flock_desk.vehicles.flight_log import FlightLog
from flock_desk.vehicles.profiles import AutopilotParameters, PROFILES
from flock_desk.vehicles.px4 import Px4
from flock_desk.vehicles.quadrotor import Quadrotor, VehicleParams
from flock_follower.geometry import Array, enu_to_ned, flu_to_frd, quaternion_enu_flu_to_ned_frd
from flock_follower.ranges import Range

STEP: Final[float] = 0.01  # s
#: PX4 sends CURRENT_MODE at the most every so many seconds where the mode stays.
CURRENT_MODE_PERIOD: Final[float] = 0.5
FORCE: Final[int] = 21196  # param2 that forces arming and disarming
_LONGEST_WAY: Final[int] = 1_000_000_000  # ns from a TIMESYNC question to its answer
_AIDED: Final[float] = 0.55  # s without vision until PX4 compares its estimate with none
_CELLS: Final[int] = 4
_UNKNOWN_VOLTAGE: Final[int] = 65535
LATITUDE, LONGITUDE = 47.397742, 8.545594  # degrees, of the local origin
DEGREE: Final[float] = 111_320.0  # m along a meridian


class MavlinkVehicle:
    """
    The MAVLink face of a flight controller and its equipment; no socket, no clock.

    :param now: monotonic time, s; messages carry times since then.
    """

    def __init__(self, controller: FlightController, equipment: Equipment, now: float, *,
                 system_id: int = 1) -> None:
        self.controller, self.equipment = controller, equipment
        self.system_id = system_id
        self._start = now
        self._px4 = controller.PROFILE.px4
        self._intervals = {message: 1.0 / rate if rate else math.inf
                           for message, rate in controller.PROFILE.rates.items()}
        self._due = {message: now if math.isfinite(interval) else math.inf
                     for message, interval in self._intervals.items()}
        self._mode_sent = controller.custom_mode, now
        self._clock_offset: float | None = None
        ids = {name: getattr(mavlink, f'MAVLINK_MSG_ID_{name}') for name in (
            'HEARTBEAT', 'TIMESYNC', 'LOCAL_POSITION_NED', 'ATTITUDE_QUATERNION',
            'EXTENDED_SYS_STATE', 'GLOBAL_POSITION_INT', 'HOME_POSITION', 'SCALED_PRESSURE',
            'AUTOPILOT_VERSION', 'ESTIMATOR_STATUS', 'EKF_STATUS_REPORT', 'CURRENT_MODE',
            'SYS_STATUS', 'BATTERY_STATUS')}
        self._encoders: Mapping[int, Callable[[float], Any]] = {
            number: getattr(self, f'_{name.lower()}') for name, number in ids.items()}

    def handle(self, message: Any, now: float) -> list[Any]:
        """Take a message received at ``now`` and return the answers."""
        kind = message.get_type()
        if getattr(message, 'target_system', 0) not in (0, self.system_id):
            return []
        if kind == 'SET_POSITION_TARGET_LOCAL_NED':
            self.controller.on_setpoint(message, now)
        elif kind == 'ODOMETRY':
            # Before the sender's clock is learnt it is new.
            age = 0.0 if self._clock_offset is None else (
                now - self._start - message.time_usec * 1e-6 - self._clock_offset)
            self.controller.estimator.on_odometry(message, now, age)
        elif kind in ('PARAM_REQUEST_READ', 'PARAM_SET'):
            return self.controller.parameters.handle(message)
        elif kind == 'TIMESYNC':
            return self._answer_timesync(message, now)
        elif kind == 'SET_GPS_GLOBAL_ORIGIN':
            self.controller.set_origin()
            return [mavlink.MAVLink_gps_global_origin_message(
                message.latitude, message.longitude, message.altitude, self._boot_ms(now) * 1000)]
        elif kind == 'COMMAND_LONG':
            return self._command(message, now)
        return []

    def _answer_timesync(self, message: Any, now: float) -> list[Any]:
        # Zero would turn an answer into a request, and both ends would answer for ever.
        nanoseconds = max(1, round((now - self._start) * 1e9))
        if message.tc1 == 0:
            return [mavlink.MAVLink_timesync_message(nanoseconds, message.ts1)]
        if 0 <= nanoseconds - message.ts1 < _LONGEST_WAY:
            # The other end answered half way between request and answer.
            self._clock_offset = (0.5 * (message.ts1 + nanoseconds) - message.tc1) * 1e-9
        return []

    def step(self, now: float) -> list[Any]:
        """Fly on to ``now`` and return the messages that are due."""
        self.controller.step(now)
        messages = self._status_texts()
        self._note_mode(now)
        for message_id, due in self._due.items():
            if now >= due - 0.5 * STEP:
                messages += self._encoded(message_id, now)
                # From the time it was due: the mean rate is exact.
                interval = self._intervals[message_id]
                self._due[message_id] = due + interval * max(1, (now - due) // interval)
        return messages

    def _note_mode(self, now: float) -> None:
        """Send the message with the mode at each change, as PX4 1.16 and ArduCopter 4.7 do."""
        mode, time = self._mode_sent
        news = mode != self.controller.custom_mode
        if not self._px4:
            self._mode_sent = self.controller.custom_mode, now
            if news:
                self._due[mavlink.MAVLINK_MSG_ID_HEARTBEAT] = now
            return
        interval = self._intervals[mavlink.MAVLINK_MSG_ID_CURRENT_MODE]
        due = time + (interval if news else max(interval, CURRENT_MODE_PERIOD))
        if now >= due - 0.5 * STEP:
            self._mode_sent = self.controller.custom_mode, now
        self._due[mavlink.MAVLINK_MSG_ID_CURRENT_MODE] = due

    def _status_texts(self) -> list[Any]:
        texts, self.controller.outbox = self.controller.outbox, []
        return texts

    def _encoded(self, message_id: int, now: float) -> list[Any]:
        """Return the message with an id; an empty list if it has no content."""
        message = self._encoders[message_id](now)
        return [] if message is None else [message]

    def _command(self, message: Any, now: float) -> list[Any]:
        results = self._obey(message, now)
        reply = message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and results == [ACCEPTED]
        return [*self._status_texts(), *(mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent())
            for result in results), *(self._encoded(int(message.param1), now) if reply else [])]

    def _obey(self, message: Any, now: float) -> list[int]:
        controller, command = self.controller, message.command
        if command == mavlink.MAV_CMD_DO_SET_MODE:
            return controller.command_mode((message.param1, message.param2, message.param3), now)
        if command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            return [controller.arm(message.param1 > 0.5, message.param2 == FORCE, now)]
        if command == mavlink.MAV_CMD_NAV_TAKEOFF:
            return [controller.take_off(message.param7, now)]
        if command in controller.PROFILE.commands:
            return [controller.change_mode(controller.PROFILE.commands[command], now)]
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return [self._set_interval(message.param1, message.param2, now)]
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE and message.param1 in self._intervals:
            return [ACCEPTED]
        if command == mavlink.MAV_CMD_RUN_PREARM_CHECKS:
            return [controller.run_checks(now)]
        return [int(mavlink.MAV_RESULT_UNSUPPORTED)]

    def _set_interval(self, message_id: float, microseconds: float, now: float) -> int:
        profile = self.controller.PROFILE
        fixed = self._px4 and message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT  # it stays at 1 Hz
        if message_id not in self._intervals or math.isnan(microseconds) or fixed:
            return profile.unknown_message
        number = int(message_id)
        rate = profile.rates[number]
        interval = (1.0 / rate if rate else math.inf) if microseconds == 0 else (
            max(microseconds * 1e-6, STEP) if microseconds > 0 else math.inf)
        self._intervals[number] = interval
        self._due[number] = now if math.isfinite(interval) else math.inf
        return ACCEPTED

    def _boot_ms(self, now: float) -> int:
        return round((now - self._start) * 1e3)

    def _heartbeat(self, now: float) -> Any:
        controller = self.controller
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if controller.armed else 0
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, controller.PROFILE.autopilot,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed, controller.custom_mode,
            controller.system_status, 3)

    def _timesync(self, now: float) -> Any:
        return mavlink.MAVLink_timesync_message(0, max(1, round((now - self._start) * 1e9)))

    def _local_position_ned(self, now: float) -> Any:
        estimate = self.controller.estimator
        return mavlink.MAVLink_local_position_ned_message(
            self._boot_ms(now), *enu_to_ned(estimate.position).tolist(),
            *enu_to_ned(estimate.velocity).tolist()) if self.controller.reports_position(
                now) else None

    def _attitude_quaternion(self, now: float) -> Any:
        x, y, z, w = quaternion_enu_flu_to_ned_frd(self.controller.estimator.quaternion).tolist()
        return mavlink.MAVLink_attitude_quaternion_message(
            self._boot_ms(now), w, x, y, z,
            *flu_to_frd(self.controller.vehicle.angular_velocity).tolist())

    def _extended_sys_state(self, now: float) -> Any:
        return mavlink.MAVLink_extended_sys_state_message(
            mavlink.MAV_VTOL_STATE_UNDEFINED, self.controller.landed_state)

    def _global_position_int(self, now: float) -> Any:
        estimate = self.controller.estimator
        if not self.controller.has_origin or not self.controller.position_known(now):
            return None  # vision alone says nothing of where on Earth it is
        velocity = (enu_to_ned(estimate.velocity) * 100.0).round().astype(int).tolist()
        heading = round(math.degrees(math.pi / 2.0 - estimate.yaw) % 360.0 * 100.0) % 36000
        return mavlink.MAVLink_global_position_int_message(
            self._boot_ms(now), *global_position(estimate.position),
            round(float(estimate.position[2] - self.controller.home[2]) * 1e3), *velocity,
            heading)

    def _home_position(self, now: float) -> Any:
        home, unknown = self.controller.home, [math.nan] * 4
        return mavlink.MAVLink_home_position_message(
            *global_position(home), *enu_to_ned(home).tolist(),
            [1.0, 0.0, 0.0, 0.0] if self._px4 else unknown, 0.0, 0.0, 0.0,
            self._boot_ms(now) * 1000) if self.controller.has_origin else None

    def _scaled_pressure(self, now: float) -> Any:
        return mavlink.MAVLink_scaled_pressure_message(
            self._boot_ms(now), self.equipment.pressure(now), 0.0, 1181)

    def _autopilot_version(self, now: float) -> Any:
        major, minor = self.controller.PROFILE.version
        return mavlink.MAVLink_autopilot_version_message(
            self.controller.PROFILE.encoding | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED,
            major << 24 | minor << 16 | 255, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)

    def _ekf_status_report(self, now: float) -> Any:
        return mavlink.MAVLink_ekf_status_report_message(
            self.controller.estimator_flags(now), 0.0, 0.0, 0.0, 0.0, 0.0)

    def _estimator_status(self, now: float) -> Any:
        # Measured: nothing is compared any more, and the accuracy grows from centimetres.
        estimator = self.controller.estimator
        age = estimator.vision_age(now) if estimator.ready(now) else math.inf
        ratio, accuracy = (0.02, 0.03) if age <= _AIDED else (
            math.nan, min(0.022 * age**2, 100.0))
        return mavlink.MAVLink_estimator_status_message(
            self._boot_ms(now) * 1000, self.controller.estimator_flags(now), ratio, ratio, 0.01,
            0.02, 0.01, math.nan, accuracy, 0.1)

    def _current_mode(self, now: float) -> Any:
        return mavlink.MAVLink_current_mode_message(
            0, self.controller.custom_mode, self.controller.intended_mode)

    def _battery(self) -> tuple[int, int, int]:
        """Return the voltage of a cell, mV, the current, cA, and the remaining charge, %."""
        charge = self.equipment.charge
        current = round(1e2 * (CURRENT if self.controller.armed else 0.5))
        if charge is None:
            return _UNKNOWN_VOLTAGE, current, -1
        return round(1e3 * (3.5 + 0.7 * charge)), current, round(1e2 * charge)

    def _sys_status(self, now: float) -> Any:
        checks, place = (mavlink.MAV_SYS_STATUS_PREARM_CHECK,
                         mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL)
        # PX4 neither has nor enables the check: only its health counts.
        there = place | (0 if self._px4 else checks)
        well = ((place if self.controller.position_known(now) else 0)
                | (0 if self.controller.unfit(now) else checks))
        cell, current, percent = self._battery()
        return mavlink.MAVLink_sys_status_message(
            there, there, well, 250, cell if percent < 0 else _CELLS * cell, current, percent,
            0, 0, 0, 0, 0, 0)

    def _battery_status(self, now: float) -> Any:
        cell, current, percent = self._battery()
        voltages = [cell] * _CELLS + [_UNKNOWN_VOLTAGE] * (10 - _CELLS)
        return mavlink.MAVLink_battery_status_message(
            0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, 32767, voltages,
            current, round(1e3 * (1.0 - max(percent, 0) / 1e2) * CAPACITY), -1, percent)


def global_position(position: Array) -> tuple[int, int, int]:
    """Return latitude and longitude, 1e-7 degrees, and altitude, mm, of a local position (3,)."""
    east, north, up = position.tolist()
    across = DEGREE * math.cos(math.radians(LATITUDE))
    return (round((LATITUDE + north / DEGREE) * 1e7), round((LONGITUDE + east / across) * 1e7),
            round((up + GROUND_AMSL) * 1e3))


STARTS: Final[tuple[str, ...]] = ('airborne', 'armed', 'landed')
SYSTEM_IDS: Final[Range] = Range(1, 255, whole=True)
_NO_PARAMETERS: Final[Mapping[str, float]] = MappingProxyType({})


class EmbeddedAutopilot:
    """
    An autopilot with the personality of PX4 or ArduCopter.

    :param now: monotonic time, s, of the start.
    :param start: 'airborne' (hovering in Hold or LOITER), 'armed' or 'landed'.
    :param altitude: m, of an airborne start.
    :param yaw: rad, ENU, at the start.
    :param parameters: values that differ from the autopilot's defaults.
    :param arming_denial: where given, arming is refused with this reason.
    :param ready_after: s from the start, and from a reboot, until the estimator is ready.
    :param seed: of the sensors' noise.
    :param signing: a pymavlink MAVLinkSigning, where the link is signed.
    :param barometer: how it errs.
    :raises ValueError: for an unknown personality, start or parameter.
    """

    def __init__(self, personality: str = 'px4', *, now: float, start: str = 'airborne',
                 altitude: float = 2.0, yaw: float = 0.0, system_id: int = 1,
                 parameters: Mapping[str, float] = _NO_PARAMETERS, arming_denial: str = '',
                 ready_after: float = 0.0, seed: int = 0, signing: Any = None,
                 barometer: BarometerErrors | None = None) -> None:
        for name, value, valid in (('personality', personality, tuple(PROFILES)),
                                   ('start', start, STARTS)):
            if value not in valid:
                raise ValueError(f'{name} = {value!r}: must be one of {", ".join(valid)}')
        SYSTEM_IDS.check('system_id', system_id)
        profile = PROFILES[personality]
        self._parameters = AutopilotParameters(profile)
        for name, number in parameters.items():
            self._parameters.set(name, number)
        self.log = FlightLog()
        self._kind: type[FlightController] = Px4 if profile.px4 else ArduCopter
        self._start, self._steps = now, 0
        self._silent_until = -math.inf
        self._arming_denial, self._ready_after = arming_denial, ready_after
        self.vehicle = Quadrotor((0.0, 0.0, altitude if start == 'airborne' else 0.0), yaw,
                                 VehicleParams(tilt_max=profile.tilt_max))
        self.equipment = Equipment(self.vehicle, seed, barometer)
        self._codec = mavlink.MAVLink(
            None, srcSystem=system_id, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._codec.robust_parsing = True
        if signing is not None:
            self._codec.signing = signing
        self._boot(now, armed=start != 'landed')

    @property
    def next_step(self) -> float:
        """Return the time, s, of the next step."""
        return self._start + self._steps * STEP

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes that have arrived, and return what goes out at once."""
        answers = []
        for message in self._codec.parse_buffer(data) or []:
            if now >= self._silent_until:
                self.log.received(message, now)
                answers += self._packed(self._face.handle(message, now))
        return answers

    def step(self, now: float) -> list[bytes]:
        """Fly on to ``now``, a STEP after the last, and return what goes out."""
        self._steps += 1
        messages = []
        vehicle, controller = self.vehicle, self.controller
        if now < self._silent_until:
            vehicle.step((0.0, 0.0, 0.0), vehicle.yaw, STEP, powered=False)
        else:
            messages = self._face.step(now)
        self.equipment.step(controller.armed, STEP)
        self.log.moved(now, vehicle.position, vehicle.velocity, vehicle.acceleration, vehicle.yaw,
                       controller.armed, controller.mode)
        return self._packed(messages)

    def reboot(self, now: float, duration: float) -> None:
        """Restart: silent, motors off, everything but the parameters forgotten."""
        self._silent_until = now + duration
        self._boot(self._silent_until, armed=False)

    def _boot(self, now: float, *, armed: bool) -> None:
        airborne = armed and not self.vehicle.landed
        #: The flight controller that runs; a reboot starts another.
        self.controller = self._kind(
            self.vehicle, now, armed=armed, parameters=self._parameters,
            arming_denial=self._arming_denial,
            ready_at=-math.inf if airborne else now + self._ready_after)
        self._face = MavlinkVehicle(self.controller, self.equipment, now,
                                    system_id=self._codec.srcSystem)
        self._codec.seq = 0

    def _packed(self, messages: list[Any]) -> list[bytes]:
        packed = []
        for message in messages:
            packed.append(bytes(message.pack(self._codec)))
            self._codec.seq = (self._codec.seq + 1) % 256
        return packed
