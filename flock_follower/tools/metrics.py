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

"""Errors of relative pose and velocity against the truth, and rates, from recorded messages."""

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


class RelativeErrors(NamedTuple):
    """
    Errors of the relative state at the n images where an estimate exists.

    ``stamps`` (n,), ns; ``position`` and ``velocity`` (n, 3), in the follower's body frame, m and
    m/s; ``distance`` (n,) and ``true_distance`` (n,), m; ``recall`` in 0..1.
    """

    stamps: np.ndarray[Any, np.dtype[np.int64]]
    position: Array
    velocity: Array
    distance: Array
    true_distance: Array
    recall: float

    @property
    def position_rms(self) -> float:
        """Root mean square of the length of the position error, m."""
        return float(np.sqrt(np.mean(np.sum(self.position**2, axis=1))))

    @property
    def velocity_rms(self) -> float:
        """Root mean square of the length of the velocity error, m/s."""
        return float(np.sqrt(np.mean(np.sum(self.velocity**2, axis=1))))


def relative_errors(neighbors: States, odometry: States, true_neighbors: States,
                    true_odometry: States) -> RelativeErrors:
    """
    Compare estimated with true leader-minus-follower states at the images of the truth.

    Each is taken in its own follower's body frame, so drift of the odometry, common to leader
    and follower, does not count. Images without an estimate lower ``recall`` only.
    """
    found = {int(stamp): i for i, stamp in enumerate(neighbors.stamps)}
    rows = []
    for k, true_stamp in enumerate(true_neighbors.stamps):
        stamp = int(true_stamp)
        i = found.get(stamp)
        if i is None:
            continue
        p, R, v = odometry.at(stamp)
        true_p, true_R, true_v = true_odometry.at(stamp)
        relative = R.T @ (neighbors.positions[i] - p)
        true_relative = true_R.T @ (true_neighbors.positions[k] - true_p)
        velocity = R.T @ (neighbors.velocities[i] - v)
        true_velocity = true_R.T @ (true_neighbors.velocities[k] - true_v)
        rows.append((stamp, relative - true_relative, velocity - true_velocity,
                     np.linalg.norm(relative), np.linalg.norm(true_relative)))
    if not rows:
        return RelativeErrors(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)),
                              np.zeros(0), np.zeros(0), 0.0)
    stamps, position, velocity, distance, true_distance = zip(*rows)
    return RelativeErrors(
        np.array(stamps, dtype=np.int64), np.array(position), np.array(velocity),
        np.array(distance), np.array(true_distance), len(rows) / len(true_neighbors.stamps))


def mean_rate(times: Array) -> float:
    """Return the mean rate, Hz, of events at the given times (n,), s; 0 for fewer than two."""
    return float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else 0.0
