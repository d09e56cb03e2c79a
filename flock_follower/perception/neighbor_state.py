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
A neighbour's state at a moment, with covariance: what its filter estimates.

Position p, velocity v and acceleration a of the neighbour's body, its attitude R (body to odom)
and angular velocity w, all in odom. The error state is (dp, dv, dr, dw, da), (15,), with
R_true = exp(dr) R, a rotation vector along odom's axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    matrix_to_quaternion,
    rotation_vector_to_matrix,
    skew,
    Transform,
)

#: Where in the error state what is.
POSITION, VELOCITY, ATTITUDE, RATE, ACCELERATION = (slice(k, k + 3) for k in range(0, 15, 3))
SIZE = 15
#: What of the error state a pose is, (6, 15).
POSE = np.concatenate([np.eye(SIZE)[POSITION], np.eye(SIZE)[ATTITUDE]])


class Estimate(NamedTuple):
    """
    A neighbour's state at a stamp, s, in odom.

    ``position`` (3,), m; ``velocity`` (3,), m/s; ``rotation`` (3, 3), body to odom;
    ``angular_velocity`` (3,), rad/s, along odom's axes; ``acceleration`` (3,), m/s^2;
    ``covariance`` (15, 15) of the errors of position, velocity, attitude (rotation vector along
    odom's axes), angular velocity and acceleration. It is of the state relative to the own one:
    what the own odometry errs by, both share.
    """

    stamp: float
    position: Array
    velocity: Array
    rotation: Array
    angular_velocity: Array
    acceleration: Array
    covariance: Array

    def moved(self, stamp: float, linear: Array, transition: Array, noise: Array) -> Estimate:
        """Return the state at another stamp, given ``neighbor_motion.transition`` to there."""
        dt = stamp - self.stamp
        return Estimate(
            stamp, self.position + dt * self.velocity + linear[0, 2] * self.acceleration,
            self.velocity + linear[1, 2] * self.acceleration,
            rotation_vector_to_matrix(dt * self.angular_velocity).dot(self.rotation),
            self.angular_velocity, linear[2, 2] * self.acceleration,
            transition.dot(self.covariance).dot(transition.T) + noise)

    def corrected(self, error: Array, covariance: Array) -> Estimate:
        """Return the state with an error state (15,) added, and another covariance (15, 15)."""
        return Estimate(
            self.stamp, self.position + error[POSITION], self.velocity + error[VELOCITY],
            rotation_vector_to_matrix(error[ATTITUDE]).dot(self.rotation),
            self.angular_velocity + error[RATE], self.acceleration + error[ACCELERATION],
            covariance)

    @property
    def quaternion(self) -> Array:
        """Return the attitude (x, y, z, w), body to odom."""
        return canonical_quaternion(matrix_to_quaternion(self.rotation))

    @property
    def pose(self) -> Transform:
        """Return ``T_odom_body`` of the neighbour."""
        return Transform(self.rotation, self.position)

    @property
    def pose_covariance(self) -> Array:
        """Return the covariance (6, 6) of position and rotation about odom's axes (REP-103)."""
        return POSE @ self.covariance @ POSE.T

    @property
    def child_twist(self) -> Array:
        """Return linear and angular velocity (6,) in the neighbour's body frame (REP-105)."""
        return np.concatenate([self.rotation.T @ self.velocity,
                               self.rotation.T @ self.angular_velocity])

    @property
    def child_acceleration(self) -> Array:
        """Return the acceleration (3,) in the neighbour's body frame."""
        return self.rotation.T @ self.acceleration

    @property
    def child_acceleration_covariance(self) -> Array:
        """Return the covariance (3, 3) of ``child_acceleration``, but for the attitude's share."""
        own = self.covariance[ACCELERATION, ACCELERATION]
        covariance: Array = self.rotation.T @ own @ self.rotation
        return covariance

    @property
    def child_twist_covariance(self) -> Array:
        """Return the covariance (6, 6) of ``child_twist``, the attitude's share included."""
        # R_true^T v_true = R^T (1 - [dr]x)(v + dv) = R^T (v + dv + [v]x dr).
        jacobian: Array = np.zeros((6, SIZE))
        jacobian[:3, VELOCITY] = jacobian[3:, RATE] = np.eye(3)
        jacobian[:3, ATTITUDE] = skew(self.velocity)
        jacobian[3:, ATTITUDE] = skew(self.angular_velocity)
        to_child = np.zeros((6, 6))
        to_child[:3, :3] = to_child[3:, 3:] = self.rotation.T
        jacobian = to_child @ jacobian
        return jacobian @ self.covariance @ jacobian.T
