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

"""Who is near whom: by a k-d tree where scipy is installed, else by comparing every pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array

try:
    from scipy.spatial import cKDTree as KDTree
except ImportError:  # an optional dependency: slower, not different
    KDTree = None

Indices = NDArray[np.int64]


def pairs_within(positions: Array, distance: float) -> Indices:
    """Return all pairs (m, 2), i < j, of the positions (k, n) nearer than a distance, m."""
    if KDTree is not None:
        return KDTree(positions).query_pairs(distance, output_type='ndarray')
    found: list[Indices] = [np.zeros((0, 2), dtype=np.int64)]
    for row in range(len(positions) - 1):
        r2 = np.sum((positions[row + 1:] - positions[row]) ** 2, axis=1)
        others = row + 1 + np.flatnonzero(r2 < distance ** 2)
        found.append(np.stack([np.full_like(others, row), others], axis=1))
    return np.concatenate(found)


def nearest(positions: Array, count: int) -> Indices:
    """Return for each position (k, n) the others nearest to it (k, min(count, k - 1))."""
    k = len(positions)
    count = min(count, k - 1)
    if KDTree is not None:
        tree = KDTree(positions)
        order = tree.indices  # asked leaf by leaf, what one query has read serves the next
        found = np.empty((k, count + 1), dtype=np.int64)
        # One more than asked for, because each finds itself; among coincident ones not first.
        found[order] = tree.query(positions[order], count + 1)[1].reshape(k, count + 1)
        others = found != np.arange(k)[:, None]
        others[others.all(axis=1), -1] = False
        return found[others].reshape(k, count)
    rows = []
    for i, own in enumerate(positions):
        r2 = np.sum((positions - own) ** 2, axis=1)
        r2[i] = np.inf
        rows.append(np.argsort(r2, kind='stable')[:count])
    return np.array(rows, dtype=np.int64).reshape(k, count)
