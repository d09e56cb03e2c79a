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
Rotations, frames and rigid transforms, in the conventions of REP-103 and REP-105.

A quaternion is an array ``(x, y, z, w)`` as in ``geometry_msgs``. A rotation ``q_a_b`` or
``R_a_b`` converts coordinates from frame b to frame a: ``p_a = R_a_b @ p_b``.

=========  ==========================================  ==============================
name       axes                                        used for
=========  ==========================================  ==============================
ENU        x east, y north, z up                       the world (``odom``), REP-103
FLU        x forward, y left, z up                     bodies (``base_link``), REP-103
optical    x right, y down, z forward                  images, REP-103
=========  ==========================================  ==============================

The frames of MAVLink are in ``ned``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]

#: Rotation taking optical coordinates to FLU coordinates (REP-103, suffix ``_optical``).
R_FLU_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

IDENTITY_QUATERNION: Array = np.array([0.0, 0.0, 0.0, 1.0])

#: Standard acceleration of gravity, m/s^2.
GRAVITY = 9.80665

#: m, or m/s: a shorter vector has no direction.
SHORTEST = 1e-6


def wrap_angle(angle: float) -> float:
    """Return the angle in radians, wrapped to [-pi, pi)."""
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def normalize_quaternion(q: ArrayLike) -> Array:
    """
    Return the quaternion scaled to unit length.

    :raises ValueError: if the quaternion is not four finite numbers, or its length is below 1e-6.
    """
    a = np.asarray(q, dtype=float)
    norm = math.sqrt(a.dot(a)) if a.shape == (4,) else math.nan
    if not math.isfinite(norm):
        raise ValueError(f'quaternion = {a.tolist()}: must be four finite numbers (x, y, z, w)')
    if norm < 1e-6:
        raise ValueError(f'quaternion = {a.tolist()}: its length must be above 1e-6')
    return a / norm


def canonical_quaternion(q: ArrayLike) -> Array:
    """Return q, or -q (the same rotation) if w is negative."""
    a = np.asarray(q, dtype=float)
    return -a if a[3] < 0.0 else a


def quaternion_multiply(q1: ArrayLike, q2: ArrayLike) -> Array:
    """Return the Hamilton product q1 * q2: the rotation q2 followed by q1."""
    x1, y1, z1, w1 = np.asarray(q1, dtype=float).tolist()
    x2, y2, z2, w2 = np.asarray(q2, dtype=float).tolist()
    return np.array([
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2])


def quaternion_conjugate(q: ArrayLike) -> Array:
    """Return the conjugate: the inverse rotation of a unit quaternion."""
    x, y, z, w = np.asarray(q, dtype=float).tolist()
    return np.array([-x, -y, -z, w])


def quaternion_to_matrix(q: ArrayLike) -> Array:
    """Return the (3, 3) rotation matrix of a quaternion of any length above zero."""
    return unit_quaternion_to_matrix(normalize_quaternion(q))


def unit_quaternion_to_matrix(q: Array) -> Array:
    """Return the (3, 3) rotation matrix of a quaternion of length 1."""
    x, y, z, w = q.tolist()
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def matrix_to_quaternion(rotation: ArrayLike) -> Array:
    """Return the unit quaternion, w >= 0, of a (3, 3) rotation matrix (Shepperd's method)."""
    m = np.asarray(rotation, dtype=float).tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    largest = max(m[0][0], m[1][1], m[2][2], trace)
    if largest == trace:
        q = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1.0 + trace]
    else:
        i = 0 if largest == m[0][0] else 1 if largest == m[1][1] else 2
        j, k = (i + 1) % 3, (i + 2) % 3
        q = [0.0] * 4
        q[i] = 1.0 + m[i][i] - m[j][j] - m[k][k]
        q[j] = m[j][i] + m[i][j]
        q[k] = m[k][i] + m[i][k]
        q[3] = m[k][j] - m[j][k]
    scale = math.copysign(1.0 / math.sqrt(sum(c * c for c in q)), q[3])
    return np.array([scale * c for c in q])


def rotation_vector_to_quaternion(vector: ArrayLike) -> Array:
    """Return the unit quaternion of a rotation vector (axis times angle, rad)."""
    x, y, z = np.asarray(vector, dtype=float).tolist()
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    scale = 0.5 * (math.sin(half) / half if half > 0.0 else 1.0)
    return np.array([scale * x, scale * y, scale * z, math.cos(half)])


def quaternion_to_rotation_vector(q: ArrayLike) -> Array:
    """Return the rotation vector (axis times angle, rad), angle in [0, pi], of a quaternion."""
    return _rotation_vector(canonical_quaternion(normalize_quaternion(q)))


def _rotation_vector(q: Array) -> Array:
    """Return the rotation vector of a unit quaternion with w >= 0."""
    x, y, z, w = q.tolist()
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return np.array([scale * x, scale * y, scale * z])


def rotation_vector_to_matrix(vector: ArrayLike) -> Array:
    """Return the (3, 3) rotation matrix of a rotation vector (axis times angle, rad)."""
    x, y, z = np.asarray(vector, dtype=float).tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    # Rodrigues' formula; near 0 its fractions are 1 and 1/2.
    sine, versine = (1.0, 0.5) if angle < 1e-6 else (
        math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle)**2)
    xx, yy, zz = versine * x * x, versine * y * y, versine * z * z
    xy, xz, yz = versine * x * y, versine * x * z, versine * y * z
    sx, sy, sz = sine * x, sine * y, sine * z
    return np.array([[1.0 - yy - zz, xy - sz, xz + sy],
                     [xy + sz, 1.0 - xx - zz, yz - sx],
                     [xz - sy, yz + sx, 1.0 - xx - yy]])


def matrix_to_rotation_vector(rotation: ArrayLike) -> Array:
    """Return the rotation vector (axis times angle, rad) of a (3, 3) rotation matrix."""
    return _rotation_vector(matrix_to_quaternion(rotation))


def quaternion_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Return the quaternion of fixed-axis roll, pitch, yaw in rad (URDF's convention)."""
    qx = rotation_vector_to_quaternion([roll, 0.0, 0.0])
    qy = rotation_vector_to_quaternion([0.0, pitch, 0.0])
    qz = rotation_vector_to_quaternion([0.0, 0.0, yaw])
    return canonical_quaternion(quaternion_multiply(qz, quaternion_multiply(qy, qx)))


def rpy_from_matrix(rotation: ArrayLike) -> Array:
    """Return roll, pitch, yaw (3,), rad, of a rotation (3, 3); pitch in [-pi/2, pi/2]."""
    R = np.asarray(rotation, dtype=float)
    pitch = math.asin(min(max(-R[2, 0], -1.0), 1.0))
    if abs(R[2, 0]) < 1.0 - 1e-6:
        return np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])
    # Roll and yaw turn about one axis: all of it is yaw.
    return np.array([0.0, pitch, math.atan2(-R[0, 1], R[1, 1])])


def quaternion_from_yaw(yaw: float) -> Array:
    """Return the quaternion of a rotation by yaw, rad, about z."""
    return np.array([0.0, 0.0, np.sin(yaw / 2.0), np.cos(yaw / 2.0)])


def yaw_from_quaternion(q: ArrayLike) -> float:
    """Return the yaw, rad in [-pi, pi], of an attitude quaternion (z-y-x convention)."""
    x, y, z, w = normalize_quaternion(q).tolist()
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def slerp(q0: ArrayLike, q1: ArrayLike, fraction: float) -> Array:
    """Return the rotation at a fraction of the shorter arc from q0 (0) to q1 (1)."""
    delta = quaternion_multiply(quaternion_conjugate(normalize_quaternion(q0)), q1)
    step = rotation_vector_to_quaternion(fraction * quaternion_to_rotation_vector(delta))
    return quaternion_multiply(normalize_quaternion(q0), step)


def skew(vector: ArrayLike) -> Array:
    """Return the (3, 3) matrix S with ``S @ u == cross(vector, u)``."""
    x, y, z = np.asarray(vector, dtype=float).tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


class Transform(NamedTuple):
    """
    A rigid transform ``T_a_b``: coordinates in frame b to coordinates in frame a.

    ``rotation`` is the matrix (3, 3), ``translation`` the origin of b in a, (3,), m.
    ``T_a_b @ T_b_c`` composes to ``T_a_c``; ``T_a_b.apply(p_b)`` is ``p_a``, shape (..., 3).
    """

    rotation: Array = np.broadcast_to(np.eye(3), (3, 3))  # read-only: all identities share it
    translation: Array = np.broadcast_to(np.zeros(3), (3,))

    @classmethod
    def from_quaternion(cls, translation: ArrayLike, quaternion: ArrayLike) -> Transform:
        """Build from an origin (3,), m, and a quaternion ``(x, y, z, w)``."""
        return cls(quaternion_to_matrix(quaternion), np.asarray(translation, dtype=float))

    @property
    def quaternion(self) -> Array:
        """Return the rotation as a unit quaternion ``(x, y, z, w)``, w >= 0."""
        return matrix_to_quaternion(self.rotation)

    def __matmul__(self, other: Transform) -> Transform:
        """Compose: ``(self @ other).apply(p) == self.apply(other.apply(p))``."""
        return Transform(self.rotation.dot(other.rotation),
                         self.rotation.dot(other.translation) + self.translation)

    def inverse(self) -> Transform:
        """Return the transform ``T_b_a``."""
        return Transform(self.rotation.T, -self.rotation.T.dot(self.translation))

    def apply(self, points: ArrayLike) -> Array:
        """Return the coordinates in a, (..., 3), of points given in b."""
        return np.asarray(points, dtype=float).dot(self.rotation.T) + self.translation
