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
Compare what the package computes with results that were frozen before (test/frozen/).

``make freeze`` writes the results, ``make frozen`` compares: every figure that differs is printed
with its part, row and name, before and after. The parts:

- ``sample``: what ``evaluate`` publishes for the sample bag, see golden_result.py;
- ``flights``: flights in lock step with the guard, eight scenarios, ``--runs`` runs of each;
- ``captures``: what the bridge says and sends while it receives test/captures;
- ``recordings``: markers in the real recordings, which are not in this repository.

Each is a table, written as CSV with all digits: equal means equal bit for bit.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
import csv
from itertools import zip_longest
import math
import multiprocessing
import os
from pathlib import Path
import sys
from typing import Any

from captured import captured, link
import golden_result
import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.metrics import measure
from flock_desk.scenarios.scenario_file import load
from flock_follower.gate.gate import Gate
from flock_follower.gate.velocity_check import MotionReport
from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.messages import OdometryState
from flock_follower.messages.commands import Command

FOLDER = Path(__file__).resolve().parent / 'frozen'
SCENARIOS = ('hover', 'straight', 'stop', 'circle', 'figure_eight', 'toward', 'random_walk',
             'stairs')
FIGURES = ('min_separation', 'max_separation', 'in_band', 'time_in_band', 'guard_active', 'jerk',
           'speed_share')
CHUNK = 50  # runs flown side by side
CAPTURES = ('px4_refusals', 'px4_vision_lost', 'ardupilot_refusals', 'ardupilot_vision_lost')
PERIOD = 0.2  # s between two cycles of the bridge
#: Rows by name: of each the numbers or texts of the columns. '' names the columns.
Table = dict[str, list[str]]


def table(columns: list[str], rows: dict[str, list[float | str]]) -> Table:
    """Return a table; floats are written with all their digits."""
    return {'': columns, **{name: [each if isinstance(each, str) else repr(float(each))
                                   for each in row] for name, row in rows.items()}}


def sample(_: argparse.Namespace) -> Table:
    """Return neighbors and commands of the sample bag."""
    return table(['x', 'y', 'z', 'vx_or_yaw', 'vy', 'vz'], {
        f'{topic} at {time} ns': [*numbers] for topic, time, numbers in golden_result.result()})


def flights(options: argparse.Namespace) -> Table:
    """Return the figures of every run."""
    tasks = [(name, range(k, min(k + CHUNK, options.runs)))
             for name in SCENARIOS for k in range(0, options.runs, CHUNK)]
    rows: dict[str, list[float | str]] = {}
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context('spawn')) as pool:
        for part in pool.map(_flown, *zip(*tasks)):
            rows |= part
    return table([*FIGURES], rows)


def _flown(name: str, runs: range) -> dict[str, list[float | str]]:
    measured = measure(fly(load(name), runs, guard=True))
    columns = [measured[figure].tolist() for figure in FIGURES]
    return {f'{name} run {run}': [*row] for run, row in zip(runs, zip(*columns))}


def captures(_: argparse.Namespace) -> Table:
    """Return state and setpoint of the bridge, and the number and payload of what it sends."""
    rows: dict[str, list[float | str]] = {}
    for name in CAPTURES:
        rows |= _replayed(name)
    return table(['state', 'setpoint', 'sent'], rows)


def _replayed(name: str) -> dict[str, list[float | str]]:
    """
    Receive a capture, with odometry and commands of our own.

    The vehicle flies north at 0.3 m/s and says that it is in the air. Offboard is permitted every
    5 s, and in turns arming, landing and holding are requested.
    """
    forwarder = OdometryForwarder() if 'vision' in name else None
    bridge = Bridge(link(), Gate(), now=0.0, forwarder=forwarder)
    codec = mavlink.MAVLink(None, 1, 1)
    transport: Any = bridge.link.transport
    messages, rows = captured(name), dict[str, list[float | str]]()
    velocity = np.array([0.0, 0.3, 0.0])
    for k in range(*(round(messages[end][0] / PERIOD) for end in (0, -1))):
        now = k * PERIOD
        while messages and messages[0][0] <= now:
            transport.arrived.append(messages.pop(0)[1])
        transport.arrived.append(bytes(mavlink.MAVLink_extended_sys_state_message(
            0, mavlink.MAV_LANDED_STATE_IN_AIR).pack(codec)))
        bridge.receive(now)
        bridge.gate.take_motion(
            'odom', MotionReport(velocity, 0.5, now * velocity), 0.02, now)
        if k % 5 == 0:
            bridge.forward(OdometryState(
                0, 'odom', 'base_link', now * velocity, np.array([0.0, 0.0, 0.6, 0.8]), velocity,
                np.array([0.1, 0.2, 0.3]), np.eye(6), np.eye(6), np.eye(3)), now, now)
        match k % 100:
            case 0 | 25 | 50 | 75:
                bridge.gate.permit(bridge.gate.permission.request(now))
            case 30:
                bridge.requests.arm(True, now)
            case 60:
                bridge.requests.land(now)
            case 90:
                bridge.requests.offboard(False, now)
        bridge.gate.take_command(Command([0.4 * np.cos(now), 0.3, 0.1], now), 0.05, now)
        setpoint, _, _ = bridge.cycle(now)
        acceleration = ' '.join(map(repr, setpoint.acceleration.tolist()))
        rows[f'{name} at {now:.1f} s'] = [
            bridge.state(now), f'{setpoint.kind} {setpoint.reason} {acceleration}',
            ' '.join(f'{int.from_bytes(data[7:10], "little")}:{data[10:-2].hex()}'
                     for data in transport.written)]
        transport.written.clear()
    return rows


def recordings(_: argparse.Namespace) -> Table:
    """Return how the tags of two recorded paths come out, and the markers in two recordings."""
    import real_vio

    from flock_follower.bags.bag import deserialize, open_bag
    from flock_follower.odometry.reader import OdometrySource
    from flock_follower.perception import markers as aruco
    from flock_follower.perception.images import decode_compressed

    if not (real_vio.FOLDER / 'truth.yaml').exists():
        print(f'recordings: skipped, {real_vio.FOLDER} is not there')
        return {}
    rows: dict[str, list[float | str]] = {}
    for name in ('vio/flight_fla_vio.bag', 'vio/walk_t265.bag'):
        recording, source = real_vio.Recording(name), OdometrySource()
        source.place_child(recording.T_base_child)
        seen = real_vio.seen_tags(recording, source.take)
        rows[name] = [len(seen), real_vio.velocity_rms(seen), real_vio.scatter(seen)]
        for tag in {tag.number: tag for tag in seen}.values():
            rows[f'{name} tag {tag.number} last'] = [*tag.position, *tag.velocity]
    for name in ('ubiq_aruco_images.bag', 'ubiq_aruco_marker.bag'):
        with open_bag(real_vio.FOLDER / name) as bag:
            for k, message in enumerate(m for m in bag.messages()
                                        if m.msgtype.endswith('CompressedImage')):
                image = decode_compressed(deserialize(message.data, message.msgtype).data)
                found = aruco.detect(image, 'DICT_5X5_1000')
                for number, corners in zip(found.ids.tolist(), found.corners):
                    rows[f'{name} image {k} marker {number}'] = [*np.ravel(corners)]
    return table([], rows)


PARTS: dict[str, Callable[[argparse.Namespace], Table]] = {
    part.__name__: part for part in (sample, captures, recordings, flights)}


def read(part: str) -> Table:
    """Return a frozen table; empty if there is none."""
    path = FOLDER / f'{part}.csv'
    if not path.exists():
        return {}
    with path.open(encoding='utf-8', newline='') as file:
        return {name: row for name, *row in csv.reader(file)}


def write(part: str, rows: Table) -> None:
    """Freeze a table."""
    FOLDER.mkdir(exist_ok=True)
    with (FOLDER / f'{part}.csv').open('w', encoding='utf-8', newline='') as file:
        csv.writer(file, lineterminator='\n').writerows([name, *row] for name, row in rows.items())
    print(f'{part}: {len(rows) - 1} rows frozen')


def differences(before: Table, after: Table) -> list[str]:
    """Return every figure that differs, before and after."""
    columns, found = before.get('', []), []
    for name in {**before, **after}:
        figures = zip_longest(before.get(name, []), after.get(name, []), fillvalue='none')
        found += [f'{name}: {columns[k] if k < len(columns) else k + 1}: {old} -> {new}'
                  for k, (old, new) in enumerate(figures) if old != new]
    return found


def largest_difference(before: Table, after: Table) -> float:
    """Return the largest difference of two numbers; NaN counts as none, a text as infinite."""
    def between(old: str, new: str) -> float:
        try:
            return abs(float(old) - float(new))
        except ValueError:
            return math.inf
    found = (between(old, new) for name in {*before, *after} for old, new in zip_longest(
        before.get(name, []), after.get(name, []), fillvalue='none') if old != new)
    return max((each for each in found if each == each), default=0.0)


def main() -> int:
    """Freeze or compare, and return the exit code."""
    parser = argparse.ArgumentParser(description='Compare with frozen results, or freeze them.')
    parser.add_argument('parts', nargs='*', metavar='PART', help=f'{", ".join(PARTS)} (all)')
    parser.add_argument('--write', action='store_true', help='freeze instead of comparing')
    parser.add_argument('--runs', type=int, default=25, help='of each scenario (%(default)s)')
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1,
                        help='processes (one per processor)')
    options = parser.parse_args()
    if unknown := {*options.parts} - {*PARTS}:
        parser.error(f'no such part: {", ".join(unknown)}')
    different = 0
    for part in options.parts or PARTS:
        before = {} if options.write else read(part)
        if part == 'flights' and before:  # only runs that both have
            options.runs = min(options.runs, max(
                int(name.split()[-1]) for name in before if name) + 1)
            before = {name: row for name, row in before.items()
                      if not name or int(name.split()[-1]) < options.runs}
        after = PARTS[part](options)
        if options.write and after:
            write(part, after)
        elif after:
            found = differences(before, after) if before else [f'{part}: run make freeze']
            different += len(found)
            print('\n'.join([*(f'{part}: {each}' for each in found), f'{part}: {len(after) - 1} '
                             f'rows compared, {len(found)} figures differ, by at most '
                             f'{largest_difference(before, after):.1g}']), flush=True)
    return 1 if different else 0


if __name__ == '__main__':
    sys.exit(main())
