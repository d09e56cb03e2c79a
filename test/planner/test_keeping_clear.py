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

"""Downwash, fences, and whom one no longer sees: what bounds them ask for, flown by a point."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.guard import guard, ordered
from flock_follower.planner.keeping_clear import DOWNWASH, fences, in_sight, out_of_sight
from flock_follower.planner.memory import Loss
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.prediction import Expected

PARAMS = PlannerParams(v_max=2.0)
AHEAD = np.array([1.0, 0.0, 0.0])


def expected(position: Array, spread: float = 0.0, spreading: float = 0.0) -> Expected:
    return Expected(position, np.zeros(3), np.zeros(3), spread, spreading)


@pytest.mark.parametrize('height', [-3.0, -1.2, -0.5, 0.0, 0.5, 1.2, 3.0])
def test_nobody_flies_above_or_below_another(height: float) -> None:
    """Drawn towards it as hard as it can, it stays beside it, whatever the height."""
    leader = np.array([3.0, 0.1, height])
    position, velocity, least = np.zeros(3), np.zeros(3), math.inf
    for _ in range(300):
        bounds = ordered(in_sight(expected(leader), position, velocity, True, True, PARAMS))
        pull = 2.0 * AHEAD
        a = guard(pull, velocity, bounds, PARAMS.a_max, PARAMS.v_max, 0.1).acceleration
        velocity = velocity + 0.1 * a
        position = position + 0.1 * velocity
        least = min(least, math.hypot(*(leader - position)[:2]))
    assert least >= DOWNWASH * math.sqrt(PARAMS.law.d0)


def test_it_stays_within_its_range_of_home() -> None:
    params = PlannerParams(v_max=2.0, range_max=5.0)
    position, velocity = np.zeros(3), np.zeros(3)
    for _ in range(300):
        bounds = ordered([], fences(np.zeros(3), None, position, velocity, params))
        a = guard(2.0 * AHEAD, velocity, bounds, params.a_max, params.v_max, 0.1)
        velocity = velocity + 0.1 * a.acceleration
        position = position + 0.1 * velocity
        assert position[0] <= 5.05
    assert position[0] == pytest.approx(5.0, abs=0.1)
    assert a.reason == 'fence'


def test_it_backs_away_along_the_line_of_the_loss_and_gently() -> None:
    lost = Loss(0.0, AHEAD)
    it = expected(np.array([1.5, 0.4, 0.0]), spread=2.0, spreading=2.0)
    found = out_of_sight(it, lost, np.zeros(3), np.zeros(3), PARAMS)
    assert found is not None
    assert found.direction == pytest.approx(-AHEAD)
    assert found.lowest == PARAMS.guarding.b
    assert not found.seen and math.isinf(found.highest)
    behind = expected(np.array([-1.5, 0.0, 0.0]), spread=2.0)
    assert out_of_sight(behind, lost, np.zeros(3), np.zeros(3), PARAMS) is None
