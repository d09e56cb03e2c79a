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

"""The setpoints that PX4 takes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.flight_controller import TrackedSetpoint
from flock_follower.geometry import ned_to_enu, yaw_ned_to_enu


def decode_setpoint(message: Any) -> TrackedSetpoint | None:
    """
    Return a SET_POSITION_TARGET_LOCAL_NED in ENU, NaN where its mask ignores an axis.

    None for what PX4 drops: other frames, acceleration as force, axes that nothing is given for,
    and numbers that are not finite.
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
    enu = ned_to_enu(ned.reshape(3, 3))
    yaw, yaw_rate = math.nan, math.nan
    if not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE and math.isfinite(message.yaw):
        yaw = yaw_ned_to_enu(message.yaw)
    if not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE:
        yaw_rate = -message.yaw_rate
    if not np.all(np.any(np.isfinite(enu), axis=0)):
        return None
    return TrackedSetpoint(enu[0], enu[1], enu[2], yaw, yaw_rate)
