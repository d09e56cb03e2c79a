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

"""States as Odometry messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import canonical_quaternion, quaternion_to_matrix
from flock_follower.messages import (
    Make,
    OdometryState,
    set_quaternion,
    set_stamp,
    set_vector,
)

ODOMETRY = 'nav_msgs/msg/Odometry'


def odometry(make: Make, stamp: int, frame: str, child: str, position: ArrayLike,
             quaternion: ArrayLike, velocity_child: ArrayLike,
             angular_velocity_child: ArrayLike = (0.0, 0.0, 0.0),
             pose_covariance: Any = None, twist_covariance: Any = None) -> Any:
    """
    Return an Odometry message; the twist is given, and sent, in the child frame (REP-105).

    ``stamp`` in ns. Covariances are (6, 6), in the order x, y, z, rotations about x, y, z. None
    becomes zeros, which means unknown.
    """
    message = make(ODOMETRY)
    set_stamp(message.header.stamp, stamp)
    message.header.frame_id = frame
    message.child_frame_id = child
    set_vector(message.pose.pose.position, position)
    set_quaternion(message.pose.pose.orientation, canonical_quaternion(quaternion))
    set_vector(message.twist.twist.linear, velocity_child)
    set_vector(message.twist.twist.angular, angular_velocity_child)
    if pose_covariance is not None:
        message.pose.covariance = np.asarray(pose_covariance, dtype=float).reshape(36)
    if twist_covariance is not None:
        message.twist.covariance = np.asarray(twist_covariance, dtype=float).reshape(36)
    return message


def from_state(make: Make, state: OdometryState) -> Any:
    """Return the Odometry message of a state, its twist in the child frame (REP-105)."""
    to_child = quaternion_to_matrix(state.quaternion).T
    twist = state.twist_covariance.copy()
    twist[:3, :3] = to_child.dot(state.velocity_covariance).dot(to_child.T)
    return odometry(make, state.stamp, state.frame, state.child, state.position,
                    state.quaternion, to_child.dot(state.velocity), state.angular_velocity,
                    state.pose_covariance, twist)
