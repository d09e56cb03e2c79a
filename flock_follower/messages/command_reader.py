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

"""A command of the planner from its message, as the bridge reads it; see ``commands``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flock_follower.geometry import Array, yaw_from_quaternion
from flock_follower.messages import read_stamp, RELATIVE, to_array
from flock_follower.messages.commands import (
    ALTITUDE_JOINT,
    Command,
    RETREAT_JOINT,
    SEPARATION_JOINT,
)


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
