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
The law on a neighbor graph, for flocks larger than one band can hold.

If every pair is in the sum, every pair must stay inside (d0, d1): only a handful of agents fit,
and a pair outside is drawn to r^2 = d1, where the law is singular. Therefore

* an edge joins two agents that start with r^2 < d1, or later come as near as
  r^2 < d0 + 0.8 (d1 - d0), and is never dropped: alignment, separation and cohesion act on edges;
* any other two agents only separate, with f0(r^2) psi(r^2), where psi falls as a cosine from 1
  at d0 + 0.28 (d1 - d0) to 0 at d1.

So edges stay inside the band, other pairs beyond d0, and a flock that is connected stays so.
The gap between the two thresholds lets an edge begin with finite forces. On the complete
graph this is the law of :mod:`flock_follower.flocking`.

Pairs, and edges among them, are arrays (m, 2) of agents i < j.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flock_follower.flock.neighbor_graph import fade
from flock_follower.flocking import alignment, cohesion, disagreement, FlockingParams, separation
from flock_follower.geometry import Array

Pairs = NDArray[np.int64]
_JOIN = 0.8  # share of the band, from d0


def new_edges(edges: Pairs, positions: Array, params: FlockingParams, near: Pairs) -> Pairs:
    """
    Return the pairs that have come near enough for an edge, and have none yet.

    :param positions: (k, n), m; :param near: all pairs with r^2 < d1 at least.
    """
    joining = params.d0 + _JOIN * (params.d1 - params.d0)
    pairs = near[squared_distances(positions, near) < joining]
    known, found = (each[:, 0] * len(positions) + each[:, 1] for each in (edges, pairs))
    return pairs[~np.isin(found, known)]


def graph_accelerations(positions: Array, velocities: Array, params: FlockingParams, edges: Pairs,
                        near: Pairs) -> Array:
    """
    Return the acceleration (k, n), m/s^2, of every agent; they sum to zero.

    :param positions: (k, n), n = 2 or 3, m; :param velocities: (k, n), m/s, in the same frame.
    :param near: all pairs with r^2 < d1 at least.
    """
    scale = disagreement(velocities)
    # Columns: faster for many pairs.
    x, v = np.ascontiguousarray(positions.T), np.ascontiguousarray(velocities.T)
    u = np.zeros_like(x)
    # Any pair separates with f0 psi, and an edge with f0 (1 - psi) more: no search for edges.
    for pairs, joined in ((edges, True), (near, False)):
        i, j = np.ascontiguousarray(pairs.T)
        offset = x.take(j, 1) - x.take(i, 1)
        r2 = np.einsum('ij,ij->j', offset, offset)
        if joined:
            difference = v.take(j, 1) - v.take(i, 1)
            pull = cohesion(r2, params) - separation(r2, params) * (1.0 - fade(r2, params))
            action = alignment(r2, params) * difference + scale * pull * offset
        else:
            action = -scale * separation(r2, params) * fade(r2, params) * offset
        for each, component in zip(u, action):  # equal and opposite on i and j
            each += np.bincount(i, component, len(each)) - np.bincount(j, component, len(each))
    return u.T


def step_is_small(before: Array, after: Array, params: FlockingParams, edges: Pairs,
                  near: Pairs) -> bool:
    """
    Return whether no pair moves more than half of its distance to a singularity of the law.

    :param before: positions (k, n), m; :param after: those a step later.
    :param near: all pairs with r^2 < d1 at least, of the positions before.
    """
    old, new = squared_distances(before, near), squared_distances(after, near)
    if np.any(new - params.d0 < 0.5 * np.minimum(old - params.d0, params.d1 - params.d0)):
        return False
    old, new = squared_distances(before, edges), squared_distances(after, edges)
    return not np.any(params.d1 - new < 0.5 * (params.d1 - old))


def squared_distances(positions: Array, pairs: Pairs) -> Array:
    """Return r^2 (m,), m^2, of the pairs (m, 2) among the positions (k, n)."""
    ends = positions.take(pairs, 0)
    offset = ends[:, 1] - ends[:, 0]
    squares: Array = np.einsum('ij,ij->i', offset, offset)
    return squares


def pairs_within(positions: Array, distance: float) -> Pairs:
    """Return all pairs (m, 2), i < j, of the positions (k, n) nearer than a distance, m."""
    from scipy.spatial import cKDTree
    return cKDTree(positions).query_pairs(distance, output_type='ndarray')
