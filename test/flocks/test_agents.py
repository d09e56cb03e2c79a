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

"""Simulated flocks: the paper's two setups, Vicsek's rule, integrators, metrics and starts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flock_desk.flocks.agents import (
    adaptive,
    semi_implicit,
    simulate,
    velocities_after,
)
from flock_desk.flocks.flock_metrics import extremum, Metrics, metrics
from flock_desk.flocks.paper import (
    FLIGHT_PARAMS,
    LEADER_FOLLOWER_START,
    leader_input,
    LEADERLESS_START,
    PAPER_PARAMS,
    random_start,
)
from flock_follower.flocking import accelerations, FlockingParams
from flock_follower.geometry import Array

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(('disagreement', 'settled'), [
    ([1.0, 1e-1, 1e-3, 1e-3], 1.5), ([1.0, 1e-3, 1e-1, 1e-3], 2.5), ([1.0, 1e-3, 1e-3, 0.1], None),
    ([1.0, 1e-2, 1e-3, 1e-4], 1.0), ([1.0, 1e-3, 1e-3, np.nan], None), ([0.0] * 4, None)])
def test_velocities_agree_from_when_on_they_stay_so(disagreement: list[float],
                                                    settled: float | None) -> None:
    rest = np.zeros(4)
    m = Metrics(np.arange(4.0), rest, rest, rest, rest, np.array(disagreement), rest, rest)
    assert m.time_to_agree() == pytest.approx(np.nan if settled is None else settled, nan_ok=True)


def test_vicsek_fits_papers_figure_only_with_averaging() -> None:
    averaged, literal = (simulate(*LEADERLESS_START, PAPER_PARAMS, duration=20.0, model=model)
                         for model in ('vicsek_mean_velocity', 'vicsek'))
    assert averaged.metrics.mean_distance[-1] == pytest.approx(0.900, abs=5e-4)
    assert literal.metrics.mean_distance[-1] > 5.0 * np.sqrt(PAPER_PARAMS.d1)
    speeds = np.linalg.norm(literal.velocities, axis=2)
    assert speeds == pytest.approx(np.broadcast_to([0.54, 0.42, 0.99], speeds.shape), rel=1e-12)


@pytest.mark.parametrize('dt', [0.01, 0.1])
def test_semi_implicit_euler_keeps_the_band_behind_the_leader(dt: float) -> None:
    def law(t: float, x: Array, v: Array) -> Array:
        return np.stack([leader_input(t), accelerations(x, v, PAPER_PARAMS)[1]])

    for x, _ in semi_implicit(law, (*LEADER_FOLLOWER_START,), np.arange(0.0, 10.05, 0.1), dt):
        assert PAPER_PARAMS.d0 < np.sum((x[1] - x[0]) ** 2) < PAPER_PARAMS.d1


def test_no_step_of_the_adaptive_integrator_straddles_a_break() -> None:
    def switched(t: float, x: Array, v: Array) -> Array:
        return np.full_like(x, 1.0 if t < 1.0 else -1.0)

    start = (np.zeros((1, 2)), np.zeros((1, 2)))
    states = list(adaptive(switched, start, np.array([0.0, 0.5, 1.0, 2.0]), breaks=[1.0]))
    assert [x[0, 0] for x, _ in states] == pytest.approx([0.0, 0.125, 0.5, 1.0], abs=1e-14)
    assert [v[0, 0] for _, v in states] == pytest.approx([0.0, 0.5, 1.0, 0.0], abs=1e-14)


@pytest.mark.parametrize(('second', 'mean_velocity', 'expected'), [
    ([0.0, 1.0], False, [[2.0 ** 0.5, 2.0 ** 0.5], [0.5 ** 0.5, 0.5 ** 0.5], [0.0, 3.0]]),
    ([0.0, 1.0], True, [[1.0, 0.5], [1.0, 0.5], [0.0, 3.0]]),
    # Headings that cancel are kept.
    ([-1.0, 0.0], False, [[2.0, 0.0], [-1.0, 0.0], [0.0, 3.0]])])
def test_vicsek_turns_to_the_mean_of_those_in_sight(
        second: list[float], mean_velocity: bool, expected: list[list[float]]) -> None:
    x, v = np.array([[0.0, 0.0], [0.5, 0.0], [9.0, 0.0]]), np.array([[2.0, 0.0], second, [0, 3]])
    assert velocities_after(x, v, mean_velocity) == pytest.approx(np.array(expected))


def test_metrics_of_a_known_flock() -> None:
    x = np.array([[[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]] * 2)
    v = np.array([[[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], [[2.0, 0.0]] * 3])
    m = metrics(np.array([0.0, 1.0]), x, v, FlockingParams(d0=1.0, d1=30.0))
    assert m.min_r2.tolist() == [9.0, 9.0] and m.max_r2.tolist() == [25.0, 25.0]
    assert m.mean_distance == pytest.approx([4.0, 4.0])
    assert m.speed == pytest.approx([2.0 / 3.0, 2.0])
    assert m.order == pytest.approx([np.sqrt(2.0) / 3.0, 1.0])
    assert m.disagreement == pytest.approx([np.sqrt(4.0 / 3.0), 0.0])
    assert np.isinf(metrics(m.time, x, v, PAPER_PARAMS).lyapunov).all()
    t = np.linspace(0.0, 1.0, 11)  # an extremum between samples is that of the parabola
    assert extremum(t, 3.0 - (t - 0.437) ** 2, least=False) == pytest.approx((0.437, 3.0))
    assert extremum(t, t, least=True) == (0.0, 0.0)


FAR = np.array([[0.0, 0.0], [1.2, 0.0], [9.0, 0.0]])


@pytest.mark.parametrize(('positions', 'model', 'message'), [
    (LEADERLESS_START.positions[0], 'flocking', r'^positions has shape \(2,\): must be'),
    (0.5 * LEADERLESS_START.positions, 'cucker_dong',
     r'^two agents start 0\.62\d* m apart: must be more'
     r' than sqrt\(d0\) = 1 m$'),
    (FAR, 'flocking', r'^two agents start 9 m apart: must be less than sqrt\(d1\) = 1\.5 m'),
    (FAR, 'boids', r"^model = 'boids': must be one of flocking, cucker_dong, cucker_smale")])
def test_bad_input_is_refused_with_what_to_change(positions: Any, model: Any,
                                                  message: str) -> None:
    with pytest.raises(ValueError, match=message):
        simulate(positions, LEADERLESS_START.velocities, PAPER_PARAMS, model=model)


@pytest.mark.parametrize('params', [PAPER_PARAMS, FLIGHT_PARAMS])
@pytest.mark.parametrize('dimension', [2, 3])
def test_random_starts_keep_clear_of_the_singularities(params: FlockingParams,
                                                       dimension: int) -> None:
    x = random_start(40, dimension, params, seed=2).positions
    i, j = np.triu_indices(40, k=1)
    r2 = np.sum((x[i] - x[j]) ** 2, axis=1)
    margin = 0.0999 * (params.d1 - params.d0)
    assert r2.min() > params.d0 + margin and np.abs(r2 - params.d1).min() > margin
    with pytest.raises(ValueError, match=r'^count = 0: must be an integer in \[1, inf\)$'):
        random_start(0, dimension, params, seed=0)
