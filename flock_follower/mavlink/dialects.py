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

"""The supported autopilots as two records of data: modes, take-off, frames, messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

AUTO: Final[str] = 'auto'
#: PX4 enters its failsafe when fewer setpoints than this arrive, Hz, and accepts OFFBOARD only
#: after a stream of this rate has lasted 1 s.
MINIMUM_STREAM_RATE: Final[float] = 2.0
#: The mode numbers of ArduPilot depend on the vehicle type; these are the types of ArduCopter.
_MULTIROTORS: Final[frozenset[int]] = frozenset({
    mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_HEXAROTOR, mavlink.MAV_TYPE_OCTOROTOR, mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_DODECAROTOR, mavlink.MAV_TYPE_DECAROTOR})


def enum_name(enum: str, value: int | None) -> str:
    """Return the name of a value of an enum of MAVLink, without the name of the enum."""
    entry = mavlink.enums[enum].get(value)
    return entry.name.removeprefix(f'{enum}_') if entry else f'{enum} {value}'


class VehicleStatus(NamedTuple):
    """The vehicle's state by HEARTBEAT, or by a CURRENT_MODE after it."""

    armed: bool
    mode: str
    offboard: bool
    """Whether the mode obeys our setpoints: OFFBOARD, GUIDED."""


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """One autopilot."""

    name: str
    """Value of the parameter ``autopilot``."""
    title: str
    """Name for people."""
    firmware: int
    """MAV_AUTOPILOT."""
    modes: Mapping[str, int]
    """custom_mode by the name of the mode."""
    sub_modes: bool
    """Whether custom_mode holds a main mode in bits 16 to 23 and a sub mode in bits 24 to 31."""
    offboard: str
    """The mode that obeys our setpoints."""
    hold: str
    """The mode that keeps the position, requested when offboard ends."""
    hold_instead: tuple[str, ...]
    """Modes requested in turn if ``hold`` is refused; the last one descends."""
    arming_modes: tuple[str, ...]
    """Modes in which it arms, requested in turn if it does not arm in the present one."""
    unarmable_modes: tuple[str, ...]
    """Modes in which a flight may leave it, and in which it does not arm, or flies once armed."""
    land: str
    """The mode that lands at the present place."""
    takeoff_modes: tuple[str, ...]
    """The modes during and after a take-off."""
    takeoff_above_sea: bool
    """Whether the height of NAV_TAKEOFF is above mean sea level, else above home."""
    minimum_takeoff: str
    """Parameter of the least height of a take-off, m, whatever NAV_TAKEOFF asks for; or ''."""
    setpoints_end_takeoff: bool
    """Whether a setpoint during a take-off ends it, and one on the ground has no effect."""
    stream_before_offboard: float
    """Time for which setpoints must be sent before the autopilot accepts offboard mode, s."""
    compensates_wind: bool
    """Whether the autopilot controls accelerations in a closed loop, which rejects wind."""
    bytewise_parameters: bool
    """Whether PARAM_VALUE carries integers as their bytes, else as a float of their value."""
    odometry_frame: int
    """The only ``frame_id`` (MAV_FRAME) of ODOMETRY it accepts, with the child BODY_FRD."""
    estimator_status: int
    """Message id of the status of its estimator, see ``estimator_health``."""
    gps_switch: str
    """Parameter that is 0 if it uses no GPS; '' if zeros are no origin for it."""
    origin_has_height: bool
    """Whether the origin is sent with its height; the heights of PX4 would jump by it."""
    recommendations: str
    """File of recommended parameters in ``config/``."""
    mode_message: int
    """Message id that reports the mode, and so the pilot's switch."""
    mode_rate: float
    """Rate requested for it, Hz."""
    least_mode_rate: float
    """Rate at which it then arrives while the mode does not change, Hz."""
    reports_checks: bool = False
    """Whether it answers MAV_CMD_RUN_PREARM_CHECKS by EVENTs that name the failed checks."""
    no_reason: str = ''
    """Advice if a refusal comes without a reason."""

    def mode_name(self, custom_mode: int) -> str:
        """Return the name of a custom_mode, or its number if it has none."""
        names = {code: name for name, code in self.modes.items()}
        if not self.sub_modes:
            return names.get(custom_mode) or f'mode {custom_mode}'
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
        # PX4 1.15 has sub modes of POSCTL (orbit, slow) that fly like their main mode.
        return (names.get(main << 16 | sub << 24) or names.get(main << 16)
                or f'mode {main}.{sub}')

    def arming_mode(self, mode: str) -> str:
        """Return the mode that ``arm`` arms in: another one if this one is not to be armed in."""
        return self.arming_modes[0] if mode in self.unarmable_modes else mode

    def set_mode_parameters(self, name: str) -> tuple[float, ...]:
        """Return the parameters of MAV_CMD_DO_SET_MODE for the name of a mode."""
        code, flag = self.modes[name], float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        if self.sub_modes:
            return flag, float(code >> 16 & 0xFF), float(code >> 24)
        return flag, float(code)

    def takeoff_parameters(self, height: float, sea_level_altitude: float | None,
                           above_home: float) -> tuple[float, ...]:
        """
        Return the parameters of MAV_CMD_NAV_TAKEOFF: straight up.

        :param height: to climb, m.
        :param sea_level_altitude: of the vehicle now, m above mean sea level. None (no GPS) leaves
            the height of PX4 to ``minimum_takeoff``.
        :param above_home: of the vehicle now, m.
        """
        if not self.takeoff_above_sea:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, above_home + height
        goal = math.nan if sea_level_altitude is None else sea_level_altitude + height
        return 0.0, 0.0, 0.0, math.nan, math.nan, math.nan, goal

    def status(self, heartbeat: Any) -> VehicleStatus:
        """Return the status in a HEARTBEAT."""
        mode = self.mode_name(heartbeat.custom_mode)
        return VehicleStatus(
            bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED), mode,
            mode == self.offboard)


#: PX4 1.14 and later.
PX4: Final[Dialect] = Dialect(
    name='px4', title='PX4', firmware=mavlink.MAV_AUTOPILOT_PX4,
    modes=MappingProxyType({name: main << 16 | sub << 24 for name, main, sub in (
        ('MANUAL', 1, 0), ('ALTCTL', 2, 0), ('POSCTL', 3, 0), ('ACRO', 5, 0), ('OFFBOARD', 6, 0),
        ('STABILIZED', 7, 0), ('RATTITUDE', 8, 0), ('AUTO.READY', 4, 1), ('AUTO.TAKEOFF', 4, 2),
        ('AUTO.LOITER', 4, 3), ('AUTO.MISSION', 4, 4), ('AUTO.RTL', 4, 5), ('AUTO.LAND', 4, 6),
        ('AUTO.FOLLOW_TARGET', 4, 8), ('AUTO.PRECLAND', 4, 9))}),
    sub_modes=True, offboard='OFFBOARD', hold='AUTO.LOITER', hold_instead=('POSCTL', 'AUTO.LAND'),
    arming_modes=('AUTO.LOITER', 'POSCTL'),
    # It arms in AUTO.TAKEOFF, and climbs at once.
    unarmable_modes=('OFFBOARD', 'AUTO.LAND', 'AUTO.RTL', 'AUTO.TAKEOFF'), land='AUTO.LAND',
    takeoff_modes=('AUTO.TAKEOFF', 'AUTO.LOITER'), takeoff_above_sea=True,
    minimum_takeoff='MIS_TAKEOFF_ALT', setpoints_end_takeoff=False,
    stream_before_offboard=1.5,  # 1 s, with a margin for delays
    compensates_wind=False, bytewise_parameters=True,
    odometry_frame=mavlink.MAV_FRAME_LOCAL_NED,
    estimator_status=mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, gps_switch='EKF2_GPS_CTRL',
    origin_has_height=False, recommendations='px4.params',
    # Two changes further apart than 20 ms arrive as two messages. The cost is that of 2 Hz:
    # without a change no more are sent. A rate for HEARTBEAT would be refused.
    mode_message=mavlink.MAVLINK_MSG_ID_CURRENT_MODE, mode_rate=50.0, least_mode_rate=2.0,
    reports_checks=True,
    no_reason='PX4 sends the cause only to a ground station: look there, or set announce_as_gcs')
#: ArduCopter; its behaviour was measured on 4.7.
ARDUPILOT: Final[Dialect] = Dialect(
    name='ardupilot', title='ArduPilot', firmware=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    modes=MappingProxyType({
        'STABILIZE': 0, 'ACRO': 1, 'ALT_HOLD': 2, 'AUTO': 3, 'GUIDED': 4, 'LOITER': 5, 'RTL': 6,
        'CIRCLE': 7, 'LAND': 9, 'DRIFT': 11, 'SPORT': 13, 'FLIP': 14, 'AUTOTUNE': 15,
        'POSHOLD': 16, 'BRAKE': 17, 'THROW': 18, 'AVOID_ADSB': 19, 'GUIDED_NOGPS': 20,
        'SMART_RTL': 21, 'FLOWHOLD': 22, 'FOLLOW': 23, 'ZIGZAG': 24, 'SYSTEMID': 25,
        'AUTOROTATE': 26, 'AUTO_RTL': 27, 'TURTLE': 28}),
    # BRAKE keeps the position whatever the sticks of a transmitter do; LOITER obeys them.
    sub_modes=False, offboard='GUIDED', hold='BRAKE', hold_instead=('LAND',),
    arming_modes=('GUIDED',), unarmable_modes=('LAND', 'RTL', 'SMART_RTL', 'BRAKE'), land='LAND',
    takeoff_modes=('GUIDED',), takeoff_above_sea=False, minimum_takeoff='',
    setpoints_end_takeoff=True, stream_before_offboard=0.0, compensates_wind=True,
    bytewise_parameters=False, odometry_frame=mavlink.MAV_FRAME_LOCAL_FRD,
    estimator_status=mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    gps_switch='',  # an origin of zeros makes its firmware panic
    origin_has_height=True, recommendations='ardupilot.parm',
    # HEARTBEAT is sent at once when the mode changes; 5 Hz covers lost ones.
    mode_message=mavlink.MAVLINK_MSG_ID_HEARTBEAT, mode_rate=5.0, least_mode_rate=5.0)
DIALECTS: Final[Mapping[str, Dialect]] = MappingProxyType({
    dialect.name: dialect for dialect in (PX4, ARDUPILOT)})
#: Values of the parameter ``autopilot``.
AUTOPILOTS: Final[tuple[str, ...]] = (AUTO, *DIALECTS)


def dialect_of(heartbeat: Any, autopilot: str = AUTO) -> Dialect | None:
    """
    Return the dialect of the sender of a HEARTBEAT, None if it is not supported.

    :param autopilot: 'auto' follows the HEARTBEAT; a name requires this firmware, and accepts one
        that HEARTBEAT does not name.
    """
    sender = next((d for d in DIALECTS.values() if d.firmware == heartbeat.autopilot), None)
    if heartbeat.autopilot == mavlink.MAV_AUTOPILOT_INVALID or (  # a gimbal, a ground station
            sender is ARDUPILOT and heartbeat.type not in _MULTIROTORS):
        return None
    if autopilot == AUTO:
        return sender
    required = DIALECTS[autopilot]
    return required if sender in (None, required) else None


def describe(heartbeat: Any) -> str:
    """Return the firmware and vehicle type in a HEARTBEAT: 'ARDUPILOTMEGA FIXED_WING'."""
    return ' '.join((enum_name('MAV_AUTOPILOT', heartbeat.autopilot),
                     enum_name('MAV_TYPE', heartbeat.type)))
