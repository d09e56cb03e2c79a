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
Acceleration setpoints as SET_POSITION_TARGET_LOCAL_NED holds them: type masks, and ENU to NED.

No autopilot applies a speed limit to acceleration setpoints, so what is encoded here must have
passed the setpoint gate.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pymavlink.dialects.v20 import all as mavlink

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
