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
The state of a neighbor and its motion model.

``Estimate``: position p, velocity v and acceleration a of the neighbor's body, its attitude R
(body to odom) and angular velocity w, all in odom. The error state is (dp, dv, dr, dw, da), (15,),
with R_true = exp(dr) R, a rotation vector along odom's axes.

``transition``: the acceleration follows Singer's model ("Estimating optimal tracking filter
performance for manned maneuvering targets", IEEE Trans. AES, 1970): it has the standard deviation
s, decays with a time constant T, and is driven by white jerk of spectral density 2 s^2 / T. White
angular acceleration drives the angular velocity.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    matrix_to_quaternion,
    skew,
    Transform,
)
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.messages import FASTEST
from flock_follower.ranges import Checked, parameter, Range

#: Slices of the error state.
POSITION, VELOCITY, ATTITUDE, RATE, ACCELERATION = (slice(k, k + 3) for k in range(0, 15, 3))
STATE_SIZE = 15
#: Rows of the error state that form a pose, (6, 15).
POSE = np.concatenate([np.eye(STATE_SIZE)[POSITION], np.eye(STATE_SIZE)[ATTITUDE]])


class Estimate(NamedTuple):
    """
    A neighbor's state at a stamp, s, in odom.

    ``position`` (3,), m; ``velocity`` (3,), m/s; ``rotation`` (3, 3), body to odom;
    ``angular_velocity`` (3,), rad/s, along odom's axes; ``acceleration`` (3,), m/s^2;
    ``covariance`` (15, 15) of the errors of position, velocity, attitude (rotation vector along
    odom's axes), angular velocity and acceleration. The covariance is that of the state relative
    to the ego state, because both have the same errors of the odometry. Published covariances add
    the white noise of the ego attitude and velocity.
    """

    stamp: float
    position: Array
    velocity: Array
    rotation: Array
    angular_velocity: Array
    acceleration: Array
    covariance: Array

    def propagate(self, stamp: float, linear: Array, transition: Array, noise: Array) -> Estimate:
        """Return the state at another stamp, given ``neighbor_motion.transition`` to there."""
        dt = stamp - self.stamp
        return Estimate(
            stamp, self.position + dt * self.velocity + linear[0, 2] * self.acceleration,
            self.velocity + linear[1, 2] * self.acceleration,
            rotation_vector_to_matrix(dt * self.angular_velocity).dot(self.rotation),
            self.angular_velocity, linear[2, 2] * self.acceleration,
            transition.dot(self.covariance).dot(transition.T) + noise)

    def corrected(self, error: Array, covariance: Array) -> Estimate:
        """Return the state plus an error state (15,), with a new covariance (15, 15)."""
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
        """Return ``T_odom_body`` of the neighbor."""
        return Transform(self.rotation, self.position)

    @property
    def pose_covariance(self) -> Array:
        """Return the covariance (6, 6) of position and rotation about odom's axes (REP-103)."""
        return POSE.dot(self.covariance).dot(POSE.T)

    @property
    def child_twist(self) -> Array:
        """Return linear and angular velocity (6,) in the neighbor's body frame (REP-105)."""
        return np.concatenate([self.rotation.T.dot(self.velocity),
                               self.rotation.T.dot(self.angular_velocity)])

    @property
    def child_acceleration(self) -> Array:
        """Return the acceleration (3,) in the neighbor's body frame."""
        return self.rotation.T.dot(self.acceleration)

    @property
    def child_acceleration_covariance(self) -> Array:
        """Return the covariance (3, 3) of ``child_acceleration``, without the attitude's share."""
        own = self.covariance[ACCELERATION, ACCELERATION]
        covariance: Array = self.rotation.T.dot(own).dot(self.rotation)
        return covariance

    @property
    def child_twist_covariance(self) -> Array:
        """Return the covariance (6, 6) of ``child_twist``, the attitude's share included."""
        # R_true^T v_true = R^T (1 - [dr]x)(v + dv) = R^T (v + dv + [v]x dr).
        jacobian: Array = np.zeros((6, STATE_SIZE))
        jacobian[:3, VELOCITY] = jacobian[3:, RATE] = np.eye(3)
        jacobian[:3, ATTITUDE] = skew(self.velocity)
        jacobian[3:, ATTITUDE] = skew(self.angular_velocity)
        to_child = np.zeros((6, 6))
        to_child[:3, :3] = to_child[3:, 3:] = self.rotation.T
        jacobian = to_child.dot(jacobian)
        return jacobian.dot(self.covariance).dot(jacobian.T)


_EYE_3 = np.eye(3)
#: Position, velocity and acceleration among the five parts of the error state.
_MOTION = np.ix_((0, 1, 4), (0, 1, 4))
#: Random walk of the ego position without a measured velocity, m/sqrt(s).
ODOMETRY_WALK = 0.02
#: Standard deviation of a neighbor's angular velocity before any motion was seen, rad/s.
INITIAL_RATE = 0.5


@dataclass(frozen=True)
class FilterParams(Checked):
    """
    Motion model of neighbors, and limits for measurements.

    ``acceleration`` is the standard deviation of a neighbor's acceleration, m/s^2 per axis, and
    ``acceleration_time`` the time in which it changes, s. ``angular_noise`` is the root of the
    spectral density of its angular acceleration, rad/s^2/sqrt(Hz). ``odometry_noise`` is the
    random walk of the error of the ego velocity, m/s^2/sqrt(Hz). ``initial_speed``, m/s, is the
    standard deviation of the velocity at the beginning of a track. ``attitude_noise``, rad, is
    the noise of the ego attitude from one image to the next, which moves a distant neighbor
    sideways.

    The filter restarts after ``max_rejections`` successive measurements outside the gate; after
    0.2 s with at least three measurements whose attitude is outside; after a gap above ``max_gap``
    s; and for a stamp more than ``MAX_JUMP`` s back. A restart at a place that a neighbor cannot
    reach with ``leader_speed_max``, m/s, is refused, see ``hypotheses``.
    """

    acceleration: float = parameter(
        0.5, Range(0.01, 100.0, 'm/s^2'),
        "standard deviation of a neighbor's acceleration per axis", live=False)
    acceleration_time: float = parameter(
        1.0, Range(0.01, 100.0, 's'), "correlation time of a neighbor's acceleration", live=False)
    angular_noise: float = parameter(2.0, Range(0.01, 100.0, 'rad/s^2/sqrt(Hz)'))
    odometry_noise: float = parameter(0.03, Range(0.0, 100.0, 'm/s^2/sqrt(Hz)', above=True))
    initial_speed: float = parameter(1.0, Range(0.0, 100.0, 'm/s', above=True))
    attitude_noise: float = parameter(0.0005, Range(0.0, 1.0, 'rad'))
    max_rejections: int = parameter(6, Range(1, 1000, whole=True))
    max_gap: float = parameter(2.0, Range(0.0, 60.0, 's', above=True))
    leader_speed_max: float = parameter(
        2.0, Range(0.0, FASTEST, 'm/s'),
        "a track restarts only at a place that a neighbor at this speed can reach; the planner's "
        'leader_speed_max must be the same',
        live=False)


def motion(dt: float, params: FilterParams) -> tuple[Array, Array]:
    """
    Return the transition of (p, v, a) along an axis in dt, s, (3, 3), and its noise, (3, 3).

    Singer's transition is exact. The noise is that of white jerk with the same density, a good
    approximation for a time constant much longer than dt. A negative dt predicts backwards, and
    adds the same noise.
    """
    T, x = params.acceleration_time, dt / params.acceleration_time
    decay = math.exp(-x)
    linear = np.array([[1.0, dt, T * T * (x - 1.0 + decay)],
                       [0.0, 1.0, T * (1.0 - decay)],
                       [0.0, 0.0, decay]])
    density, dt = 2.0 * params.acceleration**2 / T, abs(dt)
    noise = density * np.array([[dt**5 / 20.0, dt**4 / 8.0, dt**3 / 6.0],
                                [dt**4 / 8.0, dt**3 / 3.0, dt**2 / 2.0],
                                [dt**3 / 6.0, dt**2 / 2.0, dt]])
    noise[:2, :2] += params.odometry_noise**2 * _walk(dt)
    return linear, noise


def _walk(dt: float) -> Array:
    """Return the covariance of a rate and its integral, driven for dt by white noise."""
    return np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])


def transition(dt: float, params: FilterParams) -> tuple[Array, Array, Array]:
    """
    Return the transitions of (p, v, a), (3, 3), and of the error state, (15, 15), and its noise.

    See :func:`motion`; dt is in s.
    """
    linear, jerk = motion(dt, params)
    # Along one axis: position, velocity, attitude, rate and acceleration.
    whole, noise = np.eye(5), np.zeros((5, 5))
    whole[_MOTION], noise[_MOTION] = linear, jerk
    whole[2, 3], noise[2:4, 2:4] = dt, params.angular_noise**2 * _walk(abs(dt))
    return linear, np.kron(whole, _EYE_3), np.kron(noise, _EYE_3)


def turned_along(covariance: Array, before: Array, now: Array) -> Array:
    """
    Return a covariance (15, 15) rotated from one line to another.

    If only the distance of a neighbor is known, the neighbor may be anywhere on a sphere. If the
    line to its most likely place rotates from ``before`` to ``now``, unit vectors (3,), the
    covariance rotates with this line. With ``before`` zero nothing is rotated.
    """
    cross = skew(np.cross(before, now))
    turn = _EYE_3 + cross + cross @ cross / max(1.0 + float(before.dot(now)), 0.1)
    whole = np.eye(STATE_SIZE)
    for part in (POSITION, VELOCITY, ACCELERATION):
        whole[part, part] = turn
    return whole @ covariance @ whole.T


def bounded_across(covariance: Array, along: Array, distance: float, speed: float) -> Array:
    """
    Return a covariance (15, 15) with bounded deviations across a line ``along`` (3,).

    Across the line along which the distance, m, was measured, the standard deviation of the
    position is at most the distance, and that of the velocity at most ``speed``, m/s. Larger
    deviations would make the distance uncertain after a small rotation of the line.
    """
    scale, line = np.eye(STATE_SIZE), np.outer(along, along)
    for part, most in ((POSITION, distance), (VELOCITY, speed)):
        across = float(((_EYE_3 - line) * covariance[part, part]).sum())
        share = min(most / math.sqrt(max(0.5 * across, 1e-12)), 1.0)
        scale[part, part] = line + share * (_EYE_3 - line)
    return scale @ covariance @ scale.T
