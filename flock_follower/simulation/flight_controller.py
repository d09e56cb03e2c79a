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
when the stream stops, the last setpoint is obeyed for COM_OF_LOSS_T (1 s), then a failsafe acts;
no speed limit applies to acceleration setpoints; vertical acceleration 0 leaves the height open.
ENU throughout; the time is given.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from flock_follower.geometry import Array, wrap_angle
from flock_follower.mavlink import px4
from flock_follower.simulation.vehicle import Vehicle

#: PX4's COM_OF_LOSS_T, s.
OFFBOARD_LOSS_TIMEOUT: Final[float] = 1.0
#: PX4's COM_DISARM_LAND, s.
DISARM_AFTER_LANDING: Final[float] = 2.0
DESCENT_SPEED: Final[float] = 0.7  # m/s, MPC_LAND_SPEED
# PX4's MPC_XY_P, MPC_Z_P and MPC_XY_VEL_P_ACC, MPC_Z_VEL_P_ACC.
_POSITION_GAIN: Final[Array] = np.array([0.95, 0.95, 1.0])
_VELOCITY_GAIN: Final[Array] = np.array([1.8, 1.8, 4.0])
_HOLD_SPEED_MAX: Final[float] = 2.0  # m/s
_CAPTURE_SPEED: Final[float] = 0.2  # m/s; Hold brakes to this, then keeps the place
_MODES: Final[tuple[str, ...]] = (px4.OFFBOARD, px4.HOLD, 'POSCTL', 'AUTO.LAND')

ACCEPTED: Final[int] = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED: Final[int] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
UNSUPPORTED: Final[int] = mavlink.MAV_RESULT_UNSUPPORTED


class Setpoint(NamedTuple):
    """An offboard setpoint, ENU; NaN where an axis is not given."""

    position: Array
    velocity: Array
    acceleration: Array
    yaw: float = math.nan
    yaw_rate: float = math.nan

    @property
    def valid(self) -> bool:
        """Return whether every axis is given somehow, and nothing is infinite."""
        given = np.array([self.position, self.velocity, self.acceleration])
        yaws_finite = not (math.isinf(self.yaw) or math.isinf(self.yaw_rate))
        return bool(np.all(np.any(np.isfinite(given), axis=0))
                    and not np.any(np.isinf(given)) and yaws_finite)


class StatusText(NamedTuple):
    """Something the vehicle says."""

    severity: int
    text: str


class FlightController:
    """
    Modes, arming and control of one vehicle.

    :param armed: whether it starts armed; airborne vehicles must.
    :param failsafe: what follows the loss of the stream: 'descend' (PX4 without RC) or 'hold'.
    :param arming_denial: where given, arming is refused with this reason.
    """

    def __init__(self, vehicle: Vehicle, now: float, *, armed: bool, failsafe: str = 'descend',
                 arming_denial: str = '') -> None:
        if failsafe not in ('descend', 'hold'):
            raise ValueError(f"failsafe = {failsafe!r}: must be 'descend' or 'hold'")
        self.vehicle = vehicle
        self.armed = armed
        self.mode = px4.HOLD
        self.in_failsafe = False
        self.said: list[StatusText] = []
        self.wind: Array = np.zeros(3)
        """Velocity of the air (3,), m/s, ENU."""
        self._failsafe = failsafe
        self._arming_denial = arming_denial
        self._time = now
        self._setpoint: Setpoint | None = None
        self._setpoint_time = -math.inf
        self._stream_since = -math.inf
        self._yaw = vehicle.yaw
        self._place: Array | None = vehicle.position.copy()
        self._landed_since = now

    def on_setpoint(self, setpoint: Setpoint, now: float) -> bool:
        """Take an offboard setpoint; return whether it is one PX4 would obey."""
        if not setpoint.valid:
            return False
        if now - self._setpoint_time > 1.0 / px4.MINIMUM_STREAM_RATE:
            self._stream_since = now
        self._setpoint, self._setpoint_time = setpoint, now
        return True

    def offboard_available(self, now: float) -> bool:
        """Return whether setpoints have come often enough for long enough."""
        return (now - self._setpoint_time <= 1.0 / px4.MINIMUM_STREAM_RATE
                and now - self._stream_since >= px4.STREAM_BEFORE_OFFBOARD)

    def set_mode(self, name: str, now: float) -> int:
        """Change the flight mode; return the MAV_RESULT."""
        if name not in _MODES or (name == px4.OFFBOARD and not self.offboard_available(now)):
            self._say(mavlink.MAV_SEVERITY_CRITICAL,
                      f"Switching to mode '{name}' is currently not possible")
            if name == px4.OFFBOARD:
                self._say(mavlink.MAV_SEVERITY_CRITICAL, 'No offboard signal')
            return TEMPORARILY_REJECTED
        self._enter(name)
        self.in_failsafe = False
        return ACCEPTED

    def arm(self, value: bool, now: float) -> int:
        """Arm or disarm; return the MAV_RESULT."""
        if value == self.armed:
            return ACCEPTED
        if not value and not self.vehicle.landed:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, 'Disarming denied: not landed')
            return TEMPORARILY_REJECTED
        if value:
            reason = self._arming_denial
            if self.mode == px4.OFFBOARD and not self.offboard_available(now):
                reason = 'No offboard signal'
            if reason:
                self._say(mavlink.MAV_SEVERITY_CRITICAL, f'Arming denied: {reason}')
                return TEMPORARILY_REJECTED
            self._landed_since = now
        self.armed = value
        self._say(mavlink.MAV_SEVERITY_INFO,
                  f'{"Armed" if value else "Disarmed"} by external command')
        return ACCEPTED

    def step(self, now: float) -> None:
        """Fly on to ``now``, s, not before the time of the last step."""
        dt = now - self._time
        if dt <= 0.0:
            return
        self._time = now
        if self.mode == px4.OFFBOARD and now - self._setpoint_time > OFFBOARD_LOSS_TIMEOUT:
            self._lose_offboard()
        acceleration = self._acceleration()
        if self.mode == px4.OFFBOARD and self._setpoint is not None:
            self._follow_yaw(self._setpoint, dt)
        self.vehicle.step(acceleration, self._yaw, dt, powered=self.armed, wind=self.wind)
        self._disarm_when_landed(now)

    def _enter(self, name: str) -> None:
        self.mode = name
        self._place = None
        self._yaw = self.vehicle.yaw

    def _lose_offboard(self) -> None:
        self._enter('AUTO.LAND' if self._failsafe == 'descend' else px4.HOLD)
        self.in_failsafe = self.armed
        if self.armed:
            action = 'descending' if self._failsafe == 'descend' else 'hold'
            self._say(mavlink.MAV_SEVERITY_CRITICAL,
                      f'Failsafe activated: no offboard signal, {action}')

    def _acceleration(self) -> Array:
        nowhere = np.full(3, math.nan)
        if self.mode == px4.OFFBOARD and self._setpoint is not None:
            return self._track(self._setpoint)
        if self.mode == 'AUTO.LAND':
            down = np.array([0.0, 0.0, -DESCENT_SPEED])
            if self.in_failsafe:
                # PX4's Descend has no position to rely on: level, and down.
                down[:2] = math.nan
                return self._track(Setpoint(nowhere, down, np.array([0.0, 0.0, math.nan])))
            return self._track(Setpoint(nowhere, down, nowhere))
        if self._place is None and np.linalg.norm(self.vehicle.velocity) < _CAPTURE_SPEED:
            self._place = self.vehicle.position.copy()
        if self._place is None:
            return self._track(Setpoint(nowhere, np.zeros(3), nowhere))
        return self._track(Setpoint(self._place, nowhere, nowhere))

    def _track(self, setpoint: Setpoint) -> Array:
        """Return the acceleration of PX4's cascade: position, velocity and acceleration add."""
        vehicle = self.vehicle
        towards = _POSITION_GAIN * (setpoint.position - vehicle.position)
        velocity = _sum(np.clip(towards, -_HOLD_SPEED_MAX, _HOLD_SPEED_MAX), setpoint.velocity)
        return _sum(_VELOCITY_GAIN * (velocity - vehicle.velocity), setpoint.acceleration)

    def _follow_yaw(self, setpoint: Setpoint, dt: float) -> None:
        if math.isfinite(setpoint.yaw):
            self._yaw = setpoint.yaw
        elif math.isfinite(setpoint.yaw_rate):
            self._yaw = wrap_angle(self._yaw + setpoint.yaw_rate * dt)

    def _disarm_when_landed(self, now: float) -> None:
        if not self.vehicle.landed or self.mode != 'AUTO.LAND':
            self._landed_since = now
        elif self.armed and now - self._landed_since >= DISARM_AFTER_LANDING:
            self.armed = self.in_failsafe = False
            self._say(mavlink.MAV_SEVERITY_INFO, 'Disarmed by landing')

    def _say(self, severity: int, text: str) -> None:
        self.said.append(StatusText(severity, text))


def _sum(a: Array, b: Array) -> Array:
    """Return a + b, where NaN counts as absent and both absent as NaN."""
    return np.where(np.isnan(a), b, np.where(np.isnan(b), a, a + b))
