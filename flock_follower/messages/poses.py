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

"""What perception takes and publishes beside Odometry: poses, accelerations, ranges."""

from __future__ import annotations

from collections.abc import Iterable
import math
import struct
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, canonical_quaternion, Transform
from flock_follower.messages import (
    Make,
    read_stamp,
    set_quaternion,
    set_stamp,
    set_vector,
    to_array,
)
from flock_follower.messages.state_writer import ODOMETRY

ACCELERATION = 'geometry_msgs/msg/AccelWithCovarianceStamped'
POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
#: Types of the poses of other detectors, the best first.
POSE_TYPES = (POSE, 'geometry_msgs/msg/PoseStamped', ODOMETRY)
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'


def pose_topic(name: str) -> str:
    """Return the topic of the measured poses of a neighbor."""
    return f'neighbors/{name}/pose'


def child_frame(name: str, namespace: str) -> str:
    """Return the frame of a neighbor on /tf."""
    return '/'.join(filter(None, [namespace.strip('/'), name]))


def pose_with_covariance(make: Make, stamp: int, frame: str, pose: Transform,
                         covariance: Array) -> Any:
    """
    Return a PoseWithCovarianceStamped of a stamp, ns, in a frame.

    ``covariance`` (6, 6): position, m, then rotation vector, rad, both along the frame's axes.
    """
    message = make(POSE)
    set_stamp(message.header.stamp, stamp)
    message.header.frame_id = frame
    set_vector(message.pose.pose.position, pose.translation)
    set_quaternion(message.pose.pose.orientation, canonical_quaternion(pose.quaternion))
    message.pose.covariance = np.asarray(covariance, dtype=float).reshape(36)
    return message


def acceleration(make: Make, stamp: int, child: str, vector: ArrayLike,
                 covariance: ArrayLike) -> Any:
    """
    Return an AccelWithCovarianceStamped of a neighbor, in its own frame ``child``.

    ``stamp`` in ns; ``vector`` (3,), m/s^2; ``covariance`` (3, 3). The angular acceleration is
    unknown: its covariance is -1.
    """
    message = make(ACCELERATION)
    set_stamp(message.header.stamp, stamp)
    message.header.frame_id = child
    set_vector(message.accel.accel.linear, vector)
    full = np.zeros((6, 6))
    full[:3, :3], full[3, 3] = covariance, -1.0
    message.accel.covariance = full.reshape(36)
    return message


def transforms(make: Make, states: Iterable[Any], namespace: str = '') -> Any:
    """
    Return the TFMessage of Odometry messages: each pose is the transform to its child frame.

    :param namespace: prefix of the name of each child frame.
    """
    message = make(TRANSFORMS)
    for state in states:
        stamped, pose = make(TRANSFORM), state.pose.pose
        stamped.header.stamp = state.header.stamp
        stamped.header.frame_id = state.header.frame_id
        stamped.child_frame_id = child_frame(state.child_frame_id, namespace)
        set_vector(stamped.transform.translation, to_array(pose.position))
        turn = pose.orientation
        set_quaternion(stamped.transform.rotation, [turn.x, turn.y, turn.z, turn.w])
        message.transforms.append(stamped)
    return message


class PoseState(NamedTuple):
    """
    The pose of a neighbor as another detector sends it, in ``frame``; nothing is checked.

    ``stamp``, ns; ``position`` (3,), m; ``quaternion`` (x, y, z, w); ``covariance`` (6, 6) of
    position, m, and rotation vector, rad, along the axes of ``frame``, None if the type has none.
    """

    stamp: int
    frame: str
    position: Array
    quaternion: Array
    covariance: Array | None = None


def from_pose(message: Any) -> PoseState:
    """
    Return the pose of a PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped.

    :raises ValueError: if the stamp is invalid.
    """
    covariance = None
    if hasattr(message, 'transform'):
        place, turn = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose
        if hasattr(pose, 'covariance'):
            covariance, pose = np.asarray(pose.covariance, dtype=float).reshape(6, 6), pose.pose
        place, turn = pose.position, pose.orientation
    return PoseState(read_stamp(message.header.stamp), message.header.frame_id, to_array(place),
                     np.array([turn.x, turn.y, turn.z, turn.w]), covariance)


class RangeState(NamedTuple):
    """
    A Range message in numbers.

    ``stamp``, ns; ``name`` of the neighbor; ``distance``, m; ``limits`` of valid distances, m,
    both 0 if unknown; ``variance``, m^2, 0 if unknown.
    """

    stamp: int
    name: str
    distance: float
    limits: tuple[float, float] = (0.0, 0.0)
    variance: float = 0.0


def from_range(message: Any) -> RangeState:
    """Return the fields of a Range message; they are not checked."""
    variance = float(getattr(message, 'variance', 0.0))  # older bags have none
    return RangeState(
        read_stamp(message.header.stamp), message.header.frame_id, float(message.range),
        (float(message.min_range), float(message.max_range)),
        variance if 0.0 < variance < math.inf else 0.0)


def stamp_of(data: bytes) -> int:
    """
    Return the stamp, ns, of the bytes of a message that begins with a header.

    :raises ValueError: if the bytes have no stamp.
    """
    try:
        seconds, nanoseconds = struct.unpack_from('<iI' if data[1] & 1 else '>iI', data, 4)
    except (struct.error, IndexError):
        raise ValueError('a message without a header') from None
    return read_stamp(SimpleNamespace(sec=seconds, nanosec=nanoseconds))
