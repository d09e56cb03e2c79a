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
Odometry as a visual-inertial estimator gives it: true motion, drift, noise, honest covariances.

There is one model of the errors, with the parameters ``VioErrors``. :class:`Vio` has position,
velocity and yaw of n runs at once, which is what flights in lock step need; :class:`VioEstimator`
is one run of it with attitude, angular velocity and covariances, for bags and for the nodes.

The estimate starts without error. Its yaw then drifts as a random walk, which rotates all later
motion; the position has a random walk of its own. Tilt errors stay bounded, because gravity shows
the tilt. Velocity and angular velocity have errors of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flock_desk.scenarios.scenario import VioErrors
from flock_desk.scenarios.trajectories import Track
from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)

_BLOCK = 256  # steps whose random numbers are drawn together: it is faster
_NO_COVARIANCE = np.zeros((6, 6))


class Odometry(NamedTuple):
    """The content of a ``nav_msgs/Odometry``: pose in odom, twist in the child frame."""

    time: float
    """s."""
    position: Array
    """(3,), m."""
    quaternion: Array
    """(4,), ``(x, y, z, w)``, child frame to odom."""
    linear: Array
    """(3,), velocity in the child frame, m/s."""
    angular: Array
    """(3,), angular velocity in the child frame, rad/s."""
    pose_covariance: Array = _NO_COVARIANCE
    """(6, 6) of x, y, z and rotations about the fixed axes x, y, z; m^2, rad^2."""
    twist_covariance: Array = _NO_COVARIANCE
    """(6, 6) of linear and angular velocity in the child frame."""


class NormalBlocks:
    """Standard normal vectors of n generators, which nothing else may use, drawn in blocks."""

    def __init__(self, generators: Sequence[np.random.Generator], size: int) -> None:
        self._generators, self._size = generators, size
        self._drawn: Array = np.zeros((len(generators), 0, size))
        self._used = 0

    def draw(self) -> Array:
        """Return the next (n, size)."""
        if self._used == self._drawn.shape[1]:
            self._drawn = np.stack([
                g.standard_normal((_BLOCK, self._size)) for g in self._generators])
            self._used = 0
        self._used += 1
        return self._drawn[:, self._used - 1]


class Vio:
    """
    Position, velocity and yaw of n runs, step by step.

    :param position: true ones at the start (n, 3), m; :param velocity: likewise, m/s.
    :param generators: of the random numbers, one for each run.
    :param period: between steps, s.
    """

    def __init__(self, position: Array, velocity: Array, generators: list[np.random.Generator],
                 errors: VioErrors, period: float) -> None:
        self.position, self.velocity = position.copy(), velocity.copy()
        self.yaw_error: Array = np.zeros(len(position))
        self._true, self._walked = position.copy(), position.copy()
        self._correction, self._slip = np.zeros_like(position), np.zeros_like(position)
        self._normal = NormalBlocks(generators, 13)
        root = period ** 0.5
        self._yaw_walk = errors.yaw_walk * root
        self._walk = root * np.array(
            [errors.position_walk, errors.position_walk, errors.height_walk])
        self._keep_correction = float(np.exp(-period / errors.position_memory))
        self._keep_slip = float(np.exp(-period / errors.velocity_memory))
        self._errors = errors

    def step(self, position: Array, velocity: Array) -> None:
        """Take the true position and velocity (n, 3) one period later."""
        draw, errors = self._normal.draw(), self._errors
        self.yaw_error = self.yaw_error + self._yaw_walk * draw[:, 0]
        self._walked = (self._walked + turned(position - self._true, self.yaw_error)
                        + self._walk * draw[:, 1:4])
        self._true = position
        self._correction = _renewed(self._correction, self._keep_correction,
                                    errors.position * draw[:, 4:7])
        self._slip = _renewed(self._slip, self._keep_slip, errors.velocity * draw[:, 7:10])
        self.position = self._walked + self._correction
        self.velocity = (turned(velocity, self.yaw_error) + self._slip
                         + errors.velocity_white * draw[:, 10:13])


class VioEstimator:
    """
    The odometry of one vehicle: :class:`Vio`, attitude, and the covariances of both.

    :param start: the true motion at the start.
    :param period: between steps, s.
    """

    def __init__(self, start: Odometry, rng: np.random.Generator, errors: VioErrors,
                 period: float) -> None:
        self._errors, self._rng, self._period = errors, rng, period
        self._vio = Vio(start.position[None], _velocity(start)[None], [rng], errors, period)
        self._drift: Array = np.zeros((4, 4))  # covariance of the walking position and yaw
        self._walk = period * np.array(
            [errors.position_walk, errors.position_walk, errors.height_walk, errors.yaw_walk]) ** 2
        self._tilt: Array = errors.tilt * rng.standard_normal(2)
        self._tilt_bias: Array = (errors.tilt_bias * rng.standard_normal(2) if errors.tilt_bias
                                  else np.zeros(2))
        self._keep = float(np.exp(-period / errors.tilt_memory))
        self._bias = errors.gyro_bias * rng.standard_normal(3)
        self._twist_covariance = errors.twist_covariance
        self._position = start.position
        self.estimate = self._reported(start)
        """The newest odometry."""

    def step(self, true: Odometry) -> Odometry:
        """Return the odometry one period later, given the true motion then."""
        self._vio.step(true.position[None], _velocity(true)[None])
        dx, dy, _ = true.position - self._position
        self._position = true.position
        turn = np.eye(4)  # an error of yaw turns the way to come
        turn[:2, 3] = -dy, dx
        drift = turn @ self._drift @ turn.T
        self._drift = 0.5 * (drift + drift.T) + np.diag(self._walk)
        self._tilt = _renewed(self._tilt, self._keep,
                              self._errors.tilt * self._rng.standard_normal(2))
        self.estimate = self._reported(true)
        return self.estimate

    def _reported(self, true: Odometry) -> Odometry:
        vio, fresh = self._vio, self._rng.standard_normal(6)
        tilt = self._tilt + self._tilt_bias
        error = np.array([*tilt, 0.0]) + self._errors.attitude * fresh[:3]
        quaternion = canonical_quaternion(quaternion_multiply(
            quaternion_from_yaw(float(vio.yaw_error[0])),
            quaternion_multiply(rotation_vector_to_quaternion(error), true.quaternion)))
        return Odometry(true.time, vio.position[0], quaternion,
                        quaternion_to_matrix(quaternion).T @ vio.velocity[0],
                        true.angular + self._bias + self._errors.gyro * fresh[3:],
                        self._covariance(), self._twist_covariance)

    def _covariance(self) -> Array:
        """Return the covariance (6, 6) of the pose."""
        errors, covariance = self._errors, np.zeros((6, 6))
        covariance[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])] = self._drift
        return covariance + np.diag(
            [errors.position ** 2] * 3
            + [errors.tilt ** 2 + errors.tilt_bias ** 2 + errors.attitude ** 2] * 2
            + [errors.attitude ** 2])


class GaussMarkov:
    """
    First-order Gauss-Markov processes of n runs, one for each generator.

    :param size: of the vector that each is.
    :param deviation: of each component, standard; :param memory: its time constant, s.
    :param period: between steps, s.
    :param bias: standard deviation of the constant part, which is added.
    """

    def __init__(self, generators: Sequence[np.random.Generator], size: int, deviation: float,
                 memory: float, period: float, bias: float = 0.0) -> None:
        first = np.stack([g.standard_normal((2, size)) for g in generators])
        self._bias = bias * first[:, 0]
        self._value: Array = deviation * first[:, 1]
        self._normal = NormalBlocks(generators, size)
        self._deviation = deviation
        self._keep = float(np.exp(-period / memory))

    def step(self) -> Array:
        """Return the values (n, size) one period later."""
        self._value = _renewed(self._value, self._keep, self._deviation * self._normal.draw())
        return self._bias + self._value


class Due:
    """Selects the steps of a simulation that give a sample, at most ``rate``, Hz, of them."""

    def __init__(self, rate: float) -> None:
        self._period, self.next = 1.0 / rate, 0.0

    def at(self, time: float) -> bool:
        """Return whether a step at a time, s, gives one."""
        if time < self.next - 1e-9:
            return False
        # The next one keeps step with this where it can, and never catches up.
        self.next = max(self.next + self._period, time + 0.5 * self._period)
        return True


def odometry(track: Track, times: Sequence[float] | Array, errors: VioErrors,
             seed: int) -> list[Odometry]:
    """Return the odometry of a vehicle at evenly spaced times, s, within its track."""
    true = [true_odometry(track, float(time)) for time in times]
    estimator = VioEstimator(true[0], np.random.default_rng(seed), errors,
                             float(times[1] - times[0]))
    return [estimator.estimate, *(estimator.step(motion) for motion in true[1:])]


def true_odometry(track: Track, time: float) -> Odometry:
    """Return the motion of a vehicle at a time, s, without error: its covariances are zero."""
    pose = track.pose(time)
    return Odometry(
        time, pose.translation.round(7), pose.quaternion.round(9),
        (quaternion_to_matrix(pose.quaternion).T @ track.velocity(time)).round(7),
        track.rate(time).round(7))


def turned(vectors: Array, angle: Array) -> Array:
    """Return vectors (n, 3) turned about z by angles (n,), rad."""
    c, s, x, y = np.cos(angle), np.sin(angle), vectors[:, 0], vectors[:, 1]
    result = np.empty_like(vectors)
    result[:, 0], result[:, 1], result[:, 2] = c * x - s * y, s * x + c * y, vectors[:, 2]
    return result


def _velocity(motion: Odometry) -> Array:
    return quaternion_to_matrix(motion.quaternion) @ motion.linear


def _renewed(values: Array, keep: float, fresh: Array) -> Array:
    """Return a first-order Gauss-Markov process one step later."""
    return keep * values + (1.0 - keep ** 2) ** 0.5 * fresh
