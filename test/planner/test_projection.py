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

"""The projection against the search over all candidates, on cases of every kind."""

from __future__ import annotations

import cmath
import math

import exhaustive_projection as reference
import numpy as np
import pytest

from flock_follower.planner.projection import Discs, nearest_in_order, optimum, product, Side

CASES = 120  # of each kind of bounds
DISCS = ('any', 'any', 'guard', 'tangent outside', 'tangent inside', 'same', 'point')
KINDS = ('any', 'with room', 'one point', 'touching', 'parallel', 'nearly parallel', 'grid',
         'tangent')

Generator = np.random.Generator


def unit(rng: Generator) -> complex:
    return cmath.rect(1.0, rng.uniform(-math.pi, math.pi))


def normal(rng: Generator) -> complex:
    return complex(*rng.normal(size=2))


def two_discs(rng: Generator, kind: str) -> Discs:
    """Return discs of radii as in flight; they may touch from outside or from inside."""
    radius, other = rng.uniform(0.5, 3.0), rng.uniform(0.5, 6.0)
    if kind == 'guard':
        radius, other = 2.5, 5.0
    elif kind == 'same':
        other = radius
    elif kind == 'point':
        other = 0.0
    apart = {'guard': rng.uniform(0.0, 5.0), 'tangent outside': radius + other, 'same': 0.0,
             'tangent inside': abs(radius - other), 'point': rng.uniform(0.0, radius)}.get(
        kind, rng.uniform(max(abs(radius - other) - 0.2, 0.0), 0.98 * (radius + other)))
    return Discs(0j, radius, apart * unit(rng), other)


def bounds(rng: Generator, discs: Discs, kind: str, most: int) -> list[Side]:
    """Return up to so many bounds; all but 'any' lie specially to the discs or to each other."""
    inside, found = discs.best(3.0 * normal(rng)), list[Side]()
    for _ in range(int(rng.integers(0, most + 1))):
        n = rng.uniform(0.1, 1.0) * unit(rng)
        if kind == 'grid':
            n = complex(*rng.integers(-1, 2, 2)) or 1.0 + 0j
        elif 'parallel' in kind and found and rng.random() < 0.6:
            n = float(rng.choice([-1.0, -0.3, 0.5, 1.0])) * found[rng.integers(len(found))][0]
            n += 1e-3 * normal(rng) if kind == 'nearly parallel' else 0.0
        there, slack, k = product(n, inside), abs(n) * rng.exponential(0.5), rng.integers(2)
        least = {'with room': there - slack, 'one point': there,
                 'touching': there - float(rng.random() < 0.5) * slack,
                 'grid': float(rng.integers(-3, 4)) / 2.0,
                 'tangent': product(n, discs[2 * k]) + abs(n) * discs[2 * k + 1]}.get(
            kind, abs(n) * rng.uniform(-2.0, 3.0))
        found.append((n, least))
    return found


@pytest.mark.parametrize('kind', KINDS)
def test_priority_solution_equals_search_of_all_candidates(kind: str) -> None:
    for case in range(CASES):
        rng = np.random.default_rng([2, KINDS.index(kind), case])
        discs = two_discs(rng, DISCS[rng.integers(len(DISCS))])
        sides, wanted = bounds(rng, discs, kind, 7), 3.0 * normal(rng)
        point = nearest_in_order(wanted, sides, discs)
        assert point == pytest.approx(reference.nearest_in_order(wanted, sides, discs), abs=1e-6)
        assert reference.holds(point, [], discs), case


@pytest.mark.parametrize('far', [False, True])
def test_best_point_equals_search_of_all_candidates(far: bool) -> None:
    none = 0
    for case in range(CASES):
        rng = np.random.default_rng([2, case])
        discs = two_discs(rng, 'any')
        sides, goal = bounds(rng, discs, KINDS[case % 2], 5), 3.0 * normal(rng)
        point, met = optimum(goal, far, sides, discs)
        expected = (reference.farthest if far else reference.nearest)(goal, sides, discs)
        assert (met == len(sides)) == (expected is not None), case
        assert expected is None or point == pytest.approx(expected, abs=1e-6), case
        none += expected is None
    assert 0.1 * CASES < none < 0.5 * CASES


def test_the_solution_moves_with_discs_bounds_and_goal() -> None:
    for case in range(CASES):
        rng = np.random.default_rng([3, case])
        discs = two_discs(rng, DISCS[case % len(DISCS)])
        sides, goal, by = bounds(rng, discs, 'with room', 5), 3.0 * normal(rng), normal(rng)
        moved = discs._replace(center=discs.center + by, other=discs.other + by)
        assert moved.best(goal + by) == pytest.approx(discs.best(goal) + by, abs=1e-6), case
        point = nearest_in_order(
            goal + by, [(n, least + product(n, by)) for n, least in sides], moved)
        assert point == pytest.approx(nearest_in_order(goal, sides, discs) + by, abs=1e-6), case


@pytest.mark.parametrize('center', [0j, 5.0 + 5.0j])
def test_best_point_of_two_discs_of_radius_and_distance_1(center: complex) -> None:
    discs = Discs(center, 1.0, center + 1.0, 1.0)
    for side in (1j, -1j):
        corner = center + 0.5 + math.sqrt(0.75) * side
        assert discs.best(center + 0.5 + 3.0 * side) == pytest.approx(corner)
        assert discs.best(3.0 * side + 0.5, far=True) == pytest.approx(corner)


def test_discs_that_miss_each_other_have_the_point_between() -> None:
    """By more than rounding none should."""
    for axis in (1.0 + 0j, 1j):
        discs = Discs(1.0 + 1j, 1.0, 1.0 + 1j + 3.0 * axis, 1.0)
        assert discs.best(1.0 + 1j + 9.0 * axis) == discs.best(axis, far=True) == 1.0 + 1j + axis


def test_bounds_that_conflict_by_rounding_are_all_met() -> None:
    """Whichever way a comparison falls out, and whatever bound beyond reach comes after them."""
    for case in range(500):
        rng = np.random.default_rng([2, case])
        discs = two_discs(rng, 'any')
        place, normals = discs.best(normal(rng)), [unit(rng)]
        for _ in range(int(rng.integers(2, 6))):
            opposite = rng.random() < 0.6
            normals.append(-normals[rng.integers(len(normals))] if opposite else unit(rng))
        excess = rng.choice([0.0, 5e-12, 9e-12, 1e-11, -1e-11, 2e-11, 1e-10, 1e-9, 1e-8],
                            len(normals))
        together = int(rng.integers(1, len(normals) + 1))
        excess[together:together + 1] = 1.0
        sides = [(n, product(n, place) + float(more)) for n, more in zip(normals, excess)]
        point = nearest_in_order(3.0 * normal(rng), sides, discs)
        assert min(product(n, point) - least for n, least in sides[:together]) > -1e-4, case


@pytest.mark.parametrize(('sides', 'expected'), [
    ([], 0.3), ([(0j, 1.0), (1j, 0.5)], 0.3 + 0.5j),  # without a direction
    ([(1j, math.inf), (1 + 0j, 0.5)], 2j), ([(1j, -math.inf), (1e-3j, 5e-4)], 0.3 + 0.5j),
    ([(1j, 1e18), (-1j, 1e18)], 2j)])
@pytest.mark.filterwarnings('error')
def test_bounds_without_a_direction_or_without_an_end(sides: list[Side],
                                                      expected: complex) -> None:
    point = nearest_in_order(0.3 + 0j, sides, Discs(0j, 2.0, 1 + 0j, 4.0))
    assert point == pytest.approx(expected, abs=1e-6)
