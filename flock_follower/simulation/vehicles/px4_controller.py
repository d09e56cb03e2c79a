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
The flight modes of a PX4 quadrotor, as far as a companion computer meets them.

Measured on PX4 1.16: OFFBOARD is refused without a stream of setpoints at 2 Hz or more for 1 s;
when the stream stops, the last setpoint is obeyed for COM_OF_LOSS_T (1 s), then a failsafe acts
(COM_OBL_RC_ACT; without remote control it descends); no speed limit applies to acceleration
setpoints; vertical acceleration 0 leaves the height open; DO_SET_MODE is answered twice; when
external vision stops it stays in OFFBOARD and drifts.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.geometry import Array, ned_to_enu, yaw_ned_to_enu
from flock_follower.simulation.vehicles.autopilot_parameters import AutopilotParameters, PX4
from flock_follower.simulation.vehicles.flight_controller import (
    ACCEPTED,
    FlightController,
    GROUND_AMSL,
    TEMPORARILY_REJECTED,
    TrackedSetpoint,
    UNSUPPORTED,
)
from flock_follower.simulation.vehicles.vehicle import Quadrotor

OFFBOARD: Final[str] = 'OFFBOARD'
HOLD: Final[str] = 'AUTO.LOITER'
LAND: Final[str] = 'AUTO.LAND'
TAKEOFF: Final[str] = 'AUTO.TAKEOFF'
RETURN: Final[str] = 'AUTO.RTL'
_MANUAL: Final[tuple[str, ...]] = ('MANUAL', 'ALTCTL', 'STABILIZED')
#: The stream that OFFBOARD wants: this rate, Hz, for this long, s.
STREAM_RATE: Final[float] = 2.0
STREAM_DURATION: Final[float] = 1.0
_ARRIVED: Final[float] = 0.1  # m below the take-off altitude
# COM_OBL_RC_ACT; what is not here needs a remote control, and falls back to descending.
_LOSS_ACTIONS: Final[Mapping[int, str]] = {3: RETURN, 4: LAND, 5: HOLD}
_TERMINATE, _DISARM = 6, 7
# MAVLink's variances on the diagonal of the upper triangle of a 6 x 6 covariance.
_VARIANCES: Final[tuple[int, ...]] = (0, 6, 11, 15, 18, 20)


class Px4Controller(FlightController):
    """PX4: see the module, and ``FlightController`` for the parameters."""

    AUTOPILOT = mavlink.MAV_AUTOPILOT_PX4
    # Main mode in the third byte, sub mode in the fourth. Written out here, not taken from the
    # bridge: a mistake there must not hide itself.
    MODES = MappingProxyType({name: main << 16 | sub << 24 for name, main, sub in (
        ('MANUAL', 1, 0), ('ALTCTL', 2, 0), ('POSCTL', 3, 0), (TAKEOFF, 4, 2), (HOLD, 4, 3),
        (RETURN, 4, 5), (LAND, 4, 6), (OFFBOARD, 6, 0), ('STABILIZED', 7, 0))})
    PLACE_MODES = ('POSCTL',)
    TIMESYNC_RATE = 10.0
    OLDEST_VISION = 0.2  # EKF2_DELAY_MAX
    TEXT_END = '\t'  # PX4 ends texts with a tab where it also sends them as events

    def __init__(self, vehicle: Quadrotor, now: float, *, armed: bool,
                 parameters: AutopilotParameters | None = None, arming_denial: str = '',
                 ready_after: float = 0.0) -> None:
        super().__init__(vehicle, now, armed=armed, arming_denial=arming_denial, mode=HOLD,
                         ready_after=ready_after,
                         parameters=parameters or AutopilotParameters(PX4, bytewise=True))
        self._setpoint: TrackedSetpoint | None = None
        self._setpoint_time = -math.inf
        self._stream_since = -math.inf

    @property
    def base_mode(self) -> int:
        """Return the base_mode of HEARTBEAT."""
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return int(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed)

    @property
    def system_status(self) -> int:
        """Return the MAV_STATE of HEARTBEAT."""
        if not self.armed:
            return int(mavlink.MAV_STATE_STANDBY)
        return int(mavlink.MAV_STATE_CRITICAL if self.in_failsafe else mavlink.MAV_STATE_ACTIVE)

    @property
    def landed_state(self) -> int:
        """Return the MAV_LANDED_STATE."""
        if self.vehicle.landed:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        return int({TAKEOFF: mavlink.MAV_LANDED_STATE_TAKEOFF,
                    LAND: mavlink.MAV_LANDED_STATE_LANDING}.get(
                        self.mode, mavlink.MAV_LANDED_STATE_IN_AIR))

    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a setpoint, in whatever mode, unless it is one PX4 drops."""
        setpoint = decode_setpoint(message)
        if setpoint is None:
            return
        if now - self._setpoint_time > 1.0 / STREAM_RATE:
            self._stream_since = now
        self._setpoint, self._setpoint_time = setpoint, now

    def offboard_available(self, now: float) -> bool:
        """Return whether setpoints have come often enough for long enough."""
        return (now - self._setpoint_time <= 1.0 / STREAM_RATE
                and now - self._stream_since >= STREAM_DURATION)

    def command_mode(self, params: tuple[float, ...], now: float) -> list[int]:
        """Change to the main mode of param2 and the sub mode of param3; there are two ACKs."""
        base, main, sub = (int(p) if math.isfinite(p) else 0 for p in params[:3])
        names = {number: name for name, number in self.MODES.items()}
        name = names.get(main << 16 | sub << 24, f'{main}.{sub}')
        custom = base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        # The first says accepted, whatever becomes of it.
        return [ACCEPTED, self.change_mode(name, now) if custom else UNSUPPORTED]

    def change_mode(self, name: str, now: float) -> int:
        """Change the mode where it is available."""
        if name not in self.MODES or (name == OFFBOARD and not self.offboard_available(now)):
            self._say(mavlink.MAV_SEVERITY_CRITICAL,
                      f"Switching to mode '{name}' is currently not possible")
            if name == OFFBOARD:
                self._say(mavlink.MAV_SEVERITY_CRITICAL, 'No offboard signal')
            return TEMPORARILY_REJECTED
        if name == TAKEOFF:
            return self.take_off(math.nan, now)
        self._enter(name)
        self.in_failsafe = False
        return ACCEPTED

    def arm(self, value: bool, force: bool, now: float) -> int:
        """Arm with a position and, in OFFBOARD, a stream; disarm on the ground."""
        if value == self.armed:
            return ACCEPTED
        if not value and not self.vehicle.landed and not force:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, 'Disarming denied: not landed')
            return TEMPORARILY_REJECTED
        if value and not force and (reason := self._unfit(now)):
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f'Arming denied: {reason}')
            return TEMPORARILY_REJECTED
        self._landed_since = now
        self.armed = value
        self._say(mavlink.MAV_SEVERITY_INFO,
                  f'{"Armed" if value else "Disarmed"} by external command')
        return ACCEPTED

    def take_off(self, altitude: float, now: float) -> int:
        """
        Climb to an altitude, m above sea level, then hold; once armed, where it is not.

        NaN, and what is lower, becomes MIS_TAKEOFF_ALT above the ground.
        """
        lowest = self.parameters['MIS_TAKEOFF_ALT']
        height = lowest if math.isnan(altitude) else altitude - GROUND_AMSL
        if height < lowest:
            height = lowest
            self._say(mavlink.MAV_SEVERITY_CRITICAL,
                      f'Using minimum takeoff altitude: {lowest:.2f} m')
        self._enter(TAKEOFF)
        self.in_failsafe = False
        position = self.estimator.position
        self._place = np.array([*position[:2], max(height, float(position[2]))])
        return ACCEPTED

    def takes_odometry(self, message: Any) -> bool:
        """Return whether it is LOCAL_NED or LOCAL_FRD to BODY_FRD, with its variances filled."""
        variances = [matrix[i] for matrix in (message.pose_covariance, message.velocity_covariance)
                     for i in _VARIANCES]
        return (message.frame_id in (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_FRD)
                and message.child_frame_id == mavlink.MAV_FRAME_BODY_FRD
                and all(math.isfinite(v) and v > 0.0 for v in variances))

    def position_known(self, now: float) -> bool:
        """Return whether there is an estimate; it stays when vision stops, and drifts."""
        return self.estimator.ready(now)

    def _uses_vision(self) -> bool:
        return self.parameters['EKF2_GPS_CTRL'] == 0

    def _unfit(self, now: float) -> str:
        if self._arming_denial:
            return self._arming_denial
        if self.mode not in _MANUAL and not self.position_known(now):
            return 'No valid local position estimate'
        if self.mode == OFFBOARD and not self.offboard_available(now):
            return 'No offboard signal'
        return ''

    def _control(self, now: float, dt: float) -> Array:
        lost = now - self._setpoint_time > self.parameters['COM_OF_LOSS_T']
        if self.mode == OFFBOARD and lost:
            self._lose_offboard()
        if self.mode == OFFBOARD and self._setpoint is not None:
            self._follow_yaw(self._setpoint, dt)
            return self._track(self._setpoint)
        if self.mode == LAND:
            speed = self.parameters['MPC_LAND_SPEED']
            # PX4's Descend has no position to rely on: level, and down.
            return self._level(-speed) if self.in_failsafe else self._descend(speed)
        if self.mode == RETURN:
            return self._return(self.parameters['RTL_RETURN_ALT'], LAND)
        if self.mode == TAKEOFF and self.armed and self._place is not None and (
                self.estimator.position[2] >= self._place[2] - _ARRIVED):
            place = self._place
            self._enter(HOLD)
            self._place = place
        if self.mode in _MANUAL:
            return self._level()
        return self._hold()

    def _lose_offboard(self) -> None:
        action = int(self.parameters['COM_OBL_RC_ACT'])
        self._enter(_LOSS_ACTIONS.get(action, LAND))
        self.in_failsafe = self.armed
        if not self.armed:
            return
        words = {RETURN: 'return', HOLD: 'hold', LAND: 'descending'}[self.mode]
        if action in (_TERMINATE, _DISARM):
            self.armed, words = False, 'terminate'
        self._say(mavlink.MAV_SEVERITY_CRITICAL,
                  f'Failsafe activated: no offboard signal, {words}')

    def _watch_ground(self, now: float) -> None:
        if not self.vehicle.landed or not self.armed:
            self._landed_since = now
            return
        limit = self.parameters['COM_DISARM_LAND' if self._flown else 'COM_DISARM_PRFLT']
        if 0.0 < limit <= now - self._landed_since:
            self._say(mavlink.MAV_SEVERITY_INFO, 'Disarmed by landing' if self._flown else
                      'Disarmed by auto preflight disarming')
            self.armed = self.in_failsafe = self._flown = False


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
