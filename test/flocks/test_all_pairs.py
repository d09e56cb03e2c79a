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

import tracemalloc
from typing import Any

import numpy as np
import pytest

from flock_desk.flocks import neighbor_search
from flock_desk.flocks.all_pairs import accelerations
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


@pytest.mark.parametrize('method', ['blocked', 'compiled'])
@pytest.mark.parametrize('model', MODELS)
@pytest.mark.parametrize('dimension', [2, 3])
def test_every_method_gives_the_sums_of_the_plain_law(method: Any, model: Any,
                                                      dimension: int) -> None:
    if method == 'compiled':
        pytest.importorskip('numba')
    x, v = flock(133, dimension)  # neither a multiple of a block nor below one
    for params in PARAMS if method == 'blocked' else PARAMS[:1]:
        u = accelerations(x, v, params, model, method)
        expected = flocking.accelerations(x, v, params, model)
        assert u == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize('params', PARAMS[1:])
def test_the_compiled_sums_are_right_for_any_exponents(params: FlockingParams) -> None:
    pytest.importorskip('numba')
    x, v = flock(40, 2)
    expected = flocking.accelerations(x, v, params)
    assert accelerations(x, v, params, method='compiled') == pytest.approx(
        expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_blocks_smaller_and_larger_than_the_flock_agree() -> None:
    rng = np.random.default_rng(0)
    x, v = 100.0 * rng.random((1500, 2)), rng.normal(size=(1500, 2))  # more than a tile wide
    params = FlockingParams(d0=0.0, d1=1e4, theta=1.0)
    assert accelerations(x, v, params, method='blocked') == pytest.approx(
        accelerations(x, v, params, method='whole'), rel=1e-8, abs=1e-6)


def test_blocks_need_memory_in_proportion_to_the_agents() -> None:
    def peak(count: int) -> int:
        x = np.random.default_rng(0).random((count, 2)) * 100.0
        tracemalloc.start()
        accelerations(x, x, FlockingParams(), method='blocked')
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(200)
    small, large = peak(500), peak(2000)
    assert large - small < 1500 * 500  # a matrix of 2000 agents would be 32 MB
    assert large < 4e6


@pytest.mark.parametrize(('change', 'message'), [
    ({'method': 'fast'}, r"^method = 'fast': must be one of auto, whole, blocked, compiled$"),
    ({'model': 'vicsek'}, r"^model = 'vicsek': must be one of flocking, cucker_dong, cucker_s"),
    ({'velocities': np.zeros((3, 3))}, r'^positions has shape \(3, 2\) and velocities \(3, 3\)'),
])
def test_bad_input_is_refused(change: dict[str, Any], message: str) -> None:
    usual: dict[str, Any] = {'positions': np.eye(3, 2), 'velocities': np.eye(3, 2),
                             'params': FlockingParams()}
    with pytest.raises(ValueError, match=message):
        accelerations(**{**usual, **change})


@pytest.fixture(params=['tree', 'plain'])
def search(request: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    if request.param == 'plain':
        monkeypatch.setattr(neighbor_search, 'KDTree', None)
    elif neighbor_search.KDTree is None:
        pytest.skip('scipy is not installed')
    return neighbor_search


@pytest.mark.parametrize('dimension', [2, 3])
def test_pairs_within_a_distance_are_all_found_once(search: Any, dimension: int) -> None:
    x = np.random.default_rng(1).random((60, dimension)) * 4.0
    expected = [[i, j] for i in range(60) for j in range(i + 1, 60)
                if np.linalg.norm(x[i] - x[j]) < 1.2]
    assert sorted(search.pairs_within(x, 1.2).tolist()) == expected
    assert search.pairs_within(x[:1], 1.2).shape == (0, 2)


def test_the_nearest_are_found_without_oneself(search: Any) -> None:
    x = np.random.default_rng(2).random((40, 3))
    found = search.nearest(x, 7)
    assert found.shape == (40, 7)
    for i, others in enumerate(found):
        distances = np.linalg.norm(x - x[i], axis=1)
        distances[i] = np.inf
        assert sorted(others) == sorted(np.argsort(distances)[:7])
    assert search.nearest(x[:3], 7).shape == (3, 2)
    assert search.nearest(x[:1], 7).shape == (1, 0)


def test_agents_in_one_place_do_not_find_themselves(search: Any) -> None:
    found = search.nearest(np.zeros((12, 2)), 3)
    assert found.shape == (12, 3)
    assert not np.any(found == np.arange(12)[:, None])
