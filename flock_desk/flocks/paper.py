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

"""Initial states of simulated flocks: those of Liu & Qiu (AAMAS 2020), and random ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.ranges import Range

PAPER_PARAMS = FlockingParams(K=1.0, sigma=1.0, beta=0.5, theta=2.0, d0=1.0, d1=2.25)
FLIGHT_PARAMS = FlockingParams(K=1.0, sigma=1.0, beta=0.25, theta=2.0, d0=1.0, d1=8.0)

#: The leader's input switches sign at its step 125; a step is read as 0.01 s.
LEADER_SWITCH = 1.25
_MARGIN = 0.1  # share of the band that every pair of a random start keeps from its edges
_TRIES = 10_000  # for one agent
_COUNTS = Range(1, whole=True)
_SPEED = 0.5  # m/s, standard deviation of the velocities along each axis


class InitialMotion(NamedTuple):
    """Positions (k, n), m, and velocities (k, n), m/s."""

    positions: Array
    velocities: Array


def _start(*agents: tuple[float, float, float, float]) -> InitialMotion:
    """Return the start from x and y, m, heading, degrees, and speed, m/s, of each agent."""
    x, y, heading, speed = np.array(agents).T
    angle = np.radians(heading)
    velocities = speed * np.stack([np.cos(angle), np.sin(angle)])
    return InitialMotion(np.stack([x, y], axis=1), velocities.T)


#: Positions, m, headings, deg, and speeds, m/s, of the paper's leaderless case.
LEADERLESS_START = _start((0.0, 0.0, 45.0, 0.54), (1.25, 0.0, 135.0, 0.42),
                          (0.63, 1.08, 270.0, 0.99))
#: The same of leader and follower.
LEADER_FOLLOWER_START = _start((0.0, 1.32, 118.0, 0.88), (0.0, 0.0, 92.0, 0.50))


def leader_input(t: float) -> Array:
    """
    Return the leader's acceleration (2,), m/s^2, at t in s.

    u = (sin(pi n / 180), cos(pi n / 180)), negated from n = 125 on. The paper calls n the time;
    taken as seconds the leader would reach 180 m/s, taken as steps of 0.01 s it flies as drawn.
    """
    angle = np.pi * (t / 0.01) / 180.0
    sign = 1.0 if t < LEADER_SWITCH else -1.0
    return sign * np.array([np.sin(angle), np.cos(angle)])


def random_start(count: int, dimension: int, params: FlockingParams,
                 seed: int) -> InitialMotion:
    """
    Return a flock grown agent by agent, each inside the band of one that is there already.

    No pair's r^2 is within a tenth of the band's width of d0 or d1, at which the law is singular.

    :param dimension: 2 or 3.
    :raises ValueError: for a count below 1, or a band too narrow to find room in.
    """
    _COUNTS.check('count', count)
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
                         _SPEED * rng.normal(size=positions.shape))
