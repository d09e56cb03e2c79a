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
How fast large flocks are simulated: ``python benchmarks/simulation.py``, all in one run.

All pairs two ways, neighbours by a k-d tree beside a plain numpy loop, and Vicsek's model beside
SiSyPHE if that is installed (``pip install torch sisyphe``). Exit code 0 only if all bounds hold.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import os
import resource
import sys
import time

import numpy as np
from scipy.spatial import cKDTree

from flock_desk.flocks import laws
from flock_desk.flocks.agents import NEAREST
from flock_desk.flocks.laws import accelerations, nearest, pairs_within, velocities_after
from flock_desk.flocks.paper import FLIGHT_PARAMS, PARAMS
from flock_follower.geometry import Array

_DENSITY = 0.6  # agents per m^2
_WHOLE_BYTES = 100  # per pair: what whole matrices take at their peak, and some room
_RADIUS = 1.5  # m, of Vicsek's model


def main(args: Sequence[str] | None = None) -> int:
    """Run the benchmarks, print them, and return the exit code."""
    parser = argparse.ArgumentParser(description='Measure the simulation of large flocks.')
    parser.add_argument('--agents', type=int, default=10_000, help='%(default)s')
    parser.add_argument('--repeats', type=int, default=3, help='the best counts; %(default)s')
    options = parser.parse_args(args)
    n, repeats = options.agents, options.repeats
    print(f'{n} agents in 2-D, {os.cpu_count()} cores, numpy {np.__version__}; '
          f'the best of {repeats}\n')
    bounds = [*neighbors(n, repeats), *all_pairs(n, repeats)]
    beside_sisyphe(n, repeats)
    print()
    for name, holds in bounds:
        print(f'  {name:<60} {"ok" if holds else "FAILED"}')
    return 0 if all(holds for _, holds in bounds) else 1


def all_pairs(n: int, repeats: int) -> list[tuple[str, bool]]:
    """Print the time per pair by blocks and by whole matrices, and the peak memory of each."""
    x, v = flock(n)
    blocked = min(timed(accelerations, x, v, PARAMS, 'flocking', 'blocked')
                  for _ in range(repeats)) / n ** 2
    peak = peak_memory()
    whole, room = n, available_memory()
    while whole ** 2 * _WHOLE_BYTES > room:
        whole //= 2
    if whole < n:
        print(f'whole matrices of {n} agents do not fit in {room / 1e9:.1f} GB: '
              f'measured with {whole}')
    at_once = min(timed(accelerations, *flock(whole), PARAMS, 'flocking', 'whole')
                  for _ in range(min(repeats, 2))) / whole ** 2
    print('all pairs     ns/pair   times as fast as whole   peak memory of the process')
    for name, seconds, memory in (('whole', at_once, peak_memory()), ('blocked', blocked, peak)):
        print(f'  {name:<10} {1e9 * seconds:8.2f}   {at_once / seconds:22.1f}   '
              f'{memory / 1e6:10.0f} MB')
    return [('blocked at least as fast as whole', at_once >= blocked)]


def neighbors(n: int, repeats: int) -> list[tuple[str, bool]]:
    """Print the time of a step with neighbours, at n and 10 n agents of the same density."""
    print('one step with neighbours     agents   ms       us/agent   peak memory of the process')
    seconds: dict[tuple[str, int], float] = {}
    for count in (n, 10 * n):
        for name, step in neighbor_steps(*flock(count)).items():
            s = seconds[name, count] = min(timed(step) for _ in range(3 * repeats))
            print(f'  {name:<24} {count:8d}   {1e3 * s:7.1f}  {1e6 * s / count:8.2f}   '
                  f'{peak_memory() / 1e6:10.0f} MB')
    print()
    ratio = seconds['7 nearest', 10 * n] / seconds['7 nearest', n]
    beside = seconds['neighbour graph', n] / seconds['plain numpy loop', n]
    return [(f'7 nearest of 10 times the agents: {ratio:.1f} times as long, at most 14',
             ratio <= 14.0),
            (f'neighbour graph: {beside:.2f} times as long as plain numpy, at most 1.1',
             beside <= 1.1)]


def neighbor_steps(x: Array, v: Array) -> dict[str, Callable[[], object]]:
    """Return what one step of each model costs, the search for neighbours included."""
    distance = np.sqrt(FLIGHT_PARAMS.d1)
    graph = laws.Graph(len(x), pairs_within(x, distance))
    return {
        '7 nearest': lambda: laws.nearest_accelerations(
            x, v, FLIGHT_PARAMS, nearest(x, NEAREST)),
        'neighbour graph': lambda: laws.graph_accelerations(x, v, FLIGHT_PARAMS, graph),
        'plain numpy loop': lambda: plain(x, v),
        'Vicsek': lambda: velocities_after(x, v, _RADIUS)}


def plain(x: Array, v: Array) -> Array:
    """Return the law over all pairs within the band, as one writes it at first."""
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


def beside_sisyphe(n: int, repeats: int) -> None:
    """Print the time of a step of Vicsek's model here and in SiSyPHE, both on the processor."""
    try:
        from sisyphe.models import Vicsek
        import torch
    except ImportError as error:
        print(f'\nSiSyPHE: not measured, because it is not installed ({error})')
        return
    side = np.sqrt(n / _DENSITY)
    x, v = flock(n)
    unit = v / np.linalg.norm(v, axis=1, keepdims=True)
    torch.set_default_dtype(torch.float64)
    theirs = []
    for sparse in (False, True):
        model = Vicsek(pos=torch.tensor(x), vel=torch.tensor(unit), v=1.0, sigma=0.1, nu=1.0,
                       interaction_radius=_RADIUS, box_size=float(side), dt=0.01,
                       block_sparse_reduction=sparse, number_of_cells=1024)
        next(model)  # the first step compiles
        theirs.append(min(timed(next, model) for _ in range(repeats)))
    ours = min(timed(velocities_after, x, unit, _RADIUS) for _ in range(repeats))
    print(f"\none step of Vicsek's model, {n} agents, radius {_RADIUS} m, float64\n"
          f'  here, k-d tree           {1e3 * ours:8.1f} ms\n'
          f'  SiSyPHE, all pairs       {1e3 * theirs[0]:8.1f} ms  ({theirs[0] / ours:.1f} times)\n'
          f'  SiSyPHE, block-sparse    {1e3 * theirs[1]:8.1f} ms  ({theirs[1] / ours:.1f} times)\n'
          '  (its step also adds noise and wraps around a periodic box; ours does neither)')


def flock(n: int) -> tuple[Array, Array]:
    """Return positions and velocities (n, 2), as dense for any n."""
    rng = np.random.default_rng(0)
    return np.sqrt(n / _DENSITY) * rng.random((n, 2)), rng.normal(size=(n, 2))


def timed(action: Callable[..., object], *args: object) -> float:
    """Return how long an action on some arguments takes, s."""
    start = time.perf_counter()
    action(*args)
    return time.perf_counter() - start


def peak_memory() -> float:
    """Return the most memory this process has held so far, bytes."""
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def available_memory() -> float:
    """Return the memory that is free, bytes."""
    with open('/proc/meminfo', encoding='ascii') as lines:
        return next(1024.0 * int(line.split()[1]) for line in lines if 'MemAvailable' in line)


if __name__ == '__main__':
    sys.exit(main())
