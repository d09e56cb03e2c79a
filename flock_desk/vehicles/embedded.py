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
    for data in autopilot.step(now): ...   # every STEP_TIME
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.arducopter import ArduCopter
from flock_desk.vehicles.estimator import Barometer, GROUND_AMSL, pressure
from flock_desk.vehicles.flight_controller import ACCEPTED, FlightController
from flock_desk.vehicles.flight_log import FlightLog
from flock_desk.vehicles.profiles import Parameters, PROFILES
from flock_desk.vehicles.px4 import Px4
from flock_desk.vehicles.quadrotor import Quadrotor
from flock_follower.geometry import Array
from flock_follower.mavlink.ned import enu_to_ned, flu_to_frd, quaternion_enu_flu_to_ned_frd

STEP_TIME: Final[float] = 0.01  # s
STARTS: Final[tuple[str, ...]] = ('airborne', 'armed', 'landed')
#: PX4 sends CURRENT_MODE at the most every so many seconds while the mode stays.
CURRENT_MODE_PERIOD: Final[float] = 0.5
CURRENT = 18.0  # A
_LONGEST_WAY: Final[int] = 1_000_000_000  # ns from a TIMESYNC question to its answer
_CELLS = 4
ORIGIN_LATITUDE = 47.397742  # degrees, of the local origin
ORIGIN_LONGITUDE = 8.545594  # degrees, of the local origin
DEGREE: Final[float] = 111_320.0  # m along a meridian
_NO_PARAMETERS: Final[Mapping[str, float]] = MappingProxyType({})
_NAMES: Final[Mapping[int, str]] = {
    number: message.msgname for number, message in mavlink.mavlink_map.items()}


class EmbeddedAutopilot:
    """
    An autopilot with the personality of PX4 or ArduCopter.

    :param personality: a key of ``PROFILES``.
    :param version: of its firmware, a key of the profile's ``firmwares``; '' for the first.
    :param now: monotonic time, s, of the start; messages carry times since then.
    :param start: one of ``STARTS``: 'airborne' (hovering in Hold or LOITER), 'armed' or 'landed'.
    :param altitude: m, of an airborne start.
    :param yaw: rad, ENU, at the start.
    :param parameters: values that differ from the autopilot's defaults.
    :param arming_denial: if given, arming is refused with this reason.
    :param ready_after: s from the start, and from a reboot, until the estimator is ready.
    :param seed: of the sensors' noise.
    :param signing: a pymavlink MAVLinkSigning, if the link is signed.
    :raises ValueError: for an unknown version or parameter, or a value that it cannot have.
    """

    def __init__(self, personality: str = 'px4', *, now: float, start: str = 'airborne',
                 altitude: float = 2.0, yaw: float = 0.0, system_id: int = 1,
                 parameters: Mapping[str, float] = _NO_PARAMETERS, arming_denial: str = '',
                 ready_after: float = 0.0, seed: int = 0, signing: Any = None,
                 version: str = '') -> None:
        self._profile = PROFILES[personality]
        self._version = self._profile.version(version)
        self._parameters = Parameters(self._profile, self._version)
        for name, number in parameters.items():
            self._parameters.set(name, number)
        self.log = FlightLog()
        self._start, self._steps = now, 0
        self._silent_until = -math.inf
        self._arming_denial, self._ready_after = arming_denial, ready_after
        self.vehicle = Quadrotor((0.0, 0.0, altitude if start == 'airborne' else 0.0), yaw,
                                 self._profile.tilt_max)
        self.barometer = Barometer([np.random.default_rng([seed, 1])])
        self.charge = 1.0
        """Remaining charge of the battery, a share; it does not change by itself."""
        self._codec = mavlink.MAVLink(
            None, srcSystem=system_id, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._codec.robust_parsing = True
        if signing is not None:
            self._codec.signing = signing
        self._boot(now, armed=start != 'landed')

    @property
    def next_step(self) -> float:
        """Return the time, s, of the next step."""
        return self._start + self._steps * STEP_TIME

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes that have arrived, and return the datagrams to send at once."""
        answers = []
        for message in self._codec.parse_buffer(data) or []:
            if now >= self._silent_until:
                self.log.add_message(message, now)
                answers += self._packed(self._handle(message, now))
        return answers

    def step(self, now: float) -> list[bytes]:
        """Fly on to ``now``, a STEP_TIME after the last, and return the datagrams to send."""
        self._steps += 1
        messages = []
        vehicle, controller = self.vehicle, self.controller
        if now < self._silent_until:
            vehicle.steer((0.0, 0.0, 0.0), vehicle.yaw)
            vehicle.step(STEP_TIME, powered=False)
        else:
            controller.step(now)
            messages = self._due_messages(now)
        self.log.add_state(now, vehicle.position, vehicle.velocity, vehicle.acceleration,
                           vehicle.yaw, controller.armed, controller.mode)
        return self._packed(messages)

    def reboot(self, now: float, duration: float) -> None:
        """Restart: silent, motors off, everything but the parameters forgotten."""
        self._silent_until = now + duration
        self._boot(self._silent_until, armed=False)

    def _boot(self, now: float, *, armed: bool) -> None:
        airborne, profile = armed and not self.vehicle.landed, self._profile
        #: The flight controller that runs; a reboot starts another.
        self.controller: FlightController = (Px4 if profile.px4 else ArduCopter)(
            self.vehicle, now, armed=armed, parameters=self._parameters,
            arming_denial=self._arming_denial,
            ready_at=-math.inf if airborne else now + self._ready_after)
        self._booted = now
        self._intervals = {message: 1.0 / rate if rate else math.inf
                           for message, rate in profile.rates.items()}
        self._due = {message: now if math.isfinite(interval) else math.inf
                     for message, interval in self._intervals.items()}
        self._shown_mode = self.controller.mode
        self._clock_offset: float | None = None
        self._codec.seq = 0

    def _packed(self, messages: list[Any]) -> list[bytes]:
        packed = []
        for message in messages:
            packed.append(bytes(message.pack(self._codec)))
            self._codec.seq = (self._codec.seq + 1) % 256
        return packed

    def _handle(self, message: Any, now: float) -> list[Any]:
        """Take a message received at ``now`` and return the answers."""
        controller = self.controller
        if getattr(message, 'target_system', 0) not in (0, self._codec.srcSystem):
            return []
        match message.get_type():
            case 'SET_POSITION_TARGET_LOCAL_NED':
                controller.on_setpoint(message, now)
            case 'ODOMETRY':
                # Before the sender's clock is learned it is new.
                controller.estimator.on_odometry(
                    message, now, 0.0 if self._clock_offset is None else
                    now - self._booted - message.time_usec * 1e-6 - self._clock_offset)
            case 'PARAM_REQUEST_READ':
                return self._parameters.answer(message)
            case 'TIMESYNC':
                return self._answer_timesync(message, now)
            case 'SET_GPS_GLOBAL_ORIGIN':
                controller.has_origin = True  # where on Earth does not matter here
                # PX4 1.18 returns it on request only.
                return [] if self._profile.px4 else [self._origin(now)]
            case 'COMMAND_LONG':
                return self._command(message, now)
        return []

    def _origin(self, now: float) -> Any:
        return mavlink.MAVLink_gps_global_origin_message(
            round(ORIGIN_LATITUDE * 1e7), round(ORIGIN_LONGITUDE * 1e7), 0,
            self._boot_ms(now) * 1000)

    def _answer_timesync(self, message: Any, now: float) -> list[Any]:
        # Zero would turn an answer into a request, and both ends would answer for ever.
        nanoseconds = max(1, round((now - self._booted) * 1e9))
        if message.tc1 == 0:
            return [mavlink.MAVLink_timesync_message(nanoseconds, message.ts1)]
        if 0 <= nanoseconds - message.ts1 < _LONGEST_WAY:
            # The other end answered half way between request and answer.
            self._clock_offset = (0.5 * (message.ts1 + nanoseconds) - message.tc1) * 1e-9
        return []

    def _due_messages(self, now: float) -> list[Any]:
        messages = self._status_texts()
        if self.controller.mode != self._shown_mode:
            self._shown_mode, shown_by = self.controller.mode, self._profile.mode_message
            # PX4 shows a change in its stream; ArduCopter sends another HEARTBEAT at once.
            delay = self._intervals[shown_by] if self._profile.px4 else 0.0
            self._due[shown_by] = min(self._due[shown_by], now + delay)
        for message_id, due in self._due.items():
            if now >= due - 0.5 * STEP_TIME:
                name = _NAMES[message_id]
                if fields := self._status(name, now) or self._motion(name, now):
                    messages.append(mavlink.mavlink_map[message_id](*fields))
                # From the time it was due: the mean rate is exact.
                interval = self._intervals[message_id]
                if name == 'CURRENT_MODE':
                    interval = max(interval, CURRENT_MODE_PERIOD)
                self._due[message_id] = due + interval * max(1, (now - due) // interval)
        return messages

    def _status_texts(self) -> list[Any]:
        texts, self.controller.texts = self.controller.texts, []
        return [mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_CRITICAL, text.encode())
                for text in texts]

    def _command(self, message: Any, now: float) -> list[Any]:
        controller = self.controller
        answers: list[Any] = []
        match message.command:
            case mavlink.MAV_CMD_REQUEST_MESSAGE if controller.has_origin and (
                    message.param1 == mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN):
                results, answers = [ACCEPTED], [self._origin(now)]
            case mavlink.MAV_CMD_DO_SET_MODE:
                results = controller.command_mode(
                    (message.param1, message.param2, message.param3), now)
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                results = [controller.arm(message.param1 > 0.5, now)]
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                results = [controller.take_off(message.param7, now)]
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                results = [self._set_interval(message.param1, message.param2, now)]
            case mavlink.MAV_CMD_REQUEST_MESSAGE if (
                    message.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION):
                answers, results = [self._autopilot_version()], [ACCEPTED]
            case mavlink.MAV_CMD_RUN_PREARM_CHECKS if controller.armed and not self._profile.px4:
                results = [int(mavlink.MAV_RESULT_TEMPORARILY_REJECTED)]
            case mavlink.MAV_CMD_RUN_PREARM_CHECKS:
                controller.check_arming(now)
                results = [ACCEPTED]
            case _:
                results = [int(mavlink.MAV_RESULT_UNSUPPORTED)]
        return [*answers, *self._status_texts(), *(mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent())
            for result in results)]

    def _autopilot_version(self) -> Any:
        major, minor = map(int, self._version.split('.'))
        version = major << 24 | minor << 16 | mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
        return mavlink.MAVLink_autopilot_version_message(
            mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2, version, version, 0, 0, bytes(8), bytes(8),
            bytes(8), 0, 0, 0)

    def _set_interval(self, message_id: float, microseconds: float, now: float) -> int:
        # The HEARTBEAT of PX4 stays at 1 Hz.
        fixed = self._profile.px4 and message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT
        if message_id not in self._intervals or not microseconds > 0.0 or fixed:
            return self._profile.unknown_message
        self._intervals[int(message_id)] = max(microseconds * 1e-6, STEP_TIME)
        self._due[int(message_id)] = now
        return ACCEPTED

    def _boot_ms(self, now: float) -> int:
        return round((now - self._booted) * 1e3)

    def _motion(self, name: str, now: float) -> tuple[Any, ...]:
        """Return the fields of a message about the motion; () if it is not known."""
        controller, boot_ms = self.controller, self._boot_ms(now)
        estimate, home, met = controller.estimator, controller.home, controller.conditions(now)
        position, velocity = estimate.position, enu_to_ned(estimate.velocity)
        match name:
            case 'LOCAL_POSITION_NED' if met['reported']:
                return boot_ms, *enu_to_ned(position).tolist(), *velocity.tolist()
            case 'ATTITUDE_QUATERNION':
                x, y, z, w = quaternion_enu_flu_to_ned_frd(estimate.quaternion).tolist()
                return (boot_ms, w, x, y, z,
                        *flu_to_frd(self.vehicle.angular_velocity).tolist())
            case 'GLOBAL_POSITION_INT' if met['global']:
                # Vision alone knows no place on Earth.
                heading = round(math.degrees(math.pi / 2.0 - estimate.yaw) % 360.0 * 100.0) % 36000
                return (boot_ms, *global_position(position),
                        round(float(position[2] - home[2]) * 1e3),
                        *(velocity * 100.0).round().astype(int).tolist(), heading)
            case 'HOME_POSITION' if controller.has_origin:
                attitude = [1.0, 0.0, 0.0, 0.0] if self._profile.px4 else [math.nan] * 4
                return (*global_position(home), *enu_to_ned(home).tolist(), attitude,
                        0.0, 0.0, 0.0, boot_ms * 1000)
        return ()

    def _status(self, name: str, now: float) -> tuple[Any, ...]:
        """Return the fields of a message about the vehicle's state; () for others."""
        controller, profile = self.controller, self._profile
        match name:
            case 'HEARTBEAT':
                armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if controller.armed else 0
                return (mavlink.MAV_TYPE_QUADROTOR, profile.autopilot,
                        mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed,
                        profile.modes[controller.mode].number, controller.system_status, 3)
            case 'TIMESYNC':
                return 0, max(1, round((now - self._booted) * 1e9))
            case 'EXTENDED_SYS_STATE':
                return mavlink.MAV_VTOL_STATE_UNDEFINED, controller.landed_state
            case 'SCALED_PRESSURE':
                height = self.barometer.heights(self.vehicle.position[2:] + GROUND_AMSL, now)[0]
                return self._boot_ms(now), pressure(height), 0.0, 1181
            case 'EKF_STATUS_REPORT':
                return self.estimator_flags(now), 0.0, 0.0, 0.0, 0.0, 0.0
            case 'ESTIMATOR_STATUS':
                # Without aiding nothing is compared any more.
                ratio, accuracy = ((0.02, 0.03) if controller.conditions(now)['aided']
                                   else (math.nan, 100.0))
                return (self._boot_ms(now) * 1000, self.estimator_flags(now), ratio, ratio,
                        0.01, 0.02, 0.01, math.nan, accuracy, 0.1)
            case 'CURRENT_MODE':
                return 0, *(profile.modes[each].number
                            for each in (controller.mode, controller.chosen))
            case 'SYS_STATUS':
                voltage = round(1e3 * _CELLS * (3.5 + 0.7 * self.charge))
                return (0, 0, 0, 0, voltage, round(1e2 * CURRENT), round(1e2 * self.charge),
                        0, 0, 0, 0, 0, 0)
        return ()

    def estimator_flags(self, now: float) -> int:
        """Return the flags of ESTIMATOR_STATUS, or of ArduPilot's EKF_STATUS_REPORT."""
        met = self.controller.conditions(now)
        return sum(bits for name, bits in self._profile.estimator_flags.items() if met[name])


def global_position(position: Array) -> tuple[int, int, int]:
    """Return latitude and longitude, 1e-7 degrees, and altitude, mm, of a local position (3,)."""
    east, north, up = position.tolist()
    across = DEGREE * math.cos(math.radians(ORIGIN_LATITUDE))
    return (round((ORIGIN_LATITUDE + north / DEGREE) * 1e7),
            round((ORIGIN_LONGITUDE + east / across) * 1e7),
            round((up + GROUND_AMSL) * 1e3))
