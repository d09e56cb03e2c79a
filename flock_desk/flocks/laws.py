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

"""
The accelerations of large flocks: all pairs in blocks, a neighbour graph, the nearest; Vicsek.

``accelerations`` sums over all pairs. ``velocities_after`` is the rule of Vicsek et al. (1995) in
discrete time, without noise, in two readings: in the literal one each agent keeps its own speed
and takes the mean heading of the agents within a radius, itself included. The paper's figure of
three agents, whose speeds become equal, fits only the other: each takes their mean velocity.

The law on a neighbour graph is for flocks larger than one band can hold. With every pair in the
sum, every pair must stay inside (d0, d1): no more than a handful of agents fit, and one pair
outside is drawn to r^2 = d1, where the law is singular. Here

* an edge joins two agents that start with r^2 < d1, or later come as near as
  r^2 < d0 + 0.8 (d1 - d0), and is never dropped: alignment, separation and cohesion act on edges;
* any other two agents only separate, with f0(r^2) psi(r^2), where psi falls as a cosine from 1
  at d0 + 0.28 (d1 - d0) to 0 at d1.

So edges stay inside the band, other pairs beyond d0, and a flock that is connected stays so.
The gap between the two thresholds is what lets an edge begin with finite forces. The complete
graph is the law of :mod:`flock_follower.flocking`.

Pairs are arrays (m, 2) of agents i < j.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flock_follower.flock.neighbor_graph import fade, pair_disagreement
from flock_follower.flocking import (
    alignment,
    checked,
    cohesion,
    disagreement,
    FlockingParams,
    Model,
    separation,
    sum_over_neighbors,
)
from flock_follower.geometry import Array

Pairs = NDArray[np.int64]
Coupling = Literal['flock', 'pair']
Method = Literal['auto', 'whole', 'blocked']
_JOIN = 0.8  # share of the band, from d0
_ROWS = 2048  # agents at a time, so that their arrays stay in cache
_ENTRIES = 2 ** 17  # of a block, whose few arrays of 1 MB stay in cache
_FEW = 128  # agents up to which whole matrices are the fastest


def check_choice(name: str, value: str, known: Any) -> None:
    """
    Check that a value is one of a ``Literal`` type.

    :raises ValueError: naming the parameter, its value and the valid ones.
    """
    if value not in get_args(known):
        raise ValueError(f'{name} = {value!r}: must be one of {", ".join(get_args(known))}')


def accelerations(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams,
                  model: Model = 'flocking', method: Method = 'auto') -> Array:
    """
    Return the acceleration (k, n), m/s^2, of every agent, each seeing all others.

    :param positions: (k, n), n = 2 or 3, m.
    :param velocities: (k, n), m/s, in the same frame.
    :param method: 'whole' (k, k) matrices; 'blocked', some rows of them at a time, in O(k) memory;
        'auto', the first of them for a few agents.
    :raises ValueError: for another method or model, other shapes, or values not finite.
    """
    x, v = checked(positions, velocities)
    check_choice('method', method, Method)
    whole = method == 'whole' or (method == 'auto' and len(x) <= _FEW)
    count = len(x) if whole else max(1, _ENTRIES // len(x))
    scale, u = disagreement(v), np.empty_like(x)
    for first in range(0, len(x), count):
        rows = slice(first, first + count)
        u[rows] = sum_over_neighbors(x - x[rows, None], v - v[rows, None], scale, params, model)
    return u


def velocities_after(positions: Array, velocities: Array, radius: float = 1.0,
                     mean_velocity: bool = False) -> Array:
    """
    Return the velocities (k, n), m/s, that the agents take next.

    :param positions: (k, n), m, now.
    :param velocities: (k, n), m/s, now.
    :param radius: how far an agent sees, m.
    :param mean_velocity: take the mean velocity, not the mean heading at the agent's own speed.
    """
    speed = np.linalg.norm(velocities, axis=1, keepdims=True)
    seen = velocities if mean_velocity else velocities / np.where(speed > 0.0, speed, 1.0)
    i, j = pairs_within(positions, radius).T
    k = len(positions)
    total, count = seen.copy(), 1 + np.bincount(i, minlength=k) + np.bincount(j, minlength=k)
    for axis in range(positions.shape[1]):
        total[:, axis] += np.bincount(i, seen[j, axis], k) + np.bincount(j, seen[i, axis], k)
    if mean_velocity:
        return total / count[:, None]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    heading = np.where(length > 1e-12, total / np.where(length > 0.0, length, 1.0), seen)
    return speed * heading


@dataclass(frozen=True)
class Graph:
    """``count`` agents and the edges (m, 2) between them, i < j."""

    count: int
    edges: Pairs

    def joins(self, pairs: Pairs) -> NDArray[np.bool_]:
        """Return (m,) which of the pairs are edges."""
        own, others = (each[:, 0] * self.count + each[:, 1] for each in (self.edges, pairs))
        return np.isin(others, own)

    @cached_property
    def connected(self) -> bool:
        """Whether a path of edges leads from every agent to every other."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components
        joined = coo_array((np.ones(len(self.edges)), self.edges.T), (self.count, self.count))
        return bool(connected_components(joined, directed=False, return_labels=False) == 1)


def complete_graph(count: int) -> Graph:
    """Return the graph that joins every two agents: the law as the paper has it."""
    return Graph(count, np.stack(np.triu_indices(count, k=1), axis=1))


def initial_graph(positions: Array, params: FlockingParams) -> Graph:
    """Return the graph that joins agents at (k, n), m, wherever r^2 < d1."""
    return Graph(len(positions), pairs_within(positions, np.sqrt(params.d1)))


def grown(graph: Graph, positions: Array, params: FlockingParams, near: Pairs) -> Graph:
    """
    Return the graph with an edge more for every two agents that have come near enough.

    :param near: all pairs with r^2 < d1 at least.
    """
    joining = params.d0 + _JOIN * (params.d1 - params.d0)
    pairs = near[squared_distances(positions, near) < joining]
    new = pairs[~graph.joins(pairs)]
    return Graph(graph.count, np.concatenate([graph.edges, new])) if len(new) else graph


def graph_accelerations(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams,
                              graph: Graph, coupling: Coupling = 'flock',
                        near: Pairs | None = None) -> Array:
    """
    Return the acceleration (k, n), m/s^2, of every agent; they sum to zero.

    :param positions: (k, n), n = 2 or 3, m.
    :param velocities: (k, n), m/s, in the same frame.
    :param coupling: 'flock' scales separation and cohesion with the L of the whole flock, as the
        paper does; 'pair' with each pair's own |v_i - v_j| / sqrt(2), which two agents can know
        by themselves. Both are equal for two agents; for more, nothing is proven of 'pair'.
    :param near: all pairs with r^2 < d1 at least, if known; found here otherwise.
    :raises ValueError: for another coupling, another number of agents than the graph's, other
        shapes, or values not finite or beyond 1e100.
    """
    x, v = _checked(positions, velocities, graph.count, coupling)
    near = pairs_within(x, np.sqrt(params.d1)) if near is None else near
    whole = disagreement(v)
    x, v = np.ascontiguousarray(x.T), np.ascontiguousarray(v.T)  # columns: faster for many pairs
    u = np.zeros_like(x)
    # Any pair separates with f0 psi, and an edge with f0 (1 - psi) more: no search for edges.
    for pairs, joined in ((graph.edges, True), (near, False)):
        i, j = np.ascontiguousarray(pairs.T)
        offset, difference = x.take(j, 1) - x.take(i, 1), v.take(j, 1) - v.take(i, 1)
        r2 = np.einsum('ij,ij->j', offset, offset)
        scale = whole if coupling == 'flock' else pair_disagreement(difference.T)[:, 0]
        if joined:
            pull = cohesion(r2, params) - separation(r2, params) * (1.0 - fade(r2, params))
            action = alignment(r2, params) * difference + scale * pull * offset
        else:
            action = -scale * separation(r2, params) * fade(r2, params) * offset
        for each, component in zip(u, action):  # equal and opposite on i and j
            each += np.bincount(i, component, len(each)) - np.bincount(j, component, len(each))
    return u.T


def step_is_small(before: Array, after: Array, params: FlockingParams, graph: Graph,
                  near: Pairs) -> bool:
    """
    Return whether no pair comes more than halfway from where it is to a singularity of the law.

    :param before: positions (k, n), m.
    :param after: those a step later.
    :param near: all pairs with r^2 < d1 at least, of the positions before.
    """
    old, new = squared_distances(before, near), squared_distances(after, near)
    if np.any(new - params.d0 < 0.5 * np.minimum(old - params.d0, params.d1 - params.d0)):
        return False
    old, new = squared_distances(before, graph.edges), squared_distances(after, graph.edges)
    return not np.any(params.d1 - new < 0.5 * (params.d1 - old))


def nearest_accelerations(positions: ArrayLike, velocities: ArrayLike, params: FlockingParams,
                          neighbors: NDArray[np.int64], coupling: Coupling = 'flock') -> Array:
    """
    Return the acceleration (k, n), m/s^2, of agents that each follow some others, as birds do.

    The law over those only, its cohesion f1 psi: bounded, because neighbours come and go. This
    loses what the law is for: attending is not mutual, so the mean velocity drifts; nothing
    bounds the distance, so that the flock may fall apart; and two agents that each attend to
    nearer ones do not avoid each other. Of 72 random starts of 10 to 50 agents 47 stayed apart
    and together for 20 s, most of the others in the narrow band, where the graph kept all 72.

    :param neighbors: (k, m), the neighbours of each agent, such as the seven nearest.
    :param coupling: as in :func:`graph_accelerations`.
    :raises ValueError: as :func:`graph_accelerations`.
    """
    x, v = _checked(positions, velocities, len(neighbors), coupling)
    whole = disagreement(v)
    u = np.empty_like(x)
    for first in range(0, len(x), _ROWS):
        rows = slice(first, first + _ROWS)
        offset = x[neighbors[rows]] - x[rows, None]
        difference = v[neighbors[rows]] - v[rows, None]
        r2 = np.sum(offset ** 2, axis=-1, keepdims=True)
        pull = cohesion(r2, params) * fade(r2, params) - separation(r2, params)
        scale = whole if coupling == 'flock' else pair_disagreement(difference)
        u[rows] = np.sum(alignment(r2, params) * difference + scale * pull * offset, axis=1)
    return u


def squared_distances(positions: Array, pairs: Pairs) -> Array:
    """Return r^2 (m,), m^2, of the pairs (m, 2) among the positions (k, n)."""
    ends = positions.take(pairs, 0)
    offset = ends[:, 1] - ends[:, 0]
    squares: Array = np.einsum('ij,ij->i', offset, offset)
    return squares


def _checked(positions: ArrayLike, velocities: ArrayLike, count: int,
             coupling: Coupling) -> tuple[Array, Array]:
    x, v = checked(positions, velocities)
    if len(x) != count:
        raise ValueError(f'positions has {len(x)} agents: the graph has {count}')
    check_choice('coupling', coupling, Coupling)
    return x, v


def pairs_within(positions: Array, distance: float) -> Pairs:
    """Return all pairs (m, 2), i < j, of the positions (k, n) nearer than a distance, m."""
    from scipy.spatial import cKDTree
    return cKDTree(positions).query_pairs(distance, output_type='ndarray')


def nearest(positions: Array, count: int) -> Pairs:
    """Return for each position (k, n) the others nearest to it (k, min(count, k - 1))."""
    from scipy.spatial import cKDTree
    k = len(positions)
    count = min(count, k - 1)
    tree, found = cKDTree(positions), np.empty((k, count + 1), dtype=np.int64)
    order = tree.indices  # leaf by leaf: what one query has read serves the next
    # One more than asked for, because each finds itself; among coincident ones not first.
    found[order] = tree.query(positions[order], count + 1)[1].reshape(k, count + 1)
    others = found != np.arange(k)[:, None]
    others[others.all(axis=1), -1] = False
    return found[others].reshape(k, count)
