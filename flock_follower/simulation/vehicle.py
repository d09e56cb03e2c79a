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
A quadrotor that flies acceleration setpoints: thrust, tilt, gravity and the lags in between.

Coordinates are ENU and FLU. The model is stepped with a given dt and is deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    wrap_angle,
)

GRAVITY: Final[float] = 9.80665  # m/s^2
_UP: Final[Array] = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class VehicleParams:
    """How the vehicle answers; the defaults resemble a 250 mm to 450 mm quadrotor on PX4."""

    attitude_time: float = 0.15
    """Time constant of tilting, s."""
    thrust_time: float = 0.05
    """Time constant of the thrust, s."""
    tilt_max: float = math.radians(45.0)
    """Largest tilt, rad."""
    thrust_max: float = 2.0 * GRAVITY
    """Largest specific thrust, m/s^2."""
    yaw_gain: float = 2.8
    """Yaw rate for a yaw error, 1/s."""
    yaw_rate_max: float = math.radians(60.0)
    """Largest yaw rate, rad/s."""
    drag: float = 0.1
    """Deceleration for a speed, 1/s."""
    thrust_error: float = 0.008
    """Error of the hover thrust, m/s^2: without height control it climbs 0.9 m in 15 s."""


class Vehicle:
    """
    The state of the vehicle, and its motion.

    ``position`` (3,), m, ``velocity`` (3,), m/s and ``acceleration`` (3,), m/s^2 are ENU,
    ``rotation`` (3, 3) takes FLU to ENU, ``angular_velocity`` (3,), rad/s, is FLU. The ground is
    at z = 0.
    """

    def __init__(self, position: ArrayLike = (0.0, 0.0, 0.0), yaw: float = 0.0,
                 params: VehicleParams | None = None) -> None:
        self.params = params or VehicleParams()
        self.position: Array = np.array(position, dtype=float)
        self.velocity: Array = np.zeros(3)
        self.acceleration: Array = np.zeros(3)
        self.angular_velocity: Array = np.zeros(3)
        self.yaw = wrap_angle(yaw)
        self.rotation = _attitude(_UP, self.yaw)
        self.thrust = GRAVITY if self.position[2] > 0.0 else 0.0
        """Specific thrust along the body's z axis, m/s^2."""

    @property
    def quaternion(self) -> Array:
        """Return the attitude FLU to ENU, (x, y, z, w)."""
        return matrix_to_quaternion(self.rotation)

    @property
    def landed(self) -> bool:
        """Return whether the vehicle stands on the ground."""
        return bool(self.position[2] <= 0.0)

    def step(self, acceleration: ArrayLike, yaw: float, dt: float, *,
             powered: bool = True) -> None:
        """
        Move on by ``dt``, s.

        :param acceleration: setpoint (3,), m/s^2, ENU, without gravity.
        :param yaw: setpoint, rad, ENU.
        :param powered: False stops the motors.
        """
        thrust, tilt = self._wanted(np.asarray(acceleration, dtype=float))
        if not powered:
            thrust = 0.0
        if self.landed:
            tilt = _UP
        self.thrust += (thrust - self.thrust) * -math.expm1(-dt / self.params.thrust_time)
        axis = _turn(self.rotation[:, 2], tilt, -math.expm1(-dt / self.params.attitude_time))
        if not self.landed:
            error = wrap_angle(yaw - self.yaw)
            rate = np.clip(self.params.yaw_gain * error, -self.params.yaw_rate_max,
                           self.params.yaw_rate_max)
            self.yaw = wrap_angle(self.yaw + float(rate) * dt)
        rotation = _attitude(axis, self.yaw)
        self.angular_velocity = matrix_to_rotation_vector(self.rotation.T @ rotation) / dt
        self.rotation = rotation
        self._move(dt, powered)

    def _wanted(self, acceleration: Array) -> tuple[float, Array]:
        force: Array = acceleration + GRAVITY * _UP
        # No upside-down flight: a fall is commanded by little thrust, not by turning over.
        up = max(float(force[2]), 0.1 * GRAVITY)
        level = float(np.hypot(force[0], force[1]))
        if level > up * math.tan(self.params.tilt_max):
            force[:2] *= up * math.tan(self.params.tilt_max) / level
        force[2] = up
        size = float(np.linalg.norm(force))
        return min(size, self.params.thrust_max), force / size

    def _move(self, dt: float, powered: bool) -> None:
        force = self.thrust * self.rotation[:, 2]
        error = self.params.thrust_error * _UP if powered else 0.0
        acceleration = force + error - GRAVITY * _UP - self.params.drag * self.velocity
        # On the ground it stays until the thrust clearly exceeds its weight.
        if self.landed and acceleration[2] < 0.3:
            self.velocity = np.zeros(3)
            self.acceleration = np.zeros(3)
            self.position[2] = 0.0
            return
        self.acceleration = acceleration
        self.velocity = self.velocity + acceleration * dt
        self.position = self.position + self.velocity * dt
        if self.position[2] <= 0.0:
            self.position[2] = 0.0
            self.velocity = np.zeros(3)


def _turn(axis: Array, target: Array, fraction: float) -> Array:
    """Return the unit vector at a fraction of the way from axis to target, along the arc."""
    normal = np.cross(axis, target)
    sine = float(np.linalg.norm(normal))
    if sine < 1e-12:
        return target
    angle = math.atan2(sine, float(axis @ target))
    return rotation_vector_to_matrix(normal / sine * angle * fraction) @ axis


def _attitude(axis: Array, yaw: float) -> Array:
    """Return the rotation FLU to ENU with the given z axis, heading along yaw."""
    left = np.cross(axis, [math.cos(yaw), math.sin(yaw), 0.0])
    left /= np.linalg.norm(left)
    return np.column_stack([np.cross(left, axis), left, axis])
