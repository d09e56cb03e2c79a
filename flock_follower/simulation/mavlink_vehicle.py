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

"""The MAVLink 2 face of the simulated vehicle: PX4's messages, masks and acknowledgements."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from flock_follower.geometry import (
    enu_to_ned,
    flu_to_frd,
    ned_to_enu,
    quaternion_enu_flu_to_ned_frd,
    yaw_ned_to_enu,
)
from flock_follower.mavlink import px4
from flock_follower.simulation.flight_controller import (
    ACCEPTED,
    FlightController,
    Setpoint,
    UNSUPPORTED,
)

STEP: Final[float] = 0.01  # s
#: Message rates, Hz; SET_MESSAGE_INTERVAL changes them up to the rate of the steps.
RATES: Final[dict[int, float]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
}
TEXT_CHUNK: Final[int] = 50  # bytes of a STATUSTEXT
_CELLS: Final[int] = 4
_CAPACITY: Final[float] = 5.2  # Ah
_CURRENT: Final[float] = 18.0  # A in flight


class MavlinkVehicle:
    """
    The MAVLink face of a flight controller; no socket, no clock.

    :param now: monotonic time, s; messages carry times since then.
    :param heartbeats_until: HEARTBEAT stops at this time, s after the start (a fault for tests).
    """

    def __init__(self, controller: FlightController, now: float, *, system_id: int = 1,
                 heartbeats_until: float = math.inf) -> None:
        if not 1 <= system_id <= 255:
            raise ValueError(f'system_id = {system_id}: must be in [1, 255]')
        self.controller = controller
        self.system_id = system_id
        self._start = now
        self._heartbeats_until = heartbeats_until
        self._intervals = {message: 1.0 / rate for message, rate in RATES.items()}
        self._due = dict.fromkeys(RATES, now)
        self._charge_used = 0.0
        self._texts_sent = 0
        self._time = now

    def handle(self, message: Any, now: float) -> list[Any]:
        """Take a message received at ``now`` and return the answers."""
        kind = message.get_type()
        if getattr(message, 'target_system', 0) not in (0, self.system_id):
            return []
        if kind == 'SET_POSITION_TARGET_LOCAL_NED':
            setpoint = decode_setpoint(message)
            if setpoint is not None:
                self.controller.on_setpoint(setpoint, now)
            return []
        if kind == 'COMMAND_LONG':
            answers = self._command(message, now)
            return [*self._texts(), *answers]
        return []

    def step(self, now: float) -> list[Any]:
        """Fly on to ``now`` and return the messages that are due."""
        self.controller.step(now)
        if self.controller.armed:
            self._charge_used += _CURRENT * (now - self._time) / 3600.0
        self._time = now
        messages = self._texts()
        for message_id, due in self._due.items():
            if now >= due - 0.5 * STEP:
                messages += self._telemetry(message_id, now)
                # From the time it was due: the mean rate is exact.
                interval = self._intervals[message_id]
                self._due[message_id] = due + interval * max(1, (now - due) // interval)
        return messages

    def _texts(self) -> list[Any]:
        said, self.controller.said = self.controller.said, []
        messages = []
        for text in said:
            # PX4 ends texts that it also sends as events with a tab. A chunk that is full means
            # that another follows.
            data = f'{text.text}\t'.encode()
            self._texts_sent += 1
            number = self._texts_sent % 0xFFFF + 1 if len(data) > TEXT_CHUNK else 0
            messages += [mavlink.MAVLink_statustext_message(
                text.severity, data[i:i + TEXT_CHUNK], number, i // TEXT_CHUNK)
                for i in range(0, len(data) + (number > 0), TEXT_CHUNK)]
        return messages

    def _command(self, message: Any, now: float) -> list[Any]:
        acks = []
        if message.command == mavlink.MAV_CMD_DO_SET_MODE:
            # PX4 1.16 answers twice; the first says accepted, whatever becomes of it.
            acks.append(ACCEPTED)
            known = int(message.param1) & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            name = px4.mode_name(int(message.param2) << 16 | int(message.param3) << 24)
            acks.append(self.controller.set_mode(name, now) if known else UNSUPPORTED)
        elif message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            acks.append(self.controller.arm(message.param1 > 0.5, now))
        elif message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            acks.append(self._set_interval(int(message.param1), message.param2, now))
        else:
            acks.append(UNSUPPORTED)
        return [*self._texts(), *(mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent())
            for result in acks)]

    def _set_interval(self, message_id: int, microseconds: float, now: float) -> int:
        if message_id not in RATES or math.isnan(microseconds):
            return UNSUPPORTED
        interval = 1.0 / RATES[message_id] if microseconds == 0 else microseconds * 1e-6
        self._intervals[message_id] = math.inf if interval < 0 else max(interval, STEP)
        self._due[message_id] = math.inf if interval < 0 else now
        return ACCEPTED

    def _telemetry(self, message_id: int, now: float) -> list[Any]:
        vehicle, boot = self.controller.vehicle, round((now - self._start) * 1e3)
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return [self._heartbeat()] if now - self._start < self._heartbeats_until else []
        if message_id == mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            return [mavlink.MAVLink_local_position_ned_message(
                boot, *enu_to_ned(vehicle.position).tolist(),
                *enu_to_ned(vehicle.velocity).tolist())]
        if message_id == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            x, y, z, w = quaternion_enu_flu_to_ned_frd(vehicle.quaternion).tolist()
            return [mavlink.MAVLink_attitude_quaternion_message(
                boot, w, x, y, z, *flu_to_frd(vehicle.angular_velocity).tolist())]
        remaining = max(0.0, 1.0 - self._charge_used / _CAPACITY)
        cell = round(1e3 * (3.5 + 0.7 * remaining))  # mV
        current = round(1e2 * (_CURRENT if self.controller.armed else 0.5))  # cA
        percent = round(1e2 * remaining)
        if message_id == mavlink.MAVLINK_MSG_ID_SYS_STATUS:
            return [mavlink.MAVLink_sys_status_message(
                0, 0, 0, 250, _CELLS * cell, current, percent, 0, 0, 0, 0, 0, 0)]
        voltages = [cell] * _CELLS + [65535] * (10 - _CELLS)
        return [mavlink.MAVLink_battery_status_message(
            0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, 32767, voltages,
            current, round(1e3 * self._charge_used), -1, percent)]

    def _heartbeat(self) -> Any:
        controller = self.controller
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if controller.armed:
            base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        state = mavlink.MAV_STATE_STANDBY
        if controller.armed:
            state = (mavlink.MAV_STATE_CRITICAL if controller.in_failsafe
                     else mavlink.MAV_STATE_ACTIVE)
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base,
            px4.custom_mode(controller.mode), state, 3)


def decode_setpoint(message: Any) -> Setpoint | None:
    """
    Return a SET_POSITION_TARGET_LOCAL_NED in ENU, NaN where its mask ignores an axis.

    None for what PX4 drops: other frames, and acceleration as force.
    """
    mask = message.type_mask
    if (message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED
            or mask & mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET):
        return None
    values = [message.x, message.y, message.z, message.vx, message.vy, message.vz,
              message.afx, message.afy, message.afz]
    if not all(math.isfinite(v) for i, v in enumerate(values) if not mask >> i & 1):
        return None
    ned = np.array([math.nan if mask >> i & 1 else v for i, v in enumerate(values)])
    position, velocity, acceleration = ned_to_enu(ned.reshape(3, 3))
    use_yaw = not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
    use_rate = not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    return Setpoint(position, velocity, acceleration,
                    yaw_ned_to_enu(message.yaw) if use_yaw else math.nan,
                    -message.yaw_rate if use_rate else math.nan)
