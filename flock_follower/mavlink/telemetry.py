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
The newest messages of the autopilot, in ENU and FLU, with their times of arrival.

``estimate`` combines position and attitude to one odometry of the time at which both were valid.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any, Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.gate.height import pressure_altitude
from flock_follower.gate.permission import MODE_TIMEOUT
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.geometry import (
    Array,
    normalize_quaternion,
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from flock_follower.mavlink.dialects import AUTO, Dialect, dialect_of
from flock_follower.mavlink.estimator_health import (
    Arrivals,
    estimator_status,
    EstimatorStatus,
    gps_fix,
    GpsFix,
)
from flock_follower.mavlink.ned import frd_to_flu, ned_to_enu, quaternion_ned_frd_to_enu_flu
from flock_follower.messages import OdometryState

#: Every MAVLink system sends HEARTBEAT at 1 Hz.
HEARTBEAT_PERIOD: Final[float] = 1.0
#: An estimate older than this, s, is not used.
ESTIMATE_TIMEOUT: Final[float] = 1.0
#: EXTENDED_SYS_STATE comes at 5 Hz; a landed state older than this, s, is not used.
LANDED_OLDEST: Final[float] = 3.0
#: A barometer whose number changes on the ground so often in a row has noise (3 s at 20 Hz). One
#: without noise, a simulated one, repeats its number in a hover, too.
NOISY_CHANGES: Final[int] = 60
#: An altitude above sea level older than this, s, is not used.
SEA_LEVEL_TIMEOUT: Final[float] = 3.0
#: The autopilot has rebooted if stamps of two consecutive attitudes go back by more than this, ms.
REBOOT_STEP_MS: Final[int] = 1000
#: Stamps wrap at 2**32 ms, after 50 days: from at most this long before to as long after it, ms.
WRAP_MARGIN_MS: Final[int] = 60_000
#: ``signal_quality`` of a DISTANCE_SENSOR without a valid distance; 0 is unknown.
_INVALID_DISTANCE: Final[int] = 1
_FLYING: Final[dict[int, bool]] = {
    mavlink.MAV_LANDED_STATE_ON_GROUND: False, mavlink.MAV_LANDED_STATE_TAKEOFF: False,
    mavlink.MAV_LANDED_STATE_IN_AIR: True, mavlink.MAV_LANDED_STATE_LANDING: True}
_UNKNOWN_VOLTAGE = 65535  # mV
_TRANSMITTER: Final[int] = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER


class SensorAltitude(NamedTuple):
    """SCALED_PRESSURE, or DISTANCE_SENSOR downwards: an altitude independent of odometry."""

    time: float
    altitude: float
    """Altitude, m: by barometer in the standard atmosphere, by rangefinder above ground."""
    source: str
    """The name of the message."""


class LocalPosition(NamedTuple):
    """LOCAL_POSITION_NED in ENU: position (3,), m, velocity (3,), m/s."""

    time: float
    position: Array
    velocity: Array
    time_boot_ms: int
    """Stamp on the autopilot's clock, see ``housekeeping.TimeSync.age``."""


class Attitude(NamedTuple):
    """ATTITUDE_QUATERNION: FLU to ENU quaternion (x, y, z, w), body rates (3,), rad/s, FLU."""

    time: float
    quaternion: Array
    angular_velocity: Array
    time_boot_ms: int


class Battery(NamedTuple):
    """SYS_STATUS, in which PX4 reports its lowest battery; NaN if unknown."""

    time: float
    voltage: float
    """Voltage, V."""
    current: float
    """Current, A; positive while discharging."""
    remaining: float
    """Remaining charge, from 0 to 1."""


class Telemetry:
    """
    The newest of each message of one autopilot; times are those given to ``update``.

    :param autopilot: see ``dialects.dialect_of``.
    """

    def __init__(self, autopilot: str = AUTO) -> None:
        self.dialect: Dialect | None = None
        self.status: VehicleStatus | None = None
        self.newest: dict[str, tuple[float, Any]] = {}
        """The newest message of each type, and its time of arrival, s."""
        self.sensor_altitude: SensorAltitude | None = None
        self._pressure_altitude = math.nan  # m
        self._changes = 0  # of the pressure on the ground, in a row
        self.reboots = 0
        self.heartbeat_time = -math.inf
        self.mode_time = -math.inf
        """Time of the last report of the mode, by HEARTBEAT or CURRENT_MODE, s."""
        self.message_time = -math.inf
        self.local_position: LocalPosition | None = None
        self.attitude: Attitude | None = None
        self.battery: Battery | None = None
        self.estimator: EstimatorStatus | None = None
        self.gps: GpsFix | None = None
        self.arrivals = Arrivals()
        self._autopilot = autopilot
        self._boot_time_ms = 0
        self._fallen = False

    def update(self, message: Any, now: float) -> None:
        """Take a message of the autopilot, received at ``now``, s, monotonic."""
        self.message_time = now
        self.arrivals.take(message.get_msgId(), now)
        kind = message.get_type()
        self.newest[kind] = now, message
        if kind == 'HEARTBEAT':
            self.dialect = dialect_of(message, self._autopilot) or self.dialect
            self.heartbeat_time = now
        status = self.shown(message)
        if status is not None:
            self.status, self.mode_time = status, now
        elif kind == 'LOCAL_POSITION_NED':
            self._local_position(message, now)
        elif kind == 'ATTITUDE_QUATERNION':
            self._attitude(message, now)
        elif kind == 'SCALED_PRESSURE':
            self._take_pressure(pressure_altitude(message.press_abs), now)
        elif kind == 'DISTANCE_SENSOR':
            self._distance(message, now)
        elif self.dialect is not None and message.get_msgId() == self.dialect.estimator_status:
            self.estimator = estimator_status(message, self.dialect, now)
        elif kind == 'GPS_RAW_INT':
            self.gps = gps_fix(message, self.gps, now)
        elif kind == 'SYS_STATUS':
            self.battery = _battery(message, now)

    def recent(self, kind: str, oldest: float, now: float) -> Any | None:
        """Return the newest message of a type, None if it is older than ``oldest``, s."""
        time, message = self.newest.get(kind, (-math.inf, None))
        return message if now - time <= oldest else None

    def shown(self, message: Any) -> VehicleStatus | None:
        """
        Return the vehicle's status from a message, None if the message has no status.

        CURRENT_MODE has only the mode; the other values come from the newest HEARTBEAT.
        """
        kind = message.get_type()
        if self.dialect is None:
            return None
        if kind == 'HEARTBEAT':
            return self.dialect.status(message)
        if kind == 'CURRENT_MODE' and self.status is not None:
            mode = self.dialect.mode_name(message.custom_mode)
            return self.status._replace(mode=mode, offboard=mode == self.dialect.offboard)
        return None

    def shown_time(self, command: int) -> float:
        """Return the time of the last report that shows whether a command was obeyed, s."""
        arming = command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM  # not in CURRENT_MODE
        return self.heartbeat_time if arming else self.mode_time

    def silence(self, now: float) -> float:
        """
        Return for how long messages of the autopilot have been overdue, s; 0 if they are not.

        Any message shows that the link is alive; ``mode_age`` measures the age of the mode. Before
        telemetry is sent, only HEARTBEATs may arrive, at 1 Hz, and one of them may be lost.
        """
        if self.dialect is None:
            return math.inf
        streams = {'LOCAL_POSITION_NED', 'ATTITUDE_QUATERNION'} & self.newest.keys()
        return max(0.0, now - self.message_time - (0.0 if streams else MODE_TIMEOUT))

    def mode_age(self, now: float) -> float:
        """Return the time since HEARTBEAT or CURRENT_MODE last showed the mode, s."""
        return now - self.mode_time

    def alive(self, now: float, link_timeout: float) -> bool:
        """Return whether the autopilot has not been missing for longer than ``link_timeout``."""
        return self.silence(now) <= link_timeout

    def current(self, now: float, link_timeout: float) -> VehicleStatus | None:
        """Return the vehicle's status, None while the link is not alive or the mode unknown."""
        known = self.alive(now, link_timeout) and self.mode_age(now) <= MODE_TIMEOUT
        return self.status if known else None

    def is_flying(self, now: float) -> bool | None:
        """Return whether the vehicle reports that it is in the air; None without a report."""
        message = self.recent('EXTENDED_SYS_STATE', LANDED_OLDEST, now)
        return None if message is None else _FLYING.get(message.landed_state)

    def has_left_ground(self, now: float) -> bool | None:
        """Return whether the vehicle flies or is taking off; None without a report."""
        flying = self.is_flying(now)
        return flying if flying is None else (
            flying or self.landed == mavlink.MAV_LANDED_STATE_TAKEOFF)

    @property
    def vehicle_type(self) -> int | None:
        """Return the MAV_TYPE in the newest HEARTBEAT, None before the first."""
        message = self.recent('HEARTBEAT', math.inf, 0.0)
        return None if message is None else message.type

    def vtol_state(self, now: float) -> int | None:
        """Return the MAV_VTOL_STATE; None without a report."""
        message = self.recent('EXTENDED_SYS_STATE', LANDED_OLDEST, now)
        return None if message is None else message.vtol_state

    def transmitter_lost(self, now: float) -> bool:
        """Return whether the autopilot reports that the pilot's transmitter is lost."""
        message = self.recent('SYS_STATUS', LANDED_OLDEST, now)
        return message is not None and bool(
            message.onboard_control_sensors_enabled & _TRANSMITTER
            & ~message.onboard_control_sensors_health)

    @property
    def landed(self) -> int | None:
        """Return the newest MAV_LANDED_STATE, None if the autopilot does not report it."""
        message = self.recent('EXTENDED_SYS_STATE', math.inf, 0.0)
        return None if message is None else message.landed_state

    def altitude(self, now: float) -> float | None:
        """Return the height above the origin of the local frame, m; None if not fresh."""
        place = self.local_place(now)
        return None if place is None else float(place[2])

    def local_place(self, now: float) -> Array | None:
        """Return LOCAL_POSITION_NED (3,), m, ENU; None if not fresh."""
        local = self.local_position
        fresh = local is not None and now - local.time <= ESTIMATE_TIMEOUT
        return local.position if local is not None and fresh else None

    def home(self) -> Array | None:
        """Return HOME_POSITION in the frame of LOCAL_POSITION_NED (3,), m, ENU; None: unknown."""
        message = self.recent('HOME_POSITION', math.inf, 0.0)
        return None if message is None else ned_to_enu([message.x, message.y, message.z])

    def sea_level_altitude(self, now: float) -> float | None:
        """Return the height above mean sea level, m; None if not fresh (no GPS)."""
        message = self.recent('GLOBAL_POSITION_INT', SEA_LEVEL_TIMEOUT, now)
        return None if message is None else message.alt * 1e-3

    def height_above_home(self, now: float) -> float | None:
        """Return the height above the place of arming by the estimate, m; None if not known."""
        above_sea, home = self.sea_level_altitude(now), self.recent('HOME_POSITION', math.inf, now)
        return None if home is None or above_sea is None else above_sea - home.altitude * 1e-3

    def _take_pressure(self, altitude: float, now: float) -> None:
        repeats, self._pressure_altitude = altitude == self._pressure_altitude, altitude
        if self.is_flying(now):
            if repeats and self._changes >= NOISY_CHANGES:  # it is stuck: this is no measurement
                return
        elif self.landed == mavlink.MAV_LANDED_STATE_ON_GROUND and self._changes < NOISY_CHANGES:
            self._changes = 0 if repeats else self._changes + 1
        self.sensor_altitude = SensorAltitude(now, altitude, 'SCALED_PRESSURE')

    def _distance(self, message: Any, now: float) -> None:
        """Take a downward rangefinder as long as no barometer is reported."""
        known = self.sensor_altitude
        if message.orientation == mavlink.MAV_SENSOR_ROTATION_PITCH_270 and (
                message.min_distance <= message.current_distance <= message.max_distance) and (
                    message.signal_quality != _INVALID_DISTANCE) and (
                    known is None or known.source == 'DISTANCE_SENSOR'):
            self.sensor_altitude = SensorAltitude(
                now, message.current_distance * 1e-2, 'DISTANCE_SENSOR')

    def forget(self) -> None:
        """Reset home and clock after a reboot or replacement of the autopilot, not the origin."""
        self.newest.pop('HOME_POSITION', None)
        self._boot_time_ms, self._fallen = 0, False

    def _notice_reboot(self, stamp: int) -> None:
        """Compare the stamp of an attitude, ms since boot, with the newest; 0: not set."""
        if self._boot_time_ms >= 2**32 - WRAP_MARGIN_MS and 0 < stamp < WRAP_MARGIN_MS:
            self._boot_time_ms = stamp
        fallen = 0 < stamp < self._boot_time_ms - REBOOT_STEP_MS
        if fallen and self._fallen:  # a single one may have been delayed
            self.reboots += 1
            self.forget()
            fallen = False
        self._fallen = fallen
        self._boot_time_ms = max(self._boot_time_ms, stamp)

    def _local_position(self, message: Any, now: float) -> None:
        position = ned_to_enu([message.x, message.y, message.z])
        velocity = ned_to_enu([message.vx, message.vy, message.vz])
        if np.all(np.isfinite(position)) and np.all(np.isfinite(velocity)):
            self.local_position = LocalPosition(now, position, velocity, message.time_boot_ms)

    def _attitude(self, message: Any, now: float) -> None:
        self._notice_reboot(message.time_boot_ms)
        decoded = decode_attitude([message.q1, message.q2, message.q3, message.q4],
                                  [message.rollspeed, message.pitchspeed, message.yawspeed])
        if decoded is not None:
            self.attitude = Attitude(now, *decoded, message.time_boot_ms)


def decode_attitude(wxyz: list[float], rates: Sequence[float]) -> tuple[Array, Array] | None:
    """
    Return attitude (x, y, z, w) and rates (3,), rad/s, FLU and ENU; None if they are invalid.

    :param wxyz: MAVLink's quaternion (w, x, y, z), FRD to NED; ``rates`` FRD.
    """
    try:
        quaternion = quaternion_ned_frd_to_enu_flu(normalize_quaternion(wxyz[1:] + wxyz[:1]))
    except ValueError:
        return None
    return quaternion, np.nan_to_num(frd_to_flu(rates), posinf=0.0, neginf=0.0)


def _battery(message: Any, now: float) -> Battery:
    """Return the battery in a SYS_STATUS."""
    voltage, current, remaining = (
        message.voltage_battery, message.current_battery, message.battery_remaining)
    return Battery(now, math.nan if voltage == _UNKNOWN_VOLTAGE else voltage * 1e-3,
                   current * 1e-2 if current >= 0 else math.nan,
                   remaining * 1e-2 if remaining >= 0 else math.nan)


#: An attitude further than this, s, from a position does not belong to it.
ATTITUDE_TIMEOUT: Final[float] = 0.1


def estimate(position: LocalPosition, attitude: Attitude, age: float
             ) -> tuple[OdometryState, float] | None:
    """
    Return the odometry, and the time of a position, s, at which it was valid.

    None if the times of attitude and position differ too much. The stamp of the odometry is 0.

    If the autopilot has stamped both, the attitude is extrapolated by its rates to the time of the
    position: without this, 20 ms at 1 rad/s would displace a neighbor at 2.5 m by 5 cm.

    :param age: of the position at its arrival, s; 0 if unknown.
    """
    if abs(position.time - attitude.time) > ATTITUDE_TIMEOUT:
        return None
    between = 0.0  # s
    if position.time_boot_ms and attitude.time_boot_ms:
        between = (position.time_boot_ms - attitude.time_boot_ms) * 1e-3
        if abs(between) > ATTITUDE_TIMEOUT:  # another clock, or one of them was delayed
            between = 0.0
    quaternion = quaternion_multiply(
        attitude.quaternion, rotation_vector_to_quaternion(attitude.angular_velocity * between))
    state = OdometryState(
        0, 'odom', 'base_link', position.position, quaternion, position.velocity,
        attitude.angular_velocity, np.zeros((6, 6)), np.zeros((6, 6)),
        quaternion_to_matrix(quaternion))
    return state, position.time - max(age, 0.0)
