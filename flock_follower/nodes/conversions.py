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

"""Messages to numpy and back; the only place where message fields are spelled out."""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion, Vector3
from nav_msgs.msg import Odometry
import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    normalize_quaternion,
    quaternion_to_matrix,
)
from flock_follower.nodes.parameters import Spec

NANOSECONDS = 1_000_000_000


def message_class(msgtype: str) -> Any:
    """
    Return the Python class of a message type such as 'nav_msgs/msg/Odometry'.

    :raises ValueError: where the name is malformed or its package is not installed.
    """
    package, _, name = msgtype.partition('/msg/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError, ValueError):
        raise ValueError(f'message type {msgtype!r}: not installed, or not PACKAGE/msg/NAME'
                         ) from None


def stamp_to_nanoseconds(stamp: Time) -> int:
    """Return a stamp as integer nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def nanoseconds_to_stamp(nanoseconds: int) -> Time:
    """Return a stamp message of integer nanoseconds."""
    return Time(sec=nanoseconds // NANOSECONDS, nanosec=nanoseconds % NANOSECONDS)


def to_array(message: Vector3 | Point) -> Array:
    """Return a Vector3 or Point as an array (3,)."""
    return np.array([message.x, message.y, message.z])


def to_vector3(vector: ArrayLike) -> Vector3:
    """Return an array (3,) as a Vector3."""
    x, y, z = np.asarray(vector, dtype=float).tolist()
    return Vector3(x=x, y=y, z=z)


def to_point(vector: ArrayLike) -> Point:
    """Return an array (3,) as a Point."""
    x, y, z = np.asarray(vector, dtype=float).tolist()
    return Point(x=x, y=y, z=z)


def to_quaternion(q: ArrayLike) -> Quaternion:
    """Return an array ``(x, y, z, w)`` as a Quaternion."""
    x, y, z, w = np.asarray(q, dtype=float).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


#: The parameter of every node that reads ``odom``, see :func:`from_odometry`.
ODOM_TWIST_FRAME = Spec(
    'odom_twist_frame', 'child', 'frame of the velocity in odom: child as in REP-105, or odom',
    choices=('child', 'odom'), read_only=True)


#: Numbers beyond this, m, m/s or rad/s, are nobody's motion, and their squares overflow in time: a
#: filter that takes one in never recovers.
SANE = 1e6


class OdometryState(NamedTuple):
    """
    An Odometry message in numpy: pose and velocity in the header's frame.

    ``position`` (3,), m; ``quaternion`` (x, y, z, w); ``velocity`` (3,), m/s, and
    ``velocity_covariance`` (3, 3) in the header's frame; ``angular_velocity`` (3,), rad/s, in the
    child frame; ``pose_covariance`` and ``twist_covariance`` (6, 6) as in the message.
    """

    stamp: int
    frame: str
    child: str
    position: Array
    quaternion: Array
    velocity: Array
    angular_velocity: Array
    pose_covariance: Array
    twist_covariance: Array
    velocity_covariance: Array


def from_odometry(message: Odometry, twist_frame: str = 'child') -> OdometryState:
    """
    Return the state of an Odometry message, its velocity in the header's frame.

    ``twist_frame`` is 'child' for a twist in the child frame (REP-105) or 'odom' for sources
    that put the linear velocity in the header's frame.

    :raises ValueError: where position, attitude or velocity is not finite, or beyond ``SANE``.
    """
    pose, twist = message.pose.pose, message.twist.twist
    q = normalize_quaternion(
        [pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    position, linear = to_array(pose.position), to_array(twist.linear)
    angular = to_array(twist.angular)
    for name, value in (('position', position), ('linear velocity', linear),
                        ('angular velocity', angular)):
        if not np.all(np.abs(value) <= SANE):
            raise ValueError(f'{name} = {value.tolist()}: must be finite, and within {SANE:g}')
    twist_covariance = np.asarray(message.twist.covariance, dtype=float).reshape(6, 6)
    rotation = quaternion_to_matrix(q) if twist_frame == 'child' else np.eye(3)
    return OdometryState(
        stamp_to_nanoseconds(message.header.stamp), message.header.frame_id,
        message.child_frame_id, position, q, rotation @ linear, angular,
        np.asarray(message.pose.covariance, dtype=float).reshape(6, 6), twist_covariance,
        rotation @ twist_covariance[:3, :3] @ rotation.T)


def to_odometry(stamp: Time, frame: str, child: str, position: ArrayLike, quaternion: ArrayLike,
                velocity_child: ArrayLike, angular_velocity_child: ArrayLike = (0.0, 0.0, 0.0),
                pose_covariance: Any = None, twist_covariance: Any = None) -> Odometry:
    """
    Return an Odometry message; the twist is given, and sent, in the child frame (REP-105).

    Covariances are (6, 6), in the order x, y, z, rotations about x, y, z; None sends zeros,
    which means unknown.
    """
    message = Odometry()
    message.header.stamp, message.header.frame_id = stamp, frame
    message.child_frame_id = child
    message.pose.pose.position = to_point(position)
    message.pose.pose.orientation = to_quaternion(canonical_quaternion(quaternion))
    message.twist.twist.linear = to_vector3(velocity_child)
    message.twist.twist.angular = to_vector3(angular_velocity_child)
    if pose_covariance is not None:
        message.pose.covariance = np.asarray(pose_covariance, dtype=float).reshape(36)
    if twist_covariance is not None:
        message.twist.covariance = np.asarray(twist_covariance, dtype=float).reshape(36)
    return message
