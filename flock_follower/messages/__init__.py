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
Conversion of messages to numpy and back, and the first check of their values.

NaN is refused by ``from_odometry`` here (neighbors), ``odometry.reader`` (odometry),
``planner.inputs`` (every state), ``gate.setpoint_rules`` (everything that decides on a setpoint)
and ``mavlink.setpoint_encoding`` (the wire).

The functions work with any message classes: rclpy's in the nodes, the type store's when bags are
read. To build a message, the caller passes ``make``, which returns an empty message of a type such
as 'nav_msgs/msg/Odometry'.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    normalize_quaternion,
    quaternion_to_matrix,
)
from flock_follower.ranges import Range

NANOSECONDS = 1_000_000_000
_NANOSEC = Range(0, NANOSECONDS - 1, whole=True)

ODOMETRY = 'nav_msgs/msg/Odometry'
STATE = 'std_msgs/msg/String'
#: Frame of the motion without odometry: axes ENU by the autopilot's attitude, height by its
#: barometer. Horizontally only differences of positions, and of velocities, have a meaning.
RELATIVE = 'flock_relative'
#: Topic on which the bridge publishes that motion during flight without odometry.
MOTION_TOPIC = 'mavlink/relative'
#: Suffix of a neighbor's name on ``neighbors``: another object with the same marker. The planner
#: avoids it, and never follows it.
DUPLICATE = '/duplicate'

# Bounds of plausible values from outside, for all packages.
#: m, m/s, m/s^2, rad/s, and entries of covariances: a larger number is an error. Its square may
#: overflow in time, and a filter that uses it never recovers.
SANE = 1e6
#: m: a neighbor is not measured farther away; m/s: no vehicle of a flock is faster.
FARTHEST, FASTEST = 100.0, 50.0
#: m/s: a faster own velocity is an error, and unknown. Up to this, not only to FASTEST, the gate
#: brakes on it: 5 times the highest ``v_max``.
FASTEST_OWN = 100.0
#: m: a position that differs by more from the expected one has jumped.
POSITION_JUMP = 0.3
#: s: a stamp may be ahead by this much: clocks differ, and /clock comes in steps.
FUTURE_TOLERANCE = 0.1
#: s: a stamp farther back is a new start (a bag played again), not a message out of order.
MAX_JUMP = 0.5
#: m: odometry farther from its prediction has another frame than before: places in the old frame
#: are lost. Any one such jump counts; ``POSITION_JUMP`` is for evidence about a source. ``jump``
#: is the rule. Two others predict otherwise: ``derivation`` has positions alone, and
#: ``velocity_check.Path`` allows for motion in a gap.
ODOMETRY_JUMP = 0.25
#: m: a neighbor's position with a larger standard deviation, sqrt(trace), is not used.
POSITION_STD_MAX = 0.5
#: Standard deviations of position, m, attitude, rad, velocity, m/s, and angular velocity, rad/s,
#: of an odometry whose covariances are missing or invalid.
ODOMETRY_STD = (0.1, 0.05, 0.1, 0.05)

Make = Callable[[str], Any]


def duplicate_name(name: str, number: int) -> str:
    """Return the name of the first, second, ... duplicate of a neighbor."""
    return f'{name}{DUPLICATE}{f"_{number}" if number > 1 else ""}'


def to_nanoseconds(seconds: float) -> int:
    """Return seconds as integer nanoseconds, rounded."""
    return round(seconds * NANOSECONDS)


def stamp_to_nanoseconds(stamp: Any) -> int:
    """Return a stamp, or a duration, as integer nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def read_stamp(stamp: Any) -> int:
    """
    Return the stamp, or the duration, of a received message as integer nanoseconds.

    :raises ValueError: if the nanoseconds are not below a second: beyond 2**31 s no stamp can hold
        the sum.
    """
    nanosec = int(stamp.nanosec)
    if not 0 <= nanosec < NANOSECONDS:  # the check itself takes ten times as long
        _NANOSEC.check('stamp: nanosec', nanosec)
    return int(stamp.sec) * NANOSECONDS + nanosec


def set_stamp(stamp: Any, nanoseconds: int) -> None:
    """Write integer nanoseconds into a stamp, or a duration."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)


def stamp_age(stamp: int, now: int) -> float:
    """Return the age, s, of a stamp at a time, both in ns; a stamp of 0 has the age 0."""
    return (now - stamp) / NANOSECONDS if stamp > 0 else 0.0


def to_array(message: Any) -> Array:
    """Return a Vector3 or Point as an array (3,)."""
    return np.array([message.x, message.y, message.z])


def set_vector(message: Any, vector: ArrayLike) -> None:
    """Write an array (3,) into a Vector3 or Point."""
    message.x, message.y, message.z = np.asarray(vector, dtype=float).tolist()


def set_quaternion(message: Any, q: ArrayLike) -> None:
    """Write an array ``(x, y, z, w)`` into a Quaternion."""
    message.x, message.y, message.z, message.w = np.asarray(q, dtype=float).tolist()


class OdometryState(NamedTuple):
    """
    An Odometry message in numpy: pose and velocity in the header's frame.

    ``stamp`` ns; ``position`` (3,), m; ``quaternion`` (x, y, z, w); ``velocity`` (3,), m/s, in the
    header's frame; ``angular_velocity`` (3,), rad/s, in the child frame; ``pose_covariance`` and
    ``twist_covariance`` (6, 6) as in the message; ``twist_rotation`` (3, 3) takes the message's
    linear velocity to the header's frame. ``derived``: whether the velocity was derived from the
    positions. ``acceleration`` (3,), m/s^2, in the header's frame; None if it is unknown.
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
    twist_rotation: Array
    derived: bool = False
    acceleration: Array | None = None

    @property
    def velocity_covariance(self) -> Array:
        """Return the covariance (3, 3) of the velocity in the header's frame."""
        turned: Array = self.twist_rotation.dot(self.twist_covariance[:3, :3]).dot(
            self.twist_rotation.T)
        return turned


class Moving(Protocol):
    """A state with a position (3,), m, and a velocity (3,), m/s."""

    @property
    def position(self) -> Array:
        """Return the position."""

    @property
    def velocity(self) -> Array:
        """Return the velocity."""


def jump(before: Moving, after: Moving, elapsed: float, tolerance: float) -> float:
    """
    Return the distance, m, of a position from its prediction if it exceeds a tolerance, else 0.

    The prediction is from ``elapsed`` s before, with the mean of both velocities: exact for a
    constant acceleration.
    """
    half, (x, y, z), (u, v, w), (new_u, new_v, new_w) = (
        0.5 * elapsed, before.position.tolist(), before.velocity.tolist(), after.velocity.tolist())
    distance = math.dist(after.position.tolist(), [
        x + half * (u + new_u), y + half * (v + new_v), z + half * (w + new_w)])
    return distance if distance > tolerance else 0.0


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


def twist(make: Make, linear: ArrayLike) -> Any:
    message = make('geometry_msgs/msg/Twist')
    set_vector(message.linear, linear)
    return message
