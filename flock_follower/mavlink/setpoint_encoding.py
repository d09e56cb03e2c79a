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
``encode_setpoint`` makes SET_POSITION_TARGET_LOCAL_NED of a setpoint.

The message has acceleration and yaw in MAV_FRAME_LOCAL_NED, which PX4 and ArduCopter obey. This
is the last check for NaN before the wire.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.ned import enu_to_ned, yaw_enu_to_ned

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


def encode_setpoint(acceleration: ArrayLike, yaw: float | None = None, time_boot_ms: int = 0,
                    system: int = 1, component: int = 1) -> Any:
    """
    Return SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_LOCAL_NED of an ENU acceleration and yaw.

    :param acceleration: (3,), m/s^2, ENU.
    :param yaw: rad, anticlockwise from east; None leaves it to the autopilot.
    :param time_boot_ms: time stamp, ms; ``system`` and ``component`` address the receiver.
    :raises ValueError: for a value that is not finite.
    """
    north, east, down = enu_to_ned(acceleration).tolist()
    heading = 0.0 if yaw is None else yaw_enu_to_ned(yaw)
    if not all(map(math.isfinite, (north, east, down, heading))):
        raise ValueError(f'setpoint: acceleration = {np.asarray(acceleration).tolist()}, '
                         f'yaw = {yaw}: must be finite')
    return mavlink.MAVLink_set_position_target_local_ned_message(
        time_boot_ms, system, component, mavlink.MAV_FRAME_LOCAL_NED,
        ACCELERATION if yaw is None else ACCELERATION_YAW, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        north, east, down, heading, 0.0)
