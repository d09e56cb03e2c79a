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
How fast a large flock is simulated on its neighbor graph: ``python benchmarks/simulation.py``.

One step beside a plain numpy loop, the search for neighbors included in both. Exit code 0 only
if the graph takes no longer.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import sys
import time

import numpy as np
from scipy.spatial import cKDTree

from flock_desk.flocks.laws import graph_accelerations, pairs_within
from flock_desk.flocks.paper import FLIGHT_PARAMS
from flock_follower.geometry import Array

_DENSITY = 0.6  # agents per m^2


def main(args: Sequence[str] | None = None) -> int:
    """Run the benchmark, print it, and return the exit code."""
    parser = argparse.ArgumentParser(description='Measure the simulation of large flocks.')
    parser.add_argument('--agents', type=int, default=10_000, help='%(default)s')
    parser.add_argument('--repeats', type=int, default=9, help='the best counts; %(default)s')
    options = parser.parse_args(args)
    n, rng = options.agents, np.random.default_rng(0)
    x, v = np.sqrt(n / _DENSITY) * rng.random((n, 2)), rng.normal(size=(n, 2))
    # In turns: the load of the machine is the same for both.
    times = [(timed(on_graph, x, v), timed(plain, x, v)) for _ in range(options.repeats)]
    ours, theirs = map(min, zip(*times))
    print(f'one step of {n} agents in 2-D: neighbor graph {1e3 * ours:.1f} ms, '
          f'plain numpy loop {1e3 * theirs:.1f} ms')
    return 0 if ours <= theirs else 1


def on_graph(x: Array, v: Array) -> Array:
    """Return the law with an edge between any two within the band."""
    pairs = pairs_within(x, np.sqrt(FLIGHT_PARAMS.d1))
    return graph_accelerations(x, v, FLIGHT_PARAMS, pairs, pairs)


def plain(x: Array, v: Array) -> Array:
    """Return the law over all pairs within the band, in its first, simplest form."""
    p = FLIGHT_PARAMS
    i, j = cKDTree(x).query_pairs(np.sqrt(p.d1), output_type='ndarray').T
    offset, difference = x[j] - x[i], v[j] - v[i]
    r2 = np.sum(offset**2, axis=1, keepdims=True)
    scale = np.linalg.norm(v - v.mean(axis=0))
    pull = 1.0 / np.maximum(p.d1 - r2, 1e-6)**2 - 1.0 / np.maximum(r2 - p.d0, 1e-6)**2
    action = p.K / (p.sigma**2 + r2)**p.beta * difference + scale * pull * offset
    u = np.zeros_like(x)
    np.add.at(u, i, action)
    np.subtract.at(u, j, action)
    return u


def timed(action: Callable[[Array, Array], object], x: Array, v: Array) -> float:
    """Return the time that an action takes, s."""
    start = time.perf_counter()
    action(x, v)
    return time.perf_counter() - start


if __name__ == '__main__':
    sys.exit(main())
