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

"""Series of Odometry messages as arrays, for tests that compare them with what came out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array, normalize_quaternion, quaternion_to_matrix, slerp


class States(NamedTuple):
    """
    A series of n Odometry messages; velocities in the header's frame.

    ``stamps`` (n,) are header stamps in integer ns; ``positions`` (n, 3), m; ``quaternions``
    (n, 4); ``velocities`` (n, 3), m/s.
    """

    stamps: np.ndarray[Any, np.dtype[np.int64]]
    positions: Array
    quaternions: Array
    velocities: Array

    def at(self, stamp: int) -> tuple[Array, Array, Array]:
        """Return position, rotation matrix and velocity interpolated to a stamp, ns."""
        i = int(np.clip(np.searchsorted(self.stamps, stamp), 1, len(self.stamps) - 1))
        before, after = int(self.stamps[i - 1]), int(self.stamps[i])
        f = float(np.clip((stamp - before) / (after - before), 0.0, 1.0))
        return (self.positions[i - 1] * (1 - f) + self.positions[i] * f,
                quaternion_to_matrix(slerp(self.quaternions[i - 1], self.quaternions[i], f)),
                self.velocities[i - 1] * (1 - f) + self.velocities[i] * f)


def states(messages: Iterable[Any]) -> States:
    """Return the states of Odometry messages whose twist is in the child frame (REP-105)."""
    rows = []
    for m in messages:
        p, q, v = m.pose.pose.position, m.pose.pose.orientation, m.twist.twist.linear
        quaternion = normalize_quaternion([q.x, q.y, q.z, q.w])
        rows.append((m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, [p.x, p.y, p.z],
                     quaternion, quaternion_to_matrix(quaternion) @ [v.x, v.y, v.z]))
    stamps, positions, quaternions, velocities = zip(*rows)
    return States(np.array(stamps, dtype=np.int64), np.array(positions), np.array(quaternions),
                  np.array(velocities))


def states_of(bag_path: Any, topic: str) -> States:
    """
    Return the states recorded on an Odometry topic of a bag.

    :raises BagError: where the bag cannot be read or does not hold the topic.
    """
    with open_bag(bag_path) as bag:
        return states([deserialize(m.data, m.msgtype) for m in bag.messages([topic])])
