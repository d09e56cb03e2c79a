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
The parameters of the embedded autopilot, served the way PX4 and ArduPilot each serve them.

PARAM_VALUE carries every parameter in a float. PX4 puts the four bytes of an integer there
(MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE), ArduPilot the number itself: who mixes them up
reads 1 as 1.4e-45.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
import contextlib
import math
import struct
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.ranges import Range

FLOAT: Final[int] = mavlink.MAV_PARAM_TYPE_REAL32
INT8: Final[int] = mavlink.MAV_PARAM_TYPE_INT8
INT16: Final[int] = mavlink.MAV_PARAM_TYPE_INT16
INT32: Final[int] = mavlink.MAV_PARAM_TYPE_INT32
_LIMITS: Final[Mapping[int, int]] = {INT8: 2**7, INT16: 2**15, INT32: 2**31}
_UNKNOWN_INDEX: Final[int] = 65535

#: Type and default of what this vehicle has of PX4's parameters. Some are here to be read only:
#: the failsafes of transmitter, ground station and battery, and the geofence, are not simulated.
PX4: Final[Mapping[str, tuple[int, float]]] = {
    'COM_DISARM_LAND': (FLOAT, 2.0),      # s on the ground after landing until it disarms
    'COM_DISARM_PRFLT': (FLOAT, 10.0),    # s on the ground after arming until it disarms
    'COM_LOW_BAT_ACT': (INT32, 0),        # 0: a warning, 2: Land, 3: Return
    'COM_OBL_RC_ACT': (INT32, 0),         # what follows the loss of the stream
    'COM_OF_LOSS_T': (FLOAT, 1.0),        # s without setpoints until it counts as lost
    'COM_RC_IN_MODE': (INT32, 3),
    'COM_RCL_EXCEPT': (INT32, 0),         # modes without the failsafe; bit 2: Offboard
    'COM_RC_OVERRIDE': (INT32, 1),
    'COM_SPOOLUP_TIME': (FLOAT, 1.0),     # s after arming until it can take off
    'EKF2_BARO_CTRL': (INT32, 1),
    'EKF2_EV_CTRL': (INT32, 0),           # what is taken of vision; 15: everything
    'EKF2_EV_DELAY': (FLOAT, 0.0),
    'EKF2_EV_NOISE_MD': (INT32, 0),
    'EKF2_GPS_CTRL': (INT32, 7),          # 0: fly without GPS
    'EKF2_HGT_REF': (INT32, 1),           # 0: barometer, 1: GPS, 2: rangefinder, 3: vision
    'EKF2_MAG_TYPE': (INT32, 0),          # 0: automatic, 5: no compass
    'EKF2_NOAID_TOUT': (INT32, 5_000_000),
    'GF_ACTION': (INT32, 2),              # 0: none, 1: a warning, 2: Hold, 3: Return
    'GF_MAX_HOR_DIST': (FLOAT, 0.0),      # m; 0: no limit
    'GF_MAX_VER_DIST': (FLOAT, 0.0),      # m; 0: no limit
    'MAV_SYS_ID': (INT32, 1),
    'MIS_TAKEOFF_ALT': (FLOAT, 2.5),      # m
    'MPC_LAND_SPEED': (FLOAT, 0.7),       # m/s
    'MPC_THR_HOVER': (FLOAT, 0.5),
    'MPC_TKO_RAMP_T': (FLOAT, 3.0),       # s in which the climb rate of a take-off rises
    'MPC_XY_VEL_MAX': (FLOAT, 12.0),      # not applied to acceleration setpoints
    'NAV_DLL_ACT': (INT32, 0),            # without a ground station; 0: nothing
    'NAV_RCL_ACT': (INT32, 2),            # without a transmitter; 1: Hold, 2: Return, 3: Land
    'RTL_RETURN_ALT': (FLOAT, 60.0),      # m
}
#: The same of ArduCopter's.
ARDUCOPTER: Final[Mapping[str, tuple[int, float]]] = {
    'AHRS_EKF_TYPE': (INT8, 3),
    'BATT_CRT_MAH': (FLOAT, 0.0),         # mAh; 0: no limit
    'BATT_CRT_VOLT': (FLOAT, 0.0),        # V; 0: no limit
    'BATT_FS_CRT_ACT': (INT8, 0),         # 0: a warning, 1: LAND, 2: RTL
    'BATT_FS_LOW_ACT': (INT8, 0),
    'BATT_LOW_MAH': (FLOAT, 0.0),
    'BATT_LOW_VOLT': (FLOAT, 10.5),
    'DISARM_DELAY': (INT8, 10),           # s on the ground after arming until it disarms
    'EK3_ENABLE': (INT8, 1),
    'EK3_SRC1_POSXY': (INT8, 3),          # 3: GPS, 6: external navigation
    'EK3_SRC1_POSZ': (INT8, 1),           # 1: barometer
    'EK3_SRC1_VELXY': (INT8, 3),
    'EK3_SRC1_VELZ': (INT8, 3),
    'EK3_SRC1_YAW': (INT8, 1),            # 1: compass
    'FENCE_ACTION': (INT8, 1),            # 0: a report, 1: RTL or LAND
    'FENCE_ALT_MAX': (FLOAT, 100.0),      # m
    'FENCE_ENABLE': (INT8, 0),
    'FENCE_RADIUS': (FLOAT, 300.0),       # m
    'FENCE_TYPE': (INT8, 7),              # bits: altitude, circle, polygons
    'FS_EKF_ACTION': (INT8, 1),           # 1: LAND, 2: ALT_HOLD
    'FS_GCS_ENABLE': (INT8, 0),
    'FS_THR_ENABLE': (INT8, 1),           # without a transmitter; 0: nothing, 1: RTL, 3: LAND
    'GPS1_TYPE': (INT8, 1),               # 0: fly without GPS
    'GUID_OPTIONS': (INT32, 0),
    'GUID_TIMEOUT': (FLOAT, 3.0),         # s without setpoints until GUIDED stops
    'LAND_SPEED': (INT16, 50),            # cm/s
    'RTL_ALT': (INT32, 1500),             # cm
    'VISO_TYPE': (INT8, 0),               # 1: vision by MAVLink
    'WPNAV_SPEED': (FLOAT, 1000.0),       # cm/s, not applied to acceleration setpoints
}


class AutopilotParameters:
    """
    A table of parameters and its MAVLink protocol.

    :param bytewise: whether integers travel as their bytes (PX4) or as their value (ArduPilot).
    """

    def __init__(self, table: Mapping[str, tuple[int, float]], *, bytewise: bool) -> None:
        self._types = {name: kind for name, (kind, _) in table.items()}
        self._values = {name: float(value) for name, (_, value) in table.items()}
        self._bytewise = bytewise
        self._pending: deque[str] = deque()

    def __getitem__(self, name: str) -> float:
        """Return a value by its name."""
        return self._values[name]

    def set(self, name: str, value: float) -> None:
        """
        Set a value.

        :raises ValueError: for an unknown name, or a value that its type cannot hold.
        """
        if name not in self._values:
            raise ValueError(f'{name}: must be one of {", ".join(self._values)}')
        limit = _LIMITS.get(self._types[name])
        valid = Range() if limit is None else Range(-limit, limit - 1, whole=True)
        whole = limit is not None and float(value).is_integer()
        valid.check(name, int(value) if whole else value)
        self._values[name] = float(value)

    def handle(self, message: Any) -> list[Any]:
        """Answer PARAM_REQUEST_READ, PARAM_REQUEST_LIST and PARAM_SET; unknown names silently."""
        kind = message.get_type()
        if kind == 'PARAM_REQUEST_LIST':
            self._pending = deque(self._values)
            return []
        name = str(message.param_id)
        if kind == 'PARAM_REQUEST_READ' and message.param_index >= 0:
            if message.param_index >= len(self._values):
                return []
            return [self._message(list(self._values)[message.param_index], named=False)]
        if name not in self._values:
            return []
        if kind == 'PARAM_SET':
            with contextlib.suppress(ValueError):  # the answer tells the old value then
                self.set(name, self._decode(message.param_value, self._types[name]))
        return [self._message(name, named=True)]

    def step(self) -> list[Any]:
        """Return what is due of a list: one at a time, as a real one paces it."""
        return [self._message(self._pending.popleft(), named=False)] if self._pending else []

    def _message(self, name: str, *, named: bool) -> Any:
        # ArduPilot does not look up the index of a parameter asked for by its name.
        index = (_UNKNOWN_INDEX if named and not self._bytewise
                 else list(self._values).index(name))
        return mavlink.MAVLink_param_value_message(
            name.encode(), self._encode(name), self._types[name], len(self._values), index)

    def _encode(self, name: str) -> float:
        value, kind = self._values[name], self._types[name]
        if self._bytewise and kind != FLOAT:
            return float(struct.unpack('<f', struct.pack('<i', int(value)))[0])
        return value

    def _decode(self, value: float, kind: int) -> float:
        if self._bytewise and kind != FLOAT:
            return float(struct.unpack('<i', struct.pack('<f', value))[0])
        return value if kind == FLOAT else float(round(value)) if math.isfinite(value) else value
