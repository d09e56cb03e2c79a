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
Where a neighbour is when a command acts, and how sure that is: every assumption is in here.

1. It goes on with the velocity of its newest estimate, and with its acceleration, where that is
   believable, for at most TRUSTED_TIME; both until the command acts, ``response_time`` from now.
   What is as small as the noise of an estimated acceleration, a, counts as
   a / (1 + (ACCELERATION_NOISE / a)^4): taken as it is, it makes the guard twitch.
2. Where the estimate is older than SEEN its acceleration may make oneself keep farther away, and
   not follow: never chase a guess.
3. Up to FRESH the guard's margin covers what else it may do, and up to ``heard_timeout`` where it
   was told of: words are that late wherever some are lost, of vehicles that fly on. From then on
   it may be anywhere that an acceleration of ``leader_acceleration_max`` takes it to, at up to
   ``leader_speed_max``: in a sphere that grows, around the place of 1.
4. What oneself was told and has not flown yet will be flown: it counts as velocity.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array
from flock_follower.planner.inputs import NeighborEstimate
from flock_follower.planner.limits import limit_norm
from flock_follower.planner.params import PlannerParams

TRUSTED_ACCELERATION = 2.0  # m/s^2: more is taken for a jump of the estimate
ACCELERATION_NOISE = 0.35  # m/s^2: a neighbour's acceleration below this is mostly noise
TRUSTED_TIME = 1.0  # s for which a neighbour is expected to go on accelerating as it did
SEEN = 0.25  # s: with an older estimate its acceleration is a guess that is not followed
FRESH = 0.12  # s up to which the guard's margin covers what else a neighbour may do


class Expected(NamedTuple):
    """A neighbour, as far as it can be known, when a command acts."""

    position: Array
    """(3,), m, now."""
    velocity: Array
    """(3,), m/s."""
    acceleration: Array
    """(3,), m/s^2."""
    spread: float
    """How far from there it may be, m ..."""
    spreading: float
    """... and how fast that grows, m/s."""


def expected(n: NeighborEstimate, acceleration: Array, age: float,
             params: PlannerParams) -> Expected:
    """Return what to expect of a neighbour whose estimate is of an age, s."""
    its = limit_norm(acceleration, TRUSTED_ACCELERATION)
    share = (math.hypot(*its.tolist()) / ACCELERATION_NOISE) ** 4
    its = its * (share / (1.0 + share))
    known = min(max(age, 0.0), TRUSTED_TIME)
    position = n.position + age * n.velocity + known * (age - 0.5 * known) * its
    velocity = n.velocity + min(age + params.response_time, TRUSTED_TIME) * its
    fresh = params.heard_timeout if n.heard else FRESH
    blind, most = max(age - fresh, 0.0), params.leader_acceleration_max
    fastest = params.leader_speed_max + math.hypot(*n.velocity.tolist())
    speeding = min(blind, fastest / most) if most > 0.0 else 0.0
    return Expected(position, velocity, its if age < TRUSTED_TIME else np.zeros(3),
                    most * speeding * (blind - 0.5 * speeding), most * speeding)


def unflown(before: Array, command: Array, elapsed: float, params: PlannerParams) -> Array:
    """Return the velocity that is commanded and not flown one period from now, (3,), m/s."""
    if params.response_time == 0.0:
        return np.zeros(3)
    left = math.exp(-elapsed / params.response_time)
    return left * before + (1.0 - left) * params.response_time * command


def since_measured(age: float, params: PlannerParams) -> float:
    """
    Return how many times what ``unflown`` tells has not been flown when a velocity was measured.

    As it is flown with the time constant ``response_time``, it is being flown at that rate.

    :param age: of the velocity, s.
    """
    return 1.0 + max(age, 0.0) / params.response_time if params.response_time > 0.0 else 1.0
