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

The estimate starts without error. Its yaw then walks at random, and turns every further step of
the position, which walks at random too; tilt errors stay bounded, for gravity shows. Velocity
and angular velocity have errors of their own. The covariances are those of exactly these errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from flock_follower.simulation.scenarios.trajectories import Track


class Odometry(NamedTuple):
    """What a ``nav_msgs/Odometry`` holds: pose in odom, twist in the child frame."""

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
    pose_covariance: Array
    """(6, 6) of x, y, z and rotations about the fixed axes x, y, z; m^2, rad^2."""
    twist_covariance: Array
    """(6, 6) of linear and angular velocity in the child frame."""


@dataclass(frozen=True)
class VioNoise:
    """Standard deviations of the errors of a visual-inertial estimator."""

    position_walk: float = 0.02
    """Drift of every coordinate, m after 1 s, growing with the root of time."""
    yaw_walk: float = 0.0017
    """Drift of yaw, rad after 1 s."""
    position: float = 0.003
    """Error of the newest correction, m, renewed in about 0.5 s."""
    tilt: float = 0.003
    """Error of roll and pitch, rad, renewed in about 5 s."""
    attitude: float = 0.0004
    """White noise about each axis, rad."""
    velocity: float = 0.02
    """Error per axis, m/s, renewed in about 0.3 s."""
    velocity_white: float = 0.006
    """m/s."""
    gyro_bias: float = 0.002
    """What is left of the gyroscopes' bias, rad/s, constant."""
    gyro: float = 0.006
    """White noise of the gyroscopes, rad/s."""


def odometry(track: Track, times: Sequence[float] | Array, noise: VioNoise,
             seed: int) -> list[Odometry]:
    """Return the odometry of a vehicle at evenly spaced times, s, within its track."""
    times = np.asarray(times, dtype=float)
    count, step = len(times), float(times[1] - times[0])
    rng = np.random.default_rng(seed)
    root = step**0.5
    yaw = _walk(rng, (count, 1), noise.yaw_walk * root)[:, 0]
    walk = _walk(rng, (count, 3), noise.position_walk * root)
    correction = _renewed(rng, (count, 3), noise.position, step / 0.5)
    correction -= correction[0]
    tilt = _renewed(rng, (count, 2), noise.tilt, step / 5.0)
    white = noise.attitude * rng.standard_normal((count, 3))
    linear = _renewed(rng, (count, 3), noise.velocity, step / 0.3) + (
        noise.velocity_white * rng.standard_normal((count, 3)))
    angular = (noise.gyro_bias * rng.standard_normal(3)
               + noise.gyro * rng.standard_normal((count, 3)))

    true = [true_odometry(track, time) for time in times]
    position = true[0].position
    drift: Array = np.zeros((4, 4))  # covariance of the walking position and yaw
    twist_covariance = np.diag([noise.velocity**2 + noise.velocity_white**2] * 3
                               + [noise.gyro_bias**2 + noise.gyro**2] * 3)
    estimates = []
    for k, state in enumerate(true):
        if k:
            dx, dy, dz = state.position - true[k - 1].position
            c, s = np.cos(yaw[k - 1]), np.sin(yaw[k - 1])
            position = position + np.array([c * dx - s * dy, s * dx + c * dy, dz])
            f = np.eye(4)
            f[:2, 3] = -dy, dx
            drift = f @ drift @ f.T + step * np.diag(
                [noise.position_walk**2] * 3 + [noise.yaw_walk**2])
        error = np.array([tilt[k, 0], tilt[k, 1], 0.0]) + white[k]
        quaternion = quaternion_multiply(
            quaternion_from_yaw(yaw[k]),
            quaternion_multiply(rotation_vector_to_quaternion(error), state.quaternion))
        covariance = np.zeros((6, 6))
        covariance[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])] = drift
        covariance += np.diag([2 * noise.position**2] * 3 + [noise.tilt**2] * 2 + [0.0])
        covariance[3:, 3:] += noise.attitude**2 * np.eye(3)
        estimates.append(Odometry(
            state.time, (position + walk[k] + correction[k]).round(6),
            canonical_quaternion(quaternion).round(8), (state.linear + linear[k]).round(6),
            (state.angular + angular[k]).round(6), covariance.round(12), twist_covariance))
    return estimates


def true_odometry(track: Track, time: float) -> Odometry:
    """Return the motion of a vehicle at a time, s, without error: its covariances are zero."""
    pose = track.pose(time)
    return Odometry(
        time, pose.translation.round(7), pose.quaternion.round(9),
        (quaternion_to_matrix(pose.quaternion).T @ track.velocity(time)).round(7),
        track.rate(time).round(7), np.zeros((6, 6)), np.zeros((6, 6)))


def _walk(rng: np.random.Generator, shape: tuple[int, int], step: float) -> Array:
    """Return random walks (count, n) that start at 0."""
    steps = step * rng.standard_normal(shape)
    steps[0] = 0.0
    return np.cumsum(steps, axis=0)


def _renewed(rng: np.random.Generator, shape: tuple[int, int], sigma: float,
             renewal: float) -> Array:
    """Return stationary errors (count, n) with memory: first-order Gauss-Markov processes."""
    keep = 1.0 - renewal
    values = sigma * rng.standard_normal(shape)
    for k in range(1, shape[0]):
        values[k] = keep * values[k - 1] + (1.0 - keep**2) ** 0.5 * values[k]
    return values
