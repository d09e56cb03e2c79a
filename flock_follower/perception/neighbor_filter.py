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
Where a neighbour is and how it moves: a Kalman filter in the odom frame.

State: position p and velocity v of the neighbour's body, its attitude R (body to odom) and
angular velocity w, all in odom. Both pairs follow the constant-velocity model driven by white
acceleration of spectral density q (Bar-Shalom, "Estimation with Applications", section 6.2.2):
F = [[1, T], [0, 1]], Q = q [[T^3/3, T^2/2], [T^2/2, T]] per axis. The error state is
(dp, dv, dr, dw), (12,), with R_true = exp(dr) R, a rotation vector along odom's axes.

Living in odom, not relative to oneself, the filter does not mistake one's own manoeuvres for the
neighbour's; slow drift of the odometry moves both alike.

What is measured is the marker's pose. The marker is off the body's centre by l, so position and
attitude are one estimate: p_marker = p + R l, and an uncertain attitude widens p by l's leverage.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    skew,
    Transform,
)

_P, _V, _R, _W = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12))
#: chi^2 with 3 degrees of freedom at a probability of 0.999.
GATE = 16.27


@dataclass(frozen=True)
class FilterParams:
    """
    How neighbours move, and when to doubt a measurement.

    ``acceleration_noise`` is sqrt(q) in m/s^2/sqrt(Hz), for a leader whose acceleration wanders
    by as much within about a second; ``angular_noise`` likewise in rad/s^2/sqrt(Hz).
    ``initial_speed``, m/s, and ``initial_rate``, rad/s, are the deviations before any motion has
    been seen. ``attitude_noise``, rad, is the deviation of one's own attitude between odometry
    and image stamp; at a distance it moves a neighbour sideways.
    ``max_rejections`` measurements in a row outside the gate restart the filter, as does a gap
    above ``max_gap`` s or a stamp more than ``max_jump`` s back.
    """

    acceleration_noise: float = 0.6
    angular_noise: float = 2.0
    initial_speed: float = 1.0
    initial_rate: float = 0.5
    attitude_noise: float = 0.003
    max_rejections: int = 6
    max_gap: float = 2.0
    max_jump: float = 0.5

    def __post_init__(self) -> None:
        """Validate."""
        for name, high in (('acceleration_noise', 100.0), ('angular_noise', 100.0),
                           ('initial_speed', 100.0), ('initial_rate', 100.0),
                           ('max_rejections', 1000), ('max_gap', 60.0), ('max_jump', 60.0)):
            value = getattr(self, name)
            if not 0.0 < value <= high:
                raise ValueError(f'{name} = {value}: must be in (0, {high:g}]')
        if not 0.0 <= self.attitude_noise <= 1.0:
            raise ValueError(f'attitude_noise = {self.attitude_noise}: must be in [0, 1] rad')


class Outcome(Enum):
    """What became of a measurement."""

    STARTED = 'track started'
    USED = 'used'
    POSITION_ONLY = 'implausible attitude, position used'
    OUTLIER = 'outside the gate'
    LATE = 'older than the estimate'


@dataclass(frozen=True, eq=False)
class Estimate:
    """
    A neighbour's state at a stamp, s, in odom.

    ``position`` (3,), m; ``velocity`` (3,), m/s; ``rotation`` (3, 3), body to odom;
    ``angular_velocity`` (3,), rad/s, along odom's axes; ``covariance`` (12, 12) of the errors of
    position, velocity, attitude (rotation vector along odom's axes) and angular velocity.
    """

    stamp: float
    position: Array
    velocity: Array
    rotation: Array
    angular_velocity: Array
    covariance: Array

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
        index = np.r_[_P, _R]
        return self.covariance[np.ix_(index, index)]

    @property
    def child_twist(self) -> Array:
        """Return linear and angular velocity (6,) in the neighbour's body frame (REP-105)."""
        return np.concatenate([self.rotation.T @ self.velocity,
                               self.rotation.T @ self.angular_velocity])

    @property
    def child_twist_covariance(self) -> Array:
        """Return the covariance (6, 6) of ``child_twist``, the attitude's share included."""
        # R_true^T v_true = R^T (1 - [dr]x)(v + dv) = R^T (v + dv + [v]x dr).
        jacobian: Array = np.zeros((6, 12))
        jacobian[:3, _V] = jacobian[3:, _W] = np.eye(3)
        jacobian[:3, _R] = skew(self.velocity)
        jacobian[3:, _R] = skew(self.angular_velocity)
        jacobian = np.kron(np.eye(2), self.rotation.T) @ jacobian
        return jacobian @ self.covariance @ jacobian.T


class NeighborFilter:
    """The filter of one neighbour, whose marker sits at ``T_body_marker`` on its body."""

    def __init__(self, T_body_marker: Transform, params: FilterParams | None = None) -> None:
        self.params = params or FilterParams()
        self._T_marker_body = T_body_marker.inverse()
        self._lever = T_body_marker.translation
        self._estimate: Estimate | None = None
        self._outliers = 0
        self._attitude_outliers = 0

    def reset(self) -> None:
        """Forget the neighbour."""
        self._estimate = None
        self._outliers = self._attitude_outliers = 0

    def predict(self, stamp: float) -> Estimate | None:
        """
        Return the state expected at a stamp, s, or None where no track reaches there.

        The filter itself is not altered. A stamp before the newest measurement gives None.
        """
        now = self._estimate
        if now is None or not 0.0 <= stamp - now.stamp <= self.params.max_gap:
            return None
        dt = stamp - now.stamp
        transition = np.eye(12)
        transition[_P, _V] = transition[_R, _W] = dt * np.eye(3)
        step = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        noise = np.zeros((12, 12))
        noise[:6, :6] = np.kron(self.params.acceleration_noise**2 * step, np.eye(3))
        noise[6:, 6:] = np.kron(self.params.angular_noise**2 * step, np.eye(3))
        return Estimate(stamp, now.position + dt * now.velocity, now.velocity,
                        rotation_vector_to_matrix(dt * now.angular_velocity) @ now.rotation,
                        now.angular_velocity,
                        transition @ now.covariance @ transition.T + noise)

    def update(self, stamp: float, T_odom_marker: Transform, covariance: Array) -> Outcome:
        """
        Take in a marker's pose in odom, with covariance (6, 6) along odom's axes.

        The order is position, then rotation vector.
        """
        now = self._estimate
        if now is not None and stamp <= now.stamp:
            if now.stamp - stamp <= self.params.max_jump:
                return Outcome.LATE
            self.reset()
        expected = self.predict(stamp)
        if expected is None:
            return self._start(stamp, T_odom_marker, covariance)

        lever = expected.rotation @ self._lever
        jacobian = np.zeros((6, 12))
        jacobian[:3, _P] = jacobian[3:, _R] = np.eye(3)
        jacobian[:3, _R] = -skew(lever)
        rotation = T_odom_marker.rotation @ self._T_marker_body.rotation
        innovation = np.concatenate([
            T_odom_marker.translation - expected.position - lever,
            matrix_to_rotation_vector(rotation @ expected.rotation.T)])
        spread = jacobian @ expected.covariance @ jacobian.T + covariance

        if _distance(innovation[:3], spread[:3, :3]) > GATE:
            self._outliers += 1
            if self._outliers < self.params.max_rejections:
                return Outcome.OUTLIER
            return self._start(stamp, T_odom_marker, covariance)
        self._outliers = 0
        # A marker's mirrored pose has its position right and its attitude wrong.
        rows = slice(0, 6)
        if _distance(innovation[3:], spread[3:, 3:]) > GATE:
            self._attitude_outliers += 1
            if self._attitude_outliers >= self.params.max_rejections:
                return self._start(stamp, T_odom_marker, covariance, expected)
            rows = slice(0, 3)
        else:
            self._attitude_outliers = 0
        self._correct(expected, innovation[rows], jacobian[rows], spread[rows, rows],
                      covariance[rows, rows])
        return Outcome.USED if rows.stop == 6 else Outcome.POSITION_ONLY

    def _correct(self, expected: Estimate, innovation: Array, jacobian: Array, spread: Array,
                 noise: Array) -> None:
        gain = np.linalg.solve(spread, jacobian @ expected.covariance).T
        error = gain @ innovation
        # Joseph's form stays symmetric and positive whatever the rounding.
        remain = np.eye(12) - gain @ jacobian
        covariance = remain @ expected.covariance @ remain.T + gain @ noise @ gain.T
        self._estimate = Estimate(
            expected.stamp, expected.position + error[_P], expected.velocity + error[_V],
            rotation_vector_to_matrix(error[_R]) @ expected.rotation,
            expected.angular_velocity + error[_W], covariance)

    def _start(self, stamp: float, T_odom_marker: Transform, covariance: Array,
               moving: Estimate | None = None) -> Outcome:
        """Start from one measurement; where ``moving`` is given, keep its velocity."""
        self.reset()
        body = T_odom_marker @ self._T_marker_body
        # p = p_marker - R l, so dp = dp_marker + [R l]x dr.
        to_body = np.zeros((12, 6))
        to_body[_P, :3] = to_body[_R, 3:] = np.eye(3)
        to_body[_P, 3:] = skew(body.rotation @ self._lever)
        full = to_body @ covariance @ to_body.T
        velocity: Array = np.zeros(3)
        full[_V, _V] = self.params.initial_speed**2 * np.eye(3)
        if moving is not None:
            velocity, full[_V, _V] = moving.velocity, moving.covariance[_V, _V]
        full[_W, _W] = self.params.initial_rate**2 * np.eye(3)
        self._estimate = Estimate(stamp, body.translation, velocity, body.rotation, np.zeros(3),
                                  full)
        return Outcome.STARTED


def _distance(innovation: Array, spread: Array) -> float:
    """Return the squared Mahalanobis distance."""
    return float(innovation @ np.linalg.solve(spread, innovation))
