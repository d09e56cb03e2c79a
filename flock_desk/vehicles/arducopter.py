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
ArduCopter as a companion computer uses it: GUIDED, take-off, landing, the EKF failsafe.

Measured on ArduCopter 4.7, and by its source code, see docs/autopilots.md. On the ground setpoints
have no effect: MAV_CMD_NAV_TAKEOFF comes first. A group of three ignore bits counts as set if any
of them is: setpoints of mixed axes stop the vehicle without a message. Here setpoints of position
and velocity, which the bridge never sends, do so, too. NaN is not checked, and no speed limit
applies to accelerations. Without setpoints the last one is flown for GUID_TIMEOUT (3 s); then the
vehicle stops. Unlike PX4, ArduCopter integrates an acceleration to a velocity and a position, and
holds those: vertical acceleration 0 keeps the height. If the EKF loses its position, the vehicle
enters LAND without a position. After landing it stays in LAND, in which it cannot be armed.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.flight_controller import (
    ACCEPTED,
    ARRIVED,
    decode_setpoint,
    FlightController,
    IDLE,
    POSITION_GAIN,
    VELOCITY_GAIN,
)
from flock_desk.vehicles.profiles import ARDUCOPTER, LAND
from flock_follower.geometry import Array

_CHECK_TIME: Final[float] = 0.8
PREARM_PERIOD: Final[float] = 30.0
_LANDED: Final[float] = 1.0  # s on the ground that count as a landing
_BRAKE_ACCELERATION: Final[float] = 7.5  # m/s^2, BRAKE_MODE_DECEL_RATE
_BRAKE_GAIN: Final[float] = 3.5  # 1/s
_STOP_ACCELERATION: Final[float] = 2.5  # m/s^2, WPNAV_ACCEL
_POSITION_BITS, _VELOCITY_BITS, _ACCELERATION_BITS = 0b111, 0b111 << 3, 0b111 << 6
#: Its words for a condition of arming that is not met.
_REASONS: Final[Mapping[str, str]] = {
    'permission': '{denial}', 'vision': 'VisOdom: not healthy',
    'armable': '{mode} mode not armable', 'position': 'Need Position Estimate'}


class ArduCopter(FlightController):
    """ArduCopter: see the module, and ``FlightController`` for the parameters."""

    PROFILE = ARDUCOPTER

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._prearm_sent = self._time - PREARM_PERIOD / 2.0
        self._stop()

    @property
    def on_ground(self) -> bool:
        """Return whether it has not flown since it was armed, or has landed."""
        return not self._flown

    @property
    def taking_off(self) -> bool:
        """Return whether it is on its way to the take-off altitude, in GUIDED."""
        return bool(self.mode == 'GUIDED' and self._place is not None
                    and self.estimator.position[2] < self._place[2] - ARRIVED)

    def on_setpoint(self, message: Any, now: float) -> None:
        """Take an acceleration, in GUIDED only; whatever else comes stops it."""
        if self.mode != 'GUIDED':
            return
        mask, setpoint = message.type_mask, decode_setpoint(message)
        if (setpoint is None or not mask & _POSITION_BITS or not mask & _VELOCITY_BITS
                or mask & _ACCELERATION_BITS):
            self._stop()
            return
        if self._place is not None:
            self._stop()  # the take-off is over
        self._setpoint, self._setpoint_time = setpoint, now

    def take_off(self, altitude: float, now: float) -> int:
        """Climb to an altitude, m above home: in GUIDED, armed, and from the ground."""
        east, north, up = self.estimator.position
        if not self.armed or self._flown or self.mode != 'GUIDED' or not altitude > up:
            return ARDUCOPTER.refused
        self._place = np.array([east, north, altitude])
        return ACCEPTED

    def change_mode(self, name: str, now: float) -> int:
        """Change the mode; a refusal says why."""
        result = super().change_mode(name, now)
        if result != ACCEPTED:
            self._send_text(f'Mode change to {name} failed: requires position')
        return result

    def arm(self, value: bool, force: bool, now: float) -> int:
        """Arm or disarm; a refused arming says why."""
        result = super().arm(value, force, now)
        if result == ACCEPTED:
            self._stop()
        elif value:
            self._send_text(f'Arm: {self._reason(now)}')
        return result

    def run_checks(self, now: float) -> int:
        """Say what keeps it from arming."""
        self._prearm_sent = now
        if self.armed:
            return int(mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
        if self.unfit(now):
            self._send_text(f'PreArm: {self._reason(now)}')
        return ACCEPTED

    def _reason(self, now: float) -> str:
        return _REASONS[self.unfit(now)[0]].format(denial=self.arming_denial, mode=self.mode)

    def _send_text(self, text: str) -> None:
        self.outbox.append(mavlink.MAVLink_statustext_message(
            mavlink.MAV_SEVERITY_CRITICAL, text.encode()))

    def _enter(self, name: str) -> None:
        super()._enter(name)
        self._stop()

    def _stop(self) -> None:
        """Let the reference of GUIDED begin where the vehicle is, and stop."""
        self._place = None if self.mode == 'GUIDED' else self._place
        self._setpoint_time = -math.inf
        self._position = self.estimator.position.copy()
        self._velocity = self.estimator.velocity.copy()

    def _supervise(self, now: float) -> None:
        if now - self._prearm_sent >= PREARM_PERIOD:
            self.run_checks(now)
        needs_position = ARDUCOPTER.modes[self.mode].needs or self._flies == LAND
        age = self.estimator.vision_age(now)
        if self.armed and needs_position and not self.in_failsafe and (
                ARDUCOPTER.position_timeout + _CHECK_TIME < age < math.inf):
            mode = 'ALT_HOLD' if self.parameters['FS_EKF_ACTION'] == 2 else 'LAND'
            self._send_text(f'EKF Failsafe: changed to {mode} Mode')
            self._enter(mode)
            self.in_failsafe = True
        elif self.position_known(now):
            self.in_failsafe = False

    def _control(self, now: float, dt: float) -> Array:
        if self.vehicle.landed and now - self._landed_since >= _LANDED:
            self._flown = False
        return super()._control(now, dt) if self._flown or self.taking_off else IDLE

    def _hold(self) -> Array:
        wanted = super()._hold()
        if self.mode != 'BRAKE' or self._place is not None:
            return wanted
        return np.clip(-_BRAKE_GAIN * self.estimator.velocity, -_BRAKE_ACCELERATION,
                       _BRAKE_ACCELERATION)

    def _fly_setpoints(self, now: float, dt: float) -> Array:
        if self._place is not None:
            return self._hold()
        forward = self._setpoint.acceleration
        if now - self._setpoint_time > self.parameters['GUID_TIMEOUT']:
            self._setpoint = self._setpoint._replace(yaw_rate=math.nan)
            forward = -self._velocity / dt
            size = max(float(np.linalg.norm(forward)), _STOP_ACCELERATION)
            forward = forward * (_STOP_ACCELERATION / size)
        self._velocity = self._velocity + forward * dt
        self._position = self._position + self._velocity * dt
        if not np.all(np.isfinite([self._velocity, self._position])):
            # A real one does not refuse NaN; its behaviour then is undefined. This one lets the
            # motors idle and falls, so that no test overlooks it.
            return IDLE
        self._follow_yaw(dt)
        estimate = self.estimator
        velocity = self._velocity + POSITION_GAIN * (self._position - estimate.position)
        return forward + VELOCITY_GAIN * (velocity - estimate.velocity)

    @property
    def _disarms_after(self) -> float:
        return _LANDED if self._flies == LAND else self.parameters['DISARM_DELAY']
