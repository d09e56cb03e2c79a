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

"""The setups of Liu & Qiu (AAMAS 2020): its Tables 1 to 3, and the leader's input."""

from __future__ import annotations

import numpy as np

from flock_desk.flocks.starts import InitialMotion
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array

PARAMS = FlockingParams(K=1.0, sigma=1.0, beta=0.5, theta=2.0, d0=1.0, d1=2.25)
FLIGHT_PARAMS = FlockingParams(K=1.0, sigma=1.0, beta=0.25, theta=2.0, d0=1.0, d1=8.0)

#: The leader's input switches sign at its step 125; a step is read as 0.01 s.
LEADER_SWITCH = 1.25


def _start(*agents: tuple[float, float, float, float]) -> InitialMotion:
    """Return the start from x and y, m, heading, degrees, and speed, m/s, of each agent."""
    x, y, heading, speed = np.array(agents).T
    angle = np.radians(heading)
    velocities = speed * np.stack([np.cos(angle), np.sin(angle)])
    return InitialMotion(np.stack([x, y], axis=1), velocities.T)


LEADERLESS = _start((0.0, 0.0, 45.0, 0.54), (1.25, 0.0, 135.0, 0.42), (0.63, 1.08, 270.0, 0.99))
LEADER_FOLLOWER = _start((0.0, 1.32, 118.0, 0.88), (0.0, 0.0, 92.0, 0.50))


def leader_input(t: float) -> Array:
    """
    Return the leader's acceleration (2,), m/s^2, at t in s.

    u = (sin(pi n / 180), cos(pi n / 180)), negated from n = 125 on. The paper calls n the time;
    taken as seconds the leader would reach 180 m/s, taken as steps of 0.01 s it flies as drawn.
    """
    angle = np.pi * (t / 0.01) / 180.0
    sign = 1.0 if t < LEADER_SWITCH else -1.0
    return sign * np.array([np.sin(angle), np.cos(angle)])
