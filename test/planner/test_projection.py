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

"""Nearest and farthest points, against all points of a fine sample."""

from __future__ import annotations

from exhaustive_projection import Ball, Bound, discs, Lens, planners, planners_best
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.geometry import Array

SEED = st.integers(0, 2 ** 32)


def drawn(seed: int, count: int) -> tuple[Lens, list[Bound], Array, Array]:
    """Return a lens, bounds, a point, and the sampled points of the lens within the bounds."""
    rng = np.random.default_rng(seed)
    lens = Lens(Ball(np.zeros(2), 1.0), Ball(rng.normal(size=2), rng.uniform(0.5, 2.0)))
    bounds = [Bound(rng.normal(size=2), rng.uniform(-1.0, 0.4)) for _ in range(count)]
    points = rng.uniform(-1.0, 1.0, (20_000, 2))
    for ball in lens:
        points = points[np.linalg.norm(points - ball.centre, axis=1) <= ball.radius]
    for bound in bounds:
        points = points[points @ bound.normal >= bound.least]
    return lens, bounds, 2.0 * rng.normal(size=2), points


@settings(max_examples=60)
@given(SEED, st.integers(0, 4))
def test_the_nearest_and_the_farthest_point_beat_every_sampled_one(seed: int, count: int
                                                                   ) -> None:
    lens, bounds, wanted, points = drawn(seed, count)
    assume(len(points))
    near, far = (planners_best(wanted, far, bounds, lens) for far in (False, True))
    assert near is not None
    assert far is not None
    for point in (near, far):
        assert all(ball.holds(point) for ball in lens)
        assert all(bound.holds(point) for bound in bounds)
    assert np.linalg.norm(near - wanted) <= np.linalg.norm(points - wanted, axis=1).min() + 1e-7
    assert far @ wanted >= (points @ wanted).max() - 1e-7


def test_bounds_that_exclude_one_another_have_no_nearest_point() -> None:
    lens = Lens(Ball(np.zeros(2), 1.0), Ball(np.zeros(2), 1.0))
    apart = [Bound(np.array([1.0, 0.0]), 0.5), Bound(np.array([-1.0, 0.0]), 0.5)]
    assert planners_best(np.zeros(2), False, apart, lens) is None
    assert planners_best(np.ones(2), True, apart, lens) is None


@settings(max_examples=60)
@given(SEED, st.integers(1, 5))
def test_a_bound_is_met_as_well_as_those_before_it_allow(seed: int, count: int) -> None:
    lens, _, wanted, _ = drawn(seed, 0)
    points = drawn(seed, 0)[3]
    assume(len(points) > 100)
    rng = np.random.default_rng(seed)
    bounds = [Bound(rng.normal(size=2), rng.uniform(-0.5, 1.5)) for _ in range(count)]
    point = planners(wanted, bounds, lens)
    assert all(ball.holds(point) for ball in lens)
    for bound in bounds:
        best = (points @ bound.normal).max()
        assert bound.normal @ point >= min(bound.least, best) - 1e-6
        # The next is judged among the points that meet this one as well as the result does.
        met = min(bound.least, float(bound.normal @ point))
        points = points[points @ bound.normal >= met - 1e-9]
        if not len(points):
            return


def test_of_two_equally_wanted_points_of_a_rim_one_inside_is_taken() -> None:
    lens = Lens(Ball(np.zeros(2), 1.0), Ball(np.array([1.5, 0.0]), 1.0))
    assert discs(lens).best(0.75 + 0j) == pytest.approx(0.75 + 0j)
