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

"""Agents near each other, by a k-d tree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree as KDTree

from flock_follower.geometry import Array

Indices = NDArray[np.int64]


def pairs_within(positions: Array, distance: float) -> Indices:
    """Return all pairs (m, 2), i < j, of the positions (k, n) nearer than a distance, m."""
    return KDTree(positions).query_pairs(distance, output_type='ndarray')


def nearest(positions: Array, count: int) -> Indices:
    """Return for each position (k, n) the others nearest to it (k, min(count, k - 1))."""
    k = len(positions)
    count = min(count, k - 1)
    tree, found = KDTree(positions), np.empty((k, count + 1), dtype=np.int64)
    order = tree.indices  # leaf by leaf: what one query has read serves the next
    # One more than asked for, because each finds itself; among coincident ones not first.
    found[order] = tree.query(positions[order], count + 1)[1].reshape(k, count + 1)
    others = found != np.arange(k)[:, None]
    others[others.all(axis=1), -1] = False
    return found[others].reshape(k, count)
