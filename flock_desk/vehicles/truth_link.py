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
The second link of the embedded autopilot, on which simulators tell where their vehicle really is.

As on the real ones: HEARTBEAT unasked, the rest at the interval that SET_MESSAGE_INTERVAL asks
for; the truth is HIL_STATE_QUATERNION (PX4) or SIM_STATE (ArduPilot), without a time.
"""

from __future__ import annotations

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.embedded import EmbeddedAutopilot
from flock_desk.vehicles.equipment import GROUND_AMSL
from flock_desk.vehicles.mavlink_vehicle import STEP
from flock_follower.geometry import (
    enu_to_ned,
    flu_to_frd,
    matrix_to_quaternion,
    quaternion_enu_flu_to_ned_frd,
)

_LATITUDE, _LONGITUDE = 47.397742, 8.545594  # degrees, of the vehicle's origin
_DEGREE: Final[float] = 111_320.0  # m along a meridian
_HEARTBEAT: Final[int] = mavlink.MAVLINK_MSG_ID_HEARTBEAT
_TRUTHS: Final[dict[int, int]] = {
    mavlink.MAV_AUTOPILOT_PX4: mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: mavlink.MAVLINK_MSG_ID_SIM_STATE}


class TruthLink:
    """Bytes in, bytes out; times are monotonic s, ``now`` that of the start."""

    def __init__(self, autopilot: EmbeddedAutopilot, now: float, system_id: int = 1) -> None:
        self._autopilot, self._start = autopilot, now
        self._periods = {_HEARTBEAT: 1.0}
        self._due = {_HEARTBEAT: now}
        self._granted = {_TRUTHS[autopilot.controller.AUTOPILOT],
                         mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
                         mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE}
        self._codec = mavlink.MAVLink(
            None, srcSystem=system_id, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._codec.robust_parsing = True

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes that have arrived, and return the answers; intervals are all it obeys."""
        answers = []
        for message in self._codec.parse_buffer(data) or []:
            if message.get_type() != 'COMMAND_LONG':
                continue
            asked = int(message.param1)
            granted = (message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
                       and asked in self._granted and message.param2 > 0.0)
            if granted:
                self._periods[asked] = max(message.param2 * 1e-6, STEP)
                self._due[asked] = now
            answers.append(self._packed(mavlink.MAVLink_command_ack_message(
                message.command, mavlink.MAV_RESULT_ACCEPTED if granted
                else mavlink.MAV_RESULT_UNSUPPORTED)))
        return answers

    def step(self, now: float) -> list[bytes]:
        """Return what is due after a step of the autopilot."""
        due = [kind for kind, time in self._due.items() if now >= time - 0.5 * STEP]
        for kind in due:
            self._due[kind] += self._periods[kind] * max(
                1, (now - self._due[kind]) // self._periods[kind])
        return [self._packed(self._message(kind, now)) for kind in due]

    def _packed(self, message: Any) -> bytes:
        data = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        return data

    def _message(self, kind: int, now: float) -> Any:
        controller, vehicle = self._autopilot.controller, self._autopilot.vehicle
        if kind == _HEARTBEAT:
            return mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, controller.AUTOPILOT, controller.base_mode,
                controller.custom_mode, controller.system_status, 3)
        if kind == mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
            return mavlink.MAVLink_system_time_message(0, round((now - self._start) * 1e3))
        if kind == mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            return mavlink.MAVLink_extended_sys_state_message(
                mavlink.MAV_VTOL_STATE_UNDEFINED, controller.landed_state)
        east, north, up = vehicle.position.tolist()
        latitude = round((_LATITUDE + north / _DEGREE) * 1e7)
        longitude = round((_LONGITUDE + east / (
            _DEGREE * math.cos(math.radians(_LATITUDE)))) * 1e7)
        height = up + GROUND_AMSL
        x, y, z, w = quaternion_enu_flu_to_ned_frd(
            matrix_to_quaternion(vehicle.rotation)).tolist()
        rates = flu_to_frd(vehicle.angular_velocity).tolist()
        velocity = enu_to_ned(vehicle.velocity)
        if kind == mavlink.MAVLINK_MSG_ID_SIM_STATE:
            return mavlink.MAVLink_sim_state_message(
                w, x, y, z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *rates, latitude, longitude, height,
                0.0, 0.0, *velocity.tolist(), latitude, longitude)
        return mavlink.MAVLink_hil_state_quaternion_message(
            0, [w, x, y, z], *rates, latitude, longitude, round(height * 1e3),
            *(velocity * 100.0).round().astype(int).tolist(), 0, 0, 0, 0, 0)
