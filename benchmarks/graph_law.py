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
its flights, 20 s each; a start counts as kept where no pair ever came to r^2 <= d0 and no edge
ever to r^2 >= d1, so that the graph stayed connected. The 7 nearest have no edges: there the
agents that are within the band at the end must connect. Exit code 0 only if the graph kept all.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
import os
import sys
from typing import NamedTuple

from flock_desk.flocks.agents import Integrator, Neighbors, simulate
from flock_desk.flocks.laws import Coupling, initial_graph
from flock_desk.flocks.paper import FLIGHT_PARAMS, PARAMS, random_start
from flock_follower.flocking import FlockingParams

VARIANTS: tuple[tuple[Neighbors, Coupling], ...] = (
    ('graph', 'flock'), ('graph', 'pair'), ('nearest', 'flock'), ('nearest', 'pair'))


class Case(NamedTuple):
    neighbors: Neighbors
    coupling: Coupling
    agents: int
    dimension: int
    params: FlockingParams
    seed: int
    integrator: Integrator
    dt: float


class Outcome(NamedTuple):
    """How near any pair and how far any edge came, m^2, the order at the end, and the verdict."""

    least: float
    greatest: float
    order: float
    kept: bool


def outcome(case: Case) -> Outcome:
    """Return what becomes of one start."""
    params = case.params
    start = random_start(case.agents, case.dimension, params, case.seed)
    try:
        run = simulate(start.positions, start.velocities, params, duration=20.0,
                       neighbors=case.neighbors, coupling=case.coupling,
                       integrator=case.integrator, dt=case.dt, sample_period=case.dt)
    except RuntimeError:  # it diverged
        return Outcome(0.0, float('inf'), float('nan'), False)
    m = run.metrics
    least, greatest = float(m.min_r2.min()), float(m.max_r2.max())
    together = (greatest < params.d1 if case.neighbors != 'nearest'
                else initial_graph(run.positions[-1], params).connected)
    return Outcome(least, greatest, float(m.order[-1]), least > params.d0 and together)


def main(args: Sequence[str] | None = None) -> int:
    """Run all starts, print the table in Markdown, and return the exit code."""
    parser = argparse.ArgumentParser(description='Test the flocking law on many random starts.')
    parser.add_argument('--seeds', type=int, default=6, help='starts of each kind; %(default)s')
    parser.add_argument('--agents', type=int, nargs='+', default=[10, 20, 50])
    parser.add_argument('--integrator', choices=('semi_implicit', 'adaptive'),
                        default='semi_implicit', help='%(default)s')
    parser.add_argument('--dt', type=float, default=0.005, help='s; %(default)s')
    options = parser.parse_args(args)
    print('| neighbours | L of the | agents | dimension | band, m² | kept | least r² | '
          'longest edge r² | least order |\n|---|---|---|---|---|---|---|---|---|')
    failed = 0
    totals = dict.fromkeys(VARIANTS, 0)
    kinds = list(product(options.agents, (2, 3), (PARAMS, FLIGHT_PARAMS)))
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for variant, (agents, dimension, params) in product(VARIANTS, kinds):
            cases = [Case(variant[0], variant[1], agents, dimension, params, seed,
                          options.integrator, options.dt) for seed in range(options.seeds)]
            outcomes = list(pool.map(outcome, cases))
            kept = [o for o in outcomes if o.kept]
            totals[variant] += len(kept)
            failed += len(outcomes) - len(kept) if variant[0] == 'graph' else 0
            worst = '| |'
            if kept:
                longest = (f'{max(o.greatest for o in kept):.3f}' if variant[0] == 'graph'
                           else '')  # there are no edges
                worst = (f'{min(o.least for o in kept):.3f} | {longest} | '
                         f'{min(o.order for o in kept):.3f}')
            print(f'| {variant[0]} | {variant[1]} | {agents} | {dimension} | {params.d0:g} to '
                  f'{params.d1:g} | {len(kept)} of {len(outcomes)} | {worst} |', flush=True)
    print()
    for (neighbors, coupling), kept_ in totals.items():
        print(f'{neighbors}, L of the {coupling}: {kept_} of {len(kinds) * options.seeds} kept')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
