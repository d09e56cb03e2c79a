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
ArduCopter's GUIDED mode: which setpoints it takes, and how it flies them.

Measured on ArduCopter 4.7, and as its source has it: each group of three ignore bits counts as
set where any of them is, so that setpoints of mixed axes are none, and stop the vehicle without a
word; nothing checks for NaN; no speed limit applies to accelerations; without setpoints it goes
on for GUID_TIMEOUT (3 s), then stops. Unlike PX4 it integrates an acceleration to a velocity and
a position and holds on to those: vertical acceleration 0 keeps the height. ENU.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.estimator import Estimator
from flock_desk.vehicles.flight_controller import (
    POSITION_GAIN,
    TrackedSetpoint,
    VELOCITY_GAIN,
)
from flock_follower.geometry import Array, ned_to_enu, yaw_ned_to_enu

_POSITION_BITS: Final[int] = 0b111
_VELOCITY_BITS: Final[int] = 0b111 << 3
_ACCELERATION_BITS: Final[int] = 0b111 << 6
_ACCELERATION_MAX: Final[float] = 2.5  # m/s^2 of stopping and of velocity setpoints, WPNAV_ACCEL
_SPEED_MAX: Final[float] = 2.0  # m/s towards a position
_ARRIVED: Final[float] = 0.1  # m below the take-off altitude
#: What is flown, by the ignore bits of position, velocity and acceleration; the rest stops it.
_SUBMODES: Final[Mapping[tuple[bool, bool, bool], str]] = MappingProxyType({
    (False, True, True): 'position',
    (True, False, True): 'velocity', (True, False, False): 'velocity',
    (True, True, False): 'acceleration',
    (False, False, True): 'everything', (False, False, False): 'everything'})
#: The submodes that stop when their setpoints do.
_STREAMED: Final[frozenset[str]] = frozenset({'velocity', 'acceleration', 'everything'})


class Guided:
    """The submodes of GUIDED: 'velocity', which stops when it starts, 'takeoff' and so on."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self.submode = ''
        self.setpoint = TrackedSetpoint()
        self._setpoint_time = -math.inf
        self._position: Array = np.zeros(3)
        self._velocity: Array = np.zeros(3)
        self.stop()

    @property
    def broken(self) -> bool:
        """Return whether a NaN has got into it; it stays until GUIDED starts anew."""
        return not (np.all(np.isfinite(self._position)) and np.all(np.isfinite(self._velocity)))

    @property
    def taking_off(self) -> bool:
        """Return whether it is on its way to the take-off altitude."""
        return (self.submode == 'takeoff'
                and self._estimator.position[2] < self.setpoint.position[2] - _ARRIVED)

    def stop(self) -> None:
        """Start anew, by stopping."""
        self._start('velocity')
        self.setpoint = TrackedSetpoint(velocity=np.zeros(3), acceleration=np.zeros(3))

    def take_off(self, altitude: float) -> None:
        """Climb to an altitude, m."""
        self._start('takeoff')
        self.setpoint = TrackedSetpoint(position=np.array([*self._position[:2], altitude]))

    def on_setpoint(self, message: Any, now: float) -> None:
        """Take a SET_POSITION_TARGET_LOCAL_NED: fly it, or stop."""
        mask = message.type_mask
        ignored = (bool(mask & _POSITION_BITS), bool(mask & _VELOCITY_BITS),
                   bool(mask & _ACCELERATION_BITS))
        forced = mask & mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET and not ignored[2]
        submode = _SUBMODES.get(ignored)
        if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED or forced or submode is None:
            self.stop()
            return
        if submode != self.submode:
            self._start(submode)
        position, velocity, acceleration = (
            np.zeros(3) if left_out else ned_to_enu(values) for left_out, values in zip(ignored, (
                [message.x, message.y, message.z], [message.vx, message.vy, message.vz],
                [message.afx, message.afy, message.afz])))
        yaw, yaw_rate = math.nan, math.nan
        if not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE and math.isfinite(message.yaw):
            yaw = yaw_ned_to_enu(message.yaw)
        if not mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE:
            yaw_rate = -message.yaw_rate
        self.setpoint = TrackedSetpoint(position, velocity, acceleration, yaw, yaw_rate)
        self._setpoint_time = now

    def acceleration(self, now: float, dt: float, timeout: float) -> Array:
        """Return what is wanted, (3,), m/s^2; the reference moves on by ``dt``, s."""
        if self.submode in _STREAMED and now - self._setpoint_time > timeout:
            self.setpoint = self.setpoint._replace(yaw_rate=math.nan)
            forward = self._towards(np.zeros(3), dt)
        else:
            forward = self._forward(self.setpoint, dt)
        self._velocity = self._velocity + forward * dt
        self._position = self._position + self._velocity * dt
        return self._follow(forward)

    def _forward(self, setpoint: TrackedSetpoint, dt: float) -> Array:
        """Return the acceleration of the reference."""
        if self.submode == 'acceleration':
            return setpoint.acceleration
        if self.submode == 'velocity':
            return self._towards(setpoint.velocity, dt) + setpoint.acceleration
        if self.submode == 'everything':
            self._position, self._velocity = setpoint.position, setpoint.velocity
            return setpoint.acceleration
        away = setpoint.position - self._position
        return self._towards(_limited(POSITION_GAIN * away, _SPEED_MAX), dt)

    def _follow(self, forward: Array) -> Array:
        """Return an acceleration and what keeps to the reference."""
        estimate = self._estimator
        velocity = self._velocity + POSITION_GAIN * (self._position - estimate.position)
        return forward + VELOCITY_GAIN * (velocity - estimate.velocity)

    def _towards(self, velocity: Array, dt: float) -> Array:
        return _limited((velocity - self._velocity) / dt, _ACCELERATION_MAX)

    def _start(self, submode: str) -> None:
        self.submode = submode
        self._position = self._estimator.position.copy()
        self._velocity = self._estimator.velocity.copy()


def _limited(vector: Array, length: float) -> Array:
    """Return a vector, shortened to a length where it is longer."""
    own = float(np.linalg.norm(vector))
    return vector * (length / own) if own > length else vector
