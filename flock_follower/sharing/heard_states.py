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
from flock_follower.messages import NANOSECONDS, OdometryState
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


def in_own_frame(state: OdometryState, teller: str, frame: str, frames: FrameAlignment,
                 params: SharingParams) -> OdometryState:
    """Return a state told by a teller whose frame is known, in one's own frame, at its stamp."""
    rotation, yaw_variance = frames.rotation(teller), float(frames.block(teller)[0, 0])
    position, share = frames.located(teller, state.position)
    velocity, told = rotation.dot(state.velocity), state.velocity_covariance
    if not is_covariance(told):
        told = VELOCITY_STD ** 2 * np.eye(3)
    swung = sideways(velocity)
    spread = rotation.dot(told).dot(rotation.T) + yaw_variance * np.outer(swung, swung)
    quaternion = canonical_quaternion(quaternion_multiply(
        quaternion_from_yaw(frames.yaw(teller)), state.quaternion))
    to_own = quaternion_to_matrix(quaternion)
    pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
    pose[:3, :3] = share + rotation.dot(
        position_covariance(state, state.child == teller, params)).dot(rotation.T)
    if is_covariance(state.pose_covariance[3:, 3:]):
        pose[3:, 3:] = rotation.dot(state.pose_covariance[3:, 3:]).dot(rotation.T)
        pose[5, 5] += yaw_variance
    twist[:3, :3] = to_own.T.dot(spread).dot(to_own)
    return OdometryState(state.stamp, frame, state.child, position, quaternion, velocity,
                         state.angular_velocity, pose, twist, to_own, state.derived)


def aged(state: OdometryState, now: int, params: SharingParams) -> OdometryState:
    """
    Return a state with the covariances that it has once it is carried on to a time, ns.

    Whoever takes it does that, with its velocity, and does not know what the vehicle has done
    since. Its stamp stays: that is when it was so.
    """
    age = max((now - state.stamp) / NANOSECONDS, 0.0)
    pose, twist = state.pose_covariance.copy(), state.twist_covariance.copy()
    pose[:3, :3] += (age ** 2 * state.velocity_covariance
                     + (0.5 * params.acceleration * age ** 2) ** 2 * np.eye(3))
    twist[:3, :3] += (params.acceleration * age) ** 2 * np.eye(3)
    return state._replace(pose_covariance=pose, twist_covariance=twist)
