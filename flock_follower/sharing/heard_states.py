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

"""A told state turned from its teller's frame to one's own, with all that makes it uncertain."""

from __future__ import annotations

import numpy as np

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
)
from flock_follower.messages import OdometryState
from flock_follower.sharing.frame_alignment import FrameAlignment, sideways
from flock_follower.sharing.sharing_params import SharingParams
from flock_follower.sharing.word_checks import is_covariance

#: Of a velocity whose covariance is not told, m/s.
VELOCITY_STD = 0.1


def position_covariance(state: OdometryState, own: bool, params: SharingParams) -> Array:
    """
    Return the covariance (3, 3) of a position told, within the frame of who tells it.

    Of oneself (``own``) the odometry's drift is no part of it: that is the frame's. So it is small
    whatever the odometry says of itself. What is seen is known as well as it was seen.
    """
    noise = params.odometry_noise if own else params.sighting_noise
    told: Array = np.zeros((3, 3)) if own else state.pose_covariance[:3, :3]
    return told + noise ** 2 * np.eye(3)


def in_own_frame(state: OdometryState, teller: str, frame: str, age: float,
                 frames: FrameAlignment, params: SharingParams) -> OdometryState:
    """
    Return a state told by a teller whose frame is known, in one's own frame.

    Its stamp stays: that is when it was so. The covariances are those of the state carried on to
    ``age``, s, later with its velocity: whoever takes it does that, and does not know what the
    vehicle has done since.
    """
    own = state.child == teller
    rotation = frames.rotation(teller)
    position, share = frames.located(teller, state.position)
    told = position_covariance(state, own, params)
    velocity = rotation.dot(state.velocity)
    moved = params.acceleration * max(age, 0.0)
    v_told = state.velocity_covariance
    if not is_covariance(v_told):
        v_told = VELOCITY_STD ** 2 * np.eye(3)
    yaw_variance = float(frames.block(teller)[0, 0])
    swung = sideways(velocity)
    v_covariance = (rotation.dot(v_told).dot(rotation.T) + yaw_variance * np.outer(swung, swung)
                    + moved ** 2 * np.eye(3))
    pose = np.zeros((6, 6))
    pose[:3, :3] = (share + rotation.dot(told).dot(rotation.T)
                    + (max(age, 0.0) ** 2 * v_told.trace() / 3.0
                       + (0.5 * moved * max(age, 0.0)) ** 2) * np.eye(3))
    if is_covariance(state.pose_covariance[3:, 3:]):
        pose[3:, 3:] = rotation.dot(state.pose_covariance[3:, 3:]).dot(rotation.T)
        pose[5, 5] += yaw_variance
    quaternion = canonical_quaternion(quaternion_multiply(
        quaternion_from_yaw(frames.yaw(teller)), state.quaternion))
    to_own = quaternion_to_matrix(quaternion)
    twist = np.zeros((6, 6))
    twist[:3, :3] = to_own.T.dot(v_covariance).dot(to_own)
    return OdometryState(state.stamp, frame, state.child, position, quaternion, velocity,
                         state.angular_velocity, pose, twist, to_own, state.derived)
