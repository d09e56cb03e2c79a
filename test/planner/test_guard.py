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

"""The guard's command is the nearest one that its bounds and the limits allow, for any input."""

from __future__ import annotations

import math
from typing import Any

from flown import assert_within_limits
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array
from flock_follower.planner.bound_keeping import Bound, COHESION, FENCE, SEPARATION, SIGHT
from flock_follower.planner.bound_keeping import keep_bounds as guard
from flock_follower.planner.bounds import radial_bounds
from flock_follower.planner.guard import sort_bounds
from flock_follower.planner.limits import limit_command
from flock_follower.planner.params import EDGE_RETURN_SPEED, Edges, GuardParams

LAW = FlockingParams(beta=0.25, d1=8.0)
PARAMS = GuardParams()
BAND = Edges.of(LAW, PARAMS)
A_MAX, V_MAX, T = 2.5, 0.5, 0.1

Vector = tuple[float, float, float]
ANYTHING = st.tuples(*[st.floats()] * 3)  # NaN, infinities, 1e308 and denormals among them


SEED = st.integers(0, 2 ** 32)


def bounds(p: Any, w: Any, its: Any = (0.0, 0.0, 0.0)) -> list[Bound]:
    return radial_bounds(p, w, BAND, PARAMS, its)


def pair(distance: float, normal: Array, lowest: float, highest: float = math.inf,
         seen: bool = True) -> list[Bound]:
    return [Bound(normal, lowest, SEPARATION, distance, seen),
            Bound(-normal, -highest, COHESION, distance, seen)]


def situation(seed: int, count: int) -> tuple[Array, Array, list[Bound]]:
    """Return a command within the limits, a velocity, and neighbors in or near the band."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(-0.4, 0.4, 3)
    a = limit_command(rng.uniform(-2.0, 2.0, 3), v, A_MAX, V_MAX, T).acceleration
    around = list[Bound]()
    for _ in range(count):
        direction = rng.normal(size=3)
        p = rng.uniform(1.0, 2.8) * direction / np.linalg.norm(direction)
        around += bounds(p, rng.uniform(-0.5, 0.5, 3))
    return a, v, around


@settings(max_examples=150)
@given(ANYTHING, ANYTHING, st.lists(st.tuples(ANYTHING, ANYTHING, ANYTHING), max_size=3),
       st.floats(0.01, 100.0), st.floats(0.01, 100.0), st.floats(0.01, 1.0))
@pytest.mark.filterwarnings('ignore:overflow')
def test_no_input_leads_beyond_a_max_or_to_more_speed_than_v_max(
        a: Vector, v: Vector, around: list[tuple[Vector, Vector, Vector]], a_max: float,
        v_max: float, period: float) -> None:
    found = [each for p, w, its in around for each in bounds(p, w, its)]
    command = guard(a, v, sort_bounds(found), a_max, v_max, period)
    assert_within_limits(command.acceleration, v, a_max, v_max, period)


@settings(max_examples=150)
@given(SEED, st.integers(1, 3))
def test_near_the_band_the_vertical_part_stays(seed: int, count: int) -> None:
    a, v, around = situation(seed, count)
    command = guard(a, v, sort_bounds(around), A_MAX, V_MAX, T)
    assert command.acceleration[2] == pytest.approx(a[2], abs=1e-9)


@given(SEED, st.integers(0, 3))
def test_command_within_every_bound_is_returned_bit_for_bit(seed: int, count: int) -> None:
    a, v, around = situation(seed, count)
    around = [b for b in around if b.normal @ a >= b.least]
    command = guard(a, v, sort_bounds(around), A_MAX, V_MAX, T)
    assert command.acceleration.tobytes() == a.tobytes()
    assert command.reason == ''


@given(SEED)
@example(3243)  # the bounds contradict each other: separation comes first
def test_one_neighbor_clips_radial_part_rest_shrinks_to_a_max(
        seed: int) -> None:
    a, v, _ = situation(seed, 0)
    rng = np.random.default_rng(seed)
    one = bounds([*rng.uniform(-2.0, 2.0, 2), 0.0], rng.uniform(-0.5, 0.5, 3))
    level = guard(a, v, sort_bounds(one), A_MAX, 100.0, T).acceleration[:2]
    n, most = np.array(one[0].normal[:2]), math.sqrt(A_MAX ** 2 - a[2] ** 2)
    lowest, highest = np.clip([one[0].least, -one[1].least], -most, most)
    # Where they contradict each other, separation comes before cohesion.
    radial = np.clip(n @ a[:2], lowest, max(lowest, highest))
    across = a[:2] - (n @ a[:2]) * n
    room = math.sqrt(most ** 2 - radial ** 2)
    length = np.linalg.norm(across)
    expected = radial * n + across * min(1.0, room / length)
    assert level == pytest.approx(expected, abs=1e-3 if room < 1e-2 else 1e-5)


@given(SEED)
def test_at_v_max_the_radial_part_comes_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = np.array([-1.0, 0.0, 0.0])
    v = np.array([0.0, 0.5, 0.0])  # sideways, at v_max
    lowest = rng.uniform(0.1, 2.2)
    a = limit_command([0.0, rng.uniform(0.0, 1.0), 0.0], v, A_MAX, V_MAX, T).acceleration
    one = sort_bounds(pair(1.1, n, lowest, 9.0))
    command = guard(a, v, one, A_MAX, V_MAX, T).acceleration
    assert n @ command == pytest.approx(lowest)
    assert np.linalg.norm(v + command * T) == pytest.approx(V_MAX)


def test_nearer_of_two_is_avoided_first_farther_as_allowed() -> None:
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    around = [*pair(1.2, -x, 1.0, 9.0), *pair(1.3, y, 2.5, 9.0), *pair(1.1, x, 1.5, 9.0)]
    command = guard(np.zeros(3), np.zeros(3), sort_bounds(around), A_MAX, 9.0, T)
    assert command.acceleration == pytest.approx([1.5, 2.0, 0.0], abs=1e-6)
    assert command.reason == 'separation'


def test_one_in_sight_comes_before_nearer_assumed_one() -> None:
    x = np.array([1.0, 0.0, 0.0])
    around = [*pair(0.1, x, 1.5, seen=False), *pair(1.1, -x, 1.0, 9.0)]
    command = guard(np.zeros(3), np.zeros(3), sort_bounds(around), A_MAX, V_MAX, T).acceleration
    assert command[0] == pytest.approx(-1.0, abs=1e-6)


def test_bounds_come_in_the_order_of_their_importance() -> None:
    x = np.array([1.0, 0.0, 0.0])
    near, far = pair(1.0, x, 0.0, 0.0), pair(2.0, x, 0.0, 0.0)
    hidden = [Bound(x, 0.0, SEPARATION, distance, False) for distance in (0.5, 3.0)]
    fence, sight = Bound(x, 0.0, FENCE), Bound(x, 0.0, SIGHT)
    found = sort_bounds([far[1], hidden[1], far[0], near[1], hidden[0], near[0]], [fence], [sight])
    assert [(each.reason, each.distance) for each in found] == [
        (SEPARATION, 1.0), (SEPARATION, 2.0), (FENCE, 0.0), (SEPARATION, 0.5), (SEPARATION, 3.0),
        (SIGHT, 0.0), (COHESION, 2.0), (COHESION, 1.0)]


def test_cohesion_against_separation_does_not_push_across() -> None:
    behind, ahead = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.01, 0.0])
    around = [Bound(behind, 0.3, SEPARATION, 1.8), Bound(ahead, 0.2, COHESION, 2.6)]
    command = guard(np.zeros(3), np.zeros(3), sort_bounds(around), A_MAX, 9.0, T).acceleration
    assert command == pytest.approx([-0.3, 0.0, 0.0], abs=1e-6)


@given(st.floats(0.0, 10.0), st.floats(0.05, 5.0), st.floats(0.1, 10.0))
def test_the_closing_speed_is_stopped_within_the_gap(gap: float, tau: float, b: float) -> None:
    speed = GuardParams(tau=tau, b=b).closing_speed(gap)[0]
    assert speed * tau + speed ** 2 / (2.0 * b) == pytest.approx(gap, abs=1e-9)


def test_beyond_the_margin_the_distance_returns_slowly() -> None:
    assert PARAMS.closing_speed(-0.1)[0] == pytest.approx(-0.2)
    assert PARAMS.closing_speed(-1.0)[0] == -EDGE_RETURN_SPEED


def test_bounds_are_those_of_the_formula() -> None:
    p, w, its = np.array([-1.5, 0.0, 0.0]), np.array([0.3, 0.4, 0.0]), np.array([0.5, 0.0, 0.0])
    lower, upper = bounds(p, w, its)
    near, far = 1.5 - 1.0 - PARAMS.m, math.sqrt(8.0) - PARAMS.m - 1.5
    common, rate = -0.5 - 0.4 ** 2 / 1.5, -0.3
    (speed, slope), (far_speed, far_slope) = PARAMS.closing_speed(near), PARAMS.closing_speed(far)
    assert lower.least == pytest.approx(common - (rate + speed) / PARAMS.T_g - slope * rate)
    assert -upper.least == pytest.approx(
        common - (rate - far_speed) / PARAMS.T_g - far_slope * rate)


def test_one_in_a_growing_sphere_is_kept_clear_of_earlier() -> None:
    known = bounds((-2.0, 0.0, 0.0), (0.2, 0.0, 0.0))
    unsure = radial_bounds((-2.0, 0.0, 0.0), (0.2, 0.0, 0.0),
                           BAND._replace(spread=0.3, spreading=0.5), PARAMS)
    same = bounds((-1.7, 0.0, 0.0), (0.7, 0.0, 0.0))
    assert unsure[0].least == pytest.approx(same[0].least)
    assert unsure[0].least > known[0].least
    assert unsure[1].least == known[1].least


def test_the_margin_leaves_room_in_a_narrow_band() -> None:
    narrow = Edges.of(FlockingParams(beta=0.25, d1=2.25), PARAMS)
    assert (narrow.near, narrow.far, narrow.margin) == (1.0, 1.5, pytest.approx(0.12))
    for distance in np.linspace(1.0, 1.5, 51):
        lower, upper = radial_bounds((-distance, 0.0, 0.0), (0.0, 0.0, 0.0), narrow, PARAMS)
        assert lower.least < -upper.least


def test_a_leader_overhead_is_not_fled_from_sideways_at_random() -> None:
    above = bounds((0.001, 0.0, -0.9), (0.0, 0.0, 0.0))
    command = guard(np.zeros(3), np.zeros(3), sort_bounds(above), A_MAX, V_MAX, T)
    assert np.array_equal(command.acceleration, np.zeros(3))


@pytest.mark.parametrize('p', [(0.0, 0.0, 0.0), (math.nan, 1.0, 0.0), (1e308, 1e308, 0.0)])
def test_a_neighbor_without_a_direction_bounds_nothing(p: Vector) -> None:
    assert bounds(p, (0.0, 0.0, 0.0)) == []
