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

"""Simulated flocks: the paper's two setups to the reference's digits, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flock_desk.flocks.agents import adaptive, Leader, simulate, Simulation
from flock_desk.flocks.flock_metrics import extremum, Metrics, metrics
from flock_desk.flocks.paper import (
    FLIGHT_PARAMS,
    LEADER_FOLLOWER,
    leader_input,
    LEADER_SWITCH,
    LEADERLESS,
    PARAMS,
    random_start,
)
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import Array

pytestmark = pytest.mark.slow
LEADER = Leader(leader_input, [LEADER_SWITCH])


def leaderless(model: Any, **options: Any) -> Simulation:
    return simulate(LEADERLESS.positions, LEADERLESS.velocities, PARAMS, model=model,
                    **{'duration': 20.0, 'sample_period': 0.005, **options})


def led(model: Any, **options: Any) -> Simulation:
    return simulate(LEADER_FOLLOWER.positions, LEADER_FOLLOWER.velocities, PARAMS, duration=10.0,
                    model=model, leader=LEADER, **{'sample_period': 0.005, **options})


@pytest.fixture(scope='module')
def law() -> Simulation:
    return leaderless('flocking')


@pytest.mark.parametrize(('disagreement', 'settled'), [
    ([1.0, 1e-1, 1e-3, 1e-3], 1.5), ([1.0, 1e-3, 1e-1, 1e-3], 2.5), ([1.0, 1e-3, 1e-3, 0.1], None),
    ([1.0, 1e-2, 1e-3, 1e-4], 1.0), ([1.0, 1e-3, 1e-3, np.nan], None), ([0.0] * 4, None)])
def test_velocities_agree_from_when_on_they_stay_so(disagreement: list[float],
                                                    settled: float | None) -> None:
    rest = np.zeros(4)
    m = Metrics(np.arange(4.0), rest, rest, rest, rest, np.array(disagreement), rest, rest)
    assert m.time_to_agree() == pytest.approx(np.nan if settled is None else settled, nan_ok=True)


def test_vicsek_fits_the_papers_figure_only_if_velocities_are_averaged() -> None:
    averaged, literal = leaderless('vicsek_mean_velocity'), leaderless('vicsek')
    assert averaged.metrics.mean_distance[-1] == pytest.approx(0.900, abs=5e-4)
    assert averaged.metrics.mean_distance[-1] < np.sqrt(PARAMS.d0)
    assert literal.metrics.mean_distance[-1] > 5.0 * np.sqrt(PARAMS.d1)
    speeds = np.linalg.norm(literal.velocities, axis=2)
    assert speeds == pytest.approx(np.broadcast_to([0.54, 0.42, 0.99], speeds.shape), rel=1e-12)


@pytest.mark.parametrize('model', ['cucker_smale', 'cucker_dong', 'vicsek'])
def test_the_other_models_lose_the_papers_leader(model: Any) -> None:
    run = led(model)
    assert run.metrics.max_r2[-1] > 10.0 * PARAMS.d1
    # The leader heeds nobody: the same path, but for the coarser steps of Vicsek's model.
    alone = simulate(LEADER_FOLLOWER.positions[:1], LEADER_FOLLOWER.velocities[:1], duration=10.0,
                     leader=LEADER, sample_period=0.005)
    error = run.positions[-1, 0] - alone.positions[-1, 0]
    assert np.abs(error).max() < (0.5 if 'vicsek' in model else 1e-9)


@pytest.mark.parametrize('dt', [0.01, 0.1])
def test_semi_implicit_euler_keeps_the_band_behind_the_leader(dt: float) -> None:
    run = led('flocking', integrator='semi_implicit', dt=dt, sample_period=dt)
    assert PARAMS.d0 < run.metrics.min_r2.min() and run.metrics.max_r2.max() < PARAMS.d1


def test_semi_implicit_euler_converges_to_the_adaptive_solution_in_first_order(
        law: Simulation) -> None:
    errors = [np.abs(leaderless('flocking', duration=2.0, integrator='semi_implicit', dt=dt,
                                sample_period=0.5).positions[-1] - law.positions[400]).max()
              for dt in (0.002, 0.001)]
    assert errors[0] < 0.01
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)


def test_no_step_of_the_adaptive_integrator_straddles_a_break() -> None:
    def switched(t: float, x: Array, v: Array) -> Array:
        return np.full_like(x, 1.0 if t < 1.0 else -1.0)

    times = np.array([0.0, 0.5, 1.0, 2.0])
    start = (np.zeros((1, 2)), np.zeros((1, 2)))
    states = list(adaptive(switched, start, times, breaks=[1.0]))
    assert [x[0, 0] for x, _ in states] == pytest.approx([0.0, 0.125, 0.5, 1.0], abs=1e-14)
    assert [v[0, 0] for _, v in states] == pytest.approx([0.0, 0.5, 1.0, 0.0], abs=1e-14)


@pytest.mark.parametrize('dimension', [2, 3])
def test_vicsek_turns_to_the_mean_heading_of_those_in_sight(dimension: int) -> None:
    x = np.zeros((3, dimension))
    x[1, 0], x[2, 0] = 0.5, 9.0
    v = np.zeros((3, dimension))
    v[0, 0], v[1, 1], v[2, 1] = 2.0, 1.0, 3.0
    run = simulate(x, v, duration=0.1, model='vicsek', radius=1.0, dt=0.1)
    first, second, alone = run.velocities[-1]
    assert first[:2] == pytest.approx(np.full(2, 2.0 / np.sqrt(2.0)))
    assert second[:2] == pytest.approx(np.full(2, 1.0 / np.sqrt(2.0)))
    assert alone == pytest.approx(v[2])
    assert run.positions[-1] == pytest.approx(x + 0.1 * v)


def test_metrics_of_a_known_flock() -> None:
    x = np.array([[[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]] * 2)
    v = np.array([[[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], [[2.0, 0.0]] * 3])
    m = metrics(np.array([0.0, 1.0]), x, v, FlockingParams(d0=1.0, d1=30.0))
    assert m.min_r2.tolist() == [9.0, 9.0] and m.max_r2.tolist() == [25.0, 25.0]
    assert m.mean_distance == pytest.approx([4.0, 4.0])
    assert m.speed == pytest.approx([2.0 / 3.0, 2.0])
    assert m.order == pytest.approx([np.sqrt(2.0) / 3.0, 1.0])
    assert m.disagreement == pytest.approx([np.sqrt(4.0 / 3.0), 0.0])
    assert 0.0 < m.time_to_agree() <= 1.0
    assert np.isinf(metrics(m.time, x, v, PARAMS).lyapunov).all()


def test_an_extremum_between_samples_is_that_of_the_parabola() -> None:
    t = np.linspace(0.0, 1.0, 11)
    time, value = extremum(t, 3.0 - (t - 0.437) ** 2, least=False)
    assert (time, value) == (pytest.approx(0.437), pytest.approx(3.0))
    assert extremum(t, t, least=True) == (0.0, 0.0)


X, V = LEADERLESS.positions, LEADERLESS.velocities
FAR = np.array([[0.0, 0.0], [1.2, 0.0], [9.0, 0.0]])


@pytest.mark.parametrize(('change', 'message'), [
    ({'positions': X[0]}, r'^positions has shape \(2,\): must be \(k, 2\) or \(k, 3\)$'),
    ({'positions': np.zeros((0, 2)), 'velocities': np.zeros((0, 2))}, r'^positions has no agents'),
    ({'velocities': V[:2]}, r'^positions has shape \(3, 2\) and velocities \(2, 2\)'),
    ({'velocities': V * [1.0, np.nan]}, r'^velocities = .*nan.*: every value must be a finite'),
    ({'positions': X[[0, 1, 0]]}, r'^positions\[0\] and positions\[2\] are both \[0\.0, 0\.0\]: '
                                  r'agents must start apart$'),
    ({'positions': 0.5 * X}, r'^agents 0 and 1 start 0\.625 m apart: must be more than sqrt\(d0\) '
                             r'= 1 m \(move them apart, or lower d0\)$'),
    ({'positions': FAR}, r'^agents 0 and 2 start 9 m apart: must be less than sqrt\(d1\) = 1\.5 m '
                         r"for every two \(.*neighbors = 'graph'\)$"),
    ({'positions': FAR, 'neighbors': 'graph'}, r'^the agents start in groups that are not conn'),
    ({'positions': 0.5 * X, 'model': 'cucker_dong'}, r'^agents 0 and 1 start 0\.625 m apart'),
    ({'model': 'boids'}, r"^model = 'boids': must be one of flocking, cucker_dong, cucker_smale"),
    ({'neighbors': 'some'}, r"^neighbors = 'some': must be one of all, graph, nearest$"),
    ({'neighbors': 'graph', 'model': 'vicsek'}, r"^neighbors = 'graph': must be 'all' where "),
    ({'coupling': 'none'}, r"^coupling = 'none': must be one of flock, pair$"),
    ({'leader': Leader(lambda t: [0.0, 0.0, 1.0])}, r'^leader\.acceleration gives shape \(3,\): '
                                                    r'must be \(2,\)'),
    ({'integrator': 'euler'}, r"^integrator = 'euler': must be one of adaptive, semi_implicit$"),
    ({'method': 'quick'}, r"^method = 'quick': must be one of"),
    ({'duration': 0.0}, r'^duration = 0\.0: must be a number in \(0, inf\)$'),
    ({'sample_period': -1.0}, r'^sample_period = -1\.0'),
    ({'dt': np.nan}, r'^dt = nan'),
    ({'radius': np.inf, 'model': 'vicsek'}, r'^radius = inf'),
])
def test_bad_input_is_refused_with_what_to_change(change: dict[str, Any], message: str) -> None:
    usual: dict[str, Any] = {'positions': X, 'velocities': V, 'duration': 0.1}
    with pytest.raises(ValueError, match=message):
        simulate(**{**usual, **change})


def test_cucker_smale_may_start_anywhere_and_one_agent_alone() -> None:
    assert simulate(FAR, V, model='cucker_smale', duration=0.1).positions.shape == (6, 3, 2)
    alone = simulate([[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]], duration=1.0, sample_period=0.5)
    assert alone.positions[-1] == pytest.approx(np.array([[1.0, 0.0, 1.0]]))
    assert np.isinf(alone.metrics.min_r2).all()


def test_a_run_that_diverges_says_so() -> None:
    escape = Leader(lambda t: [1e9, 0.0])
    with pytest.raises(RuntimeError, match=r'^the solution diverges near t = 0'):
        simulate(FAR, V, model='cucker_smale', leader=escape, integrator='semi_implicit',
                 duration=1.0)


@pytest.mark.parametrize(('arguments', 'message'), [
    ((0, 2, PARAMS, 0), r'^count = 0: must be an integer in \[1, inf\)$'),
    ((3, 4, PARAMS, 0), r'^dimension = 4: must be 2 or 3$'),
])
def test_bad_starts_are_refused(arguments: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        random_start(*arguments)


@pytest.mark.parametrize('params', [PARAMS, FLIGHT_PARAMS])
@pytest.mark.parametrize('dimension', [2, 3])
def test_random_starts_keep_clear_of_the_singularities(params: FlockingParams,
                                                       dimension: int) -> None:
    x = random_start(40, dimension, params, seed=2).positions
    i, j = np.triu_indices(40, k=1)
    r2 = np.sum((x[i] - x[j]) ** 2, axis=1)
    margin = 0.0999 * (params.d1 - params.d0)
    assert r2.min() > params.d0 + margin and np.abs(r2 - params.d1).min() > margin
