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

"""A vehicle flown by the planner: a point mass, whose accelerations may lag."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array
from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.scene import Decision
from flock_follower.planner.step import Inputs
from flock_follower.planner.step import step as step_with

PARAMS = PlannerParams()
STILL = (0.0, 0.0, 0.0)


def step(memory: Memory, now: float, engaged: bool, me: OwnState | None,
         estimates: Iterable[Neighbor], params: PlannerParams, looked: float | None = None,
         waiting: str = '', **more: Any) -> tuple[Memory, Decision]:
    """Take a step with these inputs."""
    return step_with(memory, Inputs(
        now, engaged, me, [*estimates], looked, waiting, **more), params)


def own(stamp: float = 0.0, position: ArrayLike = (0.0, 0.0, 2.0), velocity: ArrayLike = STILL,
        yaw: float = 0.0) -> OwnState:
    return OwnState(stamp, np.array(position), np.array(velocity), yaw)


def seen(stamp: float = 0.0, position: ArrayLike = (2.0, 0.0, 2.0), velocity: ArrayLike = STILL,
         name: str = 'leader', **more: Any) -> Neighbor:
    return Neighbor(name, stamp, np.array(position), np.array(velocity), **more)


def commanded(decision: Decision) -> Array:
    assert decision.acceleration is not None
    return decision.acceleration


def assert_within_limits(acceleration: Array, v: ArrayLike, a_max: float, v_max: float,
                         period: float) -> None:
    """Assert that an acceleration is within a_max, and leads to no speed above v_max and |v|."""
    assert np.all(np.isfinite(acceleration))
    assert np.linalg.norm(acceleration) <= a_max
    speed = math.hypot(*np.asarray(v).tolist())
    if speed < 100.0:
        reached = np.linalg.norm(np.array(v) + acceleration * period)
        assert reached <= max(v_max, speed * (1.0 + 1e-15))


class Follower:
    """
    A follower in lock step; its yaw is the commanded one at once.

    :param lag: s in which an acceleration follows its command to 63 %.
    :param late: age of its odometry at a tick, in ticks of 0.1 s.
    """

    def __init__(self, params: PlannerParams = PARAMS, lag: float = 0.0, late: int = 0) -> None:
        self.params, self.memory, self.now, self.yaw = params, Memory(), 0.0, 0.0
        self.position: Array = np.array([0.0, 0.0, 2.0])
        self.velocity, self.acceleration = np.zeros(3), np.zeros(3)
        self.jumped: Array = np.zeros(3)  # of its odometry
        self._share = 1.0 - math.exp(-0.01 / lag) if lag else 1.0
        self._measured = deque[OwnState](maxlen=1 + late)

    def tick(self, *estimates: Neighbor, **inputs: Any) -> Decision:
        """Take a step with these estimates, and fly its command for 0.1 s."""
        self._measured.append(
            own(self.now, self.position + self.jumped, self.velocity, self.yaw))
        self.memory, decision = step(
            self.memory, self.now, True, self._measured[0], estimates, self.params,
            ground=None if self.jumped.any() else 0.0, **inputs)
        for _ in range(10):
            self.acceleration = self.acceleration + self._share * (
                commanded(decision) - self.acceleration)
            self.velocity = self.velocity + 0.01 * self.acceleration
            self.position = self.position + 0.01 * self.velocity
        self.now, self.yaw = self.now + 0.1, decision.yaw or 0.0
        return decision
