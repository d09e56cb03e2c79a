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
The model of Vicsek et al. (1995), without noise: a rule in discrete time, in two readings.

In the literal one each agent keeps its own speed and takes the mean heading of the agents within
a radius, itself included. The paper's figure of three agents, whose speeds become equal, fits
only the other: each takes their mean velocity.
"""

from __future__ import annotations

import numpy as np

from flock_desk.flocks.neighbor_search import pairs_within
from flock_follower.geometry import Array


def velocities_after(positions: Array, velocities: Array, radius: float = 1.0,
                     mean_velocity: bool = False) -> Array:
    """
    Return the velocities (k, n), m/s, that the agents take next.

    :param positions: (k, n), m, now.
    :param velocities: (k, n), m/s, now.
    :param radius: how far an agent sees, m.
    :param mean_velocity: take the mean velocity, not the mean heading at one's own speed.
    """
    speed = np.linalg.norm(velocities, axis=1, keepdims=True)
    seen = velocities if mean_velocity else velocities / np.where(speed > 0.0, speed, 1.0)
    i, j = pairs_within(positions, radius).T
    k = len(positions)
    total, count = seen.copy(), 1 + np.bincount(i, minlength=k) + np.bincount(j, minlength=k)
    for axis in range(positions.shape[1]):
        total[:, axis] += np.bincount(i, seen[j, axis], k) + np.bincount(j, seen[i, axis], k)
    if mean_velocity:
        return total / count[:, None]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    heading = np.where(length > 1e-12, total / np.where(length > 0.0, length, 1.0), seen)
    return speed * heading
