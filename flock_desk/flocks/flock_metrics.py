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

import numpy as np

from flock_desk.flocks.laws import Graph
from flock_follower.flocking import FlockingParams, lyapunov
from flock_follower.geometry import Array


@dataclass(frozen=True)
class Metrics:
    """
    One value for each of m times.

    On a neighbour graph ``max_r2`` is over the edges there are at the time, and ``lyapunov``,
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
        """Return from when on L stays below a share of its first value, s; NaN if never."""
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
            graph: Graph | None = None, joined: Array | None = None) -> Metrics:
    """
    Return the metrics of positions, m, and velocities, m/s, both (m, k, n).

    :param graph: the neighbour graph at the end, if any.
    :param joined: when each of its edges joined (edges,), s.
    """
    least, greatest, mean = _distances(positions)
    w: Array
    if graph is not None and joined is not None:
        greatest = np.array([_longest_edge(x, graph, joined <= t)
                             for t, x in zip(time, positions)])
        w = np.full(len(time), np.nan)
    else:
        w = np.where((least > params.d0) & (greatest < params.d1), 0.0, np.inf)
        for n in np.flatnonzero(w == 0.0):
            w[n] = lyapunov(positions[n], velocities[n], params)
    speeds = np.linalg.norm(velocities, axis=2, keepdims=True)
    headings = velocities / np.where(speeds > 0.0, speeds, 1.0)
    deviations = velocities - velocities.mean(axis=1, keepdims=True)
    return Metrics(time, least, greatest, mean, speeds.mean(axis=(1, 2)),
                   np.linalg.norm(deviations, axis=(1, 2)),
                   np.linalg.norm(headings.mean(axis=1), axis=1), w)


def _distances(positions: Array) -> tuple[Array, Array, Array]:
    """Return the least and greatest r^2 and the mean distance (m,)."""
    from scipy.spatial.distance import pdist
    figures = []
    for x in positions:
        r2 = pdist(x, 'sqeuclidean')
        figures.append((r2.min(initial=np.inf), r2.max(initial=0.0),
                        np.sqrt(r2).sum() / max(1, len(r2))))
    least, greatest, mean = np.array(figures).T
    return least, greatest, mean


def _longest_edge(positions: Array, graph: Graph, present: Array) -> float:
    i, j = graph.edges[present].T
    return float(np.max(np.sum((positions[j] - positions[i]) ** 2, axis=1), initial=0.0))
