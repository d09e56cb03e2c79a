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

Coordinates are ENU and FLU. The model is stepped with a given dt and is deterministic. Its arrays
hold one vehicle, or one independent vehicle per row.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, GRAVITY, matrix_to_quaternion
from flock_follower.geometry.rotation_vectors import matrix_to_rotation_vector

_UP_ENU: Final[Array] = np.array([0.0, 0.0, 1.0])
_HOVER_FORCE: Final[Array] = GRAVITY * _UP_ENU  # m/s^2, specific


# Dynamics of a 250 mm to 450 mm quadrotor on PX4.
ATTITUDE_TIME = 0.15  # s, time constant of tilting
THRUST_TIME = 0.05  # s, time constant of the thrust
TILT_MAX = math.radians(45.0)  # rad
THRUST_MAX = 2.0 * GRAVITY  # m/s^2, specific
YAW_GAIN = 2.8  # 1/s, yaw rate for a yaw error
YAW_RATE_MAX = math.radians(60.0)  # rad/s
DRAG = 0.1  # 1/s, deceleration for a speed through the air
THRUST_ERROR = 0.008  # m/s^2, of the hover thrust: without height control it climbs 0.9 m in 15 s


class Quadrotor:
    """
    The state of the vehicle, and its motion.

    ``position``, m, ``velocity``, m/s, and ``acceleration``, m/s^2, are ENU, (3,) for one vehicle
    or (n, 3) for n; ``yaw``, rad, and ``thrust``, the specific thrust along the body's z axis,
    m/s^2, have one dimension less. ``rotation`` (..., 3, 3) takes FLU to ENU. The ground is at
    z = 0.
    """

    def __init__(self, position: ArrayLike = (0.0, 0.0, 0.0), yaw: ArrayLike = 0.0,
                 tilt_max: float = TILT_MAX) -> None:
        self._tilt_max = tilt_max  # rad
        self.position: Array = np.array(position, dtype=float)
        self.velocity: Array = np.zeros_like(self.position)
        self.acceleration: Array = np.zeros_like(self.position)
        self.yaw: Any = _wrap_angles(np.asarray(yaw, dtype=float))
        self.axis: Array = np.zeros_like(self.position) + _UP_ENU
        """The body's z axis in ENU."""
        self.thrust: Any = np.where(self.position[..., 2] > 0.0, GRAVITY, 0.0)
        self.thrust_error: Any = THRUST_ERROR
        """Error of the hover thrust, m/s^2; one for each vehicle, or one for all."""
        self._before: tuple[Array, Any, float] = self.axis, self.yaw, 1.0
        self.steer(self.acceleration, self.yaw)
        self._rotation: Array | None = None
        """That of this step, once it was asked for."""

    @property
    def rotation(self) -> Array:
        """Return the rotation FLU to ENU, heading along the yaw."""
        if self._rotation is None:
            self._rotation = attitude(self.axis, self.yaw)
        return self._rotation

    @property
    def quaternion(self) -> Array:
        """Return the attitude of one vehicle, FLU to ENU, (x, y, z, w)."""
        return matrix_to_quaternion(self.rotation)

    @property
    def angular_velocity(self) -> Array:
        """Return the mean angular velocity (3,) of one vehicle over the last step, FLU, rad/s."""
        axis, yaw, dt = self._before
        return matrix_to_rotation_vector(attitude(axis, yaw).T @ self.rotation) / dt

    @property
    def landed(self) -> Any:
        """Return whether the vehicle stands on the ground."""
        return self.position[..., 2] <= 0.0

    def steer(self, acceleration: ArrayLike, yaw: ArrayLike) -> None:
        """
        Take a setpoint, which is flown until the next one.

        :param acceleration: (..., 3), m/s^2, ENU, without gravity.
        :param yaw: rad, ENU.
        """
        self._wanted = *self._nominal(np.asarray(acceleration, dtype=float)), np.asarray(yaw)

    def step(self, dt: float, *, powered: bool = True, wind: ArrayLike = 0.0) -> None:
        """
        Advance the motion by ``dt``, s.

        :param powered: False stops the motors.
        :param wind: velocity of the air (..., 3), m/s, ENU.
        """
        landed = self.landed
        on_ground = landed.any()
        self._before, self._rotation = (self.axis, self.yaw, dt), None
        thrust, tilt, yaw = self._wanted
        if not powered:
            thrust = np.zeros_like(thrust)
        if on_ground:
            tilt = np.where(landed[..., None], _UP_ENU, tilt)
        self.thrust = self.thrust + (thrust - self.thrust) * -math.expm1(
            -dt / THRUST_TIME)
        self.axis = _turn(self.axis, tilt, -math.expm1(-dt / ATTITUDE_TIME))
        rate = np.minimum(np.maximum(
            YAW_GAIN * _wrap_angles(yaw - self.yaw),
            -YAW_RATE_MAX), YAW_RATE_MAX)
        turn = rate * dt
        self.yaw = _wrap_angles(self.yaw + (np.where(landed, 0.0, turn) if on_ground else turn))
        self._move(dt, powered, landed if on_ground else None, np.asarray(wind, dtype=float))

    def _nominal(self, acceleration: Array) -> tuple[Array, Array]:
        force: Array = acceleration + _HOVER_FORCE
        # No upside-down flight: a fall is commanded by little thrust, not by turning over.
        up = np.maximum(force[..., 2], 0.1 * GRAVITY)
        level = np.hypot(force[..., 0], force[..., 1])
        most = up * math.tan(self._tilt_max)
        steep = level > most
        if steep.any():
            force *= np.where(steep, most / np.maximum(level, 1e-9), 1.0)[..., None]
        force[..., 2] = up
        size = np.sqrt(np.add.reduce(force * force, axis=-1))
        return np.minimum(size, THRUST_MAX), force / size[..., None]

    def _move(self, dt: float, powered: bool, landed: Any | None, wind: Array) -> None:
        """Move on by ``dt``, s; ``landed`` is None if no vehicle stands on the ground."""
        force = self.thrust[..., None] * self.axis
        error = np.asarray(self.thrust_error if powered else 0.0)
        acceleration = (force + (error - GRAVITY)[..., None] * _UP_ENU
                        - DRAG * (self.velocity - wind))
        velocity = self.velocity + acceleration * dt
        if landed is not None:
            # On the ground it stays until the thrust clearly exceeds its weight.
            flying = ~(landed & (acceleration[..., 2] < 0.3))[..., None]
            acceleration = np.where(flying, acceleration, 0.0)
            velocity = np.where(flying, velocity, 0.0)
        position = self.position + velocity * dt
        grounded = position[..., 2] <= 0.0
        if grounded.any():
            velocity = np.where(grounded[..., None], 0.0, velocity)
            position[..., 2] = np.where(grounded, 0.0, position[..., 2])
        self.acceleration, self.velocity, self.position = acceleration, velocity, position


def attitude(axis: Array, yaw: Any) -> Array:
    """Return rotations (..., 3, 3) FLU to ENU with z axes (..., 3), heading along yaw (...)."""
    rotation = np.empty((*axis.shape, 3))
    left = _cross(axis, np.cos(yaw), np.sin(yaw), 0.0)
    left /= np.sqrt(np.add.reduce(left * left, axis=-1, keepdims=True))
    rotation[..., 0] = _cross(left, axis[..., 0], axis[..., 1], axis[..., 2])
    rotation[..., 1], rotation[..., 2] = left, axis
    return rotation


def _cross(a: Array, x: Any, y: Any, z: Any) -> Array:
    """Return vector products (..., 3) with vectors (x, y, z): np.cross takes ten times as long."""
    product = np.empty(a.shape)
    east, north, up = a[..., 0], a[..., 1], a[..., 2]
    product[..., 0] = north * z - up * y
    product[..., 1] = up * x - east * z
    product[..., 2] = east * y - north * x
    return product


def _turn(axis: Array, target: Array, fraction: float) -> Array:
    """Return the unit vectors at a fraction of the way from axis to target, along the arc."""
    cosine = np.minimum(np.add.reduce(axis * target, axis=-1, keepdims=True), 1.0)
    angle = np.arccos(np.maximum(cosine, -1.0))
    sine = np.sin(angle)
    small = sine < 1e-6
    any_small = small.any()
    if any_small:
        sine = np.where(small, 1.0, sine)
    of_axis, of_target = np.sin((1.0 - fraction) * angle) / sine, np.sin(fraction * angle) / sine
    if any_small:
        of_axis = np.where(small, 1.0 - fraction, of_axis)
        of_target = np.where(small, fraction, of_target)
    turned = of_axis * axis + of_target * target
    return turned / np.sqrt(np.add.reduce(turned * turned, axis=-1, keepdims=True))


def _wrap_angles(angle: Any) -> Any:
    """Return angles, rad, in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
