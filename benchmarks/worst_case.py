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
The leader that brings the follower nearest to itself: ``python benchmarks/worst_case.py``.

A cross-entropy search (Rubinstein and Kroese, "The Cross-Entropy Method", 2004) over leaders of
at most 1 m/s^2 and 0.95 v_max, 0.4 v_max of it vertically, that turn their marker to the follower
and are hidden twice for up to 1 s. Each is flown in lock step; those that let the follower come
nearest are varied further. The worst one is written as a scenario file, to be flown again by
``make flights``. The same seed finds the same, whatever the number of jobs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
import math
import multiprocessing
import os
from pathlib import Path
import sys

import numpy as np

from flock_desk.closed_loop.campaign import fly
from flock_desk.scenarios.scenario import FlightParams, LeaderMotion, Leg, Outage, Scenario, Start
from flock_follower.geometry import Array

LEGS, LEG = 7, 4.0  # legs of so many s: longer than a change of velocity takes
DROPOUTS, LONGEST = 2, 1.0  # s
WAIT = 2.0  # s
ACCELERATION = 1.0  # m/s^2
SPEED_SHARE, CLIMB_SHARE = 0.95, 0.4  # of v_max
ELITE = 0.1  # share of a generation that the next is drawn around
KEEP = 0.3  # of the spread from one generation to the next, so that it does not settle too soon
SAFE = 0.9  # m


def main(args: Sequence[str] | None = None) -> int:
    """Search, print the worst of every generation, and return 0 where none came below SAFE."""
    parser = argparse.ArgumentParser(description='Search for the leader that comes nearest.')
    parser.add_argument('--generations', type=int, default=30, help='%(default)s')
    parser.add_argument('--population', type=int, default=100, help='%(default)s')
    parser.add_argument('--v-max', type=float, default=2.0, help='m/s, %(default)s')
    parser.add_argument('--seed', type=int, default=0, help='%(default)s')
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1, help='%(default)s')
    parser.add_argument('--output', type=Path, default=Path('build/worst_case.yaml'))
    options = parser.parse_args(args)
    rng = np.random.default_rng(options.seed)
    size = 3 * LEGS + 2 * DROPOUTS
    mean, spread = np.zeros(size), np.ones(size)
    worst, nearest = mean, math.inf
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(options.jobs, context) as pool:
        for generation in range(options.generations):
            tried = mean + spread * rng.standard_normal((options.population, size))
            found = np.array(list(pool.map(
                least_distance, tried, [options.v_max] * len(tried), chunksize=4)))
            order = np.argsort(found, kind='stable')
            if found[order[0]] < nearest:
                worst, nearest = tried[order[0]], float(found[order[0]])
            elite = tried[order[:max(2, round(ELITE * len(tried)))]]
            mean, spread = elite.mean(axis=0), KEEP * spread + (1.0 - KEEP) * elite.std(axis=0)
            print(f'{generation + 1:3}: nearest {found[order[0]]:.3f} m, median '
                  f'{np.median(found):.3f} m, so far {nearest:.3f} m', flush=True)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(as_yaml(scenario(worst, options.v_max), nearest, options.seed))
    print(f'\n{options.generations * options.population} flights; the nearest, {nearest:.3f} m: '
          f'{options.output}')
    return 0 if nearest >= SAFE else 1


def least_distance(genes: Array, v_max: float) -> float:
    """Return the least distance, m, in the flight behind a leader."""
    return float(fly(scenario(genes, v_max), [0], guard=True).nearest.min())


def scenario(genes: Array, v_max: float) -> Scenario:
    """Return the flight that some numbers, of the order of 1, stand for."""
    legs = []
    for heading, speed, climb in genes[:3 * LEGS].reshape(LEGS, 3).tolist():
        up = CLIMB_SHARE * v_max * math.tanh(climb)
        level = math.sqrt((SPEED_SHARE * v_max) ** 2 - up ** 2) / (1.0 + math.exp(-2.0 * speed))
        angle = math.pi * heading
        legs.append(Leg(LEG, (level * math.cos(angle), level * math.sin(angle), up)))
    outages = []
    for at, duration in genes[3 * LEGS:].reshape(DROPOUTS, 2).tolist():
        share = 1.0 / (1.0 + math.exp(-2.0 * at))
        outages.append(Outage('marker', WAIT + share * LEGS * LEG,
                              max(LONGEST / (1.0 + math.exp(-2.0 * duration)), 0.01)))
    return Scenario(
        'worst_case', 'found by a search for the nearest approach', duration=WAIT + LEGS * LEG,
        flight=FlightParams(v_max=v_max), start=Start(altitude=25.0),
        leader=LeaderMotion('legs', WAIT, legs=tuple(legs), acceleration=ACCELERATION,
                            heading='away'), outages=tuple(outages))


def as_yaml(found: Scenario, nearest: float, seed: int) -> str:
    """Return a scenario file."""
    lines = [f'# The nearest of a search with seed {seed}: {nearest:.3f} m in its run 0.',
             f'summary: "{found.summary}"', f'duration: {found.duration:g}',
             f'flight: {{v_max: {found.flight.v_max:g}}}',
             f'start: {{altitude: {found.start.altitude:g}}}', 'leader:', '  motion: legs',
             f'  wait: {found.leader.wait:g}', f'  acceleration: {found.leader.acceleration:g}',
             '  heading: away', '  legs:']
    for leg in found.leader.legs:
        velocity = ', '.join(f'{v:.4f}' for v in leg.velocity)
        lines.append(f'    - {{duration: {leg.duration:g}, velocity: [{velocity}]}}')
    lines.append('outages:')
    lines += [f'  - {{what: marker, at: {o.at:.3f}, duration: {o.duration:.3f}}}'
              for o in found.outages]
    return '\n'.join(lines) + '\n'


if __name__ == '__main__':
    sys.exit(main())
