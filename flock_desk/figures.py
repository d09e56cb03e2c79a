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

Without ``--agents`` every figure of Liu & Qiu (AAMAS 2020) with curves: those on simulations, and
a table of what they show, for the law and the models it is compared with; and those on flights,
from what ``fly`` has recorded of the same scenarios; and the controllers that ``flights``
compared, runs in the band against jerk. With ``--agents N`` one larger flock. Each is as wide as
a column, without a title, as PNG, SVG and PDF. Two runs write the same bytes.

For a scenario that has not been flown yet a line says how to fly it; the exit code stays 0. If a
flight cannot be read it is 1, after all else has been drawn.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
import csv
from functools import partial
from itertools import groupby
import json
from pathlib import Path
import sys

import numpy as np

from flock_desk.closed_loop.controllers import CONTROLLERS
from flock_desk.flocks import paper
from flock_desk.flocks.agents import Leader, Model, simulate, simulate_graph, Simulation
from flock_desk.flocks.flock_metrics import extremum
from flock_desk.flocks.paper import random_start
from flock_desk.runs.console import aligned, guarded, Options, parsed, Progress
from flock_desk.runs.record import last_flight, read_flown
from flock_desk.scenarios.scenario_file import load
from flock_follower.bags.bag import BagError, failures

MODELS: dict[Model, str] = {
    'flocking': 'Flocking law',
    'cucker_smale': 'Cucker-Smale',
    'cucker_dong': 'Cucker-Dong',
    'vicsek': 'Vicsek, own speed kept',
    'vicsek_mean_velocity': 'Vicsek, velocities averaged',
}
COLUMNS = ('scenario', 'model', 'min r2 [m2]', 'min r2 at [s]', 'max r2 [m2]',
           'max r2 at [s]', 'mean distance [m]', 'speed [m/s]', 'heading [deg]', 'to 1 % [s]',
           'order', 'W start', 'W end', 'band')
#: The scenarios of ``fly`` that the paper shows flights of.
FLIGHTS = ('indoor', 'outdoor')
Row = tuple[str, ...]


_OPTIONS: Options = {
    '--out': {'type': Path, 'default': Path('build/figures'), 'help': '%(default)s'},
    '--flights': {'type': Path, 'default': Path('build/fly'), 'metavar': 'FOLDER',
                  'help': 'folder of the flights of fly; %(default)s'},
    '--campaign': {'type': Path, 'default': Path('build/flights/flights.json'), 'metavar': 'FILE',
                   'help': 'results of flights; %(default)s'}}
_FLOCK: Options = {
    '--agents': {'type': int, 'metavar': 'N', 'help': 'how many, instead of the paper'},
    '--dim': {'type': int, 'choices': (2, 3), 'default': 2, 'help': '%(default)s'},
    '--seed': {'type': int, 'default': 1, 'help': 'of the start; %(default)s'},
    '--duration': {'type': float, 'default': 20.0, 'help': 's; %(default)s'}}


def main(args: Sequence[str] | None = None) -> int:
    """Draw the figures and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='figures', description='Redraw the figures of the paper, or one larger flock.')
    return guarded(partial(_draw, parsed(parser, args, _OPTIONS, {'one larger flock': _FLOCK})))


def _draw(options: argparse.Namespace) -> int:
    notes: list[str] = []
    faults: list[str] = []
    options.out.mkdir(parents=True, exist_ok=True)
    if options.agents is not None:
        written = one_flock(options)
    else:
        written = redraw(options.out)
        flown, notes, faults = redraw_flights(options.out, options.flights)
        compared, note = redraw_controllers(options.out, options.campaign)
        written, notes = [*written, *flown, *compared], [*notes, *note]
    print('\n'.join(['', *notes, f'written to {options.out}: {", ".join(written)}']))
    for fault in faults:
        print(f'error: {fault}', file=sys.stderr)
    return 1 if faults else 0


def redraw(out: Path) -> list[str]:
    """Write the paper's simulations and ``results.csv``, print the table, return the names."""
    from flock_desk.runs import paper_plots as plots
    with Progress(2 * len(MODELS) + 7) as progress:
        leader = Leader(paper.leader_input, (paper.LEADER_SWITCH,))
        runs: dict[str, dict[Model, Simulation]] = {}
        for scenario, start, lead, duration in (
                ('leaderless', paper.LEADERLESS, None, 20.0),
                ('leader-follower', paper.LEADER_FOLLOWER, leader, 10.0)):
            runs[scenario] = {}
            for model, name in MODELS.items():
                progress.start(f'{scenario}: {name}')
                runs[scenario][model] = simulate(
                    *start, paper.PARAMS, duration=duration, model=model, leader=lead,
                    sample_period=0.005, progress=progress.share)
        alone, led = ({MODELS[model]: run for model, run in by_model.items()}
                      for by_model in runs.values())
        continuous = {name: run for name, run in alone.items() if 'Vicsek' not in name}
        three, two = ('agent 1', 'agent 2', 'agent 3'), ('agent 1 (leader)', 'agent 2')
        unseen = '(d), (e): an agent sees 1 m far; the leader is never so near'
        figures = {
            'leaderless_trajectories': lambda: plots.trajectories(alone, three, 10.0),
            'leaderless_speeds': lambda: plots.speeds(alone, three, 10.0),
            'leaderless_distances': lambda: plots.distances(alone, 10.0),
            'leaderless_lyapunov': lambda: plots.agreement(continuous, 10.0),
            'leader_trajectories': lambda: plots.trajectories(led, two, 10.0, unseen),
            'leader_speeds': lambda: plots.speeds(led, two, 10.0, unseen),
            'leader_distances': lambda: plots.distances(led, 10.0, unseen),
        }
        written = []
        for name, draw in figures.items():
            progress.start(f'drawing {name}')
            written.append(plots.save(draw(), out / name))
    rows = [row(scenario, MODELS[model], run)
            for scenario, by_model in runs.items() for model, run in by_model.items()]
    write_csv(out / 'results.csv', COLUMNS, rows)
    print('\n'.join(aligned([COLUMNS, *rows])))
    return [*written, 'results.csv']


def redraw_flights(out: Path, flights: Path) -> tuple[list[str], list[str], list[str]]:
    """
    Write the paper's flights, and return the names, a note on each, and the errors.

    :param flights: the folder of the flights of ``fly``.
    :raises OSError: if a figure cannot be written.
    """
    from flock_desk.runs import paper_plots as plots
    written, notes, faults = [], [], []
    for name in FLIGHTS:
        folder = last_flight(flights, name)
        if folder is None:
            notes.append(f'{name}: not drawn, there is no flight of it in {flights}: '
                        f'make fly SCENARIO={name}')
            continue
        try:
            with failures(folder / 'flight.npz', 'cannot be read'):
                flight = read_flown(load(name), folder)
        except BagError as error:
            faults.append(f'{name}: not drawn: {error}')
            continue
        written += [plots.save(draw(flight), out / f'{name}_{draw.__name__}')
                    for draw in (plots.positions, plots.distance)]
        apart = flight.distance[np.isfinite(flight.distance)]
        notes.append(f'{name}: {flight.duration:.3g} s in {folder}, {apart.min():.2f} to '
                    f'{apart.max():.2f} m apart, '
                    f'{100.0 * flight.time_in_band_share:.1f} % of the time in the band'
                    f'{", flown by an autopilot elsewhere" if flight.external else ""}')
    return written, notes, faults


def redraw_controllers(out: Path, path: Path) -> tuple[list[str], list[str]]:
    """
    Write the comparison of controllers, and return the names and the note without it.

    :param path: flights.json of ``flights``; only scenarios that all controllers flew count.
    """
    from flock_desk.runs import paper_plots as plots
    results = json.loads(path.read_text()) if path.exists() else {}
    flown = sorted((round(each['law']['max_speed_m_s'] / each['law']['max_speed_share'], 3), name)
                   for name, each in results.items() if CONTROLLERS.keys() <= each.keys())
    if not flown:
        return [], [f'controllers: not drawn, {path} does not have them: make flights']
    means = dict[float, dict[str, tuple[float, float]]]()
    for v_max, group in groupby(flown, lambda each: each[0]):
        names = [name for _, name in group]
        means[v_max] = {controller.title: (
            float(np.mean([results[name][key]['horizontal_jerk_m_s3'] for name in names])),
            float(np.mean([results[name][key]['in_band'] for name in names])))
            for key, controller in CONTROLLERS.items()}
    return [plots.save(plots.controllers(means), out / 'controllers')], []


def one_flock(options: argparse.Namespace) -> list[str]:
    """Simulate one flock from a random start, draw it, and return the names of its files."""
    from flock_desk.runs import paper_plots as plots
    start = random_start(options.agents, options.dim, paper.FLIGHT_PARAMS, options.seed)
    with Progress(2) as progress:
        progress.start(f'{options.agents} agents, {options.dim}-D')
        run = simulate_graph(*start, paper.FLIGHT_PARAMS, duration=options.duration,
                             progress=progress.share)
        m, graph = run.metrics, run.graph
        assert graph is not None
        name = f'flock_{options.agents}_{options.dim}d_seed{options.seed}'
        progress.start(f'drawing {name}')
        written = plots.save(plots.flock(run), options.out / name)
    columns = ('t [s]', 'min r2 [m2]', 'max r2 [m2]', 'mean distance [m]', 'mean speed [m/s]',
               'disagreement [m/s]', 'order')
    values = (m.time, m.min_r2, m.max_r2, m.mean_distance, m.speed, m.disagreement, m.order)
    write_csv(options.out / f'{name}.csv', columns, zip(*([_text(v, 6) for v in column]
                                                          for column in values)))
    row_ = row(f'{options.agents} agents, {options.dim}-D', MODELS['flocking'], run)
    print('\n'.join(aligned([COLUMNS, row_])))
    print(f'neighbour graph: {len(graph.edges)} edges, of them '
          f'{np.count_nonzero(graph.joined > 0.0)} joined after the start; '
          'max r2 is over the edges')
    return [written, f'{name}.csv']


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
    with open(path, 'w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(columns)
        writer.writerows(rows)


def _text(value: float, digits: int) -> str:
    """Return a number as text; empty for NaN, and never a negative zero."""
    zero = '0.' + '0' * digits
    return '' if np.isnan(value) else f'{value:.{digits}f}'.replace(f'-{zero}', zero)


if __name__ == '__main__':
    sys.exit(main())
