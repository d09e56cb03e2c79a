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
Neighbor graph of one vehicle: which neighbors share an edge with it, and the law on the edges.

Two vehicles share an edge if no third vehicle is nearer to both than the two are to each other
(relative neighborhood graph: Toussaint, Pattern Recognition 12, 1980). This graph contains the
minimum spanning tree, so it is connected. Both vehicles compute the same edge if they know the
same positions. The graph has few edges, each about as long as the spacing of the flock. An
existing edge is removed only if a third vehicle is nearer to both ends by HELD_FACTOR; the graph
with such additional edges is connected, too.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray

from flock_follower.flocking import alignment, cohesion, disagreement, FlockingParams, separation
from flock_follower.geometry import Array

HELD_FACTOR = 1.15  # factor of distance by which a third vehicle must be nearer to remove an edge
_FADE = 0.28  # share of the band, from d0, up to which vehicles without an edge separate fully


def edges(position: Sequence[float], positions: Sequence[Sequence[float]],
          radii: Sequence[float], own_radius: float, held: Sequence[bool]) -> list[bool]:
    """
    Return which of m neighbors share an edge with this vehicle, (m,).

    All distances are between hulls. Nearly always the nearest of the others decides: in plain
    numbers that takes less time than all pairs in arrays.

    :param position: of this vehicle (3,), m.
    :param positions: of the neighbors (m, 3), m.
    :param radii: sum of the radii of each neighbor and this vehicle (m,), m.
    :param own_radius: of this vehicle, m.
    :param held: (m,) whether a neighbor shared an edge in the step before.
    """
    own = [max(math.dist(there, position) - radius, 0.0)
           for there, radius in zip(positions, radii)]
    nearest_first = sorted(zip(own, positions, radii))
    distances, joined = sorted(own), list[bool]()
    for distance, there, radius, had_edge in zip(own, positions, radii, held):
        reach = distance / (HELD_FACTOR if had_edge else 1.0)
        nearer = nearest_first[:bisect_left(distances, reach)]
        joined.append(all(math.dist(there, other) - (radius + its - 2.0 * own_radius) >= reach
                          for _, other, its in nearer))
    return joined


def graph_law(offsets: Array, differences: Array, share: Array, others: NDArray[np.bool_],
              params: FlockingParams, most: float) -> Array:
    """
    Return the acceleration (n,), m/s^2, of one agent of a flock.

    Along an edge alignment, separation and cohesion act; L is that of this agent and its
    neighbors. A neighbor without an edge causes only separation, f0 psi. The cohesion of one edge,
    which would be infinite from d1 on, is at most ``most``: an edge longer than the band does not
    outweigh all others.

    :param offsets: the neighbors' positions minus the ego position (m, n), m.
    :param differences: their velocities minus the ego velocity (m, n), m/s.
    :param share: (m,) 1 with an edge, 0 without an edge, in between while an edge fades in or out.
    :param others: (m,) whether a neighbor is not in the flock: separation with the L of the pair.
    :param most: largest cohesion with one neighbor, m/s^2.
    """
    r2 = np.einsum('ij,ij->i', offsets, offsets)
    flock = np.concatenate([np.zeros((1, differences.shape[1])), differences[~others]])
    scale: Array | float = disagreement(flock)
    if others.any():
        scale = np.where(others, pair_disagreement(differences), scale)
    apart = scale * separation(r2, params)
    pull = np.minimum(scale * cohesion(r2, params) - apart, most / np.sqrt(np.maximum(r2, 1e-12)))
    push = (1.0 - share) * apart * fade(r2, params)
    return (share * alignment(r2, params)) @ differences + (share * pull - push) @ offsets


def fade(r2: Array, params: FlockingParams) -> Array:
    """Return psi at r2, m^2: 1 up to d0 + 0.28 (d1 - d0), then falling to 0 at d1."""
    begin = params.d0 + _FADE * (params.d1 - params.d0)
    far = np.minimum(np.maximum((r2 - begin) / (params.d1 - begin), 0.0), 1.0)
    return 0.5 + 0.5 * np.cos(math.pi * far)


def pair_disagreement(differences: Array) -> Array:
    """Return L, m/s, of each single pair of agents (m,), from v_j - v_i (m, n)."""
    return np.sqrt(np.einsum('ij,ij->i', differences, differences) / 2.0)
