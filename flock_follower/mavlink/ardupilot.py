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

"""The ArduPilot dialect, of its multirotors (ArduCopter): flight modes, take-off above home."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialect import Dialect, ModeMessage

OFFBOARD: Final[str] = 'GUIDED'
#: It stops and keeps its place whatever the sticks of a transmitter say; LOITER obeys them.
HOLD: Final[str] = 'BRAKE'
LAND: Final[str] = 'LAND'

#: ArduCopter's custom_mode by name.
MODES: Final[Mapping[str, int]] = MappingProxyType({
    'STABILIZE': 0, 'ACRO': 1, 'ALT_HOLD': 2, 'AUTO': 3, 'GUIDED': 4, 'LOITER': 5, 'RTL': 6,
    'CIRCLE': 7, 'LAND': 9, 'DRIFT': 11, 'SPORT': 13, 'FLIP': 14, 'AUTOTUNE': 15, 'POSHOLD': 16,
    'BRAKE': 17, 'THROW': 18, 'AVOID_ADSB': 19, 'GUIDED_NOGPS': 20, 'SMART_RTL': 21,
    'FLOWHOLD': 22, 'FOLLOW': 23, 'ZIGZAG': 24, 'SYSTEMID': 25, 'AUTOROTATE': 26, 'AUTO_RTL': 27,
    'TURTLE': 28,
})
_NAMES: Final[Mapping[int, str]] = {code: name for name, code in MODES.items()}


def custom_mode(name: str) -> int:
    """
    Return ArduCopter's custom_mode of a flight mode named as in ``MODES``.

    :raises ValueError: for an unknown name.
    """
    if name not in MODES:
        raise ValueError(f'mode = {name!r}: must be one of {", ".join(MODES)}')
    return MODES[name]


def mode_name(mode: int) -> str:
    """Return the name of a custom_mode, or its number where it has none here."""
    return _NAMES.get(mode) or f'mode {mode}'


class ArduPilot(Dialect):
    """ArduCopter; what is said of its behaviour was measured on 4.7."""

    name = 'ardupilot'
    title = 'ArduPilot'
    offboard = OFFBOARD
    hold = HOLD
    hold_instead = (LAND,)
    arming_modes = (OFFBOARD,)
    unarmable_modes = (LAND, 'RTL', 'SMART_RTL', 'BRAKE')
    land = LAND
    takeoff_modes = (OFFBOARD,)
    stream_before_offboard = 0.0
    compensates_wind = True
    setpoints_end_takeoff = True
    bytewise_parameters = False
    minimum_takeoff = ''
    odometry_frame = mavlink.MAV_FRAME_LOCAL_FRD
    estimator_status = mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT
    origin_has_height = True
    gps_switch = ''  # an origin of zeros ends it with a panic
    recommendations = 'ardupilot.parm'
    # HEARTBEAT comes at once when the mode changes; 5 Hz is for those that get lost.
    mode_message = ModeMessage(mavlink.MAVLINK_MSG_ID_HEARTBEAT, asked=5.0, least=5.0)

    def mode_name(self, custom_mode: int) -> str:
        """Return the name of a custom_mode, or its number where it has none here."""
        return mode_name(custom_mode)

    def set_mode_parameters(self, name: str) -> tuple[float, ...]:
        """Return the parameters of MAV_CMD_DO_SET_MODE; ValueError for an unknown name."""
        return float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(custom_mode(name))

    def takeoff_parameters(self, height: float, sea_level_altitude: float | None,
                           above_home: float) -> tuple[float, ...]:
        """Return the parameters of MAV_CMD_NAV_TAKEOFF: straight up, to a height above home."""
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, above_home + height
