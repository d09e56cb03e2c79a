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
The flight modes of ArduCopter, as far as a companion computer meets them.

Measured on ArduCopter 4.7: it arms once the EKF is ready, in modes that allow it; on the ground
setpoints do nothing, MAV_CMD_NAV_TAKEOFF comes first; a mode change has one ACK. A position that
the EKF has lost ends in its failsafe, LAND without a position. After landing it stays in LAND,
in which it does not arm. See docs/autopilots.md.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.arducopter_guided import Guided
from flock_desk.vehicles.autopilot_parameters import ARDUCOPTER, AutopilotParameters
from flock_desk.vehicles.flight_controller import (
    ACCEPTED,
    DENIED,
    FAILED,
    FlightController,
    IDLE,
    TEMPORARILY_REJECTED,
)
from flock_desk.vehicles.vehicle import Quadrotor
from flock_follower.geometry import Array

#: EKF3 gives up its position when it has had none for this long, s,
POSITION_TIMEOUT: Final[float] = 7.1
#: its check lets this pass before it acts,
_CHECK_TIME: Final[float] = 0.8
#: and after this it falls back to standing still: LOCAL_POSITION_NED ends.
_AIDING_END: Final[float] = 14.5
#: Vision is unhealthy after this, s.
VISION_HEALTHY: Final[float] = 0.3
#: The reason for not arming is repeated this often, s, from half of it on.
PREARM_PERIOD: Final[float] = 30.0
_LANDED: Final[float] = 1.0  # s on the ground that count as a landing
_NEED_POSITION: Final[frozenset[str]] = frozenset({
    'GUIDED', 'LOITER', 'RTL', 'POSHOLD', 'BRAKE'})
_ARMABLE: Final[frozenset[str]] = frozenset({
    'STABILIZE', 'ALT_HOLD', 'GUIDED', 'LOITER', 'POSHOLD'})
_AUTONOMOUS: Final[frozenset[str]] = frozenset({'GUIDED', 'LOITER', 'RTL', 'POSHOLD', 'BRAKE'})
_EXTERNAL_NAVIGATION: Final[int] = 6
_BRAKE_ACCELERATION: Final[float] = 7.5  # m/s^2, BRAKE_MODE_DECEL_RATE
_BRAKE_GAIN: Final[float] = 3.5  # 1/s
_STOPPED: Final[float] = 0.2  # m/s
# EKF_STATUS_REPORT: attitude, vertical speed and height; the horizontal all; standing still.
_ALWAYS, _HORIZONTAL, _STANDING = 0x25, 0x31A, 0x82


class ArduCopter(FlightController):
    """ArduCopter: see the module, and ``FlightController`` for the parameters."""

    AUTOPILOT = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    MODES = MappingProxyType({
        'STABILIZE': 0, 'ALT_HOLD': 2, 'GUIDED': 4, 'LOITER': 5, 'RTL': 6, 'LAND': 9,
        'POSHOLD': 16, 'BRAKE': 17})
    PLACE_MODES = ('LOITER', 'POSHOLD')
    TIMESYNC_RATE = 0.1
    DRIFT = np.array([0.012, -0.01, 0.0])

    def __init__(self, vehicle: Quadrotor, now: float, *, armed: bool,
                 parameters: AutopilotParameters | None = None, arming_denial: str = '',
                 ready_after: float = 0.0) -> None:
        super().__init__(vehicle, now, armed=armed, arming_denial=arming_denial,
                         mode='STABILIZE' if vehicle.landed else 'LOITER',
                         ready_after=ready_after,
                         parameters=parameters or AutopilotParameters(ARDUCOPTER, bytewise=False))
        self._guided = Guided(self.estimator)
        self._told_ready = not vehicle.landed
        self._told_prearm = now - PREARM_PERIOD / 2.0

    @property
    def base_mode(self) -> int:
        """Return the base_mode of HEARTBEAT."""
        flags = (mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
                 | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
                 | mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED)
        if self.mode in _AUTONOMOUS:
            flags |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
        return int(flags | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0))

    @property
    def system_status(self) -> int:
        """Return the MAV_STATE of HEARTBEAT; armed on the ground is standing by."""
        if self.in_failsafe:
            return int(mavlink.MAV_STATE_CRITICAL)
        return int(mavlink.MAV_STATE_ACTIVE if self._flown else mavlink.MAV_STATE_STANDBY)

    @property
    def landed_state(self) -> int:
        """Return the MAV_LANDED_STATE."""
        if not self._flown:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        if self.mode == 'LAND':
            return int(mavlink.MAV_LANDED_STATE_LANDING)
        taking_off = self.mode == 'GUIDED' and self._guided.taking_off
        return int(mavlink.MAV_LANDED_STATE_TAKEOFF if taking_off
                   else mavlink.MAV_LANDED_STATE_IN_AIR)

    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a setpoint, in GUIDED only."""
        if self.mode == 'GUIDED':
            self._guided.on_setpoint(message, now)

    def command_mode(self, params: tuple[float, ...], now: float) -> list[int]:
        """Change to the mode with the number param2."""
        base, number = (int(p) if math.isfinite(p) else 0 for p in params[:2])
        if not base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return [DENIED]
        names = {number: name for name, number in self.MODES.items()}
        if number not in names:
            self.say(mavlink.MAV_SEVERITY_WARNING, f'No such mode {number}')
            return [FAILED]
        return [self.change_mode(names[number], now)]

    def change_mode(self, name: str, now: float) -> int:
        """Change the mode; armed, one that needs a position is refused without."""
        # Disarmed, every mode may be chosen: arming checks.
        if self.armed and name in _NEED_POSITION and not self.position_known(now):
            self.say(mavlink.MAV_SEVERITY_WARNING,
                      f'Mode change to {name} failed: requires position')
            return FAILED
        if name != self.mode:
            self._enter(name)
        return ACCEPTED

    def arm(self, value: bool, force: bool, now: float) -> int:
        """Arm where the checks pass; disarm on the ground."""
        if value == self.armed:
            return ACCEPTED
        if not value and self._flown and not force:
            return FAILED
        if value and not force and (reason := self._unfit(now)):
            self.say(mavlink.MAV_SEVERITY_CRITICAL, f'Arm: {reason}')
            return FAILED
        self._landed_since = now
        self._guided.stop()
        self.armed = value
        self.say(mavlink.MAV_SEVERITY_INFO, f'{"Arming" if value else "Disarming"} motors')
        return ACCEPTED

    def take_off(self, altitude: float, now: float) -> int:
        """Climb to an altitude, m above home: in GUIDED, armed, and from the ground."""
        if (not self.armed or self._flown or self.mode != 'GUIDED'
                or not altitude > self.estimator.position[2]):
            return FAILED
        self._guided.take_off(altitude)
        return ACCEPTED

    def takes_odometry(self, message: Any) -> bool:
        """Return whether it is LOCAL_FRD to BODY_FRD."""
        return bool(message.frame_id == mavlink.MAV_FRAME_LOCAL_FRD
                    and message.child_frame_id == mavlink.MAV_FRAME_BODY_FRD)

    def position_known(self, now: float) -> bool:
        """Return whether there is an estimate, and vision, where it needs it, not long gone."""
        return (self.estimator.ready(now)
                and self.estimator.vision_age(now) <= POSITION_TIMEOUT)

    def tells_position(self, now: float) -> bool:
        """Return whether it sends LOCAL_POSITION_NED: longer than it is valid."""
        return self.estimator.ready(now) and self.estimator.vision_age(now) <= _AIDING_END

    def estimator_flags(self, now: float) -> int:
        """Return the flags of EKF_STATUS_REPORT."""
        if self.position_known(now):
            return _ALWAYS | _HORIZONTAL
        return _ALWAYS if self.tells_position(now) else _ALWAYS | _STANDING

    def fit(self, now: float) -> bool:
        """Return whether its checks pass."""
        return not self._unfit(now)

    def run_checks(self, now: float) -> int:
        """Say what keeps it from arming."""
        if self.armed:
            return TEMPORARILY_REJECTED
        if reason := self._unfit(now):
            self.say(mavlink.MAV_SEVERITY_CRITICAL, f'PreArm: {reason}')
        return ACCEPTED

    def _uses_vision(self) -> bool:
        return (self.parameters['VISO_TYPE'] == 1
                and self.parameters['EK3_SRC1_POSXY'] == _EXTERNAL_NAVIGATION)

    def _unfit(self, now: float) -> str:
        if self._arming_denial:
            return self._arming_denial
        if self.estimator.vision_age(now) > VISION_HEALTHY:
            return 'VisOdom: not healthy'
        if self.mode not in _ARMABLE:
            return f'{self.mode} mode not armable'
        if self.mode in _NEED_POSITION and not self.position_known(now):
            return 'Need Position Estimate'
        return ''

    def _enter(self, name: str) -> None:
        super()._enter(name)
        self._guided.stop()

    def _control(self, now: float, dt: float) -> Array:
        self._tell(now)
        if self.armed and self.mode in (*_NEED_POSITION, 'LAND') and not self.in_failsafe and (
                self.estimator.ready(now)
                and self.estimator.vision_age(now) > POSITION_TIMEOUT + _CHECK_TIME):
            self._lose_position()
        elif self.in_failsafe and self.position_known(now):
            self.say(mavlink.MAV_SEVERITY_WARNING, 'EKF Failsafe Cleared')
            self.in_failsafe = False
        if self.mode == 'GUIDED':
            return self._fly_guided(now, dt)
        if self.mode == 'LAND':
            speed = self.parameters['LAND_SPEED'] * 1e-2
            return self._descend(speed) if self.position_known(now) else self._level(-speed)
        if not self._flown:
            return IDLE
        if self.mode == 'RTL':
            return self._return(self.parameters['RTL_ALT'] * 1e-2,
                                self.parameters['LAND_SPEED'] * 1e-2)
        if self.mode == 'BRAKE' and self._place is None:
            return self._brake()
        return self._hold() if self.mode in _NEED_POSITION else self._level()

    def _brake(self) -> Array:
        """Return the acceleration that stops; at rest the place is kept."""
        velocity = self.estimator.velocity
        if np.linalg.norm(velocity) < _STOPPED:
            self._place = self.estimator.position.copy()
        return np.clip(-_BRAKE_GAIN * velocity, -_BRAKE_ACCELERATION, _BRAKE_ACCELERATION)

    def _fly_guided(self, now: float, dt: float) -> Array:
        if not self._flown and not self._guided.taking_off:
            return IDLE
        wanted = self._guided.acceleration(now, dt, self.parameters['GUID_TIMEOUT'])
        if self._guided.broken:
            # A real one does not refuse NaN; what it then does is undefined. This one lets the
            # motors idle and falls, so that no test overlooks it.
            return IDLE
        self._follow_yaw(self._guided.setpoint, dt)
        return wanted

    def _lose_position(self) -> None:
        mode = 'ALT_HOLD' if self.parameters['FS_EKF_ACTION'] == 2 else 'LAND'
        self.say(mavlink.MAV_SEVERITY_CRITICAL, 'EKF variance')
        self.say(mavlink.MAV_SEVERITY_CRITICAL, f'EKF Failsafe: changed to {mode} Mode')
        self._enter(mode)
        self.in_failsafe = True

    def _tell(self, now: float) -> None:
        if not self._told_ready and self.estimator.ready(now):
            self._told_ready = True
            source = 'external nav data' if self.estimator.uses_vision else 'GPS'
            self.say(mavlink.MAV_SEVERITY_INFO, f'EKF3 IMU0 is using {source}')
        if self.armed:
            self._told_prearm = now
        if now - self._told_prearm < PREARM_PERIOD:
            return
        self._told_prearm = now
        if reason := self._unfit(now):
            self.say(mavlink.MAV_SEVERITY_CRITICAL, f'PreArm: {reason}')

    def _watch_ground(self, now: float) -> None:
        if not self.vehicle.landed or not self.armed:
            self._landed_since = now
            return
        waited = now - self._landed_since
        if waited >= _LANDED:
            self._flown = False
        landing = self.mode in ('LAND', 'RTL')
        limit = _LANDED if landing else self.parameters['DISARM_DELAY'] or math.inf
        if waited >= limit:
            self.say(mavlink.MAV_SEVERITY_INFO, 'Disarming motors')
            self.armed = self.in_failsafe = False
