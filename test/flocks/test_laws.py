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

"""The law on a neighbour graph: what it shares with the paper's law, and what it promises."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from flock_desk.flocks import laws
from flock_desk.flocks.agents import simulate
from flock_desk.flocks.laws import complete_graph, Graph, grown, initial_graph, nearest
from flock_desk.flocks.paper import (
    FLIGHT_PARAMS,
    LEADER_FOLLOWER,
    LEADERLESS,
    PARAMS,
    random_start,
)
from flock_follower import flocking
from flock_follower.flock import neighbor_graph
from flock_follower.geometry import Array, rotation_vector_to_matrix

COUPLINGS = st.sampled_from(['flock', 'pair'])
FLOCKS = st.builds(random_start, st.integers(2, 12), st.sampled_from([2, 3]),
                   st.just(FLIGHT_PARAMS), st.integers(0, 1000))


def edges(*pairs: tuple[int, int]) -> Any:
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def test_the_complete_graph_is_the_papers_law() -> None:
    x, v = LEADERLESS.positions, LEADERLESS.velocities
    u = laws.graph_accelerations(x, v, PARAMS, complete_graph(3))
    assert u == pytest.approx(flocking.accelerations(x, v, PARAMS), rel=1e-12)


@pytest.mark.parametrize('model', ['flocking', 'cucker_dong', 'cucker_smale'])
def test_blocks_give_the_sums_of_the_plain_law(model: Any) -> None:
    rng = np.random.default_rng(0)
    x, v = 30.0 * rng.random((600, 2)), rng.normal(size=(600, 2))  # three blocks
    for params in (FLIGHT_PARAMS, flocking.FlockingParams(beta=0.0, theta=1.5, d0=0.0)):
        np.testing.assert_array_equal(laws.accelerations(x, v, params, model, 'blocked'),
                                      flocking.accelerations(x, v, params, model))


def test_the_nearest_are_found_without_oneself() -> None:
    x = np.random.default_rng(2).random((40, 3))
    distances = np.linalg.norm(x - x[:, None], axis=2) + np.diag(np.full(40, np.inf))
    np.testing.assert_array_equal(np.sort(nearest(x, 7)), np.sort(np.argsort(distances)[:, :7]))
    assert nearest(x[:3], 7).shape == (3, 2) and nearest(x[:1], 7).shape == (1, 0)


def test_for_two_agents_each_pairs_own_disagreement_is_the_papers() -> None:
    x, v = LEADER_FOLLOWER.positions, LEADER_FOLLOWER.velocities
    u = laws.graph_accelerations(x, v, PARAMS, complete_graph(2), 'pair')
    assert u == pytest.approx(flocking.accelerations(x, v, PARAMS), rel=1e-12)


def test_agents_without_an_edge_only_separate_and_not_beyond_the_band() -> None:
    v = np.array([[0.0, 0.3], [0.0, -0.3]])
    nobody = Graph(2, edges())

    def of_first(distance: float) -> Array:
        x = np.array([[0.0, 0.0], [distance, 0.0]])
        u = laws.graph_accelerations(x, v, FLIGHT_PARAMS, nobody)
        assert u[1] == pytest.approx(-u[0])
        return u[0]

    # d0 + 0.28 (d1 - d0) = 2.96: up to there f0 is whole.
    near = of_first(np.sqrt(2.9))
    assert near == pytest.approx([-0.3 * np.sqrt(2.0) * np.sqrt(2.9) / 1.9 ** 2, 0.0])
    assert -0.01 < of_first(np.sqrt(7.5))[0] < 0.0
    assert of_first(np.sqrt(8.0)) == pytest.approx([0.0, 0.0])


def test_edges_begin_at_once_below_d1_and_later_below_four_fifths_of_the_band() -> None:
    def at(r2: float) -> Array:
        return np.array([[0.0, 0.0], [np.sqrt(r2), 0.0]])

    assert len(initial_graph(at(7.99), FLIGHT_PARAMS).edges) == 1
    alone, pair = initial_graph(at(8.01), FLIGHT_PARAMS), edges((0, 1))
    assert len(alone.edges) == 0
    assert grown(alone, at(6.61), FLIGHT_PARAMS, pair) is alone  # d0 + 0.8 (d1 - d0) = 6.6
    joined = grown(alone, at(6.59), FLIGHT_PARAMS, pair)
    assert joined.edges.tolist() == [[0, 1]]
    assert grown(joined, at(7.9), FLIGHT_PARAMS, pair) is joined  # never dropped, nor joined twice


@pytest.mark.parametrize(('count', 'pairs', 'connected'), [
    (1, [], True), (2, [], False), (2, [(0, 1)], True),
    (6, [(4, 5), (0, 3), (3, 4), (1, 5), (1, 2)], True),
    (6, [(4, 5), (0, 3), (3, 4), (1, 2)], False), (3, [(1, 2)], False)])
def test_a_graph_knows_whether_it_is_connected(count: int, pairs: list[tuple[int, int]],
                                               connected: bool) -> None:
    assert Graph(count, edges(*pairs)).connected is connected


@given(FLOCKS, COUPLINGS)
def test_accelerations_on_a_graph_sum_to_zero(start: Any, coupling: Any) -> None:
    x, v = start.positions, start.velocities
    u = laws.graph_accelerations(x, v, FLIGHT_PARAMS, initial_graph(x, FLIGHT_PARAMS), coupling)
    assert np.linalg.norm(u.sum(axis=0)) <= 1e-12 * (1.0 + np.sum(np.abs(u)))


@given(FLOCKS, COUPLINGS, st.tuples(*[st.floats(-100.0, 100.0)] * 3))
def test_the_graph_law_moves_and_turns_with_the_axes(start: Any, coupling: Any,
                                                     vector: tuple[float, float, float]) -> None:
    x, v = start.positions, start.velocities
    n = x.shape[1]
    turn = rotation_vector_to_matrix(vector if n == 3 else [0.0, 0.0, vector[2]])[:n, :n]
    graph = initial_graph(x, FLIGHT_PARAMS)
    u = laws.graph_accelerations(x, v, FLIGHT_PARAMS, graph, coupling)
    moved = laws.graph_accelerations(x @ turn.T + vector[:n], v @ turn.T - vector[:n],
                                      FLIGHT_PARAMS, graph, coupling)
    assert moved == pytest.approx(u @ turn.T, rel=1e-8, abs=1e-8 * (1.0 + np.abs(u).max()))


@given(arrays(float, (3, 2), elements=st.floats(-0.08, 0.08)),
       arrays(float, (3, 2), elements=st.floats(-1.0, 1.0)))
def test_among_few_near_agents_the_nearest_are_the_law(noise: Array, v: Array) -> None:
    x = LEADERLESS.positions + noise  # so near that psi is still 1
    u = laws.nearest_accelerations(x, v, FLIGHT_PARAMS, nearest(x, 7))
    assert u == pytest.approx(flocking.accelerations(x, v, FLIGHT_PARAMS), rel=1e-9, abs=1e-9)


def test_the_nearest_are_attended_to_without_return() -> None:
    x = np.array([[0.0, 0.0], [1.3, 0.0], [2.9, 0.0]])
    v = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    u = laws.nearest_accelerations(x, v, FLIGHT_PARAMS, nearest(x, 1))
    assert nearest(x, 1).tolist() == [[1], [0], [1]]
    assert u[1, 1] == 0.0 > u[2, 1]  # the last heeds the middle one, who does not see it


@pytest.mark.slow
@pytest.mark.parametrize(('agents', 'dimension', 'params', 'coupling'), [
    (10, 2, PARAMS, 'flock'), (10, 3, FLIGHT_PARAMS, 'pair'), (30, 3, FLIGHT_PARAMS, 'flock')])
def test_random_flocks_stay_apart_and_connected(agents: int, dimension: int, params: Any,
                                                coupling: Any) -> None:
    start = random_start(agents, dimension, params, seed=agents)
    run = simulate(start.positions, start.velocities, params, duration=4.0, neighbors='graph',
                   coupling=coupling, integrator='semi_implicit', dt=0.005)
    assert run.metrics.min_r2.min() > params.d0
    assert run.metrics.max_r2.max() < params.d1  # of the edges, so that none is lost
    assert run.graph is not None and run.graph.connected
    assert run.metrics.disagreement[-1] < 0.7 * run.metrics.disagreement[0]
    drift = run.velocities.mean(axis=1) - start.velocities.mean(axis=0)
    assert np.abs(drift).max() < 1e-12


def test_steps_are_halved_where_a_whole_one_would_cross_a_singularity() -> None:
    # With whole steps of 5 ms this start diverges within 0.4 s.
    start = random_start(50, 3, PARAMS, seed=3)
    run = simulate(start.positions, start.velocities, duration=0.5, neighbors='graph',
                   integrator='semi_implicit', dt=0.005)
    assert PARAMS.d0 < run.metrics.min_r2.min() and run.metrics.max_r2.max() < PARAMS.d1


@pytest.mark.parametrize(('r2', 'joined', 'small'), [
    (1.6, True, True), (1.4, True, False), (7.4, True, True), (7.6, True, False),
    (1.6, False, True), (1.4, False, False), (9.0, False, True)])
def test_a_step_is_small_up_to_half_the_way_to_an_edge_of_the_band(r2: float, joined: bool,
                                                                   small: bool) -> None:
    def at(value: float) -> Array:
        return np.array([[0.0, 0.0], [np.sqrt(value), 0.0]])

    graph = complete_graph(2) if joined else Graph(2, edges())
    before = at(2.0 if r2 < 4.0 else 7.0)  # gaps of 1 m^2
    assert laws.step_is_small(before, at(r2), FLIGHT_PARAMS, graph,
                              laws.pairs_within(before, np.sqrt(8.0))) is small


def test_edges_that_join_on_the_way_are_recorded_with_their_time() -> None:
    start = random_start(20, 2, FLIGHT_PARAMS, seed=1)
    run = simulate(start.positions, start.velocities, FLIGHT_PARAMS, duration=3.0,
                   neighbors='graph', integrator='semi_implicit', dt=0.01)
    assert run.graph is not None and run.joined is not None
    first = initial_graph(start.positions, FLIGHT_PARAMS)
    assert np.array_equal(run.graph.edges[run.joined == 0.0], first.edges)
    assert np.any(run.joined > 0.0) and run.joined.max() <= 3.0
    assert len(np.unique(run.graph.edges, axis=0)) == len(run.graph.edges)


@pytest.mark.parametrize(('call', 'message'), [
    (lambda x: laws.graph_accelerations(x, x, PARAMS, complete_graph(4)),
     r'^positions has 3 agents: the graph has 4$'),
    (lambda x: laws.graph_accelerations(x, x, PARAMS, complete_graph(3), 'all'),
     r"^coupling = 'all': must be one of flock, pair$"),
    (lambda x: laws.graph_accelerations(x * np.nan, x, PARAMS, complete_graph(3)),
     r'^positions = .* finite'),
    (lambda x: laws.nearest_accelerations(x, x[:2], PARAMS, nearest(x, 2)),
     r'positions has shape \(3, 2\) and velocities \(2, 2\)'),
])
def test_bad_input_is_refused_with_what_to_change(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(LEADERLESS.positions)


def drawn_flock(seed: int, count: int = 7) -> tuple[Array, Array]:
    """Return positions and velocities of a flock in the band of the flights, edges being short."""
    rng = np.random.default_rng(seed)
    places = np.array([[1.9 * (k % 3), 1.9 * (k // 3), 0.0] for k in range(count)])
    return places + rng.uniform(-0.2, 0.2, (count, 3)), rng.normal(0.0, 0.3, (count, 3))


@pytest.mark.parametrize('seed', range(2))
def test_one_agent_that_knows_all_commands_itself_what_the_law_of_the_flock_does(
        seed: int) -> None:
    params = flocking.FlockingParams(beta=0.25, d1=8.0)
    x, v = drawn_flock(seed)
    graph = initial_graph(0.9 * x, flocking.FlockingParams(beta=0.25, d0=0.5, d1=3.5))
    assert 0 < len(graph.edges) < 21
    whole = laws.graph_accelerations(x, v, params, graph)
    for k in range(len(x)):
        others = np.arange(len(x)) != k
        share = np.array([graph.joins(np.array([[min(k, j), max(k, j)]]))[0]
                          for j in np.flatnonzero(others)], dtype=float)
        own = neighbor_graph.graph_law(x[others] - x[k], v[others] - v[k], share,
                                   np.zeros(len(share), dtype=bool), params, 1e9)
        assert own == pytest.approx(whole[k], rel=1e-9)


def test_an_edge_longer_than_the_band_pulls_no_harder_than_it_may() -> None:
    params = flocking.FlockingParams(beta=0.25, d1=8.0)
    offsets, differences = np.array([[6.0, 0.0, 0.0]]), np.array([[0.0, 0.2, 0.0]])
    nobody = np.zeros(1, dtype=bool)
    pulled = neighbor_graph.graph_law(offsets, differences, np.ones(1), nobody, params, 2.5)
    assert pulled[0] == pytest.approx(2.5)
    pushed = neighbor_graph.graph_law(offsets / 6.0, differences, np.ones(1), nobody, params, 2.5)
    assert pushed[0] < -1e3  # what keeps apart is not bounded here


def test_one_that_is_no_part_of_the_flock_makes_nobody_else_nervous() -> None:
    """However fast it passes, out of the band it changes nothing."""
    params = flocking.FlockingParams(beta=0.25, d1=8.0)
    offsets = np.array([[2.2, 0.0, 0.0], [0.0, 3.0, 0.0]])
    differences = np.array([[0.0, 0.1, 0.0], [9.0, 0.0, 0.0]])
    share, others = np.array([1.0, 0.0]), np.array([False, True])
    alone = neighbor_graph.graph_law(
        offsets[:1], differences[:1], share[:1], others[:1], params, 2.5)
    both = neighbor_graph.graph_law(offsets, differences, share, others, params, 2.5)
    assert both == pytest.approx(alone)
