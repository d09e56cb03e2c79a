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

"""The law against the paper's setups, its invariants, and its behavior outside the band."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from flock_desk.flocks.agents import simulate, Simulation
from flock_desk.flocks.flock_metrics import extremum
from flock_desk.flocks.paper import LEADER_FOLLOWER_START, LEADERLESS_START, PAPER_PARAMS
from flock_follower.flocking import (
    acceleration,
    accelerations,
    cohesion,
    disagreement,
    FlockingParams,
    lyapunov,
    separation,
)
from flock_follower.geometry import Array
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix

FLIGHT = FlockingParams(beta=0.25, d1=8.0)


@pytest.fixture(scope='module')
def leaderless() -> Simulation:
    return simulate(*LEADERLESS_START, PAPER_PARAMS, sample_period=0.005)


def test_leaderless_distances_reproduce_the_reference(leaderless: Simulation) -> None:
    m = leaderless.metrics
    t, smallest = extremum(m.time, m.min_r2, least=True)
    assert t == pytest.approx(0.173, abs=5e-4)
    assert smallest == pytest.approx(1.326202, abs=1e-6)
    first, _, third = leaderless.positions[int(np.argmin(m.min_r2))]
    assert np.sum((first - third) ** 2) == pytest.approx(smallest, abs=1e-4)
    assert extremum(m.time, m.max_r2, least=False)[1] == pytest.approx(1.832563, abs=1e-6)


def test_leaderless_velocities_reproduce_the_reference(leaderless: Simulation) -> None:
    final = leaderless.velocities[-1]
    assert np.linalg.norm(final, axis=1) == pytest.approx([0.10751301] * 3, abs=1e-8)
    headings = np.degrees(np.arctan2(final[:, 1], final[:, 0]))
    assert headings == pytest.approx([-74.7472] * 3, abs=5e-5)
    length = leaderless.metrics.disagreement
    assert length[0] == pytest.approx(1.18887462, abs=5e-9)
    share = length / length[0]
    below = int(np.argmax(share < 0.01))
    crossing = np.interp(0.01, share[[below, below - 1]], leaderless.time[[below, below - 1]])
    assert crossing == pytest.approx(2.5355, abs=5e-4)


def test_lyapunov_function_falls_strictly_to_the_reference(leaderless: Simulation) -> None:
    w = leaderless.metrics.lyapunov
    assert w[0] == pytest.approx(6.0436562, abs=5e-8)
    assert w[-1] == pytest.approx(4.8031331, abs=1e-7)
    assert np.all(np.diff(w) < 0.0)


@pytest.mark.parametrize(('model', 'figure', 'extreme', 'reference', 'digits'), [
    ('cucker_smale', 'min_r2', np.min, 0.404997, 5e-7),
    ('cucker_dong', 'max_r2', np.max, 21.984, 5e-4)])
def test_predecessors_leave_the_band_as_in_the_reference(
        model: Any, figure: str, extreme: Callable[[Array], float], reference: float,
        digits: float) -> None:
    run = simulate(*LEADERLESS_START, PAPER_PARAMS, model=model, sample_period=0.01)
    assert extreme(getattr(run.metrics, figure)) == pytest.approx(reference, abs=digits)


def test_follower_of_papers_leader_stays_in_reference_band() -> None:
    run = simulate(*LEADER_FOLLOWER_START, PAPER_PARAMS, duration=10.0, led=True,
                   sample_period=0.01)
    assert run.metrics.min_r2.min() == pytest.approx(1.3976, abs=1e-4)
    assert run.metrics.max_r2.max() == pytest.approx(2.0049, abs=1e-4)


@st.composite
def flocks(draw: st.DrawFn) -> tuple[Array, Array]:
    """Return positions and velocities (k, n), in and out of the band but not at its very edge."""
    shape = draw(st.tuples(st.integers(1, 6), st.sampled_from([2, 3])))
    x = draw(arrays(float, shape, elements=st.floats(-4.0, 4.0)))
    v = draw(arrays(float, shape, elements=st.floats(-3.0, 3.0)))
    i, j = np.triu_indices(shape[0], k=1)
    r2 = np.sum((x[i] - x[j]) ** 2, axis=-1)
    # At an edge the law changes by 1e9 per mm: rounding would be all these tests see.
    assume(np.all(np.abs(r2 - FLIGHT.d0) > 0.01) and np.all(np.abs(r2 - FLIGHT.d1) > 0.01))
    return x, v


def rounding(flock: tuple[Array, Array]) -> float:
    """Return how much rounding may do: outside the band forces are stiff, 1e12 times all else."""
    x, v = flock
    i, j = np.triu_indices(len(x), k=1)
    r2 = np.sum((x[i] - x[j]) ** 2, axis=-1)
    stiffness = np.sum(separation(r2, FLIGHT) + cohesion(r2, FLIGHT))  # the forces of all add
    return float(1e-14 * stiffness * (1.0 + disagreement(v)))


def assert_close(actual: Array, expected: Array, rounding: float = 0.0) -> None:
    limit = 1e-8 * (1 + np.max(np.abs(expected))) + rounding
    assert actual == pytest.approx(expected, rel=1e-8, abs=limit)


@given(flocks(), st.sampled_from(['flocking', 'cucker_dong', 'cucker_smale']),
       st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.randoms(use_true_random=False))
def test_law_is_equivariant_and_sums_to_zero(
        flock: tuple[Array, Array], model: Any, vector: tuple[float, float, float],
        random: Any) -> None:
    x, v = flock
    n, order = x.shape[1], random.sample(range(len(x)), len(x))
    rotation = rotation_vector_to_matrix(vector if n == 3 else [0.0, 0.0, vector[2]])[:n, :n]
    offset, u = 30.0 * np.array(vector[:n]), accelerations(x, v, FLIGHT, model)
    moved = accelerations((x[order] + offset) @ rotation.T, (v[order] - offset) @ rotation.T,
                          FLIGHT, model)
    assert_close(moved, u[order] @ rotation.T, 20.0 * rounding(flock))
    assert np.linalg.norm(u.sum(axis=0)) <= 1e-12 * (1.0 + np.sum(np.abs(u)))


@given(flocks())
def test_one_agent_computes_what_the_flock_does(flock: tuple[Array, Array]) -> None:
    x, v = flock
    for i, expected in enumerate(accelerations(x, v, FLIGHT)):
        others = [j for j in range(len(x)) if j != i]
        assert_close(acceleration(x[others] - x[i], v[others] - v[i], FLIGHT), expected,
                     rounding(flock))


def test_law_equals_its_formula_written_out() -> None:
    x, v = LEADERLESS_START
    k, u = len(x), np.zeros_like(x)
    scale = np.sqrt(sum(np.sum((v[i] - v[j]) ** 2) for i in range(k) for j in range(i)) / k)
    for i in range(k):
        for j in range(k):
            if i == j:
                continue
            r2 = np.sum((x[i] - x[j]) ** 2)
            u[i] += (PAPER_PARAMS.K / (PAPER_PARAMS.sigma ** 2 + r2) ** PAPER_PARAMS.beta
                     * (v[j] - v[i]))
            u[i] += scale / (r2 - PAPER_PARAMS.d0) ** PAPER_PARAMS.theta * (x[i] - x[j])
            u[i] += scale / (PAPER_PARAMS.d1 - r2) ** PAPER_PARAMS.theta * (x[j] - x[i])
    assert accelerations(x, v, PAPER_PARAMS) == pytest.approx(u, rel=1e-12)


@pytest.mark.parametrize(('r2', 'pull'), [(1.0 + 1e-5, -1e10), (8.0 - 1e-5, 1e10)])
def test_law_is_exact_to_the_edges_of_the_band(r2: float, pull: float) -> None:
    x, v = np.array([np.sqrt(r2), 0.0]), np.array([0.0, 0.2])
    u = acceleration([x], [v], FLIGHT)
    assert u[0] == pytest.approx(pull * np.sqrt(r2) * 0.2 / np.sqrt(2.0), rel=1e-6)


@pytest.mark.parametrize('theta', [1.0, 2.0, 2.5, 3.0])
@pytest.mark.parametrize('dimension', [2, 3])
def test_outside_the_band_too_close_repels_and_too_far_attracts(theta: float,
                                                                dimension: int) -> None:
    params = FlockingParams(beta=0.25, theta=theta, d0=1.0, d1=8.0)
    direction = np.ones(dimension) / np.sqrt(dimension)
    sideways = np.zeros((1, dimension))
    sideways[0, 0], sideways[0, 1] = 0.1, -0.1  # across: no alignment along the direction
    for r2, sign in ((1e-6, -1), (0.5, -1), (1.0, -1), (1.001, -1), (7.999, 1), (8.0, 1),
                     (9.0, 1), (1e4, 1)):
        u = acceleration([np.sqrt(r2) * direction], sideways, params)
        assert np.all(np.isfinite(u))
        assert np.sign(u @ direction) == sign, r2


@pytest.mark.parametrize('theta', [1.0, 2.0, 2.5, 3.0])
def test_coincident_and_far_agents_get_finite_accelerations(theta: float) -> None:
    params = FlockingParams(theta=theta)
    x = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [1e100, -1e100]])
    v = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 1e100], [0.0, 0.0]])
    with np.errstate(over='raise', divide='raise', invalid='raise'):
        assert np.all(np.isfinite(accelerations(x, v, params)))


def test_equal_velocities_or_single_agent_give_no_acceleration() -> None:
    x = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 1.0]])  # outside the band
    assert np.array_equal(accelerations(x, np.ones((2, 3)), FLIGHT), np.zeros((2, 3)))
    assert np.array_equal(acceleration(np.zeros((0, 3)), np.zeros((0, 3)), FLIGHT), np.zeros(3))
    assert np.array_equal(accelerations([[1.0, 2.0]], [[3.0, 4.0]], FLIGHT), np.zeros((1, 2)))


@pytest.mark.parametrize('theta', [1.0, 1.5, 2.0, 3.0])
def test_lyapunov_function_is_positive_falls_infinite_outside(theta: float) -> None:
    params = FlockingParams(theta=theta)
    w = simulate(*LEADERLESS_START, params, duration=2.0, sample_period=0.01).metrics.lyapunov
    assert np.all(w > 0.0)
    assert np.all(np.diff(w) < 0.0)
    for distance in (0.9, 1.0, 1.5, 1.6):
        assert lyapunov([[0.0, 0.0], [distance, 0.0]], np.zeros((2, 2)), params) == np.inf


@pytest.mark.parametrize(('change', 'message'), [
    ({'K': 0.0}, r'^K = 0\.0: must be a number in \[0\.001, 100\]$'),
    ({'K': float('nan')}, r'^K = nan'),
    ({'sigma': 0.0}, r'^sigma = 0\.0: must be a number in \[0\.001, 100\] m$'),
    ({'beta': -0.1}, r'^beta = -0\.1'),
    ({'beta': float('inf')}, r'^beta = inf'),
    ({'theta': 0.9}, r'^theta = 0\.9: must be a number in \[1, 10\]$'),
    ({'theta': 'two'}, r"^theta = 'two'"),
    ({'theta': True}, r'^theta = True'),
    ({'d0': -1.0}, r'^d0 = -1\.0: must be a number in \[0, 10000\] m\^2$'),
    ({'d0': 2.25},
     r'^d1 = 2\.25: must be a number in \[d0 \+ 0\.001, 10000\] m\^2, where d0 = 2\.25$'),
    ({'d1': 0.5}, r'^d1 = 0\.5: must be a number in \[d0'),
    ({'d1': 2e4}, r'^d1 = 20000\.0: must be a number in \[0\.001, 10000\] m\^2$'),
])
def test_bad_parameters_are_named_with_value_and_range(change: dict[str, Any],
                                                       message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FlockingParams(**change)


@pytest.mark.parametrize(('positions', 'velocities', 'message'), [
    ([0.0, 1.0], [0.0, 1.0], r'positions has shape \(2,\): must be \(k, 2\) or \(k, 3\)'),
    (np.zeros((2, 4)), np.zeros((2, 4)), r'positions has shape \(2, 4\)'),
    (np.zeros((2, 3)), np.zeros((3, 3)), r'positions .*\(2, 3\).* velocities \(3, 3\)'),
    ([[0.0, np.nan]], [[0.0, 0.0]], r'positions = \[\[0\.0, nan\]\]: every value'),
    ([[0.0, 0.0]], [[np.inf, 0.0]], r'velocities = \[\[inf, 0\.0\]\]: every value'),
])
def test_bad_states_are_refused_with_what_to_change(positions: Any, velocities: Any,
                                                    message: str) -> None:
    for function in (accelerations, lyapunov):
        with pytest.raises(ValueError, match=message):
            function(positions, velocities, PAPER_PARAMS)
    with pytest.raises(ValueError, match=f'relative_{message}'.replace(' velocities ', ' .*')):
        acceleration(positions, velocities, PAPER_PARAMS)
