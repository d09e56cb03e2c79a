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

"""What the autopilot last said, in ENU and FLU, with the time it was heard."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from flock_follower.geometry import (
    Array,
    frd_to_flu,
    ned_to_enu,
    normalize_quaternion,
    quaternion_ned_frd_to_enu_flu,
    yaw_from_quaternion,
)
from flock_follower.mavlink.px4 import vehicle_status, VehicleStatus

#: Every MAVLink system sends HEARTBEAT at 1 Hz.
HEARTBEAT_PERIOD: Final[float] = 1.0
_UNKNOWN_CELL = 65535  # mV


class LocalPosition(NamedTuple):
    """LOCAL_POSITION_NED in ENU: position (3,), m, velocity (3,), m/s."""

    time: float
    position: Array
    velocity: Array


class Attitude(NamedTuple):
    """ATTITUDE_QUATERNION: FLU to ENU quaternion (x, y, z, w), body rates (3,), rad/s, FLU."""

    time: float
    quaternion: Array
    angular_velocity: Array

    @property
    def yaw(self) -> float:
        """Return the yaw, rad, anticlockwise from east."""
        return yaw_from_quaternion(self.quaternion)


class Battery(NamedTuple):
    """BATTERY_STATUS or SYS_STATUS; NaN where unknown."""

    time: float
    voltage: float
    """V"""
    current: float
    """A drawn, positive while discharging."""
    remaining: float
    """Fraction in [0, 1]."""
    temperature: float
    """Degrees Celsius"""
    cell_voltages: tuple[float, ...]
    """V, empty where the autopilot knows only the total."""


class Telemetry:
    """The newest of each message of one autopilot; times are those given to ``update``."""

    def __init__(self) -> None:
        self.status: VehicleStatus | None = None
        self.heartbeat_time = -math.inf
        self.message_time = -math.inf
        self.local_position: LocalPosition | None = None
        self.attitude: Attitude | None = None
        self.battery: Battery | None = None
        self.rejected = 0
        self._battery_status_seen = False
        self._streaming = False

    def update(self, message: Any, now: float) -> None:
        """Take a message of the autopilot, received at ``now``, s, monotonic."""
        self.message_time = now
        kind = message.get_type()
        if kind == 'HEARTBEAT':
            self.status = vehicle_status(message)
            self.heartbeat_time = now
        elif kind == 'LOCAL_POSITION_NED':
            self._local_position(message, now)
        elif kind == 'ATTITUDE_QUATERNION':
            self._attitude(message, now)
        elif kind == 'BATTERY_STATUS' and message.id == 0:
            self._battery_status_seen = True
            self.battery = _from_battery_status(message, now)
        elif kind == 'SYS_STATUS' and not self._battery_status_seen:
            self.battery = _from_sys_status(message, now)

    def alive(self, now: float, link_timeout: float) -> bool:
        """
        Return whether the autopilot was heard recently enough.

        Once it streams telemetry, ``link_timeout`` seconds without any message are too long. So
        is a HEARTBEAT overdue by ``link_timeout``: it comes at 1 Hz, so it is missed only after
        ``1 s + link_timeout``.
        """
        if self._streaming and now - self.message_time > link_timeout:
            return False
        return now - self.heartbeat_time <= HEARTBEAT_PERIOD + link_timeout

    def _local_position(self, message: Any, now: float) -> None:
        position = ned_to_enu([message.x, message.y, message.z])
        velocity = ned_to_enu([message.vx, message.vy, message.vz])
        self._streaming = True
        if np.all(np.isfinite(position)) and np.all(np.isfinite(velocity)):
            self.local_position = LocalPosition(now, position, velocity)
        else:
            self.rejected += 1

    def _attitude(self, message: Any, now: float) -> None:
        # MAVLink's quaternions are (w, x, y, z).
        wxyz = [message.q1, message.q2, message.q3, message.q4]
        rates = frd_to_flu([message.rollspeed, message.pitchspeed, message.yawspeed])
        self._streaming = True
        try:
            quaternion = quaternion_ned_frd_to_enu_flu(normalize_quaternion(wxyz[1:] + wxyz[:1]))
        except ValueError:
            self.rejected += 1
            return
        self.attitude = Attitude(now, quaternion, np.nan_to_num(rates, posinf=0.0, neginf=0.0))


def _from_battery_status(message: Any, now: float) -> Battery:
    cells = [v * 1e-3 for v in message.voltages if v != _UNKNOWN_CELL]
    cells += [v * 1e-3 for v in message.voltages_ext if v not in (0, _UNKNOWN_CELL)]
    return Battery(
        now,
        sum(cells) if cells else math.nan,
        message.current_battery * 1e-2 if message.current_battery >= 0 else math.nan,
        message.battery_remaining * 1e-2 if message.battery_remaining >= 0 else math.nan,
        message.temperature * 1e-2 if message.temperature != 32767 else math.nan,
        tuple(cells) if len(cells) > 1 else ())


def _from_sys_status(message: Any, now: float) -> Battery:
    known = message.voltage_battery != _UNKNOWN_CELL
    return Battery(
        now,
        message.voltage_battery * 1e-3 if known else math.nan,
        message.current_battery * 1e-2 if message.current_battery >= 0 else math.nan,
        message.battery_remaining * 1e-2 if message.battery_remaining >= 0 else math.nan,
        math.nan, ())


#: The messages wanted from the autopilot, and their rates, Hz.
WANTED_RATES: Final[dict[int, float]] = {
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 1.0,
}
