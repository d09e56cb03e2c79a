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
Acceleration setpoints as SET_POSITION_TARGET_LOCAL_NED carries them: ENU to NED, and the mask.

Both autopilots obey acceleration with yaw in MAV_FRAME_LOCAL_NED. Neither applies a speed limit to
it, so the setpoint gate must have limited what is encoded here.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.geometry import enu_to_ned, yaw_enu_to_ned

#: Acceleration only, 0xC3F: for as long as no yaw is known.
ACCELERATION: Final[int] = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE)
#: Acceleration and yaw, 0x83F.
ACCELERATION_YAW: Final[int] = ACCELERATION & ~mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE


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


def encode_setpoint(acceleration: ArrayLike, yaw: float | None = None) -> LocalNedSetpoint:
    """
    Return the setpoint of an ENU acceleration and yaw, in NED.

    :param acceleration: (3,), m/s^2, ENU.
    :param yaw: rad, anticlockwise from east; None leaves it to the autopilot.
    :raises ValueError: for a value that is not finite.
    """
    north, east, down = enu_to_ned(acceleration).tolist()
    setpoint = LocalNedSetpoint(
        ACCELERATION if yaw is None else ACCELERATION_YAW, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        north, east, down, 0.0 if yaw is None else yaw_enu_to_ned(yaw), 0.0)
    if not all(math.isfinite(value) for value in setpoint):
        raise ValueError(f'setpoint: acceleration = {np.asarray(acceleration).tolist()}, '
                         f'yaw = {yaw}: must be finite')
    return setpoint
