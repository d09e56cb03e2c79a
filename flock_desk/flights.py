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
Many flights in lock step, without rendering: ``python -m flock_desk.flights``.

Flies every scenario with several controllers, with the same random draws for each: the law alone,
law and guard, and those of ``closed_loop/controllers.py``. Prints and writes the results:
OUTPUT/flights.json. The same seed gives the same file for any number of jobs.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby
import os
from pathlib import Path
import sys
from typing import NamedTuple

from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.controllers import CONTROLLERS, IN_FLOCKS
from flock_desk.closed_loop.metrics import (
    band_exits,
    joined,
    measure,
    Measures,
    of_runs,
    summary,
)
from flock_desk.runs.console import aligned, guarded, Options, parsed, Progress
from flock_desk.runs.processes import mapped, pooled
from flock_desk.runs.summary import write_summary
from flock_desk.scenarios.scenario import Scenario
from flock_desk.scenarios.scenario_file import (
    key_tables,
    load,
    names,
    ScenarioError,
)
from flock_follower.ranges import Range

CHUNK = 50  # followers flown together; fixed, so that --jobs does not change the results
LONGEST_NAME = 21
MOST_EXITS = 5  # of a scenario that are named
_COUNTS = Range(1, whole=True)
_SEEDS = Range(0, whole=True)
COLUMNS = {'in_band': ('kept band', '% runs', 100.0, 1),
           'time_in_band': ('in band', '% time', 100.0, 2),
           'time_in_sight': ('in sight', '% time', 100.0, 2),
           'min_separation_m': ('near', 'm', 1.0, 2),
           'max_separation_m': ('far', 'm', 1.0, 2),
           'max_speed_share': ('fastest', 'v_max', 1.0, 2),
           'guard_active': ('guard', '% time', 100.0, 1),
           'longest_detection_gap_s': ('unseen', 's', 1.0, 1)}
FLOCK_COLUMNS = {'in_band': ('kept band', '% runs', 100.0, 1),
                 'time_in_band': ('in band', '% time', 100.0, 2),
                 'min_separation_m': ('nearest pair', 'm', 1.0, 2),
                 'lost_for_good': ('lost', 'followers', 1.0, 0),
                 'edges': ('edges', 'each', 1.0, 2),
                 'neighbors_in_sight': ('seen', 'each', 1.0, 2),
                 'rms_acceleration_m_s2': ('accel.', 'm/s2', 1.0, 2)}
#: The meaning of the columns.
COLUMN_NOTES = """
kept band: share of runs that never left it. In band, in sight, guard (acts): share of time.
Near, far (from the leader), fastest, unseen (for how long): the worst of all runs."""
FLOCK_NOTES = """
in band: along the edges, to those that it follows. Nearest pair: any two vehicles."""
Results = dict[str, dict[str, dict[str, float]]]


class Task(NamedTuple):
    """Some runs of a scenario."""

    scenario: Scenario
    controller: str
    runs: range


class Flown(NamedTuple):
    """What a task gives."""

    runs: Measures
    exits: list[str]
    """Which runs left the band, when and why, one line each."""


_OPTIONS: Options = {
    '--controllers': {'nargs': '+', 'choices': CONTROLLERS, 'default': list(CONTROLLERS),
                      'metavar': 'NAME', 'help': f'{", ".join(CONTROLLERS)}; a flock flies '
                      f'{" and ".join(IN_FLOCKS)} only (all)'},
    '--keys': {'action': 'store_true',
               'help': 'print every key of a scenario file with its default and range'},
    '--runs': {'type': int, 'default': 200, 'help': 'of each (%(default)s)'},
    '--jobs': {'type': int, 'default': os.cpu_count() or 1,
               'help': 'processes (one per processor)'},
    '--scheduler': {'default': '', 'metavar': 'ADDRESS',
                    'help': 'of a Dask cluster, as tcp://192.168.1.5:8786, to fly on instead of '
                    '--jobs processes here; it has the same results'},
    '--seed': {'type': int, 'default': 0, 'help': '%(default)s'},
    '--output': {'type': Path, 'default': Path('build/flights'), 'metavar': 'FOLDER',
                 'help': '%(default)s'}}


def main(args: Sequence[str] | None = None) -> int:
    """Fly, print the table, write the file and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='flights', description='Fly scenarios many times, with several controllers.')
    scenario = {'nargs': '+', 'default': ['all'], 'metavar': 'NAME',
                'help': f'{", ".join(names())}; a .yaml file of your own; or all, which is the '
                'default'}
    options = parsed(parser, args, {'--scenario': scenario, **_OPTIONS},
                     valid={'runs': _COUNTS, 'jobs': _COUNTS, 'seed': _SEEDS})
    if options.keys:
        print(key_tables())
        return 0
    return guarded(partial(_campaign, options))


def _campaign(options: argparse.Namespace) -> int:
    scenarios = chosen(options.scenario)
    options.output.mkdir(parents=True, exist_ok=True)
    results, exits = fly_all(scenarios, options.controllers, options.runs, options.jobs,
                                  options.seed, options.scheduler)
    path = options.output / 'flights.json'
    write_summary(results, path)
    print(table(results))
    print(COLUMN_NOTES)
    flocks = {s.name: results[s.name] for s in scenarios if s.flock is not None}
    if flocks:
        print(f'\n{table(flocks, FLOCK_COLUMNS)}\n{FLOCK_NOTES}\n')
    if any(exits.values()):
        print('\nleft the band with law and guard:')
    for name, lines in exits.items():
        shown = lines if len(lines) <= MOST_EXITS else [
            *lines[:MOST_EXITS], f'and {len(lines) - MOST_EXITS} more']
        for line in shown:
            print(f'  {shorten(name):<22}{line}')
    print(f'\n{options.runs} runs each; written to {path}')
    return 0


def chosen(wanted: Sequence[str]) -> list[Scenario]:
    """
    Return the scenarios of given names and files, in their order; 'all' is all of the package.

    :raises ScenarioError: if one is unknown, wrong, or of the same name as another.
    """
    scenarios: dict[str, Scenario] = {}
    for name in dict.fromkeys(names() if 'all' in wanted else wanted):
        scenario = load(name)
        if scenario.name in scenarios:
            raise ScenarioError(f'{name}: another scenario has the name {scenario.name}')
        scenarios[scenario.name] = scenario
    return list(scenarios.values())


def fly_all(scenarios: Sequence[Scenario], controllers: Sequence[str], runs: int, jobs: int,
            seed: int, scheduler: str = ''
            ) -> tuple[Results, dict[str, list[str]]]:
    """
    Fly scenarios in ``jobs`` processes, or on the cluster that a scheduler is of.

    Return ``{scenario: {controller: {measure: value}}}``, and of each scenario, with law and guard
    (without it, with the first controller), the runs that left the band.
    """
    def of_scenario(scenario: Scenario) -> list[str]:
        return [name for name in controllers if scenario.flock is None or name in IN_FLOCKS
                ] or [*IN_FLOCKS]

    first = seed * 1_000_000
    tasks = [Task(scenario, controller, range(first + k, first + min(k + size, runs)))
             for scenario in scenarios for size in [max(CHUNK // scenario.company.followers, 1)]
             for controller in of_scenario(scenario) for k in range(0, runs, size)]
    parts: dict[tuple[str, str], list[Flown]] = {}
    flown = mapped(scheduler, _fly, tasks) if scheduler else pooled(jobs, _fly, tasks)
    with Progress(len(scenarios)) as progress:
        for name, group in groupby(tasks, lambda task: task.scenario.name):
            progress.start(name)
            its_tasks = list(group)
            for number, task in enumerate(its_tasks, start=1):
                parts.setdefault((name, task.controller), []).append(next(flown))
                progress.share(number / len(its_tasks))
    list(flown)  # ends the generator
    shown = {s.name: parts[s.name, max(of_scenario(s), key=lambda name: name == 'guard')]
             for s in scenarios}
    return ({s.name: {name: summary(joined([part.runs for part in parts[s.name, name]]))
                      for name in of_scenario(s)} for s in scenarios},
            {name: [line for part in flown for line in part.exits]
             for name, flown in shown.items()})


def table(results: Results,
          columns: Mapping[str, tuple[str, str, float, int]] = COLUMNS) -> str:
    """Return the results as text, a line for each scenario and controller."""
    rows = [['scenario', '', *(title for title, *_ in columns.values())],
            ['', '', *(f'[{unit}]' for _, unit, *_ in columns.values())]]
    for name, controllers in results.items():
        for number, (controller, values) in enumerate(controllers.items()):
            rows.append(['' if number else shorten(name), controller, *(
                f'{values[key] * factor:.{digits}f}'
                for key, (_, _, factor, digits) in columns.items())])
    return '\n'.join(aligned(rows))


def shorten(name: str) -> str:
    """Return a name that leaves the table within 100 columns."""
    return name if len(name) <= LONGEST_NAME else f'{name[:LONGEST_NAME - 1]}…'


def _fly(task: Task) -> Flown:
    _, law, guard = CONTROLLERS[task.controller]
    flights = fly(task.scenario, task.runs, guard, law)
    rows, many = measure(flights), task.scenario.company.followers
    exits = []
    for row, why in band_exits(flights):
        run, follower = divmod(row, many)
        which = f'follower {follower + 1} ' if many > 1 else ''
        exits.append(f'run {task.runs[run]}: {which}{why}')
    return Flown(rows if task.scenario.flock is None else of_runs(rows, flights), exits)


if __name__ == '__main__':
    sys.exit(main())
