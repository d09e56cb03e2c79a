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
The supported autopilots as records: modes, take-off, frames, messages, rules.

Another autopilot is another record, its texts in ``status_texts``, and a file in config/.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.gate.vehicle_status import VehicleStatus

AUTO: Final[str] = 'auto'
#: PX4 enters its failsafe when fewer setpoints than this arrive, Hz, and accepts OFFBOARD only
#: after a stream of this rate has lasted 1 s.
MINIMUM_STREAM_RATE: Final[float] = 2.0
#: An autopilot may fly the last setpoint for this long, s. ArduPilot's default is 3 s, in which it
#: gained 8.5 m/s, at 2.5 m/s^2, and flew 36 m.
MAX_STREAM_TIMEOUT: Final[float] = 1.0
_TOO_LONG: Final[str] = (' s: it would fly the last acceleration for so long if the bridge died; '
                         f'set it to {MAX_STREAM_TIMEOUT:g} s at most')
_NOT_FUSED: Final[str] = ': it does not fuse the odometry that is forwarded to it; '
#: Bits of PX4's EKF2_EV_CTRL: horizontal position, and velocity.
_FUSED_BITS: Final[int] = 1 | 4
#: Value of ArduPilot's EK3_SRC1 parameters for external navigation.
_EXTERNAL_NAVIGATION: Final[int] = 6
#: MAV_TYPE of the vehicles that setpoints of acceleration are for.
MULTICOPTERS: Final[frozenset[int]] = frozenset({
    mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_HEXAROTOR, mavlink.MAV_TYPE_OCTOROTOR, mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_DODECAROTOR, mavlink.MAV_TYPE_DECAROTOR})
#: MAV_TYPE of the vehicles that take them while they hover.
VTOL_TYPES: Final[frozenset[int]] = frozenset(range(
    mavlink.MAV_TYPE_VTOL_TILTROTOR - 2, mavlink.MAV_TYPE_VTOL_RESERVED5 + 1))


def enum_name(enum: str, value: int | None) -> str:
    """Return the name of a value of an enum of MAVLink, without the name of the enum."""
    entry = mavlink.enums[enum].get(value)
    return entry.name.removeprefix(f'{enum}_') if entry else f'{enum} {value}'


class Version(NamedTuple):
    """The version of a firmware."""

    major: int
    minor: int
    patch: int = 0

    def __str__(self) -> str:
        return '.'.join(map(str, self))


def firmware_version(message: Any) -> Version | None:
    """Return the version in an AUTOPILOT_VERSION, None if the version is 0."""
    number = message.flight_sw_version
    version = Version(number >> 24 & 0xFF, number >> 16 & 0xFF, number >> 8 & 0xFF)
    return version if any(version) else None


class Rule(NamedTuple):
    """A parameter, and its values with which setpoints must not be flown."""

    name: str
    forbidden: Callable[[float], bool]
    advice: str
    """Reason and remedy, printed after NAME = VALUE."""
    forwarding: bool = False
    """Whether the rule matters only if odometry is forwarded."""


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """One autopilot."""

    name: str
    """Value of the parameter ``autopilot``."""
    title: str
    """Name for people."""
    firmware: int
    """Value of MAV_AUTOPILOT."""
    vehicle_types: frozenset[int]
    """The supported values of MAV_TYPE."""
    modes: Mapping[str, int]
    """custom_mode by the name of the mode."""
    sub_modes: bool
    """Whether custom_mode holds a main mode in bits 16 to 23 and a sub mode in bits 24 to 31."""
    offboard: str
    """The mode that obeys our setpoints."""
    hold: str
    """The mode that holds the position, requested when offboard ends."""
    hold_instead: tuple[str, ...]
    """Modes requested in turn if ``hold`` is refused; the last one descends."""
    arming_modes: tuple[str, ...]
    """Modes in which it arms, requested in turn if it does not arm in the present mode."""
    unarmable_modes: tuple[str, ...]
    """Modes after a flight in which the vehicle does not arm, or takes off once armed."""
    land: str
    """The mode that lands at the present place."""
    takeoff_modes: tuple[str, ...]
    """The modes during and after a take-off."""
    takeoff_above_sea: bool
    """Whether the height in NAV_TAKEOFF is above mean sea level; if not, above home."""
    minimum_takeoff: str
    """Parameter of the least height of a take-off, m; NAV_TAKEOFF cannot be lower; or ''."""
    setpoints_end_takeoff: bool
    """Whether a setpoint ends a take-off, and has no effect on the ground."""
    stream_before_offboard: float
    """Time for which setpoints must be sent before the autopilot accepts offboard mode, s."""
    compensates_wind: bool
    """Whether the autopilot controls accelerations in a closed loop, which rejects wind."""
    bytewise_parameters: bool
    """Whether PARAM_VALUE has the bytes of an integer; if not, its value as a float."""
    odometry_frame: int
    """The only accepted ``frame_id`` (MAV_FRAME) of ODOMETRY; the child is BODY_FRD."""
    estimator_status: int
    """Message id of the status of its estimator, ESTIMATOR_STATUS or EKF_STATUS_REPORT."""
    velocity_flags: tuple[int, int]
    """Flags of this status that are set, and flags that are clear, if it has a velocity."""
    gps_switch: str
    """Parameter that is 0 if the autopilot uses no GPS; '' if it accepts no zero origin."""
    origin_has_height: bool
    """Whether the origin is sent with its height; with it, PX4's heights would jump."""
    recommendations: str
    """File of recommended parameters in ``config/``."""
    offboard_rules: tuple[Rule, ...]
    """The parameters that forbid offboard."""
    versions: tuple[tuple[int, int], tuple[int, int]]
    """The oldest and the newest known firmware, major and minor."""
    watched: tuple[str, ...]
    """More parameters that may not change in flight: failsafe, frame, height."""
    hover_thrust: str
    """Parameter of the hover thrust."""
    mode_message: int
    """Id of the message that reports the mode, and so the pilot's switch."""
    mode_rate: float
    """Requested rate of this message, Hz."""
    least_mode_rate: float
    """Rate of this message while the mode does not change, Hz."""
    pilot_modes: tuple[str, ...] = ()
    """Modes that no failsafe enters; () if unknown."""
    position: str = ''
    """The mode that the bridge requests if the pilot moves a stick; '': the hold mode."""
    stick_speed: str = ''
    """Parameter of the stick speed above which the autopilot gives control; '' if none."""
    reports_checks: bool = False
    """Whether it answers MAV_CMD_RUN_PREARM_CHECKS by EVENTs that name the failed checks."""
    no_reason: str = ''
    """Advice if a refusal comes without a reason."""

    @property
    def known_versions(self) -> str:
        """Return the range of ``versions``, for people."""
        oldest, newest = ('.'.join(map(str, version)) for version in self.versions)
        return f'{self.title} {oldest} to {newest}'

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
        """Return the mode in which ``arm`` arms: this mode, or another if it cannot be armed."""
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
    vehicle_types=MULTICOPTERS | VTOL_TYPES,
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
    estimator_status=mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
    # The second one is whether any source of horizontal motion is in use: cleared 0.6 s after
    # vision is gone, the first only after 5 s.
    velocity_flags=(mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL, 0),
    gps_switch='EKF2_GPS_CTRL', origin_has_height=False, recommendations='px4.params',
    versions=((1, 14), (1, 18)), offboard_rules=(
        Rule('COM_OF_LOSS_T', lambda value: value > MAX_STREAM_TIMEOUT, _TOO_LONG),
        Rule('COM_OBL_RC_ACT', lambda value: value in (6, 7),
             ': it would stop its motors in the air (6: terminate, 7: disarm) if the bridge died; '
             'set it to 5 (Hold), or 4 (Land) where odometry is forwarded'),
        Rule('EKF2_EV_CTRL', lambda value: not (
            math.isfinite(value) and int(value) & _FUSED_BITS == _FUSED_BITS),
             f'{_NOT_FUSED}set bits 0 (horizontal position) and 2 (velocity), as 13 does',
             forwarding=True)),
    watched=('NAV_RCL_ACT', 'COM_LOW_BAT_ACT', 'COM_RCL_EXCEPT', 'GF_ACTION', 'EKF2_GPS_CTRL',
             'EKF2_HGT_REF', 'EKF2_MAG_TYPE'),
    hover_thrust='MPC_THR_HOVER',
    # Two changes further apart than 20 ms arrive as two messages. The cost is that of 2 Hz:
    # without a change no more are sent. A rate for HEARTBEAT would be refused.
    mode_message=mavlink.MAVLINK_MSG_ID_CURRENT_MODE, mode_rate=50.0, least_mode_rate=2.0,
    position='POSCTL', stick_speed='MAN_OVERRIDE_SPD', reports_checks=True,
    no_reason='PX4 sends the cause only to a ground station: look there, or set announce_as_gcs')
#: ArduCopter; its behavior was measured on 4.7.
ARDUPILOT: Final[Dialect] = Dialect(
    name='ardupilot', title='ArduPilot', firmware=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    # Its mode numbers depend on the vehicle type.
    vehicle_types=MULTICOPTERS,
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
    # At a position that it assumes constant it integrates nothing.
    velocity_flags=(mavlink.EKF_VELOCITY_HORIZ, mavlink.EKF_CONST_POS_MODE),
    gps_switch='',  # an origin of zeros makes its firmware panic
    origin_has_height=True, recommendations='ardupilot.parm',
    versions=((4, 6), (4, 7)), offboard_rules=(
        Rule('GUID_TIMEOUT', lambda value: value > MAX_STREAM_TIMEOUT, _TOO_LONG),
        Rule('VISO_TYPE', lambda value: value == 0, f'{_NOT_FUSED}set it to 1 (MAVLink)',
             forwarding=True),
        *(Rule(f'EK3_SRC1_{source}', lambda value: value != _EXTERNAL_NAVIGATION,
               f'{_NOT_FUSED}set it to {_EXTERNAL_NAVIGATION} (ExternalNav)', forwarding=True)
          for source in ('POSXY', 'VELXY'))),
    watched=('FS_THR_ENABLE', 'BATT_FS_LOW_ACT', 'BATT_FS_CRT_ACT', 'FENCE_ACTION',
             'EK3_SRC1_POSZ', 'EK3_SRC1_VELZ', 'EK3_SRC1_YAW'),
    hover_thrust='MOT_THST_HOVER',
    # HEARTBEAT is sent at once when the mode changes; 5 Hz covers lost ones.
    mode_message=mavlink.MAVLINK_MSG_ID_HEARTBEAT, mode_rate=5.0, least_mode_rate=5.0,
    pilot_modes=('STABILIZE', 'ACRO', 'LOITER', 'POSHOLD', 'SPORT', 'DRIFT', 'FLOWHOLD'))
DIALECTS: Final[Mapping[str, Dialect]] = MappingProxyType({
    dialect.name: dialect for dialect in (PX4, ARDUPILOT)})
#: Values of the parameter ``autopilot``.
AUTOPILOTS: Final[tuple[str, ...]] = (AUTO, *DIALECTS)


def dialect_of(heartbeat: Any, autopilot: str = AUTO) -> Dialect | None:
    """
    Return the dialect of the sender of a HEARTBEAT, None if it is not supported.

    :param autopilot: 'auto' takes the firmware in the HEARTBEAT; a name requires this firmware,
        and also accepts a HEARTBEAT that names no firmware.
    """
    sender = next((d for d in DIALECTS.values() if d.firmware == heartbeat.autopilot), None)
    if heartbeat.autopilot == mavlink.MAV_AUTOPILOT_INVALID or (  # a gimbal, a ground station
            sender is not None and heartbeat.type not in sender.vehicle_types):
        return None
    if autopilot == AUTO:
        return sender
    required = DIALECTS[autopilot]
    return required if sender in (None, required) else None


def describe(heartbeat: Any) -> str:
    """Return the firmware and vehicle type in a HEARTBEAT: 'ARDUPILOTMEGA FIXED_WING'."""
    return ' '.join((enum_name('MAV_AUTOPILOT', heartbeat.autopilot),
                     enum_name('MAV_TYPE', heartbeat.type)))
