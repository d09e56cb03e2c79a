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

"""Odometry messages of other nodes as states; ``odometry.reader`` reads those of any source."""

from __future__ import annotations

from typing import Any

import numpy as np

from flock_follower.geometry import normalize_quaternion, quaternion_to_matrix
from flock_follower.messages import OdometryState, read_stamp, SANE, to_array


def from_odometry(message: Any, twist_frame: str = 'child') -> OdometryState:
    """
    Return the state of an Odometry message, its velocity in the header's frame.

    ``twist_frame`` is 'child' for a twist in the child frame (REP-105) or 'odom' for sources
    that put the linear velocity in the header's frame.

    :raises ValueError: if position, attitude or velocity is not finite, or beyond ``SANE``, or
        the stamp is invalid.
    """
    pose, twist = message.pose.pose, message.twist.twist
    x = pose.orientation
    stamp, q = read_stamp(message.header.stamp), normalize_quaternion([x.x, x.y, x.z, x.w])
    position, linear, angular = map(to_array, (pose.position, twist.linear, twist.angular))
    for name, value in (('position', position), ('linear velocity', linear),
                        ('angular velocity', angular)):
        if not all(abs(number) <= SANE for number in value.tolist()):  # written so that NaN fails
            raise ValueError(f'{name} = {value.tolist()}: must be finite, and within {SANE:g}')
    rotation = quaternion_to_matrix(q) if twist_frame == 'child' else np.eye(3)
    return OdometryState(
        stamp, message.header.frame_id, message.child_frame_id, position, q, rotation.dot(linear),
        angular, np.asarray(message.pose.covariance, dtype=float).reshape(6, 6),
        np.asarray(message.twist.covariance, dtype=float).reshape(6, 6), rotation)
