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

"""Conversion of the planner's commands to messages and back; see ``messages``."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, quaternion_from_yaw, yaw_from_quaternion
from flock_follower.messages import (
    Make,
    NANOSECONDS,
    read_stamp,
    RELATIVE,
    set_quaternion,
    set_stamp,
    set_vector,
    stamp_age,
    to_array,
    twist,
)

TRAJECTORY = 'trajectory_msgs/msg/MultiDOFJointTrajectory'
#: The names of further joints of a command, see :func:`trajectory`; all are on the wire.
SEPARATION_JOINT, ALTITUDE_JOINT, RETREAT_JOINT = 'separation', 'altitude', 'retreat'
#: Time without odometry, s, for which the gate keeps the velocity of the retreat.
ODOMETRY_GAP = 3.0
#: Largest acceleration without odometry, m/s^2: by 1 m/s^2 a quadrotor tilts by 6 degrees.
RELATIVE_ACCELERATION_MAX = 1.0
#: Oldest image that such a command may rest on, s.
OLDEST_MARKER = 0.5


class Command(NamedTuple):
    """
    A command of the planner, from its tick to the setpoint gate.

    ``stamp``, ns, is the stamp of the estimate on which the command is based, 0 without an
    estimate. The command applies ``ahead`` ns later.
    """

    acceleration: ArrayLike
    """(3,), m/s^2, in the frame ``frame``."""
    yaw: float
    """rad."""
    yaw_rate: float = 0.0
    """rad/s, anticlockwise."""
    separation_axis: Array | None = None
    """
    Unit vector (3,) away from a neighbor that would come too near: limits reduce the acceleration
    along this vector last. None without such a neighbor.
    """
    frame: str = ''
    stamp: int = 0
    ahead: int = 0
    altitude: float = math.nan
    """The commanded altitude, m, in the frame ``frame``; NaN without one."""
    relative: bool = False
    """
    Whether the command is based on the marker alone, without odometry; its frame is then
    ``RELATIVE``.
    """
    retreat: Array | None = None
    """Velocity (3,), m/s, to brake to if odometry is lost: away from an approaching neighbor. None
    without such a neighbor."""

    def ages(self, now: int) -> tuple[float, float]:
        """Return the ages of the command and of its image, s, at a time, ns."""
        source = stamp_age(self.stamp, now)
        return source - (self.ahead / NANOSECONDS if self.stamp > 0 else 0.0), source


def trajectory(make: Make, command: Command) -> Any:
    """
    Return a command as a MultiDOFJointTrajectory of one point.

    Position and velocity are NaN: they are not commanded. The acceleration of a joint 'separation'
    is ``separation_axis``, the height of a joint 'altitude' is ``altitude``, the velocity of a
    joint 'retreat' is ``retreat``. A receiver that reads only the first joint ignores the others.
    """
    message = make(TRAJECTORY)
    set_stamp(message.header.stamp, command.stamp)
    message.header.frame_id = RELATIVE if command.relative else command.frame
    joints = {'base_link': command.acceleration}
    if command.separation_axis is not None:
        joints[SEPARATION_JOINT] = command.separation_axis
    if math.isfinite(command.altitude):
        joints[ALTITUDE_JOINT] = np.zeros(3)
    if command.retreat is not None:
        joints[RETREAT_JOINT] = np.zeros(3)
    message.joint_names = list(joints)
    velocity = twist(make, [math.nan] * 3)
    velocity.angular.z = float(command.yaw_rate)
    point = make('trajectory_msgs/msg/MultiDOFJointTrajectoryPoint')
    for name in joints:
        transform = make('geometry_msgs/msg/Transform')
        set_vector(transform.translation, [math.nan] * 2 + [
            command.altitude if name == ALTITUDE_JOINT else math.nan])
        set_quaternion(transform.rotation, quaternion_from_yaw(command.yaw))
        point.transforms.append(transform)
    point.velocities = [velocity] * len(joints)
    if command.retreat is not None:
        point.velocities[-1] = twist(make, command.retreat)
    point.accelerations = [twist(make, vector) for vector in joints.values()]
    set_stamp(point.time_from_start, command.ahead)
    message.points = [point]
    return message


def from_trajectory(message: Any, odom_frame: str) -> Command:
    """
    Return the command of a MultiDOFJointTrajectory's first point.

    :raises ValueError: if the frame is neither ``odom_frame`` nor ``RELATIVE``, or a field is
        missing.
    """
    frame = message.header.frame_id
    if frame not in ('', odom_frame, RELATIVE):
        raise ValueError(f'frame {frame!r}: must be that of odom, {odom_frame!r}')
    if not (message.points and message.points[0].accelerations
            and message.points[0].transforms):
        raise ValueError('no point with an acceleration and a transform')
    point = message.points[0]
    q = point.transforms[0].rotation
    more = {name: to_array(beside.linear) for name, beside in zip(
        message.joint_names[1:], point.accelerations[1:])}
    separation_axis = _direction(more.get(SEPARATION_JOINT, np.zeros(3)))
    heights = [float(beside.translation.z) for name, beside in zip(
        message.joint_names[1:], point.transforms[1:]) if name == ALTITUDE_JOINT]
    retreats = [to_array(beside.linear) for name, beside in zip(
        message.joint_names[1:], point.velocities[1:]) if name == RETREAT_JOINT]
    return Command(
        to_array(point.accelerations[0].linear), yaw_from_quaternion([q.x, q.y, q.z, q.w]),
        point.velocities[0].angular.z if point.velocities else 0.0, separation_axis, frame,
        read_stamp(message.header.stamp), read_stamp(point.time_from_start),
        heights[0] if heights else math.nan, frame == RELATIVE,
        retreats[0] if retreats else None)


def _direction(vector: Array) -> Array | None:
    """Return a vector (3,) of about unit length, normalized; None for any other vector."""
    length = math.hypot(*vector.tolist())
    return vector / length if 0.5 < length < 2.0 else None  # NaN fails
