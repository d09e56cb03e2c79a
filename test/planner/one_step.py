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

"""One step of the planner near a leader, for the tests of its states and of its inputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import flown
from flown import seen as leader
from flown import step, STILL
from numpy.typing import ArrayLike

from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.scene import Decision

PARAMS = flown.PARAMS
# The law as it is, at once, within limits.
LAW = PlannerParams(guard=False, handover_time=0.0, yaw_rate_max=6.0, period=1.0)
FREE = replace(LAW, a_max=20.0, v_max=5.0, altitude_mode='hold')


def own(stamp: float = 0.0, position: ArrayLike = (0.0, 0.0, 2.0),
        velocity: ArrayLike = STILL, yaw: float = 0.3) -> OwnState:
    return flown.own(stamp, position, velocity, yaw)


def decide(now: float, *neighbors: Neighbor, me: OwnState | None = None,
           memory: Memory | None = None, params: PlannerParams = PARAMS) -> Decision:
    """Take one engaged step with fresh odometry, by default the first."""
    return step(memory or Memory(), now, True, me or own(now), neighbors, params)[1]


def tracking(now: float = 0.0, params: PlannerParams = PARAMS, **state: Any) -> Memory:
    """
    Return the memory of a planner that has just followed the leader.

    An estimate 1 m away from this one in the next step is refused as a jump.
    """
    memory, decision = step(Memory(), now, True, own(now), [leader(now, **state)], params)
    assert decision.state is State.TRACK
    return memory
