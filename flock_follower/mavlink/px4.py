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
The PX4 dialect: setpoint masks, ENU to NED setpoints, flight modes, HEARTBEAT.

Setpoints are ``SET_POSITION_TARGET_LOCAL_NED`` in ``MAV_FRAME_LOCAL_NED``. PX4 applies no speed
limit to acceleration setpoints, so what is encoded here must have passed the setpoint gate.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pymavlink.dialects.v20 import common as mavlink

from flock_follower.geometry import enu_to_ned, yaw_enu_to_ned

_IGNORE_Z: Final[int] = mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
_IGNORE_AZ: Final[int] = mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
_IGNORE_YAW: Final[int] = mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
_IGNORE_YAW_RATE: Final[int] = mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
_IGNORE_POSITION_AND_VELOCITY: Final[int] = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE)

#: Acceleration only, 0xC3F: the mask every autopilot takes.
ACCELERATION: Final[int] = _IGNORE_POSITION_AND_VELOCITY | _IGNORE_YAW | _IGNORE_YAW_RATE
#: Acceleration and yaw, 0x83F.
ACCELERATION_YAW: Final[int] = ACCELERATION & ~_IGNORE_YAW
#: Acceleration and yaw rate, 0x43F.
ACCELERATION_YAW_RATE: Final[int] = ACCELERATION & ~_IGNORE_YAW_RATE
#: Acceleration x and y, position z, 0xD3B; PX4 only: ArduCopter ignores mixed axes and stops.
ACCELERATION_XY_ALTITUDE: Final[int] = (ACCELERATION | _IGNORE_AZ) & ~_IGNORE_Z
#: Acceleration x and y, position z, yaw, 0x93B; PX4 only.
ACCELERATION_XY_ALTITUDE_YAW: Final[int] = ACCELERATION_XY_ALTITUDE & ~_IGNORE_YAW

#: The type masks by the name of the setpoint mode.
SETPOINT_MASKS: Final[Mapping[str, int]] = MappingProxyType({
    'acceleration_yaw': ACCELERATION_YAW,
    'acceleration': ACCELERATION,
    'acceleration_yaw_rate': ACCELERATION_YAW_RATE,
    'acceleration_xy_altitude': ACCELERATION_XY_ALTITUDE,
    'acceleration_xy_altitude_yaw': ACCELERATION_XY_ALTITUDE_YAW,
})

#: PX4 drops to its failsafe when fewer setpoints than this arrive, Hz, and takes OFFBOARD only
#: after a stream of this rate has lasted STREAM_BEFORE_OFFBOARD seconds.
MINIMUM_STREAM_RATE: Final[float] = 2.0
STREAM_BEFORE_OFFBOARD: Final[float] = 1.0

OFFBOARD: Final[str] = 'OFFBOARD'
HOLD: Final[str] = 'AUTO.LOITER'

#: Main and sub mode of PX4's custom_mode by name.
MODES: Final[Mapping[str, tuple[int, int]]] = MappingProxyType({
    'MANUAL': (1, 0), 'ALTCTL': (2, 0), 'POSCTL': (3, 0), 'ACRO': (5, 0), 'OFFBOARD': (6, 0),
    'STABILIZED': (7, 0), 'RATTITUDE': (8, 0), 'AUTO.READY': (4, 1), 'AUTO.TAKEOFF': (4, 2),
    'AUTO.LOITER': (4, 3), 'AUTO.MISSION': (4, 4), 'AUTO.RTL': (4, 5), 'AUTO.LAND': (4, 6),
    'AUTO.FOLLOW_TARGET': (4, 8), 'AUTO.PRECLAND': (4, 9),
})
_NAMES: Final[Mapping[tuple[int, int], str]] = {code: name for name, code in MODES.items()}


class LocalNedSetpoint(NamedTuple):
    """The fields of SET_POSITION_TARGET_LOCAL_NED, in its order; ignored ones are zero."""

    type_mask: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float
    afx: float
    afy: float
    afz: float
    yaw: float
    yaw_rate: float


def encode_setpoint(acceleration: ArrayLike, yaw: float | None = None, *,
                    mode: str = 'acceleration_yaw', altitude: float | None = None,
                    yaw_rate: float = 0.0) -> LocalNedSetpoint:
    """
    Return the setpoint of an ENU acceleration, yaw and altitude, in NED.

    A mode that wants a yaw or an altitude which is None ignores yaw, or takes the vertical
    acceleration instead.

    :param acceleration: (3,), m/s^2, ENU.
    :param yaw: rad, anticlockwise from east.
    :param mode: a key of ``SETPOINT_MASKS``.
    :param altitude: m above the origin of the autopilot's local frame.
    :param yaw_rate: rad/s, anticlockwise seen from above.
    :raises ValueError: for an unknown mode or a value that is not finite.
    """
    if mode not in SETPOINT_MASKS:
        raise ValueError(f'setpoint_mode = {mode!r}: must be one of {", ".join(SETPOINT_MASKS)}')
    mask = SETPOINT_MASKS[mode]
    if yaw is None:
        mask |= _IGNORE_YAW
    if altitude is None and not mask & _IGNORE_Z:
        mask = (mask | _IGNORE_Z) & ~_IGNORE_AZ
    north, east, down = enu_to_ned(acceleration).tolist()
    setpoint = LocalNedSetpoint(
        mask,
        0.0, 0.0, 0.0 if mask & _IGNORE_Z or altitude is None else -altitude,
        0.0, 0.0, 0.0,
        north, east, 0.0 if mask & _IGNORE_AZ else down,
        0.0 if mask & _IGNORE_YAW or yaw is None else yaw_enu_to_ned(yaw),
        0.0 if mask & _IGNORE_YAW_RATE else -yaw_rate)
    if not all(math.isfinite(value) for value in setpoint):
        raise ValueError(
            f'setpoint: acceleration = {np.asarray(acceleration).tolist()}, yaw = {yaw}, '
            f'altitude = {altitude}, yaw_rate = {yaw_rate}: must be finite')
    return setpoint


def custom_mode(name: str) -> int:
    """
    Return PX4's custom_mode of a flight mode named as in ``MODES``.

    :raises ValueError: for an unknown name.
    """
    if name not in MODES:
        raise ValueError(f'mode = {name!r}: must be one of {", ".join(MODES)}')
    main, sub = MODES[name]
    return main << 16 | sub << 24


def mode_name(mode: int) -> str:
    """Return the name of a custom_mode, or its numbers where it has none here."""
    main, sub = mode >> 16 & 0xFF, mode >> 24 & 0xFF
    # PX4 1.15 has sub modes of POSCTL (orbit, slow) that fly like their main mode.
    return _NAMES.get((main, sub)) or _NAMES.get((main, 0)) or f'mode {main}.{sub}'


class VehicleStatus(NamedTuple):
    """What a HEARTBEAT says of the vehicle."""

    armed: bool
    mode: str
    system_status: str
    """MAV_STATE in lower case: 'standby', 'active', 'critical' (a failsafe acts) and so on."""

    @property
    def offboard(self) -> bool:
        """Return whether the vehicle obeys our setpoints."""
        return self.mode == OFFBOARD


def is_autopilot(heartbeat: Any) -> bool:
    """Return whether a HEARTBEAT comes from a flight controller, not a gimbal or a station."""
    return bool(heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID
                and heartbeat.type not in (mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_GIMBAL,
                                           mavlink.MAV_TYPE_ONBOARD_CONTROLLER))


def vehicle_status(heartbeat: Any) -> VehicleStatus:
    """Return what a HEARTBEAT of PX4 says."""
    state = mavlink.enums['MAV_STATE'].get(heartbeat.system_status)
    name = state.name.removeprefix('MAV_STATE_').lower() if state else 'unknown'
    armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    return VehicleStatus(armed, mode_name(heartbeat.custom_mode), name)
