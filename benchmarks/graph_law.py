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
Whether flocks stay together and apart: ``python benchmarks/graph_law.py``, some minutes.

Random starts in 2-D and 3-D, in the narrow band of the paper's simulations and the wide one of
its flights, 20 s each on the neighbor graph; a start counts as kept where no pair ever came to
r^2 <= d0 and no edge ever to r^2 >= d1, so that the graph stayed connected. Exit code 0 only if
all were kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
import os
import sys
from typing import NamedTuple

from flock_desk.flocks.agents import simulate_graph
from flock_desk.flocks.paper import FLIGHT_PARAMS, PAPER_PARAMS, random_start
from flock_follower.flocking import FlockingParams


class Case(NamedTuple):
    """One random start, and the longest step, s."""

    agents: int
    dimension: int
    params: FlockingParams
    seed: int
    dt: float


def kept(case: Case) -> tuple[bool, float, float, float]:
    """Return whether a start was kept, how near any pair and how far any edge came, the order."""
    params = case.params
    start = random_start(case.agents, case.dimension, params, case.seed)
    m = simulate_graph(*start, params, dt=case.dt, sample_period=case.dt).metrics
    least, greatest = float(m.min_r2.min()), float(m.max_r2.max())
    return params.d0 < least and greatest < params.d1, least, greatest, float(m.order[-1])


def main(args: Sequence[str] | None = None) -> int:
    """Run all starts, print the table in Markdown, and return the exit code."""
    parser = argparse.ArgumentParser(description='Test the flocking law on many random starts.')
    parser.add_argument('--seeds', type=int, default=6, help='starts of each kind; %(default)s')
    parser.add_argument('--agents', type=int, nargs='+', default=[10, 20, 50])
    parser.add_argument('--dt', type=float, default=0.005, help='s; %(default)s')
    options = parser.parse_args(args)
    print('| agents | dimension | band, m² | kept | least r² | longest edge r² | least order |\n'
          '|---|---|---|---|---|---|---|')
    lost = 0
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for agents, dimension, params in product(options.agents, (2, 3),
                                                 (PAPER_PARAMS, FLIGHT_PARAMS)):
            results = [*pool.map(kept, [Case(agents, dimension, params, seed, options.dt)
                                        for seed in range(options.seeds)])]
            good, least, greatest, order = zip(*results)
            lost += good.count(False)
            print(f'| {agents} | {dimension} | {params.d0:g} to {params.d1:g} | '
                  f'{good.count(True)} of {len(good)} | {min(least):.3f} | {max(greatest):.3f} | '
                  f'{min(order):.3f} |', flush=True)
    return 1 if lost else 0


if __name__ == '__main__':
    sys.exit(main())
