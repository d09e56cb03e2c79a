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
Flights behind the distances on the pages of guard and flocks: ``benchmarks/guard_campaign.py``.

Lock step, fixed seeds: columns, members that fail, leaders that come back hidden or over the
ceiling, gaps of the odometry, and the jerk beside a PD servo. Each flight is one line of JSON in
the log; a flight that the log has is not flown again, so a campaign that was cut continues. The
runs are flown a few at a time, all cells in turn: the first runs of the last cell come before the
last runs of the first.

A column of six holds the shorter ones: nobody in it sees or receives a vehicle behind.

    .venv/bin/python benchmarks/guard_campaign.py --runs 20              # hours
    .venv/bin/python benchmarks/guard_campaign.py --cells 'gap*' --runs 6
    .venv/bin/python benchmarks/guard_campaign.py --table                # of the log alone
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
import json
import os
from pathlib import Path
import sys
from typing import Any, NamedTuple

import numpy as np

from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.controllers import CONTROLLERS
from flock_desk.closed_loop.metrics import Flights, measure, of_runs
from flock_desk.runs.console import aligned
from flock_desk.scenarios.flock import Flock, FollowerFailure
from flock_desk.scenarios.scenario import FlightParams, LeaderMotion, Leg, Outage, Scenario, Start
from flock_desk.scenarios.scenario_file import load

V_MAX = 0.5, 1.0, 2.0  # m/s
COLUMN_V_MAX = 0.5, 1.0  # m/s: a faster column is refused
LONGEST_COLUMN = 6  # followers
PART = 5  # runs flown together: fixed, so that a part is flown again alike
SEED_STEP = 1_000_000  # runs of one seed, as for ``flock_desk.flights``
NEAR = 0.6, 0.9  # m: nearest distances that the table counts
COMING = {0.5: 0.45, 1.0: 0.9, 2.0: 1.06}  # m/s of a leader that comes back, by v_max
WAIT = 2.0  # s for which the leader hovers first
FASTEST_WANDER = 1.5  # m/s: some draws of a faster leader exceed its acceleration
HIGH = 20.0  # m: altitude at the start of flights whose leader moves up and down


class Cell(NamedTuple):
    """Flights of one kind."""

    name: str
    scenario: Scenario
    controller: str = 'guard'


def legs(*stretches: tuple[float, float, float, float], wait: float = WAIT,
         heading: str = 'away') -> LeaderMotion:
    """Return the motion of stretches, each its duration, s, and its velocity, m/s."""
    return LeaderMotion('legs', wait, legs=tuple(
        Leg(duration, (x, y, z)) for duration, x, y, z in stretches), heading=heading)


def cells() -> Iterator[Cell]:
    """Yield the cells of the campaign, those that are flown first in front."""
    yield from _ceilings()
    yield from _hidden()
    yield from _gaps()
    yield from _failing()
    yield from _columns()
    yield from _jerk()
    yield Cell('worst_case', load('worst_case'))
    yield Cell('ring', load('flock_ring'))


def _ceilings() -> Iterator[Cell]:
    """Yield leaders that climb over the ceiling, fly over the follower and come down unseen."""
    for v in V_MAX:
        over = legs((6.0 / v, 0.0, 0.0, 0.5 * v), (5.0 / v, -0.5 * v, 0.0, 0.0),
                    (7.5 / v, -0.1 * v, 0.0, -0.4 * v))
        yield _single(f'ceiling v_max {v:g}', v, over, WAIT + 18.5 / v + 5.0,
                      altitude=HIGH, ceiling=HIGH + 1.0)


def _hidden() -> Iterator[Cell]:
    """Yield leaders that come back hidden, and those that turn while they are hidden."""
    for v in V_MAX:
        back = legs((5.0, 0.5 * v, 0.0, 0.0), (9.0, -0.5 * v, 0.0, 0.0), wait=3.0)
        yield _single(f'hide_back v_max {v:g}', v, back, 25.0, (Outage('marker', 8.0, 5.0),))
    for v in V_MAX:
        turning = legs((8.0, 0.5 * v, 0.0, 0.0), (8.0, -0.4 * v, 0.1 * v, 0.0),
                       (8.0, 0.45 * v, 0.0, 0.0), wait=3.0)
        yield _single(f'reverse_unseen v_max {v:g}', v, turning, 30.0, tuple(
            Outage('marker', at, 1.5) for at in (13.5, 21.5)))


def _gaps() -> Iterator[Cell]:
    """Yield gaps of the odometry of 1 and 3 s that begin some time after the leader turned."""
    for since in (0.5, 1.5, 4.0):
        for gap in (1.0, 3.0):
            for v in V_MAX:
                coming = legs((5.0, 0.5 * v, 0.0, 0.0), (8.0, -COMING[v], 0.0, 0.0))
                yield _single(f'gap {gap:g} s, {since:g} s after the turn, v_max {v:g}', v, coming,
                              WAIT + 5.0 + since + gap + 2.0,
                              (Outage('vio', WAIT + 5.0 + since, gap),))
    for v in V_MAX:
        away = legs((12.0, 0.5 * v, 0.0, 0.0))
        yield _single(f'gap 1 s, goes on, v_max {v:g}', v, away, 18.0, (Outage('vio', 7.0, 1.0),))


def _failing() -> Iterator[Cell]:
    """Yield flocks in which the computer of a member fails 3 s before the leader comes back."""
    for v in COLUMN_V_MAX[::-1]:
        for formation, followers in (('line', 3), ('wedge', 3), ('ring', 4)):
            ring = formation == 'ring'
            flock = Flock(followers, formation, words=True, fails=FollowerFailure(2, 5.0),
                          faces=('back', 'front', 'left', 'right') if ring else ('back',))
            leader = legs((6.0, 0.8 * v, 0.0, 0.0), (8.0, -0.9 * v, 0.0, 0.0),
                          heading='fixed' if ring else 'away')
            name = f'fails in {formation} v_max {v:g}'
            yield Cell(name, Scenario(name, '', 20.0, flight=FlightParams(v_max=v),
                                      leader=leader, flock=flock))


def _columns() -> Iterator[Cell]:
    """Yield columns of six behind leaders that come back, turn and stop."""
    for v in COLUMN_V_MAX[::-1]:
        for kind, duration, leader in (
                ('comes back', 20.0, legs((6.0, 0.8 * v, 0.0, 0.0), (8.0, -0.9 * v, 0.0, 0.0),
                                          (4.0, 0.8 * v, 0.0, 0.0))),
                ('turns', 18.0, legs((6.0, 0.9 * v, 0.0, 0.0), (5.0, 0.0, 0.9 * v, 0.0),
                                     (5.0, -0.9 * v, 0.0, 0.0))),
                ('stops', 14.0, legs((6.0, 0.95 * v, 0.0, 0.0)))):
            name = f'column {kind} v_max {v:g}'
            yield Cell(name, Scenario(name, '', duration, flight=FlightParams(v_max=v),
                                      leader=leader, flock=Flock(LONGEST_COLUMN)))


def _jerk() -> Iterator[Cell]:
    """Yield nine kinds of leaders up to 0.95 ``v_max``, behind guard and PD servo."""
    for v in V_MAX:
        speed, wide = 0.95 * v, max(1.5, 2.5 * v ** 2)
        kinds = {'straight': legs((30.0, speed, 0.0, 0.0)),
                 'reverses': legs((6.0, speed, 0.0, 0.0), (6.0, -speed, 0.0, 0.0),
                                  (6.0, speed, 0.0, 0.0), (6.0, -speed, 0.0, 0.0))}
        for motion in ('circle', 'figure_eight', 'wander'):
            fastest = min(speed, FASTEST_WANDER) if motion == 'wander' else speed
            kinds[motion] = LeaderMotion(
                motion, WAIT, (fastest, fastest), size=wide, heading='away')
        for motion in ('spline', 'random_walk', 'stairs', 'approach'):
            kinds[motion] = LeaderMotion(motion, WAIT, (speed, speed), climb=0.3 * v,
                                         heading='away')
        for kind, leader in kinds.items():
            for controller in ('guard', 'pd'):
                yield _single(f'jerk {kind} v_max {v:g}', v, leader, 30.0, altitude=HIGH,
                              controller=controller)


def _single(name: str, v_max: float, leader: LeaderMotion, duration: float,
            outages: tuple[Outage, ...] = (), altitude: float = Start.altitude,
            ceiling: float = FlightParams.altitude_max, controller: str = 'guard') -> Cell:
    return Cell(name, Scenario(
        name, '', duration, flight=FlightParams(v_max=v_max, altitude_max=ceiling),
        start=Start(altitude=altitude), leader=leader, outages=outages), controller)


def fly_part(cell: Cell, runs: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Fly some runs of a cell and yield the line of each for the log."""
    _, law, guard = CONTROLLERS[cell.controller]
    flights = fly(cell.scenario, runs, guard, law)
    measures = measure(flights)
    if cell.scenario.flock is not None:
        measures = of_runs(measures, flights)
    for k, run in enumerate(runs):
        yield {'cell': cell.name, 'controller': cell.controller, 'run': run, **{
            name: round(float(values[k]), 4) for name, values in measures.items()
            if name in ('min_separation', 'max_separation', 'out_of_band', 'in_band',
                        'horizontal_jerk', 'lost')},
               'fronts': fronts(flights, k) if cell.name.startswith('column') else []}


def fronts(flights: Flights, run: int) -> list[float]:
    """Return the least distance of any two vehicles, m, in the column of the first 2, 3 and on."""
    places = flights.positions[run]
    least = []
    for count in range(2, places.shape[1]):
        apart = np.linalg.norm(places[:, :count + 1, None] - places[:, None, :count + 1], axis=3)
        apart[:, np.arange(count + 1), np.arange(count + 1)] = np.inf
        least.append(round(float(apart.min()), 4))
    return least


def table(log: Sequence[dict[str, Any]]) -> str:
    """Return the figures of a log, a line for each cell, column and controller."""
    found: dict[str, list[dict[str, Any]]] = {}
    for line in log:
        where = line['cell'] + ('' if line['controller'] == 'guard' else f' {line["controller"]}')
        found.setdefault(where, []).append(line)
        for count, nearest in enumerate(line['fronts'], 2):
            found.setdefault(f'{where}, of {count}', []).append({
                'min_separation': nearest, 'horizontal_jerk': np.nan})
    rows = [['cell', 'runs', 'nearest, m', 'median', *(f'>= {near:g} m' for near in NEAR),
             'in band', 'outside, s', 'farthest, m', 'lost', 'jerk, m/s^3']]
    for where, lines in found.items():
        nearest = [line['min_separation'] for line in lines]
        own = 'in_band' in lines[0]
        rows.append([where, str(len(lines)), f'{min(nearest):.2f}', f'{np.median(nearest):.2f}',
                     *(str(sum(value >= near for value in nearest)) for near in NEAR),
                     *(f'{reduced(line[name] for line in lines):.{digits}f}' if own else ''
                       for reduced, name, digits in ((sum, 'in_band', 0), (max, 'out_of_band', 1),
                                                     (max, 'max_separation', 2))),
                     f'{sum(line.get("lost", 0.0) for line in lines):.0f}' if own else '',
                     f'{np.mean([line["horizontal_jerk"] for line in lines]):.2f}' if own else ''])
    return aligned(rows)


def read(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a log; a last line that was cut is left out."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text('utf-8').splitlines() if line[-1:] == '}']


def main(args: Sequence[str] | None = None) -> int:
    """Fly what the log lacks, print the table, and return 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').split('\n\n', maxsplit=1)[0])
    parser.add_argument('--cells', nargs='+', default=['*'], metavar='PATTERN',
                        help='such as "gap*" (all)')
    parser.add_argument('--runs', type=int, default=20, help='of each cell (%(default)s)')
    parser.add_argument('--seed', type=int, default=0, help='%(default)s')
    parser.add_argument('--log', type=Path, default=Path('build/guard_campaign.jsonl'),
                        help='%(default)s')
    parser.add_argument('--table', action='store_true', help='print the table of the log only')
    options = parser.parse_args(args)
    wanted = [cell for cell in cells()
              if any(fnmatch(cell.name, pattern) for pattern in options.cells)]
    done = {(line['cell'], line['controller'], line['run']) for line in read(options.log)}
    options.log.parent.mkdir(parents=True, exist_ok=True)
    first = options.seed * SEED_STEP
    for begin in range(0, 0 if options.table else options.runs, PART):
        for cell in wanted:
            runs = [run for run in range(first + begin, first + min(begin + PART, options.runs))
                    if (cell.name, cell.controller, run) not in done]
            with options.log.open('a', encoding='utf-8') as log:
                for line in fly_part(cell, runs) if runs else ():
                    log.write(json.dumps(line) + '\n')
                    log.flush()
                    os.fsync(log.fileno())
    names = {cell.name for cell in wanted}
    print(table([line for line in read(options.log) if line['cell'] in names]))
    return 0


if __name__ == '__main__':
    sys.exit(main())
