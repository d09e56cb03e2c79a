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
The figures of the paper, redrawn: ``python -m flock_desk.figures``.

Without ``--agents``: the simulations of Liu & Qiu (AAMAS 2020) with the law and the models that
they compare, as pictures and a table; and, for the controllers of ``flights``, the share of runs
in the band against jerk. With ``--agents N`` one larger flock of the law on a neighbor graph. Each
is as wide as a column, without a title, as PNG, SVG and PDF. Two runs write the same bytes.
Flights are drawn by the reports of ``fly``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
import csv
from functools import partial
import io
from itertools import groupby
import json
from pathlib import Path
import sys

import numpy as np

from flock_desk.closed_loop.controllers import CONTROLLERS
from flock_desk.flocks import paper
from flock_desk.flocks.agents import Model, simulate, simulate_graph, Simulation
from flock_desk.flocks.flock_metrics import extremum
from flock_desk.flocks.paper import random_start
from flock_desk.runs import paper_plots as plots
from flock_desk.runs.console import aligned, guarded, progress
from flock_follower.system.files import read_text
from flock_follower.system.whole_file import whole_file

MODELS: dict[Model, str] = {
    'flocking': 'Flocking law',
    'cucker_smale': 'Cucker-Smale',
    'cucker_dong': 'Cucker-Dong',
    'vicsek': 'Vicsek, own speed kept',
    'vicsek_mean_velocity': 'Vicsek, velocities averaged',
}
#: Where `flights` writes its results, if no other folder is given.
CAMPAIGN = Path('build/flights/flights.json')
COLUMNS = ('scenario', 'model', 'min r2 [m2]', 'min r2 at [s]', 'max r2 [m2]',
           'max r2 at [s]', 'mean distance [m]', 'speed [m/s]', 'heading [deg]', 'to 1 % [s]',
           'order', 'W start', 'W end', 'band')
MEANINGS = """
min r2, max r2  least and greatest squared distance between two agents, and its time (of edges, if
                the flock has a neighbor graph)
mean distance   of all pairs at the end
speed, heading  at the end: mean speed of the agents; direction of their mean velocity
to 1 %          time from which on L stays below 1 % of its first value. L is the disagreement:
                the root of the sum of |v_i - mean of v|^2
order           at the end: length of the mean of the unit velocities; 1: one direction
W               L plus a potential of the distances; decreases under the law if there is no leader;
                inf: a pair is outside the band
band            kept: sqrt(d0) < distance < sqrt(d1) at all times, for every pair or edge
"""
Row = tuple[str, ...]
SAMPLE_PERIOD = 0.005  # s, of the paper's simulations
FLOCK_DURATION = 20.0  # s, of the larger flock
FLOCK_PERIOD = 0.05  # s between samples of the larger flock


def main(args: Sequence[str] | None = None) -> int:
    """Draw the figures and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='figures', description='Redraw the figures of the paper, or one larger flock.')
    parser.add_argument('--output', '--out', type=Path, default='build/figures',
                        help='folder of the pictures (default: %(default)s)')
    parser.add_argument('--campaign', type=Path, metavar='FILE',
                        help=f'results of flights (default: {CAMPAIGN}, if it exists)')
    parser.add_argument('--agents', type=int, metavar='N',
                        help='one larger flock of so many, instead of the paper')
    parser.add_argument('--dim', type=int, choices=(2, 3), default=2,
                        help='of the larger flock; %(default)s')
    parser.add_argument('--seed', type=int, default=1, help='of its start; %(default)s')
    return guarded(partial(_draw, parser.parse_args(args)))


def _draw(options: argparse.Namespace) -> int:
    if options.campaign is not None:
        read_text(options.campaign)  # if it cannot be read, nothing is drawn in vain
    options.output.mkdir(parents=True, exist_ok=True)
    if options.agents is not None:
        written = one_flock(options.output, options.agents, options.dim, options.seed)
    else:
        written = [*redraw(options.output), *redraw_controllers(
            options.output, options.campaign or CAMPAIGN)]
    print(f'written to {options.output}: {", ".join(written)}')
    return 0


def redraw(out: Path) -> list[str]:
    """Write the paper's simulations and ``results.csv``, print the table, return the names."""
    runs: dict[str, dict[str, Simulation]] = {'leaderless': {}, 'leader-follower': {}}
    with progress(2 * len(MODELS)) as bar:
        for scenario, start, led, duration in (
                ('leaderless', paper.LEADERLESS_START, False, 20.0),
                ('leader-follower', paper.LEADER_FOLLOWER_START, True, 10.0)):
            for model, name in MODELS.items():
                bar.set_description_str(f'{scenario}: {name}')
                runs[scenario][name] = simulate(
                    *start, paper.PAPER_PARAMS, duration=duration, model=model, led=led,
                    sample_period=SAMPLE_PERIOD)
                bar.update()
    alone, followed = runs.values()
    continuous = {name: run for name, run in alone.items() if 'Vicsek' not in name}
    three, two = ('agent 1', 'agent 2', 'agent 3'), ('agent 1 (leader)', 'agent 2')
    unseen = '(d), (e): an agent detects others within 1 m;\nthe leader is always farther away'
    figures = {
        'leaderless_trajectories': plots.trajectories(alone, three, 10.0),
        'leaderless_speeds': plots.speeds(alone, three, 10.0),
        'leaderless_distances': plots.distances(alone, 10.0),
        'leaderless_lyapunov': plots.agreement(continuous, 10.0),
        'leader_trajectories': plots.trajectories(followed, two, 10.0, unseen),
        'leader_speeds': plots.speeds(followed, two, 10.0, unseen),
        'leader_distances': plots.distances(followed, 10.0, unseen)}
    rows = [row(scenario, name, run)
            for scenario, by_name in runs.items() for name, run in by_name.items()]
    write_csv(out / 'results.csv', COLUMNS, rows)
    print(aligned([COLUMNS, *rows]), MEANINGS, sep='\n')
    return [*(plots.save(figure, out / name) for name, figure in figures.items()), 'results.csv']


def redraw_controllers(out: Path, path: Path) -> list[str]:
    """
    Write the comparison of controllers, and return the names of its files.

    :param path: flights.json of ``flights``; only scenarios that all controllers flew count.
    """
    results = json.loads(read_text(path)) if path.exists() else {}
    flown = sorted((round(each['law']['max_speed_m_s'] / each['law']['max_speed_share'], 3), name)
                   for name, each in results.items() if CONTROLLERS.keys() <= each.keys())
    if not flown:
        print(f'controllers: not drawn, {path} does not have them: make flights')
        return []
    means = dict[float, dict[str, tuple[float, float]]]()
    for v_max, group in groupby(flown, lambda each: each[0]):
        names = [name for _, name in group]
        means[v_max] = {controller.title: (
            float(np.mean([results[name][key]['horizontal_jerk_m_s3'] for name in names])),
            float(np.mean([results[name][key]['in_band'] for name in names])))
            for key, controller in CONTROLLERS.items()}
    return [plots.save(plots.controllers(means), out / 'controllers')]


def one_flock(out: Path, agents: int, dim: int, seed: int) -> list[str]:
    """Simulate one flock from a random start, draw it, and return the names of its files."""
    start = random_start(agents, dim, paper.FLIGHT_PARAMS, seed)
    with progress(round(FLOCK_DURATION / FLOCK_PERIOD) + 1) as bar:
        bar.set_description_str(f'{agents} agents, {dim}-D')
        run = simulate_graph(*start, paper.FLIGHT_PARAMS, duration=FLOCK_DURATION,
                             sample_period=FLOCK_PERIOD, progress=bar.update)
    m, name = run.metrics, f'flock_{agents}_{dim}d_seed{seed}'
    columns = ('t [s]', 'min r2 [m2]', 'max r2 [m2]', 'mean distance [m]', 'mean speed [m/s]',
               'disagreement [m/s]', 'order')
    values = (m.time, m.min_r2, m.max_r2, m.mean_distance, m.speed, m.disagreement, m.order)
    write_csv(out / f'{name}.csv', columns, zip(*([_text(v, 6) for v in column]
                                                  for column in values)))
    print(aligned([COLUMNS, row(f'{agents} agents, {dim}-D', MODELS['flocking'], run)]), MEANINGS,
          sep='\n')
    return [plots.save(plots.flock(run), out / name), f'{name}.csv']


def row(scenario: str, name: str, run: Simulation) -> Row:
    """Return the line of the table that a simulation fills."""
    m = run.metrics
    (nearest_at, nearest), (farthest_at, farthest) = (
        extremum(m.time, values, least=side)
        for values, side in ((m.min_r2, True), (m.max_r2, False)))
    mean = run.velocities[-1].mean(axis=0)
    heading = np.degrees(np.arctan2(mean[1], mean[0]))
    kept = nearest > run.params.d0 and farthest < run.params.d1
    return (scenario, name, _text(nearest, 6), _text(nearest_at, 3), _text(farthest, 6),
            _text(farthest_at, 3), _text(m.mean_distance[-1], 3), _text(m.speed[-1], 8),
            _text(heading, 4), _text(m.time_to_agree(), 4), _text(m.order[-1], 4),
            _text(m.lyapunov[0], 7), _text(m.lyapunov[-1], 7), 'kept' if kept else 'left')


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a table with its columns' names."""
    text = io.StringIO()
    csv.writer(text, lineterminator='\n').writerows([columns, *rows])
    with whole_file(path) as file:  # which names the file if the disk is full
        file.write(text.getvalue().encode())


def _text(value: float, digits: int) -> str:
    """Return a number as text; empty for NaN, and never a negative zero."""
    zero = '0.' + '0' * digits
    return '' if np.isnan(value) else f'{value:.{digits}f}'.replace(f'-{zero}', zero)


if __name__ == '__main__':
    sys.exit(main())
