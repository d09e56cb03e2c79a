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

"""Visual-inertial odometry while a flight goes on: the errors of ``sensors.odometry``, online."""

from __future__ import annotations

import numpy as np

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from flock_follower.simulation.sensors.sensing import Vio
from flock_follower.simulation.sensors.vio import Odometry, VioNoise

_TILT_RENEWAL = 5.0  # s


class LiveVio:
    """
    Odometry of one vehicle, sample by sample.

    Position, yaw and velocity are those of ``sensing.Vio``, as in flights in lock step; attitude
    and angular velocity have the errors of ``VioNoise``, the covariances those of all of them.
    """

    def __init__(self, position: Array, rng: np.random.Generator, period: float,
                 noise: VioNoise | None = None) -> None:
        self.noise = noise or VioNoise()
        self._period = period
        self._rng = rng
        self._vio = Vio(position[None], [rng], self.noise, period)
        self._true = position
        self._drift: Array = np.zeros((4, 4))  # covariance of the walking position and yaw
        self._tilt = self.noise.tilt * rng.standard_normal(2)
        self._keep = float(np.exp(-period / _TILT_RENEWAL))
        self._bias = self.noise.gyro_bias * rng.standard_normal(3)
        self._twist_covariance = np.diag(
            [self.noise.velocity ** 2 + self.noise.velocity_white ** 2] * 3
            + [self.noise.gyro_bias ** 2 + self.noise.gyro ** 2] * 3)
        self._walk = period * np.diag(
            [self.noise.position_walk ** 2] * 3 + [self.noise.yaw_walk ** 2])

    def step(self, time: float, position: Array, quaternion: Array, velocity: Array,
             angular: Array) -> Odometry:
        """
        Return what the estimator says one period later.

        :param time: of the sample, s; it is only passed on.
        :param velocity: true one (3,), m/s, ENU; ``angular`` (3,), rad/s, FLU.
        """
        noise, vio = self.noise, self._vio
        vio.step(position[None], velocity[None])
        fresh = self._rng.standard_normal(8)
        self._tilt = self._keep * self._tilt + (
            (1.0 - self._keep ** 2) ** 0.5 * noise.tilt * fresh[:2])
        error = np.array([*self._tilt, 0.0]) + noise.attitude * fresh[2:5]
        estimate = canonical_quaternion(quaternion_multiply(
            quaternion_from_yaw(float(vio.yaw_error[0])),
            quaternion_multiply(rotation_vector_to_quaternion(error), quaternion)))
        return Odometry(time, vio.position[0], estimate,
                        quaternion_to_matrix(estimate).T @ vio.velocity[0],
                        angular + self._bias + noise.gyro * fresh[5:],
                        self._covariance(position), self._twist_covariance)

    def _covariance(self, position: Array) -> Array:
        """Return the covariance (6, 6) of the pose; an error of yaw turns the way to come."""
        dx, dy, _ = position - self._true
        self._true = position
        turn = np.eye(4)
        turn[:2, 3] = -dy, dx
        self._drift = turn @ self._drift @ turn.T + self._walk
        covariance = np.zeros((6, 6))
        covariance[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])] = self._drift
        diagonal = np.einsum('ii->i', covariance)
        diagonal[:3] += self.noise.position ** 2
        diagonal[3:5] += self.noise.tilt ** 2
        diagonal[3:] += self.noise.attitude ** 2
        return covariance
