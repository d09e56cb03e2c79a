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
Flocks in which every agent sees every other, and the model of Vicsek et al. (1995).

``accelerations`` sums over all pairs, in blocks for large flocks. ``velocities_after`` is Vicsek's
rule in discrete time, without noise, in two readings: in the literal one each agent keeps its own
speed and takes the mean heading of the agents within a radius, itself included. The paper's figure
of three agents, whose speeds become equal, fits only the other: each takes their mean velocity.
"""

from __future__ import annotations

from typing import get_args, Literal

import numpy as np
from numpy.typing import ArrayLike

from flock_desk.flocks.graph import pairs_within
from flock_follower import flocking
from flock_follower.flocking import (
    alignment,
    checked,
    cohesion,
    disagreement,
    FlockingParams,
    Model,
    separation,
)
from flock_follower.geometry import Array

Method = Literal['auto', 'whole', 'blocked']
_ENTRIES = 2 ** 17  # of a block, whose few arrays of 1 MB stay in cache
_FEW = 128  # agents up to which whole matrices are the fastest


def accelerations(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams,
                  model: Model = 'flocking', method: Method = 'auto') -> Array:
    """
    Return the acceleration (k, n), m/s^2, of every agent, each seeing all others.

    :param positions: (k, n), n = 2 or 3, m.
    :param velocities: (k, n), m/s, in the same frame.
    :param method: 'whole' (k, k) matrices; 'blocked', some rows of them at a time, in O(k) memory;
        'auto', the first of them for a few agents.
    :raises ValueError: for another method or model, other shapes, or values not finite.
    """
    x, v = checked(positions, velocities)
    for name, value, known in (('method', method, Method), ('model', model, Model)):
        if value not in get_args(known):
            raise ValueError(f'{name} = {value!r}: must be one of {", ".join(get_args(known))}')
    if method == 'whole' or (method == 'auto' and len(x) <= _FEW):
        return flocking.accelerations(x, v, params, model)
    scale, u = disagreement(v), np.empty_like(x)
    count = max(1, _ENTRIES // len(x))
    for rows in (slice(first, first + count) for first in range(0, len(x), count)):
        offset, difference = x - x[rows, None], v - v[rows, None]
        r2 = np.sum(offset ** 2, axis=-1, keepdims=True)
        u[rows] = np.sum(alignment(r2, params) * difference, axis=1)
        if model != 'cucker_smale':
            u[rows] -= scale * np.sum(separation(r2, params) * offset, axis=1)
        if model == 'flocking':
            u[rows] += scale * np.sum(cohesion(r2, params) * offset, axis=1)
    return u


def velocities_after(positions: Array, velocities: Array, radius: float = 1.0,
                     mean_velocity: bool = False) -> Array:
    """
    Return the velocities (k, n), m/s, that the agents take next.

    :param positions: (k, n), m, now.
    :param velocities: (k, n), m/s, now.
    :param radius: how far an agent sees, m.
    :param mean_velocity: take the mean velocity, not the mean heading at the agent's own speed.
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
