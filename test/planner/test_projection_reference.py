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

"""The projection against the search over all active sets, on cases of every kind."""

from __future__ import annotations

import math
from typing import Any

import exhaustive_projection as reference
from exhaustive_projection import Ball, Bound, Lens, planners, planners_best
import numpy as np
import pytest

from flock_follower.geometry import Array

pytestmark = pytest.mark.slow

CASES = 250  # of each kind of bounds
LENSES = ('any', 'any', 'any', 'guard', 'tangent outside', 'tangent inside', 'same', 'point')
BOUNDS = ('any', 'with room', 'one point', 'touching', 'parallel', 'nearly parallel', 'grid',
          'tangent')

Generator = np.random.Generator


def unit(rng: Generator) -> Array:
    drawn = rng.normal(size=2)
    return drawn / np.linalg.norm(drawn)


def a_lens(rng: Generator, kind: str) -> Lens:
    """Return a lens of radii as in flight; two discs may touch from outside or from inside."""
    radius, other = rng.uniform(0.5, 3.0), rng.uniform(0.5, 6.0)
    if kind == 'guard':
        radius, other, apart = 2.5, 5.0, rng.uniform(0.0, 5.0)
    elif kind == 'tangent outside':
        apart = radius + other
    elif kind == 'tangent inside':
        apart = abs(radius - other)
    elif kind == 'same':
        other, apart = radius, 0.0
    elif kind == 'point':
        other, apart = 0.0, rng.uniform(0.0, radius)
    else:
        apart = rng.uniform(max(abs(radius - other) - 0.2, 0.0), 0.98 * (radius + other))
    return Lens(Ball(np.zeros(2), radius), Ball(apart * unit(rng), other))


def some_bounds(rng: Generator, lens: Lens, kind: str, most: int) -> list[Bound]:
    """Return up to so many bounds; all but 'any' lie specially to the lens or to one another."""
    count = int(rng.integers(0, most + 1))
    normals = np.array([rng.uniform(0.1, 1.0) * unit(rng) for _ in range(count)]).reshape(-1, 2)
    inside = lens.nearest(3.0 * rng.normal(size=2))
    if kind == 'grid':
        normals = rng.integers(-1, 2, (count, 2)).astype(float)
        normals[~normals.any(axis=1)] = 1.0
    elif kind in ('parallel', 'nearly parallel'):
        for k in range(1, count):
            if rng.random() < 0.6:
                normals[k] = rng.choice([-1.0, -0.3, 0.5, 1.0]) * normals[rng.integers(k)]
                normals[k] += (kind != 'parallel') * 1e-3 * rng.normal(size=2)
    sizes = np.linalg.norm(normals, axis=1)
    there = normals @ inside
    least = sizes * rng.uniform(-2.0, 3.0, count)
    if kind == 'with room':
        least = there - sizes * rng.exponential(0.5, count)
    elif kind == 'one point':
        least = there
    elif kind == 'touching':
        least = there - (rng.random(count) < 0.5) * sizes * rng.exponential(0.5, count)
    elif kind == 'grid':
        least = rng.integers(-3, 4, count) / 2.0
    elif kind == 'tangent':
        balls = [lens[int(rng.integers(2))] for _ in range(count)]
        least = np.array([normal @ ball.centre + size * ball.radius
                          for normal, size, ball in zip(normals, sizes, balls)])
    elif kind == 'parallel' and rng.random() < 0.5:
        least = there + sizes * rng.choice([-0.3, 0.0, 0.1, 0.3], count)
    return [Bound(normal, float(value)) for normal, value in zip(normals, least)]


@pytest.mark.parametrize('kind', BOUNDS)
def test_the_first_bounds_first_is_what_trying_all_active_sets_finds(kind: str) -> None:
    for case in range(CASES):
        rng = np.random.default_rng([2, BOUNDS.index(kind), case])
        lens = a_lens(rng, LENSES[rng.integers(len(LENSES))])
        bounds = some_bounds(rng, lens, kind, 7)
        wanted = 3.0 * rng.normal(size=2)
        point = planners(wanted, bounds, lens)
        expected = reference.lexicographic(wanted, bounds, lens)
        assert point == pytest.approx(expected, abs=1e-6), case
        assert all(ball.holds(point) for ball in lens), case


@pytest.mark.parametrize('find', ['nearest', 'farthest'])
def test_the_best_point_or_none_is_what_trying_all_active_sets_finds(find: str) -> None:
    theirs = {'nearest': reference.nearest, 'farthest': reference.farthest}[find]
    none = 0
    for case in range(CASES):
        rng = np.random.default_rng([2, case])
        lens = a_lens(rng, 'any')
        bounds = some_bounds(rng, lens, ('any', 'with room')[case % 2], 5)
        goal = 3.0 * rng.normal(size=2)
        point = planners_best(goal, find == 'farthest', bounds, lens)
        expected = theirs(goal, bounds, lens)
        if expected is None:
            assert point is None, case
            none += 1
        else:
            assert point == pytest.approx(expected, abs=1e-6), case
    assert 0.1 * CASES < none < 0.5 * CASES


def test_of_many_bounds_those_that_are_kept_anyway_change_nothing() -> None:
    """So the reference need only solve for the others, of which it finds one after the other."""
    for case in range(30):
        rng = np.random.default_rng([2, case])
        lens = a_lens(rng, 'guard')
        normals = np.array([unit(rng) for _ in range(36)])
        place = lens.nearest(rng.normal(size=2))
        room = case % 3 > 0
        bounds = [Bound(normal, float(normal @ place) - (
            rng.exponential(0.5) if room else rng.uniform(-0.5, 2.5))) for normal in normals]
        wanted = 3.0 * rng.normal(size=2)
        some: set[int] = set()
        expected = lens.nearest(wanted)
        while True:
            broken = [k for k, bound in enumerate(bounds)
                      if not bound.holds(expected) and k not in some]
            if not broken:
                break
            some.add(broken[0])
            expected = reference.lexicographic(wanted, [bounds[k] for k in sorted(some)], lens)
        point = planners(wanted, bounds, lens)
        assert point == pytest.approx(expected, abs=1e-6), case
        all_met = all(bound.holds(expected) for bound in bounds)
        assert (planners_best(wanted, False, bounds, lens) is not None) == all_met
        assert all_met or not room


def test_bounds_that_exclude_one_another_by_rounding_only_are_all_met() -> None:
    """Whichever way a comparison falls out, and whatever bound beyond reach comes after them."""
    for case in range(2000):
        rng = np.random.default_rng([2, case])
        lens = a_lens(rng, 'any')
        place = lens.nearest(rng.normal(size=2))
        normals = [unit(rng)]
        for _ in range(int(rng.integers(2, 6))):
            opposite = rng.random() < 0.6
            normals.append(-normals[rng.integers(len(normals))] if opposite else unit(rng))
        too_much = rng.choice([0.0, 5e-12, 9e-12, 1e-11, -1e-11, 2e-11, 1e-10, 1e-9, 1e-8],
                              len(normals))
        together = int(rng.integers(1, len(normals) + 1))
        too_much[together:together + 1] = 1.0
        bounds = [Bound(normal, float(normal @ place + excess))
                  for normal, excess in zip(normals, too_much)]
        point = planners(3.0 * rng.normal(size=2), bounds, lens)
        assert min(bound.normal @ point - bound.least for bound in bounds[:together]) > -1e-4, case


def test_a_line_that_cuts_both_discs_may_miss_what_they_have_in_common() -> None:
    lens = Lens(Ball(np.zeros(2), 1.0), Ball(np.array([1.5, 0.0]), 1.0))
    up = np.array([0.0, 1.0])
    assert planners_best(up, False, [Bound(up, 0.8)], lens) is None
    point = planners(np.array([0.75, 0.0]), [Bound(up, -0.8), Bound(-up, 0.75)], lens)
    assert point == pytest.approx([0.75, -math.sqrt(1.0 - 0.75 ** 2)])


@pytest.mark.parametrize(('bounds', 'expected'), [
    ([], [0.3, 0.0]),
    ([([0.0, 0.0], 1.0), ([0.0, 1.0], 0.5)], [0.3, 0.5]),  # without a direction
    ([([0.0, 1.0], math.inf), ([1.0, 0.0], 0.5)], [0.0, 2.0]),
    ([([0.0, 1.0], -math.inf), ([0.0, 1e-3], 5e-4)], [0.3, 0.5]),
    ([([0.0, 1.0], 1e18), ([0.0, -1.0], 1e18)], [0.0, 2.0]),
])
@pytest.mark.filterwarnings('error')
def test_bounds_without_a_direction_or_without_an_end(bounds: Any, expected: Any) -> None:
    lens = Lens(Ball(np.zeros(2), 2.0), Ball(np.array([1.0, 0.0]), 4.0))
    given = [Bound(np.array(normal), least) for normal, least in bounds]
    assert planners(np.array([0.3, 0.0]), given, lens) == pytest.approx(expected, abs=1e-6)
