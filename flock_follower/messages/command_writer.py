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

"""A command of the planner as the message that the planner publishes; see ``commands``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import quaternion_from_yaw
from flock_follower.messages import Make, RELATIVE, set_quaternion, set_stamp, set_vector
from flock_follower.messages.commands import (
    ALTITUDE_JOINT,
    Command,
    RETREAT_JOINT,
    SEPARATION_JOINT,
)

TRAJECTORY = 'trajectory_msgs/msg/MultiDOFJointTrajectory'


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
    velocity = _twist(make, [math.nan] * 3)
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
        point.velocities[-1] = _twist(make, command.retreat)
    point.accelerations = [_twist(make, vector) for vector in joints.values()]
    set_stamp(point.time_from_start, command.ahead)
    message.points = [point]
    return message


def _twist(make: Make, linear: ArrayLike) -> Any:
    message = make('geometry_msgs/msg/Twist')
    set_vector(message.linear, linear)
    return message
