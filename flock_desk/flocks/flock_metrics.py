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

"""The figures flocks are judged by: distances, agreement, and the Lyapunov function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flock_desk.flocks.laws import Pairs, squared_distances
from flock_follower.flocking import FlockingParams, lyapunov
from flock_follower.geometry import Array


class Graph(NamedTuple):
    """A neighbor graph at the end of a simulation; its edges only ever join."""

    edges: Pairs
    joined: Array
    """When each edge joined (m,), s; 0: from the start."""


@dataclass(frozen=True)
class Metrics:
    """
    One value for each of m times.

    On a neighbor graph ``max_r2`` is over the edges there are at the time, and ``lyapunov``,
    which is of the law between all pairs, NaN; everything else is over all pairs.
    """

    time: Array
    """s."""
    min_r2: Array
    """Least squared distance, m^2; infinite for one agent."""
    max_r2: Array
    """Greatest squared distance, m^2."""
    mean_distance: Array
    """Average distance, m."""
    speed: Array
    """Mean speed, m/s."""
    disagreement: Array
    """L, the length of the velocities' deviation from their mean, m/s."""
    order: Array
    """Length of the mean heading: 1 if all headings are equal, near 0 if they differ."""
    lyapunov: Array
    """W, infinite if a pair is outside the band."""

    def time_to_agree(self, share: float = 0.01) -> float:
        """Return the time from which L stays below a share of its first value, s; NaN if never."""
        wanted = share * self.disagreement[0]
        above = np.flatnonzero(~(self.disagreement < wanted))  # NaN is no agreement
        if not len(above) or above[-1] == len(self.time) - 1:
            return float('nan')
        last, first = above[-1], above[-1] + 1
        # It falls exponentially: a straight line in its logarithm.
        part = (np.log(self.disagreement[last] / wanted)
                / np.log(self.disagreement[last] / max(self.disagreement[first], 1e-300)))
        return float(self.time[last] + part * (self.time[first] - self.time[last]))


def extremum(time: Array, values: Array, *, least: bool) -> tuple[float, float]:
    """Return time, s, and value of the least or greatest of values (m,), by a parabola."""
    n = int(np.argmin(values) if least else np.argmax(values))
    if not 0 < n < len(values) - 1:
        return (float(time[n]), float(values[n]))
    a, b, c = values[n - 1:n + 2]
    bend = a - 2.0 * b + c
    if bend == 0.0:
        return (float(time[n]), float(b))
    shift = 0.5 * (a - c) / bend  # in steps, within one
    return (float(time[n] + shift * (time[n + 1] - time[n])),
            float(b - 0.25 * (a - c) * shift))


def metrics(time: Array, positions: Array, velocities: Array, params: FlockingParams,
            graph: Graph | None = None) -> Metrics:
    """Return the metrics of positions, m, and velocities, m/s, both (m, k, n)."""
    from scipy.spatial.distance import pdist
    count, w = len(time), np.full(len(time), np.nan)
    least, greatest, mean = np.full(count, np.inf), np.zeros(count), np.zeros(count)
    for n, (t, x) in enumerate(zip(time, positions)):
        r2 = pdist(x, 'sqeuclidean')
        longest = r2 if graph is None else squared_distances(x, graph.edges[graph.joined <= t])
        least[n], greatest[n] = r2.min(initial=np.inf), longest.max(initial=0.0)
        mean[n] = np.sqrt(r2).sum() / max(1, len(r2))
        if graph is None:
            w[n] = lyapunov(x, velocities[n], params)
    speeds = np.linalg.norm(velocities, axis=2, keepdims=True)
    headings = velocities / np.where(speeds > 0.0, speeds, 1.0)
    deviations = velocities - velocities.mean(axis=1, keepdims=True)
    return Metrics(time, least, greatest, mean, speeds.mean(axis=(1, 2)),
                   np.linalg.norm(deviations, axis=(1, 2)),
                   np.linalg.norm(headings.mean(axis=1), axis=1), w)
