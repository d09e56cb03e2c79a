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

"""What the simulated vehicle tells of itself, message by message."""

from __future__ import annotations

import math
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.equipment import (
    CAPACITY,
    CURRENT,
    Equipment,
    GROUND_AMSL,
    RANGEFINDER_LIMITS,
)
from flock_desk.vehicles.flight_controller import FlightController
from flock_follower.geometry import (
    Array,
    enu_to_ned,
    flu_to_frd,
    quaternion_enu_flu_to_ned_frd,
)

CURRENT_MODE: Final[int] = mavlink.MAVLINK_MSG_ID_CURRENT_MODE
EKF_STATUS_REPORT: Final[int] = mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT
_AIDED: Final[float] = 0.55  # s without vision until PX4 compares its estimate with none
_CELLS: Final[int] = 4
_UNKNOWN_VOLTAGE: Final[int] = 65535
_LATITUDE, _LONGITUDE = 47.397742, 8.545594  # degrees, of the local origin
_DEGREE: Final[float] = 111_320.0  # m along a meridian


class VehicleTelemetry:
    """
    The messages of a flight controller, whenever they are wanted.

    :param now: monotonic time, s; messages carry times since then.
    """

    def __init__(self, controller: FlightController, equipment: Equipment, now: float) -> None:
        self.controller, self.equipment = controller, equipment
        self._px4 = controller.AUTOPILOT == mavlink.MAV_AUTOPILOT_PX4
        self._start = now

    def messages(self, message_id: int, now: float) -> list[Any]:
        """Return the message with an id; none where there is nothing to tell."""
        vehicle, estimate = self.controller.vehicle, self.controller.estimator
        boot = round((now - self._start) * 1e3)
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return [self.heartbeat()]
        if message_id == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            return [mavlink.MAVLink_timesync_message(
                0, max(1, round((now - self._start) * 1e9)))]
        if message_id == mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            return [mavlink.MAVLink_local_position_ned_message(
                boot, *enu_to_ned(estimate.position).tolist(),
                *enu_to_ned(estimate.velocity).tolist())] if self.controller.tells_position(
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
        if message_id == mavlink.MAVLINK_MSG_ID_HOME_POSITION:
            return self._home_position(boot)
        if message_id == mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE:
            pressure, temperature = self.equipment.air(now)
            return [mavlink.MAVLink_scaled_pressure_message(
                boot, pressure, 0.0, round(temperature * 100.0))]
        if message_id == mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR:
            return [self._distance(boot)] if self.equipment.rangefinder else []
        if message_id == mavlink.MAVLINK_MSG_ID_ALTITUDE:
            height = float(estimate.position[2])
            return [mavlink.MAVLink_altitude_message(
                boot * 1000, self.equipment.pressure_altitude(now), height + GROUND_AMSL, height,
                height - float(self.controller.home[2]), math.nan, math.nan)]
        if message_id == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            return [self._version()]
        if message_id in (mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, EKF_STATUS_REPORT):
            return [self._estimator(boot, now)]
        if message_id == CURRENT_MODE:
            return [mavlink.MAVLink_current_mode_message(
                0, self.controller.custom_mode, self.controller.intended_mode)]
        return [self._battery(message_id, now)]

    def _global_position(self, boot: int, now: float) -> list[Any]:
        estimate = self.controller.estimator
        if not self.controller.has_origin or not self.controller.position_known(now):
            return []  # vision alone says nothing of where on Earth it is
        velocity = (enu_to_ned(estimate.velocity) * 100.0).round().astype(int).tolist()
        heading = round(math.degrees(math.pi / 2.0 - estimate.yaw) % 360.0 * 100.0) % 36000
        return [mavlink.MAVLink_global_position_int_message(
            boot, *_global(estimate.position),
            round(float(estimate.position[2] - self.controller.home[2]) * 1e3), *velocity,
            heading)]

    def _home_position(self, boot: int) -> list[Any]:
        if not self.controller.has_origin:
            return []
        home, unknown = self.controller.home, [math.nan] * 4
        return [mavlink.MAVLink_home_position_message(
            *_global(home), *enu_to_ned(home).tolist(),
            [1.0, 0.0, 0.0, 0.0] if self._px4 else unknown, 0.0, 0.0, 0.0, boot * 1000)]

    def _distance(self, boot: int) -> Any:
        distance = self.equipment.distance()
        nearest, farthest = (round(100.0 * limit) for limit in RANGEFINDER_LIMITS)
        return mavlink.MAVLink_distance_sensor_message(
            boot, nearest, farthest, farthest + 100 if distance is None
            else round(100.0 * distance),
            mavlink.MAV_DISTANCE_SENSOR_LASER, 0, mavlink.MAV_SENSOR_ROTATION_PITCH_270, 255,
            signal_quality=1 if distance is None else 100)

    def origin(self, message: Any, now: float) -> Any:
        """Return GPS_GLOBAL_ORIGIN, which tells of a SET_GPS_GLOBAL_ORIGIN."""
        return mavlink.MAVLink_gps_global_origin_message(
            message.latitude, message.longitude, message.altitude,
            round((now - self._start) * 1e6))

    def _estimator(self, boot: int, now: float) -> Any:
        controller = self.controller
        flags = controller.estimator_flags(now)
        if not self._px4:
            return mavlink.MAVLink_ekf_status_report_message(flags, 0.0, 0.0, 0.0, 0.0, 0.0)
        # Measured: nothing is compared any more, and the accuracy grows from centimetres.
        age = controller.estimator.vision_age(now) if controller.estimator.ready(now) else math.inf
        aided = age <= _AIDED
        ratio = 0.02 if aided else math.nan
        accuracy = 0.03 if aided else min(0.022 * age**2, 100.0)
        return mavlink.MAVLink_estimator_status_message(
            boot * 1000, flags, ratio, ratio, 0.01, 0.02, 0.01, math.nan, accuracy, 0.1)

    def _health(self, now: float) -> tuple[int, int]:
        """Return what SYS_STATUS says is there, and what of it is well."""
        checks, place = (mavlink.MAV_SYS_STATUS_PREARM_CHECK,
                         mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL)
        # PX4 neither has nor enables the check: only its health counts.
        return place | (0 if self._px4 else checks), (
            (place if self.controller.position_known(now) else 0)
            | (checks if self.controller.fit(now) else 0))

    def _battery(self, message_id: int, now: float) -> Any:
        charge, known = self.equipment.charge, self.equipment.charge_known
        cell = round(1e3 * (3.5 + 0.7 * charge)) if known else _UNKNOWN_VOLTAGE  # mV
        current = round(1e2 * (CURRENT if self.controller.armed else 0.5))  # cA
        percent = round(1e2 * charge) if known else -1
        if message_id == mavlink.MAVLINK_MSG_ID_SYS_STATUS:
            there, well = self._health(now)
            return mavlink.MAVLink_sys_status_message(
                there, there, well, 250, _CELLS * cell if known else cell, current, percent,
                0, 0, 0, 0, 0, 0)
        voltages = [cell] * _CELLS + [_UNKNOWN_VOLTAGE] * (10 - _CELLS)
        return mavlink.MAVLink_battery_status_message(
            0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, 32767, voltages,
            current, round(1e3 * (1.0 - charge) * CAPACITY), -1, percent)

    def heartbeat(self) -> Any:
        """Return HEARTBEAT."""
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


def _global(position: Array) -> tuple[int, int, int]:
    """Return latitude and longitude, 1e-7 degrees, and altitude, mm, of a local position (3,)."""
    east, north, up = position.tolist()
    across = _DEGREE * math.cos(math.radians(_LATITUDE))
    return (round((_LATITUDE + north / _DEGREE) * 1e7), round((_LONGITUDE + east / across) * 1e7),
            round((up + GROUND_AMSL) * 1e3))
