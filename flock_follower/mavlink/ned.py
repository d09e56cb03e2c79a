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
The frames of MAVLink: NED for the world, FRD for bodies.

NED: x north, y east, z down. FRD: x forward, y right, z down. See ``geometry`` for the others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, canonical_quaternion, quaternion_multiply, wrap_angle


def enu_to_ned(vector: ArrayLike) -> Array:
    """Return the NED coordinates, shape ``(..., 3)``, of vectors given in ENU; self-inverse."""
    v = np.asarray(vector, dtype=float)
    ned = np.empty((*v.shape[:-1], 3))  # np.stack takes three times as long
    ned[..., 0], ned[..., 1], ned[..., 2] = v[..., 1], v[..., 0], -v[..., 2]
    return ned


ned_to_enu = enu_to_ned


def flu_to_frd(vector: ArrayLike) -> Array:
    """Return the FRD coordinates, shape ``(..., 3)``, of vectors given in FLU; self-inverse."""
    v = np.asarray(vector, dtype=float)
    frd = np.empty((*v.shape[:-1], 3))
    frd[..., 0], frd[..., 1], frd[..., 2] = v[..., 0], -v[..., 1], -v[..., 2]
    return frd


frd_to_flu = flu_to_frd


def yaw_enu_to_ned(yaw: float) -> float:
    """Return the NED yaw (clockwise from north) of an ENU yaw (anticlockwise from east), rad."""
    return wrap_angle(np.pi / 2.0 - yaw)


yaw_ned_to_enu = yaw_enu_to_ned


def quaternion_enu_flu_to_ned_frd(q_enu_flu: ArrayLike) -> Array:
    """Return the attitude NED<-FRD, ``(x, y, z, w)``, of an attitude ENU<-FLU; self-inverse."""
    # R_ned_frd = R_ned_enu R_enu_flu R_flu_frd, with both constant rotations as quaternions.
    half = np.sqrt(0.5)
    q_ned_enu = np.array([half, half, 0.0, 0.0])
    q_flu_frd = np.array([1.0, 0.0, 0.0, 0.0])
    return canonical_quaternion(
        quaternion_multiply(quaternion_multiply(q_ned_enu, q_enu_flu), q_flu_frd))


quaternion_ned_frd_to_enu_flu = quaternion_enu_flu_to_ned_frd
