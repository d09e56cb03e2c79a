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

"""Downwash, fences and neighbors out of sight: their bounds, flown by a point."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
import math

from flown import commanded, Follower, own, seen, step, STILL
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from numpy.typing import ArrayLike
import pytest

from flock_follower.geometry import Array
from flock_follower.planner.bound_keeping import Bound
from flock_follower.planner.bound_keeping import keep_bounds as guard
from flock_follower.planner.bounds import in_sight, stop
from flock_follower.planner.guard import (
    climb_rates,
    fences,
    limit_to_retreat,
    sort_bounds,
)
from flock_follower.planner.inputs import Neighbor, Prediction
from flock_follower.planner.limits import LimitedCommand
from flock_follower.planner.memory import Loss, Memory
from flock_follower.planner.params import Member, PlannerParams
from flock_follower.planner.retreat import overflight, retreat, RETREAT_TIME
from flock_follower.planner.scene import across_path

PARAMS = PlannerParams(v_max=2.0)
AHEAD = np.array([1.0, 0.0, 0.0])


def expected(position: Array, spread: float = 0.0, spreading: float = 0.0) -> Prediction:
    return Prediction(position.tolist(), STILL, STILL, spread, spreading, STILL)


def pushed(bounds: Callable[[Array, Array], list[Bound]], pull: float = 2.0,
           velocity: ArrayLike = STILL, params: PlannerParams = PARAMS,
           steps: int = 200) -> Iterator[tuple[Array, LimitedCommand]]:
    """Yield the places of a point pulled ahead within bounds at its place and velocity."""
    position, velocity = np.zeros(3), np.array(velocity)
    for _ in range(steps):
        command = guard(pull * AHEAD, velocity, bounds(position, velocity), params.a_max,
                        params.v_max, 0.1)
        velocity = velocity + 0.1 * command.acceleration
        position = position + 0.1 * velocity
        yield position, command


@pytest.mark.parametrize('height', [-3.0, -0.5, 0.0, 1.2])
def test_no_vehicle_flies_above_or_below_another(height: float) -> None:
    """Drawn towards it as hard as it can, it stays beside it, whatever the height."""
    leader = np.array([3.0, 0.1, height])
    for position, _ in pushed(lambda p, v: sort_bounds(
            in_sight(expected(leader), p, v, True, True, PARAMS))):
        assert math.dist(leader[:2], position[:2]) >= 0.9 * math.sqrt(PARAMS.law.d0)


LOST = Loss(AHEAD, np.zeros(3), 2.0, 0.0, 0.0, np.zeros(3), 'leader')


def test_out_of_sight_it_moves_away_no_farther_than_the_retreat() -> None:
    it = expected(np.array([1.5, 0.4, 0.0]), spread=2.0, spreading=2.0)
    found, = in_sight(it, np.zeros(3), np.zeros(3), False, False, PARAMS)
    assert found.normal == pytest.approx(-np.array([1.5, 0.4, 0.0]) / math.hypot(1.5, 0.4))
    assert not found.seen and found.least > PARAMS.a_max
    assert limit_to_retreat(found, LOST, np.zeros(3), np.zeros(3), PARAMS).least > 1.0
    there = -PARAMS.retreat_max * AHEAD
    assert limit_to_retreat(found, LOST, there, np.zeros(3), PARAMS).least <= 0.0


@pytest.mark.parametrize(('approach', 'farther'), [
    (0.05, 0.0), (0.4, 0.8), (1.0, 2.0), (2.0, 3.0)])
def test_it_retreats_farther_from_one_that_was_coming(approach: float, farther: float) -> None:
    lost = LOST._replace(approach=approach)
    assert retreat(lost, PARAMS) == pytest.approx(PARAMS.retreat_max + farther)
    slow = replace(PARAMS, v_max=0.5)
    assert retreat(lost, slow) == pytest.approx(RETREAT_TIME * 0.5 + farther)


@given(st.floats(-5.0, 5.0), st.floats(0.1, 3.0), st.floats(0.0, 10.0), st.floats(0.0, 3.0))
def test_only_one_lost_above_is_retreated_from_that_far(
        higher: float, v_max: float, most: float, approach: float) -> None:
    params = replace(PARAMS, v_max=v_max, retreat_max=most)
    more = min(2.0 * approach, 3.0) if most > 0.0 and approach > 0.1 else 0.0
    far = most if higher > 0.3 else min(most, RETREAT_TIME * v_max)
    lost = LOST._replace(height=higher, approach=approach)
    assert retreat(lost, params) == pytest.approx(far + more)
    assert retreat(lost._replace(name=''), params) <= 1.0 + more + 1e-9


COMING = LOST._replace(approach=1.0, side=np.array([0.0, 1.0, 0.0]))


def test_coming_one_passes_below_only_under_explicit_ceiling() -> None:
    explicit = replace(PARAMS, altitude_max=20.0, retreat_max=1.0)
    back = -1.0 * AHEAD
    at_height = COMING._replace(height=0.0)
    assert overflight(at_height, back, 0.5, explicit) == 1.5
    assert overflight(at_height, back, 0.5, PARAMS) == -math.inf
    assert overflight(at_height, back, 0.5, replace(explicit, retreat_max=0.0)) == -math.inf
    assert overflight(at_height, np.zeros(3), 0.5, explicit) == -math.inf  # 3 m are left
    assert overflight(at_height._replace(approach=0.05), back, 0.5, explicit) == -math.inf
    assert overflight(at_height._replace(height=0.5), back, 0.5, explicit) == -math.inf


@pytest.mark.parametrize('y', [-1.6, 1.6])
def test_leaving_one_path_leads_into_no_other_out_of_sight(y: float) -> None:
    follower, other = Follower(PARAMS, PARAMS.response_time), (-1.8, y, 2.0)
    for tick in range(90):
        follower.tick(*[
            seen(follower.now, (3.0 - 0.1 * tick, 0.05, 2.0), (-1.0, 0.0, 0.0), 'A'),
            seen(follower.now, other, name='B')] * (tick < 10))
        assert math.dist(follower.position, other) > 1.2


@pytest.mark.parametrize('y', [-0.05, -0.2])
def test_the_path_that_it_leaves_is_the_one_to_come(y: float) -> None:
    """The leader turns for a second: its path passes on the other side than its velocity shows."""
    follower, v, a = Follower(PARAMS, PARAMS.response_time), np.array([-1.0, -1.0, 0.0]), np.array(
        [0.0, 1.0, 0.0])

    def leader(t: float) -> Array:
        turned = min(t, 1.0)
        return np.array([2.0, 0.0, 2.0]) + v * t + a * turned * (t - 0.5 * turned)

    for t in (-0.4, -0.3, -0.2, -0.1, 0.0):
        follower.position = np.array([0.0, y, 2.0])
        follower.velocity, follower.acceleration = np.zeros(3), np.zeros(3)
        follower.tick(seen(follower.now, leader(t), v + a * t, acceleration=a))
    for k in range(45):
        follower.tick()
        assert math.dist(leader(0.1 * (k + 2)), follower.position) > 1.35


@pytest.mark.parametrize(('offset', 'side'), [([-2.0, 0.3, 1.0], 1.0), ([-2.0, -0.3, 0.0], -1.0)])
def test_the_side_of_a_path_is_its_own(offset: list[float], side: float) -> None:
    found = across_path(np.array([-1.0, 0.0, 0.5]), np.array(offset))
    assert found == pytest.approx([0.0, side, 0.0])
    assert across_path(np.zeros(3), np.array(offset)) == pytest.approx(np.zeros(3))


def test_it_flies_no_farther_along_line_of_sight_than_was_free() -> None:
    *_, (position, _) = pushed(lambda p, v: sort_bounds(
        [], fences(LOST._replace(origin=p), p, v, PARAMS)), velocity=(0.5, 0.0, 0.0))
    assert position[0] == pytest.approx(2.0 - PARAMS.guarding.m, abs=0.05)


def test_where_it_was_lost_only_the_line_of_sight_is_fenced() -> None:
    onward, = fences(LOST, LOST.origin, np.zeros(3), PARAMS)
    assert onward.normal == pytest.approx(-AHEAD) and math.isfinite(onward.least)
    aside = np.array([0.0, -0.5, 3.0])  # the height does not count
    outward, same = fences(LOST, aside, np.zeros(3), PARAMS)
    assert outward.normal == pytest.approx([0.0, 1.0, 0.0]) and same == onward
    assert fences(None, aside, np.zeros(3), PARAMS) == []


def test_at_the_end_of_the_retreat_it_steps_aside_twice_as_much() -> None:
    away = Bound([-1.0, 0.0, 0.0], 2.0, 'separation', 2.0, False)
    far = retreat(COMING, PARAMS)
    for back, aside in ((0.0, 0.0), (0.5 * far, 1.0), (far, 2.0), (1.5 * far, 2.0)):
        normal = limit_to_retreat(away, COMING, -back * AHEAD, np.zeros(3), PARAMS).normal
        assert normal == pytest.approx(np.array([-1.0, aside, 0.0]) / math.hypot(1.0, aside))
    for changes in ({'approach': 0.05}, {'side': np.array([1.0, 0.0, 0.0])}):
        assert limit_to_retreat(away, COMING._replace(**changes), -far * AHEAD, np.zeros(3),
                                PARAMS).normal == away.normal
    assert limit_to_retreat(away, COMING, -far * AHEAD, np.zeros(3), PARAMS,
                            False).normal == away.normal


@pytest.mark.parametrize('place', [(0.0, 0.0), (-1.0, 1.2), (1.0, -1.2), (0.5, 1.2)])
def test_the_retreat_ends_on_a_circle(place: tuple[float, float]) -> None:
    far, (x, y) = retreat(LOST, PARAMS), place
    away = Bound([-1.0, 0.0, 0.0], 1e9, 'separation', 2.0, False)
    left = x + math.sqrt(far ** 2 - y ** 2)
    assert limit_to_retreat(away, LOST, np.array([x, y, 1.0]), [0.3, 0.1, 0.0], PARAMS).least == (
        pytest.approx(-stop([-1.0, 0.0, 0.0], left, [0.3, 0.1, 0.0], PARAMS).least))


HIDDEN = 1.9  # s that it has been out of sight


def beside_hidden(place: ArrayLike | None, velocity: ArrayLike = STILL,
                  received: bool = False, distance: float = 1.6, height: float = 2.0) -> Array:
    """Return the command behind a leader ahead, m, if another one was lost at a place."""
    params = PlannerParams()
    memory, _ = step(Memory(), 0.0, True, own(), [seen(0.0, (distance, 0.0, 2.0))], params)
    if place is not None:
        hidden = seen(0.0, np.array([*place, height]) - HIDDEN * np.array(velocity), velocity, 'B',
                      member=Member('follower'))
        memory = memory._replace(flock={**memory.flock, 'B': hidden})
    ahead = seen(HIDDEN, (distance, 0.0, 2.0), received=received)
    return commanded(step(memory, HIDDEN, True, own(HIDDEN), [ahead], params)[1])


@pytest.mark.parametrize(('place', 'covered'), [
    ((2.6, 0.0), True), ((2.6, 1.4), True), ((2.6, -1.4), True), ((2.6, 1.7), False),
    ((1.5, 0.0), False), ((-2.6, 0.0), False), ((1.6, -2.0), False)])
def test_one_hidden_by_another_may_not_be_anywhere(
        place: tuple[float, float], covered: bool) -> None:
    assert np.array_equal(beside_hidden(place), beside_hidden(None)) == covered
    if covered:
        assert not np.array_equal(beside_hidden(place, received=True),
                                  beside_hidden(None, received=True))


def test_one_before_another_is_not_hidden_by_it() -> None:
    unsure, behind = (beside_hidden((x, 0.0), distance=2.4) for x in (2.3, 2.5))
    assert unsure[0] < -0.5 < behind[0]


def test_the_height_of_one_out_of_sight_is_not_known() -> None:
    found = [beside_hidden((1.65, 0.0), (-0.5, 0.0, 0.0), height=height) for height in (2.0, 2.6)]
    assert found[0] == pytest.approx(found[1]) and found[0][0] > -2.0


def test_one_that_comes_is_kept_clear_of_where_it_is_covered() -> None:
    assert beside_hidden((1.65, 0.0), (-0.5, 0.0, 0.0))[0] < beside_hidden(None)[0] - 0.1


def near(position: list[float], velocity: list[float], radius: float = 0.0) -> Neighbor:
    return seen(0.0, position, velocity, member=Member(radius=radius))


OWN = own(0.0, np.zeros(3))


def test_it_neither_climbs_into_one_above_nor_sinks_onto_one() -> None:
    still = [0.0, 0.0, 0.0]
    assert climb_rates([near([0.1, 0.0, 0.8], still)], OWN, PARAMS)[1] < -0.2
    least, most = climb_rates([near([0.1, 0.0, 1.2], still)], OWN, PARAMS)
    assert most == 0.0 and math.isinf(least)
    assert climb_rates([near([0.1, 0.0, -1.2], still)], OWN, PARAMS)[0] == pytest.approx(-most)
    assert climb_rates([near([0.1, 0.0, 1.2], [0.0, 0.0, -0.5])], OWN, PARAMS)[
        1] == pytest.approx(-0.5)
    assert climb_rates([near([1.4, 0.0, 0.3], still)], OWN, PARAMS) == (-math.inf, math.inf)


def test_climb_keeps_height_that_slant_distance_needs() -> None:
    level, height = 0.5, 0.8  # |r| = 0.94 m, less than sqrt(d0) = 1 m
    too_near = height - math.sqrt(1.0 - level ** 2)
    assert climb_rates([near([level, 0.0, height], [0.0, 0.0, 0.0])], OWN, PARAMS)[
        1] == pytest.approx(PARAMS.guarding.closing_speed(too_near)[0])


def test_the_height_between_goes_before_the_rest_of_backing_away() -> None:
    params = PlannerParams(v_max=0.5)
    for height in (0.8, -0.8):
        up = math.copysign(1.0, height)
        coming = near([0.05, 0.0, height], [-0.2, 0.0, -0.3 * up])
        assert climb_rates([coming], OWN, params) == pytest.approx((-0.6 * up, -0.6 * up), abs=0.1)


def test_the_height_between_is_that_of_hulls() -> None:
    params = PlannerParams(v_max=0.5, radius=0.3)
    still = near([0.1, 0.0, 1.2], [0.0, 0.0, 0.0], 0.3)
    assert climb_rates([still], OWN, params)[1] < -0.2
    aside = near([1.7, 0.0, 0.3], [-0.4, 0.0, 0.0], 0.3)
    assert climb_rates([aside], OWN, params)[1] < 0.4
    beside = near([1.2, 0.0, 1.2], [0.0, 0.0, 0.0], 0.3)
    assert climb_rates([beside], OWN, params)[1] == 0.0
    assert climb_rates([near([1.0, 0.0, 1.2], [0.0, 0.0, 0.0], 0.3)], OWN, params)[0] == -math.inf
    # Another one that is far away changes nothing.
    assert climb_rates([near([9.0, 0.0, 0.0], [0.0, 0.0, 0.0]), aside, beside], OWN, params) == (
        climb_rates([beside, aside], OWN, params))


def test_beside_one_that_comes_near_the_climb_gets_the_rest() -> None:
    params = PlannerParams(v_max=0.5)
    assert climb_rates([near([1.5, 0.0, 0.3], [-0.4, 0.0, 0.0])], OWN, params) == pytest.approx(
        (-0.3, 0.3))
    assert climb_rates([near([1.5, 0.0, 0.3], [-0.4, 0.0, 0.0])], OWN, PlannerParams(
        v_max=0.8))[1] == pytest.approx(math.sqrt(0.8 ** 2 - 0.4 ** 2))
    # Backing away from one that hovers too near takes its part, too.
    backing = own(0.0, np.zeros(3), (-0.4, 0.0, 0.0))
    assert climb_rates([near([1.05, 0.0, 0.3], [0.0, 0.0, 0.0])], backing,
                       params) == pytest.approx((-0.3, 0.3))
    faster = own(0.0, np.zeros(3), (-0.45, 0.0, 0.0))
    assert climb_rates([near([1.05, 0.0, 0.3], [0.0, 0.0, 0.0])], faster, params)[
        1] == pytest.approx(math.sqrt(0.5 ** 2 - 0.45 ** 2))
    assert climb_rates([near([1.7, 0.0, 0.3], [0.0, 0.0, 0.0])], faster, params)[1] == math.inf
    # Nearer than it should be, it returns by 0.4 m/s more, and does not climb meanwhile.
    assert climb_rates([near([0.9, 0.0, 0.3], [-0.4, 0.0, 0.0])], OWN, params) == pytest.approx(
        (0.0, 0.0))
    assert climb_rates([near([1.8, 0.0, 0.3], [-0.4, 0.0, 0.0])], OWN, params) == (
        -math.inf, math.inf)


def test_the_radii_of_both_hulls_keep_it_farther_away() -> None:
    found = []
    for radius, its in ((0.0, 0.0), (0.5, 0.0), (0.2, 0.3), (0.0, 0.5)):
        params = PlannerParams(radius=radius)
        leader = seen(0.0, (1.8, 0.0, 2.0), (-0.2, 0.0, 0.0), member=Member(radius=its))
        memory, _ = step(Memory(), 0.0, True, own(), [], params)
        memory = memory._replace(neighbors={'leader': leader})
        found.append(commanded(step(memory, 0.1, True, own(0.1), [], params)[1]))
    assert found[1] == pytest.approx(found[2]) and found[2] == pytest.approx(found[3])
    assert found[1][0] < found[0][0] - 0.2


@pytest.mark.parametrize('angle', [0.5, 1.5708, 2.5, -1.0])
@pytest.mark.parametrize(('position', 'velocity', 'backing'), [
    ((1.5, 0.0, 0.3), (-0.4, 0.0, 0.0), 0.0), ((1.05, 0.0, 0.3), (0.0, 0.0, 0.0), -0.4),
    ((0.95, 0.0, 0.3), (-0.2, 0.3, 0.0), -0.1), ((0.5, 0.0, 0.8), (-0.3, 0.2, -0.2), 0.0)])
def test_the_direction_of_a_neighbor_does_not_change_the_climb(
        angle: float, position: ArrayLike, velocity: ArrayLike, backing: float) -> None:
    params, cos, sin = PlannerParams(v_max=0.5), math.cos(angle), math.sin(angle)
    turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    found = [climb_rates([near((axes @ np.array(position)).tolist(),
                               (axes @ np.array(velocity)).tolist())],
                         own(0.0, np.zeros(3), backing * axes @ AHEAD), params)
             for axes in (np.eye(3), turned)]
    assert found[1] == pytest.approx(found[0]) and found[0] != (-math.inf, math.inf)
