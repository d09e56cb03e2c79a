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
from flock_follower.planner.guard import (
    beside,
    climb_range,
    fences,
    in_sight,
    ordered,
    overflight,
    retreat,
    retreating,
)
from flock_follower.planner.inputs import Expected, NeighborEstimate, OwnState
from flock_follower.planner.limits import constrained as guard
from flock_follower.planner.memory import Loss
from flock_follower.planner.params import PlannerParams, replace

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
    assert least >= 0.9 * math.sqrt(PARAMS.law.d0)


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


LOST = Loss(AHEAD, np.zeros(3), free=2.0)


def test_out_of_sight_it_moves_away_no_farther_than_the_retreat() -> None:
    it = expected(np.array([1.5, 0.4, 0.0]), spread=2.0, spreading=2.0)
    found, = in_sight(it, np.zeros(3), np.zeros(3), False, False, PARAMS)
    assert found.direction == pytest.approx(-np.array([1.5, 0.4, 0.0]) / math.hypot(1.5, 0.4))
    assert not found.seen and math.isinf(found.highest) and found.lowest > PARAMS.a_max
    assert retreating(found, LOST, np.zeros(3), np.zeros(3), PARAMS).lowest > 1.0
    there = -PARAMS.retreat_max * AHEAD
    assert retreating(found, LOST, there, np.zeros(3), PARAMS).lowest <= 0.0


@pytest.mark.parametrize(('approach', 'farther'), [
    (0.05, 0.0), (0.4, 0.8), (1.0, 2.0), (2.0, 3.0)])
def test_it_retreats_farther_from_one_that_was_coming(approach: float, farther: float) -> None:
    lost = replace(LOST, approach=approach)
    assert retreat(lost, PARAMS) == pytest.approx(PARAMS.retreat_max + farther)


COMING = replace(LOST, approach=1.0, side=np.array([0.0, 1.0, 0.0]))


def test_it_leaves_the_path_of_one_that_was_coming() -> None:
    """It ends beside the path, no farther away than the retreat."""
    position, velocity = np.zeros(3), np.zeros(3)
    for step in range(100):
        it = expected(np.array([1.5 - 0.1 * step, 0.0, 0.0]), 0.05 * step, 0.5)
        found = [retreating(each, COMING, position, velocity, PARAMS) for each in in_sight(
            it, position, velocity, False, False, PARAMS)]
        bounds = ordered(found, fences(None, COMING, position, velocity, PARAMS))
        a = guard(np.zeros(3), velocity, bounds, PARAMS.a_max, PARAMS.v_max, 0.1).acceleration
        velocity = velocity + 0.1 * a
        position = position + 0.1 * velocity
        assert COMING.retreated(position) < retreat(COMING, PARAMS) + 0.1
    assert position[1] > 1.0


def test_it_lets_a_coming_one_pass_below_only_under_an_explicit_ceiling() -> None:
    explicit = replace(PARAMS, altitude_max=20.0)
    back = -1.0 * AHEAD
    at_height = replace(COMING, height=0.0)
    assert overflight(at_height, back, explicit) == 1.0
    assert overflight(at_height, back, PARAMS) == -math.inf
    assert overflight(at_height, np.zeros(3), explicit) == -math.inf  # 3 m are left
    assert overflight(replace(at_height, approach=0.05), back, explicit) == -math.inf
    assert overflight(replace(at_height, height=0.5), back, explicit) == -math.inf


@pytest.mark.parametrize(('offset', 'side'), [([-2.0, 0.3, 1.0], 1.0), ([-2.0, -0.3, 0.0], -1.0)])
def test_the_side_of_a_path_is_its_own(offset: list[float], side: float) -> None:
    found = beside(np.array([-1.0, 0.0, 0.5]), np.array(offset))
    assert found == pytest.approx([0.0, side, 0.0])
    assert beside(np.zeros(3), np.array(offset)) == pytest.approx(np.zeros(3))


def test_it_flies_no_farther_along_the_line_of_sight_than_was_free() -> None:
    params = PlannerParams(v_max=2.0)
    position, velocity = np.zeros(3), np.array([0.5, 0.0, 0.0])
    for _ in range(100):
        lost = replace(LOST, origin=position)
        bounds = ordered([], fences(None, lost, position, velocity, params))
        a = guard(2.0 * AHEAD, velocity, bounds, params.a_max, params.v_max, 0.1)
        velocity = velocity + 0.1 * a.acceleration
        position = position + 0.1 * velocity
    assert position[0] == pytest.approx(2.0 - params.guarding.m, abs=0.05)


def near(position: list[float], velocity: list[float]) -> NeighborEstimate:
    return NeighborEstimate('leader', 0.0, np.array(position), np.array(velocity))


OWN = OwnState(0.0, np.zeros(3), np.zeros(3), 0.0)


def test_it_does_not_climb_into_one_overhead_nor_sink_onto_one_below() -> None:
    still = [0.0, 0.0, 0.0]
    assert climb_range([near([0.1, 0.0, 0.8], still)], OWN, PARAMS)[1] < -0.2
    least, most = climb_range([near([0.1, 0.0, 1.2], still)], OWN, PARAMS)
    assert most == 0.0 and math.isinf(least)
    assert climb_range([near([0.1, 0.0, -1.2], still)], OWN, PARAMS)[0] == pytest.approx(-most)
    assert climb_range([near([0.1, 0.0, 1.2], [0.0, 0.0, -0.5])], OWN, PARAMS)[
        1] == pytest.approx(-0.5)
    assert climb_range([near([1.3, 0.0, 0.3], still)], OWN, PARAMS) == (-math.inf, math.inf)


def test_beside_one_that_comes_near_the_climb_gets_the_rest() -> None:
    params = PlannerParams(v_max=0.5)
    assert climb_range([near([1.5, 0.0, 0.3], [-0.4, 0.0, 0.0])], OWN, params) == pytest.approx(
        (-0.3, 0.3))
    # Backing away from one that hovers too near takes its part, too.
    backing = OwnState(0.0, np.zeros(3), np.array([-0.4, 0.0, 0.0]), 0.0)
    assert climb_range([near([1.05, 0.0, 0.3], [0.0, 0.0, 0.0])], backing,
                       params) == pytest.approx((-0.3, 0.3))
    # Nearer than it should be, it returns by 0.3 m/s more, and does not climb meanwhile.
    assert climb_range([near([0.9, 0.0, 0.3], [-0.4, 0.0, 0.0])], OWN, params) == pytest.approx(
        (0.0, 0.0))
    assert climb_range([near([1.7, 0.0, 0.3], [-0.4, 0.0, 0.0])], OWN, params) == (
        -math.inf, math.inf)
