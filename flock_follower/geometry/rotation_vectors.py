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

"""Rotation vectors and matrices, and interpolation: of the nodes in flight only relative_pose."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
    unit_quaternion_to_rotation_vector,
)


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
    return unit_quaternion_to_rotation_vector(matrix_to_quaternion(rotation))


def slerp(q0: ArrayLike, q1: ArrayLike, fraction: float) -> Array:
    """Return the rotation at a fraction of the shorter arc from q0 (0) to q1 (1)."""
    delta = quaternion_multiply(quaternion_conjugate(normalize_quaternion(q0)), q1)
    step = rotation_vector_to_quaternion(fraction * quaternion_to_rotation_vector(delta))
    return quaternion_multiply(normalize_quaternion(q0), step)
