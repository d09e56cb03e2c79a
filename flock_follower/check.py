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
Report the faults of a running system, or of a recording, before a flight.

``python -m flock_follower.check`` listens for some seconds to camera, odometry, our nodes and the
autopilot's messages through the bridge. ``check BAG`` reads a recording, without ROS, and reports
what is missing for ``evaluate``. Each line names a property, its measured value and the value it
should have; the line below a fault says what to do.

A line that begins with ``?`` names a property that could not be measured, and why.

Exit code 0 only if nothing prevents a flight (of a bag: its use), 1 if something does, or if
something essential was not measured, 2 for a wrong bag, file or option, or without ROS.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
import os
from pathlib import Path
import re
import sys
import textwrap
from typing import Any

from flock_follower.checks.bug_report import newest_recording, write_report
from flock_follower.checks.every_check import judge_all
from flock_follower.checks.findings import (
    ERROR,
    Finding,
    OK,
    ready,
    still_needed,
    UNMEASURED,
    WARNING,
)
from flock_follower.checks.observations import Observations
from flock_follower.checks.recorded_system import check_bag
from flock_follower.checks.topic_names import full_name, parse_remaps
from flock_follower.files import resource
from flock_follower.parameters.black_box_table import folder
from flock_follower.parameters.files import given, parameters_flown, read_parameters, TABLE

SECONDS = 6.0
MOST_SECONDS = 600.0
COLUMNS = 100
_LEVELS = {OK: 'ok', WARNING: 'warning', ERROR: 'ERROR', UNMEASURED: '?'}
_WIDTHS = (8, 21, 40)  # level, what, measured; the rest is for what it should be
_COLOURS = {OK: '\x1b[32m', WARNING: '\x1b[33m', ERROR: '\x1b[1;31m',
            UNMEASURED: '\x1b[36m'}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='check', description='Report the faults of a running system (without BAG), '
        'or a recording, before anything flies. It changes nothing.')
    parser.add_argument('bag', type=Path, nargs='?', metavar='BAG',
                        help='.mcap, .db3, .bag or ROS 2 bag folder; none: the running system')
    parser.add_argument('--config', type=Path, help='ROS 2 parameter file: a bag is checked with '
                        'its values (default: those flown, of a recording of the black box, else '
                        'config/follower.yaml of this package); running nodes are compared with '
                        'it')
    parser.add_argument('--namespace', default='', help='of the nodes and topics')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO',
                        help='one of our topics by another name, as odom:=/camera/odom/sample; '
                        'may be repeated')
    parser.add_argument('--camera', default='', metavar='NAME', help='of several cameras the one '
                        'to check (default: the first)')
    parser.add_argument('--seconds', type=float, default=SECONDS,
                        help='how long to listen (default: %(default)g)')
    parser.add_argument('--json', action='store_true', help='print JSON instead of the table')
    parser.add_argument('--report', type=Path, metavar='FILE', help='also write a zip file for a '
                        'bug report: versions, findings, parameters, diagnostics, the last minute '
                        'of BAG, of the black box that runs, or of the newest recording in the '
                        'default folder')
    options = parser.parse_args(args)
    if not 1.0 <= options.seconds <= MOST_SECONDS:
        parser.error(f'--seconds = {options.seconds:g}: must be in [1, {MOST_SECONDS:g}]')
    if options.report and not options.report.expanduser().parent.is_dir():
        parser.error(f'--report = {options.report}: must be a file in a folder that exists')
    try:
        seen, findings = _observe(options)
        if options.report:
            _report(options, seen, findings)
    except OSError as error:
        return _refuse(f'{error.filename}: {error.strerror}' if error.strerror else error)
    except ValueError as error:
        return _refuse(error)
    except ModuleNotFoundError as error:
        return _refuse(f'{error}: source ROS 2 (/opt/ros/.../setup.bash) and install every '
                       'package in package.xml')
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    if options.json:
        print(json.dumps(as_json(seen, findings), indent=2))
    else:
        print(table(seen, findings, colours=sys.stdout.isatty()))
    return 0 if ready(findings) else 1


def _observe(options: argparse.Namespace) -> tuple[Observations, list[Finding]]:
    """
    Return the observations of the bag, or of the running system, and the findings in them.

    :raises ValueError: for a bag, file or option that is wrong. :raises OSError: likewise.
    :raises ModuleNotFoundError: ROS is not installed.
    """
    remaps = parse_remaps(options.remap)
    if not re.fullmatch(r'[\w/]*', options.namespace):
        raise ValueError(f'--namespace {options.namespace}: must be letters, digits, _ and /')
    if options.bag is None:
        if options.config:
            given(options.config, '')  # a fault in the file is reported before listening
        # Only here: a recording is judged without ROS.
        from flock_follower.nodes.observer import observe
        if sys.stderr.isatty():
            print(f'listening for {options.seconds:g} s ...', file=sys.stderr)
        seen = observe(options.seconds, options.namespace, remaps, options.config,
                       options.camera)
        return seen, judge_all(seen)
    flown = None if options.config else parameters_flown(options.bag.expanduser(), TABLE)
    values = flown or read_parameters(options.config or resource('config/follower.yaml'), TABLE)
    return check_bag(options.bag, values, options.camera, options.namespace, remaps)


def _report(options: argparse.Namespace, seen: Observations,
            findings: Sequence[Finding]) -> None:
    recorder = seen.statuses.get(full_name('black_box', options.namespace).lstrip('/'))
    running = Path(recorder.values.get('recording', '')) if recorder else Path()
    recording = options.bag or (running if running.name and running.exists() else newest_recording(
        folder({'record_folder': ''}, os.environ.get('ROS_HOME', ''), options.namespace)))
    try:
        write_report(options.report, seen, table(seen, findings), as_json(seen, findings),
                     recording)
    except OSError as error:
        raise ValueError(f'--report {options.report}: {error.strerror or error}') from error
    print(f'{options.report}: {options.report.stat().st_size / 1e6:.1f} MB, recording: '
          f'{recording or "none found"}', file=sys.stderr)


def as_json(seen: Observations, findings: Sequence[Finding]) -> dict[str, Any]:
    """Return what ``--json`` prints."""
    return {'ready': ready(findings), 'bag': seen.source or None,
            'seconds': round(seen.duration, 3),
            'findings': [finding._asdict() for finding in findings]}


def table(seen: Observations, findings: Sequence[Finding], colours: bool = False) -> str:
    """Return the findings as a table, at most ``COLUMNS`` wide, and the verdict."""
    lines: list[str] = []
    for finding in findings:
        lines += _rows(finding, colours)
    levels = [finding.level for finding in findings]
    verdict = {(True, True): 'ready to fly', (True, False): 'not ready to fly',
               (False, True): 'usable', (False, False): 'not usable as it is'}[
                   seen.live, ready(findings)]
    counts = ', '.join(f'{number} {name}{"s" if number != 1 else ""}' for name, number in (
        ('error', levels.count(ERROR)), ('warning', levels.count(WARNING))))
    unknown = [finding.what for finding in findings if finding.level == UNMEASURED]
    needed = still_needed(findings)
    counts += f', {levels.count(OK)} ok, {len(unknown)} not measured'
    if unknown:
        counts += f' ({"needed: " if needed else ""}{", ".join(needed or unknown)})'
    return '\n'.join([*lines, '', *textwrap.wrap(f'{verdict}: {counts}', COLUMNS)])


def _rows(finding: Finding, colours: bool) -> list[str]:
    level = _LEVELS[finding.level]
    widths = (*_WIDTHS, COLUMNS - sum(_WIDTHS))
    cells = [textwrap.wrap(text, width - 1) or [''] for text, width in zip(
        (level, finding.what, finding.measured, finding.wanted), widths)]
    rows = []
    for n in range(max(map(len, cells))):
        parts = [cell[n] if n < len(cell) else '' for cell in cells]
        rows.append(''.join(part.ljust(width) for part, width in zip(parts, widths)).rstrip())
    if colours:
        rows[0] = rows[0].replace(level, f'{_COLOURS[finding.level]}{level}\x1b[0m', 1)
    if finding.advice:
        indent = ' ' * _WIDTHS[0]
        # Text to copy is not wrapped.
        whole = finding.advice.replace('--remap ', '--remap\0').replace('-r ', '-r\0')
        rows += [row.replace('\0', ' ') for row in textwrap.wrap(
            f'-> {whole}', COLUMNS, initial_indent=indent, subsequent_indent=f'{indent}   ',
            break_long_words=False, break_on_hyphens=False)]
    return rows


def _refuse(problem: Any) -> int:
    print(f'error: {problem}', file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
