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
import os
from pathlib import Path
import sys
from typing import NamedTuple

from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.controllers import CONTROLLERS, IN_FLOCKS
from flock_desk.closed_loop.metrics import (
    band_exits,
    concatenate_measures,
    measure,
    Measures,
    of_runs,
    summary,
)
from flock_desk.runs.console import aligned, guarded, progress, within
from flock_desk.runs.processes import computed
from flock_desk.runs.summary import write_summary
from flock_desk.scenarios.scenario import Scenario
from flock_desk.scenarios.scenario_file import key_tables, load, names, ScenarioError
from flock_follower.ranges import Range

CHUNK = 50  # followers flown together; fixed, so that --jobs does not change the results
LONGEST_NAME = 21
MOST_EXITS = 5  # of a scenario that are named
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
    """The result of a task."""

    runs: Measures
    exits: list[str]
    """Which runs left the band, when and why, one line each."""


def main(args: Sequence[str] | None = None) -> int:
    """Fly, print the table, write the file and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='flights', description='Fly scenarios many times, with several controllers.')
    parser.add_argument('--scenario', nargs='+', default=['all'], metavar='NAME',
                        help=f'{", ".join(names())}; a .yaml file of your own; or all, which is '
                        'the default')
    parser.add_argument('--controllers', nargs='+', choices=CONTROLLERS, metavar='NAME',
                        default=list(CONTROLLERS), help=f'{", ".join(CONTROLLERS)}; a flock flies '
                        f'{" and ".join(IN_FLOCKS)} only (all)')
    parser.add_argument('--keys', action='store_true',
                        help='print every key of a scenario file with its default and range')
    parser.add_argument('--runs', type=within(Range(1, whole=True)), default=200,
                        help='of each (%(default)s)')
    parser.add_argument('--jobs', type=within(Range(1, whole=True)), default=os.cpu_count() or 1,
                        help='processes (one per processor)')
    parser.add_argument('--scheduler', default='', metavar='ADDRESS',
                        help='of a Dask cluster, as tcp://192.168.1.5:8786, to fly on instead of '
                        '--jobs processes here; it has the same results')
    parser.add_argument('--seed', type=within(Range(0, whole=True)), default=0,
                        help='%(default)s')
    parser.add_argument('--output', type=Path, default='build/flights', metavar='FOLDER',
                        help='%(default)s')
    options = parser.parse_args(args)
    if options.keys:
        print(key_tables())
        return 0
    return guarded(partial(_campaign, options))


def _campaign(options: argparse.Namespace) -> int:
    scenarios = chosen(options.scenario)
    options.output.mkdir(parents=True, exist_ok=True)
    flown = fly_all(scenarios, options.controllers, options.runs, options.jobs, options.seed,
                    options.scheduler)
    results = {name: {controller: summary(concatenate_measures([part.runs for part in parts]))
                      for controller, parts in of_scenario.items()}
               for name, of_scenario in flown.items()}
    path = options.output / 'flights.json'
    write_summary(results, path)
    print(f'{table(results)}\n{COLUMN_NOTES}')
    flocks = [scenario.name for scenario in scenarios if scenario.flock is not None]
    if flocks:
        print(f'\n{table({name: results[name] for name in flocks}, FLOCK_COLUMNS)}\n{FLOCK_NOTES}')
    for name, of_scenario in flown.items():
        parts = of_scenario.get('guard', next(iter(of_scenario.values())))
        exits = [line for part in parts for line in part.exits]
        for line in exits[:MOST_EXITS]:
            print(f'{name}: left the band: {line}')
        if len(exits) > MOST_EXITS:
            print(f'{name}: left the band: {len(exits) - MOST_EXITS} more')
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
            seed: int, scheduler: str = '') -> dict[str, dict[str, list[Flown]]]:
    """
    Fly scenarios in ``jobs`` processes, or on the cluster of a scheduler.

    Return the results of the tasks, by scenario and controller.
    """
    first = seed * 1_000_000
    tasks = [Task(scenario, controller, range(first + k, first + min(k + size, runs)))
             for scenario in scenarios for size in [max(CHUNK // scenario.company.followers, 1)]
             for controller in _controllers_of(scenario, controllers)
             for k in range(0, runs, size)]
    flown: dict[str, dict[str, list[Flown]]] = {}
    with progress(len(tasks)) as bar:
        for task, result in zip(tasks, computed(_fly, tasks, jobs, scheduler)):
            bar.set_description_str(task.scenario.name)
            bar.update()
            of_scenario = flown.setdefault(task.scenario.name, {})
            of_scenario.setdefault(task.controller, []).append(result)
    return flown


def _controllers_of(scenario: Scenario, controllers: Sequence[str]) -> list[str]:
    """Return the controllers that fly a scenario: those of ``IN_FLOCKS`` only in a flock."""
    return [name for name in controllers
            if scenario.flock is None or name in IN_FLOCKS] or [*IN_FLOCKS]


def table(results: Results,
          columns: Mapping[str, tuple[str, str, float, int]] = COLUMNS) -> str:
    """Return the results as text, a line for each scenario and controller."""
    rows = [['scenario', '', *(title for title, *_ in columns.values())],
            ['', '', *(f'[{unit}]' for _, unit, *_ in columns.values())]]
    for name, controllers in results.items():
        rows += [[name[:LONGEST_NAME], controller, *(
            f'{values[key] * factor:.{digits}f}'
            for key, (_, _, factor, digits) in columns.items())]
            for controller, values in controllers.items()]
    return aligned(rows)


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
