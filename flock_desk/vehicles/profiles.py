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
The differences of the embedded autopilots, as tables: measured, see docs/autopilots.md.

The values are repeated here, not imported from the bridge: otherwise a mistake of the bridge would
be in both.

PARAM_VALUE carries every parameter in a float. PX4 puts the four bytes of an integer there,
ArduPilot the number itself. A decoder that uses the wrong encoding reads 1 as 1.4e-45.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
import struct
from typing import Any, Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.geometry import Array
from flock_follower.ranges import Range

#: How a mode flies: it keeps its place, keeps level, lands, or obeys setpoints.
HOLD, LEVEL, LAND, SETPOINTS = 'hold', 'level', 'land', 'setpoints'
FLOAT: Final[int] = mavlink.MAV_PARAM_TYPE_REAL32
INT8: Final[int] = mavlink.MAV_PARAM_TYPE_INT8
INT16: Final[int] = mavlink.MAV_PARAM_TYPE_INT16
INT32: Final[int] = mavlink.MAV_PARAM_TYPE_INT32
#: Rates, Hz, of the messages of both; SET_MESSAGE_INTERVAL changes them. 0: only on request.
_RATES: Final[Mapping[int, float]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0, mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 0.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 0.0, mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.0,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 0.0}


class Mode(NamedTuple):
    """A flight mode."""

    number: int
    """custom_mode of HEARTBEAT."""
    flies: str
    needs: tuple[str, ...] = ()
    """The conditions, see ``FlightController.conditions``, without which it is refused."""
    arms: bool = True


class Firmware(NamedTuple):
    """What differs in one version of an autopilot."""

    added: Mapping[str, tuple[int, float]] = {}
    """Type and default by name of the parameters that only this version has."""
    removed: frozenset[str] = frozenset()
    """The parameters that it lacks."""
    reports_missing: bool = False
    """Whether it answers a request of a missing parameter by PARAM_ERROR."""


@dataclass(frozen=True)
class Profile:
    """One autopilot."""

    autopilot: int
    """MAV_AUTOPILOT."""
    modes: Mapping[str, Mode]
    starts: tuple[str, str]
    """The modes in which it begins on the ground, and in the air."""
    takeoff: str
    """The mode in which it takes off."""
    parameters: Mapping[str, tuple[int, float]]
    """Type and default by name."""
    firmwares: Mapping[str, Firmware]
    """By version; the first is the default."""
    landing_speed: tuple[str, float]
    """Its parameter, and the unit of that, m/s."""
    rates: Mapping[int, float]
    """Hz, by message id; 0: only on request."""
    mode_message: int
    """Id of the message that is sent at once after a change of the mode."""
    arming: tuple[str, ...]
    """The conditions of arming, besides those of the mode."""
    refused: int
    """MAV_RESULT if a condition is not met."""
    unknown_message: int
    """MAV_RESULT of SET_MESSAGE_INTERVAL for a message that it does not send."""
    vision: Mapping[str, float]
    """The values of parameters with which it flies by vision instead of GPS."""
    vision_height: tuple[str, float]
    """The parameter, and its value, with which vision is its height sensor."""
    frames: tuple[int, ...]
    """The frames of ODOMETRY that it takes."""
    oldest_vision: float
    """s; older odometry, by the estimated clock offset, is not used."""
    position_timeout: float
    """s without vision after which the position is not valid, besides EKF2_NOAID_TOUT ..."""
    reports_for: float
    """... and after which LOCAL_POSITION_NED is no longer sent."""
    estimator_flags: Mapping[str, int]
    """Bits of ESTIMATOR_STATUS or EKF_STATUS_REPORT, by condition."""
    drift: Array
    """Acceleration (3,), m/s^2, by which its estimate drifts without vision."""
    tilt_max: float
    """rad."""

    @property
    def px4(self) -> bool:
        """Return whether it is PX4."""
        return self.autopilot == mavlink.MAV_AUTOPILOT_PX4

    def version(self, name: str) -> str:
        """
        Return ``name``, a key of ``firmwares``, or the first key if ``name`` is ''.

        :raises ValueError: if ``name`` is no key.
        """
        if name and name not in self.firmwares:
            raise ValueError(f'version = {name!r}: must be one of {", ".join(self.firmwares)}')
        return name or next(iter(self.firmwares))


def _px4(main: int, sub: int = 0) -> int:
    """Return a custom_mode: main mode in the third byte, sub mode in the fourth."""
    return main << 16 | sub << 24


PX4: Final = Profile(
    autopilot=mavlink.MAV_AUTOPILOT_PX4,
    modes={
        'MANUAL': Mode(_px4(1), LEVEL, ('sticks',)), 'ALTCTL': Mode(_px4(2), LEVEL, ('sticks',)),
        'POSCTL': Mode(_px4(3), HOLD, ('position', 'sticks')),
        'AUTO.TAKEOFF': Mode(_px4(4, 2), HOLD, ('position',)),
        'AUTO.LOITER': Mode(_px4(4, 3), HOLD, ('position', 'global')),
        'AUTO.LAND': Mode(_px4(4, 6), LAND, arms=False),
        'OFFBOARD': Mode(_px4(6), SETPOINTS, ('stream',)),
        'STABILIZED': Mode(_px4(7), LEVEL, ('sticks',))},
    starts=('AUTO.LOITER', 'AUTO.LOITER'), takeoff='AUTO.TAKEOFF',
    # Some are here to be read only: the failsafes of transmitter, ground station and battery, and
    # the geofence, are not simulated.
    parameters={
        'COM_DISARM_LAND': (FLOAT, 2.0),      # s on the ground after landing until it disarms
        'COM_DISARM_PRFLT': (FLOAT, 10.0),    # s on the ground after arming until it disarms
        'COM_LOW_BAT_ACT': (INT32, 0),        # 0: a warning, 2: Land, 3: Return
        'COM_OBL_RC_ACT': (INT32, 0),         # after the loss of the stream 4: Land, 5: Hold
        'COM_OF_LOSS_T': (FLOAT, 1.0),        # s without setpoints until it counts as lost
        'COM_RC_IN_MODE': (INT32, 3),
        'COM_RCL_EXCEPT': (INT32, 0),         # modes without the failsafe; bit 2: Offboard
        'COM_RC_OVERRIDE': (INT32, 1),
        'COM_SPOOLUP_TIME': (FLOAT, 1.0),     # s after arming until it can take off
        'EKF2_BARO_CTRL': (INT32, 1),
        'EKF2_EV_CTRL': (INT32, 0),           # parts of vision that are fused; 15: all
        'EKF2_EV_DELAY': (FLOAT, 0.0),
        'EKF2_EV_NOISE_MD': (INT32, 0),
        'EKF2_EV_QMIN': (INT32, 0),           # %, quality below which vision is refused
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
        'MPC_USE_HTE': (INT32, 1),            # 1: the hover thrust is estimated in flight
        'MPC_TKO_RAMP_T': (FLOAT, 3.0),       # s in which the climb rate of a take-off rises
        'MPC_XY_VEL_MAX': (FLOAT, 12.0),      # not applied to acceleration setpoints
        'NAV_DLL_ACT': (INT32, 0),            # without a ground station; 0: nothing
        'NAV_RCL_ACT': (INT32, 2),            # without a transmitter; 1: Hold, 2: Return, 3: Land
    },
    firmwares={
        '1.16': Firmware(),
        '1.18': Firmware(added={'MAN_OVERRIDE_SPD': (FLOAT, 1.0)},  # stick travel per s; < 0: off
                         removed=frozenset({'COM_RC_OVERRIDE', 'MPC_USE_HTE'}),
                         reports_missing=True)},
    landing_speed=('MPC_LAND_SPEED', 1.0),
    rates={**_RATES, mavlink.MAVLINK_MSG_ID_TIMESYNC: 10.0,
           mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
           mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 1.0,
           mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5, mavlink.MAVLINK_MSG_ID_CURRENT_MODE: 0.5},
    mode_message=mavlink.MAVLINK_MSG_ID_CURRENT_MODE, arming=('permission', 'armable'),
    refused=mavlink.MAV_RESULT_TEMPORARILY_REJECTED, unknown_message=mavlink.MAV_RESULT_FAILED,
    vision={'EKF2_GPS_CTRL': 0}, vision_height=('EKF2_HGT_REF', 3),
    frames=(mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_FRD),
    oldest_vision=0.2, position_timeout=0.2, reports_for=math.inf,  # EKF2_DELAY_MAX
    estimator_flags={'always': 0x65, 'at rest': 0x80, 'position': 0xA, 'aided': 0x100,
                     'absolute': 0x210},
    drift=np.array([0.1, -0.07, 0.0]),
    tilt_max=math.radians(45.0))  # MPC_TILTMAX_AIR

ARDUCOPTER: Final = Profile(
    autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    modes={
        'STABILIZE': Mode(0, LEVEL), 'ALT_HOLD': Mode(2, LEVEL),
        'GUIDED': Mode(4, SETPOINTS, ('position',)), 'LOITER': Mode(5, HOLD, ('position',)),
        'LAND': Mode(9, LAND, arms=False), 'POSHOLD': Mode(16, HOLD, ('position',)),
        'BRAKE': Mode(17, HOLD, ('position',), arms=False)},
    starts=('STABILIZE', 'LOITER'), takeoff='GUIDED',
    parameters={
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
        'VISO_QUAL_MIN': (INT8, 0),           # %, quality below which vision is refused
        'VISO_TYPE': (INT8, 0),               # 1: vision by MAVLink
        'WPNAV_SPEED': (FLOAT, 1000.0),       # cm/s, not applied to acceleration setpoints
    },
    firmwares={'4.7': Firmware()},
    landing_speed=('LAND_SPEED', 1e-2),
    rates={**_RATES, mavlink.MAVLINK_MSG_ID_TIMESYNC: 0.1,
           mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 0.0},
    mode_message=mavlink.MAVLINK_MSG_ID_HEARTBEAT, arming=('permission', 'vision', 'armable'),
    refused=mavlink.MAV_RESULT_FAILED, unknown_message=mavlink.MAV_RESULT_DENIED,
    vision={'VISO_TYPE': 1, 'EK3_SRC1_POSXY': 6}, vision_height=('EK3_SRC1_POSZ', 6),
    frames=(mavlink.MAV_FRAME_LOCAL_FRD,),
    oldest_vision=math.inf, position_timeout=7.1, reports_for=14.5,
    estimator_flags={'always': 0x25, 'position': 0x31A, 'unreported': 0x82},
    drift=np.array([0.012, -0.01, 0.0]),
    tilt_max=math.radians(30.0))  # ANGLE_MAX
PROFILES: Final[Mapping[str, Profile]] = {'px4': PX4, 'arducopter': ARDUCOPTER}
_WHOLE: Final = Range(-2**31, 2**31 - 1, whole=True)
_UNKNOWN_INDEX: Final[int] = 65535


class Parameters(dict[str, float]):
    """
    The parameters of an autopilot by name, and their MAVLink protocol.

    :param version: a key of the profile's ``firmwares``.
    """

    def __init__(self, profile: Profile, version: str) -> None:
        self._firmware = profile.firmwares[version]
        table = {**profile.parameters, **self._firmware.added}
        self._types = {name: kind for name, (kind, _) in table.items()
                       if name not in self._firmware.removed}
        super().__init__({name: float(table[name][1]) for name in self._types})
        self._px4 = profile.px4

    def set(self, name: str, value: float) -> None:
        """
        Set a value.

        :raises ValueError: for an unknown name, or a value that its type cannot hold.
        """
        if name not in self:
            raise ValueError(f'{name}: must be one of {", ".join(self)}')
        if self._types[name] == FLOAT:
            Range().check(name, value)
        else:
            _WHOLE.check(name, int(value) if float(value).is_integer() else value)
        self[name] = float(value)

    def answer(self, message: Any) -> list[Any]:
        """Answer PARAM_REQUEST_READ by name; older firmware does not answer an unknown one."""
        name = str(message.param_id)
        if name not in self:
            return [mavlink.MAVLink_param_error_message(
                message.get_srcSystem(), message.get_srcComponent(), name.encode(), -1,
                mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)] if self._firmware.reports_missing else []
        value, kind = self[name], self._types[name]
        bytewise = self._px4 and kind != FLOAT
        return [mavlink.MAVLink_param_value_message(
            name.encode(),
            struct.unpack('<f', struct.pack('<i', int(value)))[0] if bytewise else value,
            kind, len(self), _UNKNOWN_INDEX)]
