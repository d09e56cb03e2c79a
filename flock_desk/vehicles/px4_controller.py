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

Measured on PX4 1.16, see docs/autopilots.md. Somebody chooses a mode, and PX4 flies it as long as
it can: OFFBOARD needs a setpoint within COM_OF_LOSS_T (1 s), Hold a global position, that is GPS
or an origin. Where it cannot, a failsafe flies another (COM_OBL_RC_ACT for a lost stream), and
ends by itself when the chosen mode can be flown again: setpoints alone bring OFFBOARD back.
Disarmed, any mode may be chosen, but arming needs one that can be flown; after landing the mode
from before is back. No speed limit applies to acceleration setpoints; vertical acceleration 0
leaves the height open; DO_SET_MODE is answered twice; when external vision stops OFFBOARD stays,
and drifts. On the ground the motors idle until something asks upwards, see ``px4_takeoff``.
"""

from __future__ import annotations

import math
import struct
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles import arming_checks
from flock_desk.vehicles.arming_checks import Check
from flock_desk.vehicles.autopilot_parameters import AutopilotParameters, PX4
from flock_desk.vehicles.equipment import GROUND_AMSL
from flock_desk.vehicles.flight_controller import (
    ACCEPTED,
    Event,
    FAILED,
    FlightController,
    IDLE,
    TEMPORARILY_REJECTED,
    TrackedSetpoint,
    UNSUPPORTED,
)
from flock_desk.vehicles.px4_failsafe import (
    failsafe,
    HOLD,
    LAND,
    OFFBOARD,
    RETURN,
    STICK_MODES,
    TAKEOFF,
)
from flock_desk.vehicles.px4_setpoint import decode_setpoint
from flock_desk.vehicles.px4_takeoff import DESCENT, LandDetector, Takeoff
from flock_desk.vehicles.vehicle import GRAVITY, Quadrotor
from flock_follower.geometry import Array

_MANUAL: Final[tuple[str, ...]] = ('MANUAL', 'ALTCTL', 'STABILIZED')
#: Modes that do not arm, and do not come back after landing.
_LANDING: Final[tuple[str, ...]] = (LAND, RETURN)
#: Without vision for this long, s, the estimate rests on the accelerometer.
AIDING_TIMEOUT: Final[float] = 0.55
_ARRIVED: Final[float] = 0.1  # m below the take-off altitude
_SETPOINT_MAX_AGE: Final[float] = 1.0  # s; an older one does not ask for a take-off
# MAVLink's variances on the diagonal of the upper triangle of a 6 x 6 covariance.
_VARIANCES: Final[tuple[int, ...]] = (0, 6, 11, 15, 18, 20)
# ESTIMATOR_STATUS: attitude, vertical speed, heights; horizontal speed and relative position;
# horizontal aiding; with an origin the same absolutely; resting on the ground.
_ALWAYS, _HORIZONTAL, _AIDED, _ABSOLUTE, _AT_REST = 0x65, 0xA, 0x100, 0x210, 0x80


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
    DRIFT = np.array([0.1, -0.07, 0.0])
    TEXT_END = '\t'  # PX4 ends texts with a tab where it also sends them as events
    TALKS_TO_GCS_ONLY = True
    UNKNOWN_MESSAGE = FAILED

    def __init__(self, vehicle: Quadrotor, now: float, *, armed: bool,
                 parameters: AutopilotParameters | None = None, arming_denial: str = '',
                 ready_after: float = 0.0) -> None:
        super().__init__(vehicle, now, armed=armed, arming_denial=arming_denial, mode=HOLD,
                         ready_after=ready_after,
                         parameters=parameters or AutopilotParameters(PX4, bytewise=True))
        if self.estimator.uses_vision and not vehicle.landed:
            # Without an origin there is no Hold: it stays in the mode that took it up there.
            self.mode = TAKEOFF
            self.estimator.assume(now)
        self._chosen = self._after_disarming = self.mode
        self._sticks = False
        self._setpoint: TrackedSetpoint | None = None
        self._setpoint_time = -math.inf
        self._takeoff = Takeoff(flying=not vehicle.landed)
        self._detector = LandDetector(landed=bool(vehicle.landed))
        self._descends = False
        self._reported: list[Check] | None = None
        self._report_time = -math.inf

    @property
    def base_mode(self) -> int:
        """Return the base_mode of HEARTBEAT."""
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return int(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed)

    @property
    def intended_mode(self) -> int:
        """Return the custom_mode of the mode that somebody chose; a failsafe may fly another."""
        return self.MODES[self._chosen]

    @property
    def system_status(self) -> int:
        """Return the MAV_STATE of HEARTBEAT."""
        if self.armed:
            return int(mavlink.MAV_STATE_CRITICAL if self.in_failsafe
                       else mavlink.MAV_STATE_ACTIVE)
        fit = arming_checks.may_arm(self._failing(self._time), self.mode)
        return int(mavlink.MAV_STATE_STANDBY if fit else mavlink.MAV_STATE_UNINIT)

    @property
    def landed_state(self) -> int:
        """Return the MAV_LANDED_STATE."""
        if self._detector.landed:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        return int({TAKEOFF: mavlink.MAV_LANDED_STATE_TAKEOFF,
                    LAND: mavlink.MAV_LANDED_STATE_LANDING}.get(
                        self.mode, mavlink.MAV_LANDED_STATE_IN_AIR))

    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a setpoint, in whatever mode, unless it is one PX4 drops."""
        setpoint = decode_setpoint(message)
        if setpoint is not None:
            self._setpoint, self._setpoint_time = setpoint, now

    def command_mode(self, params: tuple[float, ...], now: float) -> list[int]:
        """Change to the main mode of param2 and the sub mode of param3; there are two ACKs."""
        base, main, sub = (int(p) if math.isfinite(p) else 0 for p in params[:3])
        names = {number: name for name, number in self.MODES.items()}
        name = names.get(main << 16 | sub << 24, f'{main}.{sub}')
        custom = base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        # The first says accepted, whatever becomes of it.
        return [ACCEPTED, self.change_mode(name, now) if custom else UNSUPPORTED]

    def change_mode(self, name: str, now: float) -> int:
        """Change the mode: disarmed to any, armed to what can be flown, and always to land."""
        if name not in self.MODES:
            return TEMPORARILY_REJECTED
        if self.armed and name != LAND and not arming_checks.may_run(self._failing(now), name):
            return TEMPORARILY_REJECTED  # without a word, see docs/autopilots.md
        if name == TAKEOFF:
            return self.take_off(math.nan, now)
        self._choose(name, now)
        return ACCEPTED

    def arm(self, value: bool, force: bool, now: float) -> int:
        """Arm where the mode can be flown, even where forced; disarm on the ground."""
        if value == self.armed:
            return ACCEPTED
        if not value and not self._detector.landed and not force:
            self._tell(mavlink.MAV_SEVERITY_CRITICAL, 'Disarming denied: not landed',
                       'commander_disarm_denied_not_landed')
            return TEMPORARILY_REJECTED
        if value and not arming_checks.may_arm(self._failing(now), self.mode):
            if self._arming_denial:
                self.say(mavlink.MAV_SEVERITY_CRITICAL, f'Preflight Fail: {self._arming_denial}')
            self._tell(mavlink.MAV_SEVERITY_CRITICAL,
                       'Arming denied: Resolve system health failures first',
                       'commander_arm_denied_resolve_failures')
            return TEMPORARILY_REJECTED
        self._landed_since = now
        if value:
            self.armed = True
        else:
            self._disarm(now)
        self._tell(mavlink.MAV_SEVERITY_INFO,
                   f'{"Armed" if value else "Disarmed"} by external command',
                   'commander_armed_by' if value else 'commander_disarmed_by', b'\x04')
        return ACCEPTED

    def take_off(self, altitude: float, now: float) -> int:
        """
        Climb to an altitude, m above sea level, then hold; once armed, where it is not.

        NaN, and what is lower, becomes MIS_TAKEOFF_ALT above the ground.
        """
        if self.armed and not arming_checks.may_run(self._failing(now), TAKEOFF):
            self._tell(mavlink.MAV_SEVERITY_CRITICAL,
                       'Switching to Takeoff is currently not available',
                       'commander_modeswitch_not_avail')
            return TEMPORARILY_REJECTED
        lowest = self.parameters['MIS_TAKEOFF_ALT']
        height = lowest if math.isnan(altitude) else altitude - GROUND_AMSL
        if height < lowest:
            height = lowest
            self.say(mavlink.MAV_SEVERITY_CRITICAL,
                      f'Using minimum takeoff altitude: {lowest:.2f} m')
        self._choose(TAKEOFF, now)
        position = self.estimator.position
        self._place = np.array([*position[:2], max(height, float(position[2]))])
        return ACCEPTED

    def run_checks(self, now: float) -> int:
        """Report what is not well, as MAV_CMD_RUN_PREARM_CHECKS asks for."""
        self._report(self._failing(now), now)
        return ACCEPTED

    def pilot_switches(self, name: str, climb: float = 0.0) -> None:
        """Change the mode by remote control; from then on there is one."""
        self._sticks = True
        super().pilot_switches(name, climb)
        self._chosen = name
        if name not in _LANDING:
            self._after_disarming = name

    def takes_odometry(self, message: Any) -> bool:
        """Return whether it is LOCAL_NED or LOCAL_FRD to BODY_FRD, with its variances filled."""
        variances = [matrix[i] for matrix in (message.pose_covariance, message.velocity_covariance)
                     for i in _VARIANCES]
        return (message.frame_id in (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_FRD)
                and message.child_frame_id == mavlink.MAV_FRAME_BODY_FRD
                and all(math.isfinite(v) and v > 0.0 for v in variances))

    def position_known(self, now: float) -> bool:
        """Return whether the position is valid: EKF2_NOAID_TOUT without vision it is not."""
        patience = self.parameters['EKF2_NOAID_TOUT'] * 1e-6 + self.OLDEST_VISION
        return self.estimator.ready(now) and self.estimator.vision_age(now) <= patience

    def tells_position(self, now: float) -> bool:
        """Return whether it sends LOCAL_POSITION_NED: valid or not."""
        return self.estimator.started(now)

    def estimator_flags(self, now: float) -> int:
        """Return the flags of ESTIMATOR_STATUS."""
        flags = _ALWAYS | (_AT_REST if self._detector.landed else 0)
        if self.position_known(now):
            flags |= _HORIZONTAL
        if self.estimator.ready(now) and self.estimator.vision_age(now) <= AIDING_TIMEOUT:
            flags |= _AIDED | (_ABSOLUTE if self.has_origin else 0)
        return flags

    def fit(self, now: float) -> bool:
        """Return whether it would arm in the mode it is in."""
        return arming_checks.may_arm(self._failing(now), self.mode)

    def _uses_vision(self) -> bool:
        return self.parameters['EKF2_GPS_CTRL'] == 0

    def _stream_lost(self, now: float) -> bool:
        return now - self._setpoint_time > self.parameters['COM_OF_LOSS_T']

    def _failing(self, now: float) -> list[Check]:
        """Return the checks that fail."""
        local = self.position_known(now)
        wrong = {
            arming_checks.DENIAL: bool(self._arming_denial) and not self.armed,
            arming_checks.NOT_FOR_ARMING: not self.armed and self.mode in _LANDING,
            arming_checks.LOCAL_POSITION: not local,
            arming_checks.GLOBAL_POSITION: not (local and self.has_origin),
            arming_checks.MISSION: True,
            arming_checks.OFFBOARD_SIGNAL: self._stream_lost(now),
            arming_checks.STICKS: not self._sticks,
            arming_checks.GROUND_STATION: not self.gcs_heard}
        return [check for check, fails in wrong.items() if fails]

    def _choose(self, name: str, now: float) -> None:
        self._chosen = name
        if name not in _LANDING:
            self._after_disarming = name
        if name != self.mode or self.in_failsafe:
            self._enter(name)
        self.in_failsafe = False
        self._supervise(now)

    def _disarm(self, now: float) -> None:
        self.armed = False
        self._chosen = self._after_disarming
        self._supervise(now)

    def _supervise(self, now: float) -> None:
        """Fly the chosen mode where that is possible, else what the failsafe says."""
        acts = failsafe(self._chosen, self._failing(now),
                        int(self.parameters['COM_OBL_RC_ACT'])) if self.armed else None
        mode = acts.mode if acts else self._chosen
        news = bool(acts) and not self.in_failsafe
        if mode != self.mode:
            news = bool(acts)
            self._enter(mode)
        if acts and news:
            self._tell(mavlink.MAV_SEVERITY_CRITICAL, 'Failsafe activated',
                       f'commander_failsafe_enter_{acts.event}',
                       struct.pack('<IB', self.MODES[self._chosen], acts.number))
        self.in_failsafe = bool(acts)
        if acts and acts.disarms:
            self._disarm(now)

    def _control(self, now: float, dt: float) -> Array:
        self._supervise(now)
        self._takeoff.step(self.armed, self._detector.landed, self._wants_takeoff(now), dt,
                           spool_up=self.parameters['COM_SPOOLUP_TIME'],
                           ramp=self.parameters['MPC_TKO_RAMP_T'])
        self._climb_limit = self._takeoff.climb_limit
        self._descends = False
        wanted = self._fly(now, dt)
        if not self._takeoff.left:
            wanted = IDLE
        self._detect_landing(float(wanted[2]) + GRAVITY, dt)
        return wanted

    def _wants_takeoff(self, now: float) -> bool:
        """Return whether a setpoint asks upwards."""
        height = float(self.estimator.position[2])
        if self.mode in (TAKEOFF, 'POSCTL'):
            return self._place is not None and float(self._place[2]) > height
        setpoint = self._setpoint
        if (self.mode != OFFBOARD or setpoint is None
                or now - self._setpoint_time >= _SETPOINT_MAX_AGE):
            return False
        if setpoint.position[2] > height or setpoint.velocity[2] > 0.0:
            return True
        return bool(setpoint.acceleration[2] > 0.0)

    def _track(self, setpoint: TrackedSetpoint) -> Array:
        self._descends = bool(setpoint.velocity[2] <= -DESCENT)
        return super()._track(setpoint)

    def _detect_landing(self, thrust: float, dt: float) -> None:
        detector, landed = self._detector, self._detector.landed
        detector.step(armed=self.armed, thrust=thrust, descends=self._descends,
                      rests=bool(self.vehicle.landed), dt=dt)
        if self.armed and landed != detector.landed:
            what = 'Landing' if detector.landed else 'Takeoff'
            self._tell(mavlink.MAV_SEVERITY_INFO, f'{what} detected',
                       f'commander_{what.lower()}_detected')

    def _fly(self, now: float, dt: float) -> Array:
        """Return the wanted acceleration (3,), m/s^2, of the mode that is flown."""
        failing = self._failing(now)
        if failing != self._reported and (
                now - self._report_time >= arming_checks.REPORT_PERIOD):
            self._report(failing, now)
        if self.mode == OFFBOARD and self._setpoint is not None:
            self._follow_yaw(self._setpoint, dt)
            return self._track(self._setpoint)
        speed = self.parameters['MPC_LAND_SPEED']
        if self.mode == LAND:
            # PX4's Descend has no position to rely on: level, and down.
            return self._descend(speed) if self.position_known(now) else self._level(-speed)
        if self.in_failsafe and self.mode in STICK_MODES and not self._sticks:
            return self._descend(speed) if self.position_known(now) else self._level(-speed)
        if self.mode == RETURN:
            return self._return(self.parameters['RTL_RETURN_ALT'], speed)
        if self.mode == TAKEOFF and self.armed and self._place is not None and (
                self.estimator.position[2] >= self._place[2] - _ARRIVED
                and arming_checks.may_run(failing, HOLD)):
            place = self._place
            self._choose(HOLD, now)
            self._place = place
        if self.mode in _MANUAL:
            return self._level()
        return self._hold()

    def _report(self, failing: list[Check], now: float) -> None:
        self._reported, self._report_time = failing, now
        self.events += arming_checks.report(failing)

    def _tell(self, severity: int, text: str, event: str, arguments: bytes = b'') -> None:
        """Say something both ways."""
        self.say(severity, text)
        self.events.append(Event(event, severity, arguments))

    def _watch_ground(self, now: float) -> None:
        if not self._detector.landed or not self.armed:
            self._landed_since = now
            return
        limit = self.parameters['COM_DISARM_LAND' if self._flown else 'COM_DISARM_PRFLT']
        if 0.0 < limit <= now - self._landed_since:
            self._tell(mavlink.MAV_SEVERITY_INFO, 'Disarmed by landing' if self._flown else
                       'Disarmed by auto preflight disarming', 'commander_disarmed_by',
                       b'\x06' if self._flown else b'\x07')
            self._flown = self.in_failsafe = False
            self._disarm(now)
