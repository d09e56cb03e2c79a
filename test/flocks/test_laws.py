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

"""The law on a neighbor graph: what it shares with the paper's law, and what it promises."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_desk.flocks import laws
from flock_desk.flocks.agents import simulate_graph
from flock_desk.flocks.paper import FLIGHT_PARAMS, LEADERLESS_START, PAPER_PARAMS, random_start
from flock_follower import flocking
from flock_follower.flock.neighbor_graph import graph_law
from flock_follower.geometry import Array
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix

ALL = np.array([(0, 1), (0, 2), (1, 2)])
NONE = np.empty((0, 2), dtype=np.int64)
FLOCKS = st.builds(random_start, st.integers(2, 12), st.sampled_from([2, 3]),
                   st.just(FLIGHT_PARAMS), st.integers(0, 1000))


def on_graph(x: Array, v: Array) -> Array:
    """Return the accelerations with an edge between any two within the band."""
    pairs = laws.pairs_within(x, np.sqrt(FLIGHT_PARAMS.d1))
    return laws.graph_accelerations(x, v, FLIGHT_PARAMS, pairs, pairs)


def two(r2: float) -> Array:
    return np.array([[0.0, 0.0], [np.sqrt(r2), 0.0]])


def test_the_complete_graph_is_the_papers_law() -> None:
    u = laws.graph_accelerations(*LEADERLESS_START, PAPER_PARAMS, ALL, ALL)
    assert u == pytest.approx(flocking.accelerations(*LEADERLESS_START, PAPER_PARAMS), rel=1e-12)


@pytest.mark.parametrize(('r2', 'push'), [
    (2.9, 0.3 * np.sqrt(2.0) * np.sqrt(2.9) / 1.9 ** 2),  # whole up to d0 + 0.28 (d1 - d0)
    (8.0, 0.0)])
def test_agents_without_edge_only_separate_within_band(r2: float,
                                                       push: float) -> None:
    v = np.array([[0.0, 0.3], [0.0, -0.3]])
    u = laws.graph_accelerations(two(r2), v, FLIGHT_PARAMS, NONE, ALL[:1])
    assert u == pytest.approx(np.array([[-push, 0.0], [push, 0.0]]))


@pytest.mark.parametrize(('edges', 'r2', 'count'), [
    (NONE, 6.61, 0), (NONE, 6.59, 1), (ALL[:1], 6.59, 0)])  # d0 + 0.8 (d1 - d0) = 6.6
def test_an_edge_begins_once_below_four_fifths_of_the_band(edges: Any, r2: float,
                                                           count: int) -> None:
    assert len(laws.new_edges(edges, two(r2), FLIGHT_PARAMS, ALL[:1])) == count


@given(FLOCKS, st.tuples(*[st.floats(-100.0, 100.0)] * 3))
def test_the_graph_law_sums_to_zero_and_turns_with_the_axes(
        start: Any, vector: tuple[float, float, float]) -> None:
    x, v = start
    n = x.shape[1]
    turn = rotation_vector_to_matrix(vector if n == 3 else [0.0, 0.0, vector[2]])[:n, :n]
    u = on_graph(x, v)
    assert np.linalg.norm(u.sum(axis=0)) <= 1e-12 * (1.0 + np.sum(np.abs(u)))
    moved = on_graph(x @ turn.T + vector[:n], v @ turn.T - vector[:n])
    assert moved == pytest.approx(u @ turn.T, rel=1e-8, abs=1e-8 * (1.0 + np.abs(u).max()))


@pytest.mark.slow
@pytest.mark.parametrize(('agents', 'dimension', 'params', 'seed', 'duration'), [
    (10, 2, PAPER_PARAMS, 10, 4.0), (30, 3, FLIGHT_PARAMS, 30, 4.0),
    (50, 3, PAPER_PARAMS, 3, 0.5)])  # the last diverges within 0.4 s if no step is halved
def test_random_flocks_stay_apart_and_keep_every_edge(agents: int, dimension: int, params: Any,
                                                      seed: int, duration: float) -> None:
    start = random_start(agents, dimension, params, seed)
    run = simulate_graph(*start, params, duration=duration)
    assert run.metrics.min_r2.min() > params.d0
    assert run.metrics.max_r2.max() < params.d1  # of the edges, so that none is lost
    assert np.abs(run.velocities.mean(axis=1) - start.velocities.mean(axis=0)).max() < 1e-12
    assert run.graph is not None
    first = laws.pairs_within(start.positions, np.sqrt(params.d1))
    assert np.array_equal(run.graph.edges[run.graph.joined == 0.0], first)
    assert len(np.unique(run.graph.edges, axis=0)) == len(run.graph.edges)


@pytest.mark.parametrize(('r2', 'joined', 'small'), [
    (1.6, True, True), (1.4, True, False), (7.4, True, True), (7.6, True, False),
    (1.6, False, True), (1.4, False, False), (9.0, False, True)])
def test_step_is_small_up_to_half_way_to_band_edge(r2: float, joined: bool,
                                                   small: bool) -> None:
    before = two(2.0 if r2 < 4.0 else 7.0)  # gaps of 1 m^2
    assert laws.step_is_small(before, two(r2), FLIGHT_PARAMS, ALL[:1] if joined else NONE,
                              ALL[:1]) is small


def test_agent_that_knows_all_commands_itself_the_flock_law() -> None:
    rng, params = np.random.default_rng(0), flocking.FlockingParams(beta=0.25, d1=8.0)
    places = np.array([[1.9 * (k % 3), 1.9 * (k // 3), 0.0] for k in range(7)])
    x, v = places + rng.uniform(-0.2, 0.2, (7, 3)), rng.normal(0.0, 0.3, (7, 3))
    edges, near = laws.pairs_within(x, 2.0), laws.pairs_within(x, np.sqrt(8.0))
    assert 0 < len(edges) < len(near)
    whole = laws.graph_accelerations(x, v, params, edges, near)
    for k in range(len(x)):
        others = np.flatnonzero(np.arange(len(x)) != k)
        share = np.array([[min(k, j), max(k, j)] in edges.tolist() for j in others], dtype=float)
        own = graph_law(x[others] - x[k], v[others] - v[k], share, np.zeros(6, dtype=bool),
                        params, 1e9)
        assert own == pytest.approx(whole[k], rel=1e-9)


def test_edge_longer_than_band_pulls_within_its_limit() -> None:
    params = flocking.FlockingParams(beta=0.25, d1=8.0)
    offsets, differences = np.array([[6.0, 0.0, 0.0]]), np.array([[0.0, 0.2, 0.0]])
    nobody = np.zeros(1, dtype=bool)
    pulled = graph_law(offsets, differences, np.ones(1), nobody, params, 2.5)
    assert pulled[0] == pytest.approx(2.5)
    pushed = graph_law(offsets / 6.0, differences, np.ones(1), nobody, params, 2.5)
    assert pushed[0] < -1e3  # separation is not bounded here


def test_vehicle_outside_flock_changes_nothing_outside_band() -> None:
    params = flocking.FlockingParams(beta=0.25, d1=8.0)
    offsets = np.array([[2.2, 0.0, 0.0], [0.0, 3.0, 0.0]])
    differences = np.array([[0.0, 0.1, 0.0], [9.0, 0.0, 0.0]])
    share, others = np.array([1.0, 0.0]), np.array([False, True])
    alone, both = (graph_law(offsets[:n], differences[:n], share[:n], others[:n], params, 2.5)
                   for n in (1, 2))
    assert both == pytest.approx(alone)
