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

"""Where simulated flocks begin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.ranges import Range

_MARGIN = 0.1  # share of the band that every pair keeps from its edges
_TRIES = 10_000  # for one agent
_COUNTS = Range(1, whole=True)
_SPEEDS = Range(0.0, unit='m/s')


@dataclass(frozen=True)
class InitialMotion:
    """Positions (k, n), m, and velocities (k, n), m/s."""

    positions: Array
    velocities: Array


def random_start(count: int, dimension: int, params: FlockingParams, seed: int,
                 speed: float = 0.5) -> InitialMotion:
    """
    Return a flock grown agent by agent, each inside the band of one that is there already.

    No pair's r^2 is within a tenth of the band's width of d0 or d1, at which the law is singular.

    :param dimension: 2 or 3.
    :param seed: of the random numbers; the same gives the same flock.
    :param speed: standard deviation of the velocities along each axis, m/s.
    :raises ValueError: for a count below 1, another dimension, a negative speed, or a band too
        narrow to find room in.
    """
    _COUNTS.check('count', count)
    if dimension not in (2, 3):
        raise ValueError(f'dimension = {dimension!r}: must be 2 or 3')
    _SPEEDS.check('speed', speed)
    rng = np.random.default_rng(seed)
    margin = _MARGIN * (params.d1 - params.d0)
    positions = np.zeros((count, dimension))
    for n in range(1, count):
        for _ in range(_TRIES):
            direction = rng.normal(size=dimension)
            distance = np.sqrt(rng.uniform(params.d0 + margin, params.d1 - margin))
            place = positions[rng.integers(n)] + distance * direction / np.linalg.norm(direction)
            r2 = np.sum((positions[:n] - place) ** 2, axis=1)
            if r2.min() > params.d0 + margin and np.abs(r2 - params.d1).min() > margin:
                positions[n] = place
                break
        else:
            raise ValueError(f'no room for agent {n} of {count}: raise d1 = {params.d1:g} m^2')
    return InitialMotion(positions - positions.mean(axis=0),
                         speed * rng.normal(size=positions.shape))
