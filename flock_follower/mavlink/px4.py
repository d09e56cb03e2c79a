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

"""The PX4 dialect: flight modes, take-off above sea level."""

from __future__ import annotations

from collections.abc import Mapping
import math
from types import MappingProxyType
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialect import Dialect, ModeMessage

#: PX4 drops to its failsafe when fewer setpoints than this arrive, Hz, and takes OFFBOARD only
#: after a stream of this rate has lasted STREAM_BEFORE_OFFBOARD seconds.
MINIMUM_STREAM_RATE: Final[float] = 2.0
STREAM_BEFORE_OFFBOARD: Final[float] = 1.0

OFFBOARD: Final[str] = 'OFFBOARD'
HOLD: Final[str] = 'AUTO.LOITER'
LAND: Final[str] = 'AUTO.LAND'
TAKEOFF: Final[str] = 'AUTO.TAKEOFF'
#: PX4 climbs at least this parameter's height, m, whatever NAV_TAKEOFF asks for.
MINIMUM_TAKEOFF: Final[str] = 'MIS_TAKEOFF_ALT'

#: Main and sub mode of PX4's custom_mode by name.
MODES: Final[Mapping[str, tuple[int, int]]] = MappingProxyType({
    'MANUAL': (1, 0), 'ALTCTL': (2, 0), 'POSCTL': (3, 0), 'ACRO': (5, 0), 'OFFBOARD': (6, 0),
    'STABILIZED': (7, 0), 'RATTITUDE': (8, 0), 'AUTO.READY': (4, 1), 'AUTO.TAKEOFF': (4, 2),
    'AUTO.LOITER': (4, 3), 'AUTO.MISSION': (4, 4), 'AUTO.RTL': (4, 5), 'AUTO.LAND': (4, 6),
    'AUTO.FOLLOW_TARGET': (4, 8), 'AUTO.PRECLAND': (4, 9),
})
_NAMES: Final[Mapping[tuple[int, int], str]] = {code: name for name, code in MODES.items()}


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


class Px4(Dialect):
    """PX4 1.14 and later."""

    name = 'px4'
    title = 'PX4'
    offboard = OFFBOARD
    hold = HOLD
    hold_instead = ('POSCTL', LAND)
    arming_modes = (HOLD, 'POSCTL')
    unarmable_modes = (OFFBOARD, LAND, 'AUTO.RTL')
    land = LAND
    takeoff_modes = (TAKEOFF, HOLD)
    # With a margin for delays on the way.
    stream_before_offboard = STREAM_BEFORE_OFFBOARD + 0.5
    compensates_wind = False
    setpoints_end_takeoff = False
    bytewise_parameters = True
    minimum_takeoff = MINIMUM_TAKEOFF
    odometry_frame = mavlink.MAV_FRAME_LOCAL_NED
    estimator_status = mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS
    origin_has_height = False
    gps_switch = 'EKF2_GPS_CTRL'
    recommendations = 'px4.params'
    reports_checks = True
    untold = ('PX4 tells the cause only to a ground station: look there, or set announce_as_gcs')
    # Two changes further apart than 20 ms come as two messages. It costs what 2 Hz cost: without
    # a change no more are sent. HEARTBEAT would be refused.
    mode_message = ModeMessage(mavlink.MAVLINK_MSG_ID_CURRENT_MODE, asked=50.0, least=2.0)

    def mode_name(self, custom_mode: int) -> str:
        """Return the name of a custom_mode, or its numbers where it has none here."""
        return mode_name(custom_mode)

    def set_mode_parameters(self, name: str) -> tuple[float, ...]:
        """Return the parameters of MAV_CMD_DO_SET_MODE; ValueError for an unknown name."""
        code = custom_mode(name)
        return (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(code >> 16 & 0xFF),
                float(code >> 24))

    def takeoff_parameters(self, height: float, sea_level_altitude: float | None,
                           above_home: float) -> tuple[float, ...]:
        """
        Return the parameters of MAV_CMD_NAV_TAKEOFF: here, to an altitude above sea level.

        Where that is unknown (no GPS) NaN leaves the height to ``MIS_TAKEOFF_ALT``.
        """
        here = math.nan
        goal = math.nan if sea_level_altitude is None else sea_level_altitude + height
        return 0.0, 0.0, 0.0, here, here, here, goal
