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

"""The fast sums over all pairs, and the searches for neighbours, against the plain ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flock_desk.flocks.laws import accelerations, nearest, pairs_within
from flock_follower import flocking
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array

pytestmark = pytest.mark.slow
MODELS = ('flocking', 'cucker_dong', 'cucker_smale')
PARAMS = [FlockingParams(), FlockingParams(beta=0.25, d1=8.0),
          FlockingParams(beta=0.0, theta=3.0, d0=0.0), FlockingParams(beta=0.3, theta=1.5),
          FlockingParams(beta=1.0, theta=1.0, K=2.0, sigma=0.5)]


def flock(count: int, dimension: int, spacing: float = 0.2) -> tuple[Array, Array]:
    """Return agents of which no pair is where the law is singular: rounding is all to see."""
    rng = np.random.default_rng(count)
    x = rng.random((count, dimension)) * spacing * count
    for i in range(1, count):
        while True:
            r2 = np.sum((x[:i] - x[i]) ** 2, axis=1)
            if all(np.abs(r2 - edge).min() > 0.005 for edge in (0.0, 1.0, 2.25, 8.0)):
                break
            x[i] = rng.random(dimension) * spacing * count
    return x, rng.normal(size=(count, dimension))


@pytest.mark.parametrize('model', MODELS)
@pytest.mark.parametrize('dimension', [2, 3])
def test_blocks_give_the_sums_of_the_plain_law(model: Any, dimension: int) -> None:
    x, v = flock(133, dimension)
    for params in PARAMS:
        u = accelerations(x, v, params, model, 'blocked')
        expected = flocking.accelerations(x, v, params, model)
        assert u == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_blocks_smaller_and_larger_than_the_flock_agree() -> None:
    rng = np.random.default_rng(0)
    x, v = 100.0 * rng.random((1500, 2)), rng.normal(size=(1500, 2))  # several blocks
    params = FlockingParams(d0=0.0, d1=1e4, theta=1.0)
    assert accelerations(x, v, params, method='blocked') == pytest.approx(
        accelerations(x, v, params, method='whole'), rel=1e-8, abs=1e-6)


@pytest.mark.parametrize(('change', 'message'), [
    ({'method': 'fast'}, r"^method = 'fast': must be one of auto, whole, blocked$"),
    ({'model': 'vicsek'}, r"^model = 'vicsek': must be one of flocking, cucker_dong, cucker_s"),
    ({'velocities': np.zeros((3, 3))}, r'^positions has shape \(3, 2\) and velocities \(3, 3\)'),
])
def test_bad_input_is_refused(change: dict[str, Any], message: str) -> None:
    usual: dict[str, Any] = {'positions': np.eye(3, 2), 'velocities': np.eye(3, 2),
                             'params': FlockingParams()}
    with pytest.raises(ValueError, match=message):
        accelerations(**{**usual, **change})


@pytest.mark.parametrize('dimension', [2, 3])
def test_pairs_within_a_distance_are_all_found_once(dimension: int) -> None:
    x = np.random.default_rng(1).random((60, dimension)) * 4.0
    expected = [[i, j] for i in range(60) for j in range(i + 1, 60)
                if np.linalg.norm(x[i] - x[j]) < 1.2]
    assert sorted(pairs_within(x, 1.2).tolist()) == expected
    assert pairs_within(x[:1], 1.2).shape == (0, 2)


def test_the_nearest_are_found_without_oneself() -> None:
    x = np.random.default_rng(2).random((40, 3))
    found = nearest(x, 7)
    assert found.shape == (40, 7)
    for i, others in enumerate(found):
        distances = np.linalg.norm(x - x[i], axis=1)
        distances[i] = np.inf
        assert sorted(others) == sorted(np.argsort(distances)[:7])
    assert nearest(x[:3], 7).shape == (3, 2)
    assert nearest(x[:1], 7).shape == (1, 0)


def test_agents_in_one_place_do_not_find_themselves() -> None:
    found = nearest(np.zeros((12, 2)), 3)
    assert found.shape == (12, 3)
    assert not np.any(found == np.arange(12)[:, None])
