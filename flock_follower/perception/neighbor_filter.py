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

State: position p, velocity v and acceleration a of the neighbour's body, its attitude R (body to
odom) and angular velocity w, all in odom. The acceleration is Singer's ("Estimating optimal
tracking filter performance for manned maneuvering targets", IEEE Trans. AES, 1970): of standard
deviation s, forgotten with a time constant T, driven by white jerk of spectral density 2 s^2 / T.
The angular velocity is driven by white angular acceleration. The error state is
(dp, dv, dr, dw, da), (15,), with R_true = exp(dr) R, a rotation vector along odom's axes.

Living in odom, not relative to oneself, the filter does not mistake one's own manoeuvres for the
neighbour's; slow drift of the odometry moves both alike.

What is measured is the place of a point on the body, where its markers are, and the attitude: both
together give the place of the body, and an uncertain attitude widens it by the point's leverage.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
import math
from typing import ClassVar, NamedTuple

import cv2
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
from flock_follower.ranges import Checked, Range

_P, _V, _R, _W, _A = (slice(k, k + 3) for k in range(0, 15, 3))
_SIZE = 15
_EYE, _IDENTITY = np.eye(3), np.eye(_SIZE)
#: What of the error state is measured: position, and position and attitude.
_PLACE = _IDENTITY[_P]
_POSE = np.concatenate([_IDENTITY[_P], _IDENTITY[_R]])
#: chi^2 with 3 degrees of freedom at a probability of 0.999.
GATE = 16.27


@dataclass(frozen=True)
class FilterParams(Checked):
    """
    How neighbours move, and when to doubt a measurement.

    ``acceleration`` is the standard deviation of a neighbour's acceleration, m/s^2 per axis, and
    ``acceleration_time`` the time in which it changes, s. ``angular_noise`` is the root of the
    spectral density of its angular acceleration, rad/s^2/sqrt(Hz).
    ``odometry_noise`` is how the error of one's own velocity wanders, in which all is seen,
    m/s^2/sqrt(Hz).
    ``odometry_walk`` is how one's own position wanders, m/sqrt(s), where no velocity is measured.
    ``initial_speed``, m/s, and ``initial_rate``, rad/s, are the deviations before any motion has
    been seen. ``attitude_noise``, rad, is how much one's own attitude errs differently from one
    image to the next; at a distance it moves a neighbour sideways.
    ``max_rejections`` measurements in a row outside the gate restart the filter, as does a gap
    above ``max_gap`` s or a stamp more than ``max_jump`` s back.
    """

    acceleration: float = 0.5
    acceleration_time: float = 1.0
    angular_noise: float = 2.0
    odometry_noise: float = 0.03
    odometry_walk: float = 0.02
    initial_speed: float = 1.0
    initial_rate: float = 0.5
    attitude_noise: float = 0.0005
    max_rejections: int = 6
    max_gap: float = 2.0
    max_jump: float = 0.5

    RANGES: ClassVar[dict[str, Range]] = {
        'acceleration': Range(0.01, 100.0, 'm/s^2'),
        'acceleration_time': Range(0.01, 100.0, 's'),
        'angular_noise': Range(0.01, 100.0, 'rad/s^2/sqrt(Hz)'),
        'odometry_noise': Range(0.0, 100.0, 'm/s^2/sqrt(Hz)', above=True),
        'odometry_walk': Range(0.0, 1.0, 'm/sqrt(s)'),
        'initial_speed': Range(0.0, 100.0, 'm/s', above=True),
        'initial_rate': Range(0.0, 100.0, 'rad/s', above=True),
        'attitude_noise': Range(0.0, 1.0, 'rad'),
        'max_rejections': Range(1, 1000, whole=True),
        'max_gap': Range(0.0, 60.0, 's', above=True),
        'max_jump': Range(0.0, 60.0, 's', above=True),
    }


class UpdateOutcome(Enum):
    """What became of a measurement."""

    STARTED = 'track started'
    USED = 'used'
    POSITION_ONLY = 'implausible attitude, position used'
    OUTLIER = 'outside the gate'
    LATE = 'older than the estimate'


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
        return _POSE @ self.covariance @ _POSE.T

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
        covariance: Array = self.rotation.T @ self.covariance[_A, _A] @ self.rotation
        return covariance

    @property
    def child_twist_covariance(self) -> Array:
        """Return the covariance (6, 6) of ``child_twist``, the attitude's share included."""
        # R_true^T v_true = R^T (1 - [dr]x)(v + dv) = R^T (v + dv + [v]x dr).
        jacobian: Array = np.zeros((6, _SIZE))
        jacobian[:3, _V] = jacobian[3:, _W] = _EYE
        jacobian[:3, _R] = skew(self.velocity)
        jacobian[3:, _R] = skew(self.angular_velocity)
        to_child = np.zeros((6, 6))
        to_child[:3, :3] = to_child[3:, 3:] = self.rotation.T
        jacobian = to_child @ jacobian
        return jacobian @ self.covariance @ jacobian.T


class NeighborFilter:
    """The filter of one neighbour."""

    def __init__(self, params: FilterParams | None = None) -> None:
        self.params = params or FilterParams()
        self._steps: dict[float, tuple[Array, Array, Array]] = {}
        self._estimate: Estimate | None = None
        self._predicted: Estimate | None = None  # from that, to where it was last asked for
        self._outliers = 0
        self._attitude_outliers = 0
        self.walk = 0.0
        """Of one's own position, m/sqrt(s)."""

    def reset(self) -> None:
        """Forget the neighbour."""
        self._estimate = self._predicted = None
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
        if dt == 0.0:
            return now
        if self._predicted is None or self._predicted.stamp != stamp:
            linear, transition, noise = self._transition(dt)
            if self.walk:
                noise = noise + np.diag([self.walk**2 * dt] * 3 + [0.0] * (_SIZE - 3))
            self._predicted = Estimate(
                stamp, now.position + dt * now.velocity + linear[0, 2] * now.acceleration,
                now.velocity + linear[1, 2] * now.acceleration,
                rotation_vector_to_matrix(dt * now.angular_velocity).dot(now.rotation),
                now.angular_velocity, linear[2, 2] * now.acceleration,
                transition.dot(now.covariance).dot(transition.T) + noise)
        return self._predicted

    def _transition(self, dt: float) -> tuple[Array, Array, Array]:
        """Return what dt, s, does to (p, v, a), (3, 3), to the error state, and the noise."""
        dt = round(dt, 6)  # images come at even intervals, to the microsecond or so
        if dt not in self._steps:
            if len(self._steps) > 100:
                self._steps.clear()
            self._steps[dt] = _transition(dt, self.params)
        return self._steps[dt]

    def update(self, stamp: float, T_odom_body: Transform, reference: Array,
               covariance: Array) -> UpdateOutcome:
        """
        Take in a body's pose in odom, with covariance (6, 6) along odom's axes.

        The covariance is of the position of ``reference`` (3,), a point on the body, m, then of
        the rotation vector.
        """
        now = self._estimate
        if now is not None and stamp <= now.stamp:
            if now.stamp - stamp <= self.params.max_jump:
                return UpdateOutcome.LATE
            self.reset()
        expected = self.predict(stamp)
        if expected is None:
            return self._start(stamp, T_odom_body, reference, covariance)

        turn = matrix_to_rotation_vector(T_odom_body.rotation.dot(expected.rotation.T))
        spread = expected.covariance[_R, _R] + covariance[3:, 3:]
        # A marker's mirrored pose has its position right and its attitude wrong.
        plausible = _distance(turn, spread) <= GATE
        if plausible:
            place = T_odom_body.translation - expected.position
            to_body = _to_body(T_odom_body.rotation.dot(reference))
            jacobian: Array = _POSE
            noise: Array = to_body.dot(covariance).dot(to_body.T)
            innovation = np.concatenate([place, turn])
        else:  # with the attitude expected, then, from the point to the body
            lever = expected.rotation @ reference
            innovation = T_odom_body.apply(reference) - expected.position - lever
            jacobian, noise = _PLACE.copy(), covariance[:3, :3]
            jacobian[:, _R] = -skew(lever)
        spread = jacobian.dot(expected.covariance).dot(jacobian.T) + noise

        solved, gain = False, np.zeros(0)
        if _distance(innovation[:3], spread[:3, :3]) <= GATE:  # NaN is not
            solved, gain = cv2.solve(spread, jacobian.dot(expected.covariance))
        if not solved:
            self._outliers += 1
            if self._outliers < self.params.max_rejections:
                return UpdateOutcome.OUTLIER
            return self._start(stamp, T_odom_body, reference, covariance)
        self._outliers = 0
        self._attitude_outliers = 0 if plausible else self._attitude_outliers + 1
        if self._attitude_outliers >= self.params.max_rejections:
            return self._start(stamp, T_odom_body, reference, covariance, expected)
        self._correct(expected, innovation, jacobian, gain.T, noise)
        return UpdateOutcome.USED if plausible else UpdateOutcome.POSITION_ONLY

    def _correct(self, expected: Estimate, innovation: Array, jacobian: Array, gain: Array,
                 noise: Array) -> None:
        error = gain.dot(innovation)
        # Joseph's form stays symmetric and positive whatever the rounding.
        remain = _IDENTITY - gain.dot(jacobian)
        covariance = (remain.dot(expected.covariance).dot(remain.T)
                      + gain.dot(noise).dot(gain.T))
        self._predicted = None
        self._estimate = Estimate(
            expected.stamp, expected.position + error[_P], expected.velocity + error[_V],
            rotation_vector_to_matrix(error[_R]).dot(expected.rotation),
            expected.angular_velocity + error[_W], expected.acceleration + error[_A], covariance)

    def _start(self, stamp: float, body: Transform, reference: Array, covariance: Array,
               moving: Estimate | None = None) -> UpdateOutcome:
        """Start from one measurement; where ``moving`` is given, keep its velocity."""
        self.reset()
        to_body = _POSE.T @ _to_body(body.rotation @ reference)
        full = to_body @ covariance @ to_body.T
        velocity: Array = np.zeros(3)
        acceleration: Array = np.zeros(3)
        full[_V, _V] = self.params.initial_speed**2 * np.eye(3)
        full[_A, _A] = self.params.acceleration**2 * np.eye(3)
        if moving is not None:
            velocity, acceleration = moving.velocity, moving.acceleration
            for block in ((_V, _V), (_V, _A), (_A, _V), (_A, _A)):
                full[block] = moving.covariance[block]
        full[_W, _W] = self.params.initial_rate**2 * np.eye(3)
        self._estimate = Estimate(stamp, body.translation, velocity, body.rotation, np.zeros(3),
                                  acceleration, full)
        return UpdateOutcome.STARTED


def motion(dt: float, params: FilterParams) -> tuple[Array, Array]:
    """
    Return what dt, s, does to (p, v, a) along an axis, (3, 3), and the noise it adds, (3, 3).

    Singer's transition is exact. Its noise is that of white jerk of the same density, which it
    tends to for a time constant much longer than dt.
    """
    T, x = params.acceleration_time, dt / params.acceleration_time
    decay = math.exp(-x)
    linear = np.array([[1.0, dt, T * T * (x - 1.0 + decay)],
                       [0.0, 1.0, T * (1.0 - decay)],
                       [0.0, 0.0, decay]])
    density = 2.0 * params.acceleration**2 / T
    noise = density * np.array([[dt**5 / 20.0, dt**4 / 8.0, dt**3 / 6.0],
                                [dt**4 / 8.0, dt**3 / 3.0, dt**2 / 2.0],
                                [dt**3 / 6.0, dt**2 / 2.0, dt]])
    noise[:2, :2] += params.odometry_noise**2 * _walk(dt)
    return linear, noise


def _walk(dt: float) -> Array:
    """Return the covariance of a rate and its integral, driven for dt by white noise."""
    return np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])


def _transition(dt: float, params: FilterParams) -> tuple[Array, Array, Array]:
    linear, jerk = motion(dt, params)
    transition, noise = np.eye(_SIZE), np.zeros((_SIZE, _SIZE))
    order = (_P, _V, _A)
    for i, row in enumerate(order):
        for k, column in enumerate(order):
            transition[row, column] = linear[i, k] * _EYE
            noise[row, column] = jerk[i, k] * _EYE
    transition[_R, _W] = dt * _EYE
    noise[6:12, 6:12] = np.kron(params.angular_noise**2 * _walk(dt), _EYE)
    return linear, transition, noise


def _to_body(lever: Array) -> Array:
    """
    Return what takes the errors of a point and of the attitude, (6,), to those of the body.

    The point is off the body's origin by ``lever`` (3,) in odom: p = p_point - R l, so that
    dp = dp_point + [R l]x dr.
    """
    matrix = np.eye(6)
    matrix[:3, 3:] = skew(lever)
    return matrix


def _distance(innovation: Array, spread: Array) -> float:
    """Return the squared Mahalanobis distance; infinity where the spread (n, n) is singular."""
    solved, solution = cv2.solve(spread, innovation[:, None])
    return float(innovation.dot(solution[:, 0])) if solved else math.inf
