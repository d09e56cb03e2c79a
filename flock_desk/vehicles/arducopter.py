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
have no effect: MAV_CMD_NAV_TAKEOFF comes first. Setpoints that it cannot fly stop the vehicle
without a message. NaN is not checked, and no speed limit
applies to accelerations. If no setpoint arrives, the last one is flown for GUID_TIMEOUT (3 s);
then the vehicle stops. Unlike PX4, ArduCopter integrates an acceleration to a velocity and a
position, and holds those: vertical acceleration 0 keeps the height. If the EKF loses its position,
the vehicle enters LAND without a position. After landing it stays in LAND, in which it cannot be
armed.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from flock_desk.vehicles.flight_controller import (
    ACCEPTED,
    decode_setpoint,
    FlightController,
    IDLE_ACCELERATION,
    POSITION_GAIN,
)
from flock_desk.vehicles.profiles import ARDUCOPTER, LAND
from flock_follower.geometry import Array

_CHECK_TIME: Final[float] = 0.8
_LANDING_TIME: Final[float] = 1.0  # s on the ground that count as a landing
_STOP_ACCELERATION: Final[float] = 2.5  # m/s^2, WPNAV_ACCEL


class ArduCopter(FlightController):
    """ArduCopter: see the module, and ``FlightController`` for the parameters."""

    PROFILE = ARDUCOPTER

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._stop()

    def on_setpoint(self, message: Any, now: float) -> None:
        """Take an acceleration, in GUIDED only; any other setpoint stops it."""
        if self.mode != 'GUIDED':
            return
        setpoint = decode_setpoint(message)
        if setpoint is None or self._place is not None:
            self._stop()  # of a take-off: it is over
        if setpoint is not None:
            self._setpoint, self._setpoint_time = setpoint, now

    def take_off(self, altitude: float, now: float) -> int:
        """Climb to an altitude, m above home: in GUIDED, armed, and from the ground."""
        east, north, up = self.estimator.position
        if not self.armed or self._flown or self.mode != 'GUIDED' or not altitude > up:
            return ARDUCOPTER.refused
        self._place = np.array([east, north, altitude])
        return ACCEPTED

    def arm(self, value: bool, now: float) -> int:
        """Arm or disarm; the reference of GUIDED begins anew."""
        result = super().arm(value, now)
        if result == ACCEPTED:
            self._stop()
        return result

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
        needs_position = ARDUCOPTER.modes[self.mode].needs or self._flies == LAND
        age = self.estimator.vision_age(now)
        if self.armed and needs_position and not self.in_failsafe and (
                ARDUCOPTER.position_timeout + _CHECK_TIME < age < math.inf):
            self.texts.append('EKF Failsafe: changed to LAND Mode')
            self._enter('LAND')
            self.in_failsafe = True
        elif self.position_known(now):
            self.in_failsafe = False

    def _control(self, now: float, dt: float) -> Array:
        if self.vehicle.landed and now - self._landed_since >= _LANDING_TIME:
            self._flown = False
        return super()._control(now, dt) if self._flown or self.taking_off else IDLE_ACCELERATION

    def _detect_ground(self, wanted: Array, dt: float) -> None:
        self.on_ground = not self._flown

    def _fly_setpoints(self, now: float, dt: float) -> Array:
        if self._place is not None:
            return self._hold()
        forward = self._setpoint.acceleration
        if now - self._setpoint_time > self.parameters['GUID_TIMEOUT']:
            forward = -self._velocity / dt
            size = max(float(np.linalg.norm(forward)), _STOP_ACCELERATION)
            forward = forward * (_STOP_ACCELERATION / size)
        self._velocity = self._velocity + forward * dt
        self._position = self._position + self._velocity * dt
        if not np.all(np.isfinite([self._velocity, self._position])):
            # A real one does not refuse NaN; its behavior then is undefined. This one lets the
            # motors idle and falls, so that no test overlooks it.
            return IDLE_ACCELERATION
        towards = POSITION_GAIN * (self._position - self.estimator.position)
        return forward + self._track(self._velocity + towards)

    @property
    def _disarms_after(self) -> float:
        return _LANDING_TIME if self._flies == LAND else self.parameters['DISARM_DELAY']
