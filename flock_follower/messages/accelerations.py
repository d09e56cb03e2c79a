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

"""Accelerations of neighbors, from the messages of perception (``poses.acceleration``)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flock_follower.geometry import Array, quaternion_to_matrix
from flock_follower.messages import OdometryState, read_stamp, SANE


class AccelerationState(NamedTuple):
    """A neighbor's acceleration (3,), m/s^2, in its own frame ``child``, at a stamp, ns."""

    stamp: int
    child: str
    vector: Array


def from_acceleration(message: Any) -> AccelerationState:
    """
    Return the acceleration in an AccelWithCovarianceStamped of a neighbor.

    :raises ValueError: if the acceleration is not finite, or beyond ``SANE``.
    """
    linear = message.accel.accel.linear
    vector = np.array([linear.x, linear.y, linear.z], dtype=float)
    if not np.all(np.abs(vector) <= SANE):  # NaN fails
        raise ValueError(f'acceleration of {message.header.frame_id}: {vector.tolist()}: must be '
                         f'finite, and at most {SANE:g} m/s^2')
    return AccelerationState(
        read_stamp(message.header.stamp), message.header.frame_id, vector)


def with_acceleration(state: OdometryState, acceleration: AccelerationState) -> OdometryState:
    """Return a neighbor's state with an acceleration given in the neighbor's frame."""
    return state._replace(
        acceleration=quaternion_to_matrix(state.quaternion) @ acceleration.vector)
