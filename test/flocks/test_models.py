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

from flock_desk.flocks.laws import accelerations, nearest
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
