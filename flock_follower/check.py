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
what is missing for ``evaluate``. Each line has a property, the measured value and the required
value; the line below a fault has the remedy.

A line that begins with ``?`` names a property that could not be measured, and why.

Exit codes: 0 if nothing prevents a flight (or the use of a bag); 1 if a fault prevents it, or an
essential property was not measured; 2 for a wrong bag, file or option, or without ROS; 3 if only a
busy computer prevents it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import distributions
import json
import os
from pathlib import Path
import platform
import re
import sys
import textwrap
from typing import Any, Final
import zipfile

from flock_follower.bags.parameter_table import recordings_folder
from flock_follower.bags.recording import NAME
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
from flock_follower.checks.recorded_system import check_bag, judge_all
from flock_follower.messages.topic_names import parse_remaps
from flock_follower.parameters.files import parameters_flown, read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.ranges import Range
from flock_follower.system.files import resource
from flock_follower.system.whole_file import whole_file

LISTENING_TIME = 6.0  # s
VALID_SECONDS = Range(1.0, 600.0, 's')
COLUMNS = 100
TOO_BUSY: Final = 3  # exit code
#: A larger file of a recording is left out of a bug report, bytes; the black box writes none.
MAX_RECORDING_SIZE: Final = 200_000_000
_MARKS = {OK: 'ok', WARNING: 'warning', ERROR: 'ERROR', UNMEASURED: '?'}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='check', description='Report the faults of a running system (without BAG), '
        'or a recording, before anything flies. It changes nothing.')
    parser.add_argument('bag', type=Path, nargs='?', metavar='BAG',
                        help='.mcap, .db3, .bag or ROS 2 bag folder; none: the running system')
    parser.add_argument('--config', type=Path, help='ROS 2 parameter file: BAG is checked with '
                        'its values (default: those flown, of a recording of the black box, else '
                        'config/follower.yaml of this package)')
    parser.add_argument('--namespace', default='', help='namespace of the nodes and topics')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO',
                        help='one of our topics by another name, as odom:=/camera/odom/sample; '
                        'may be repeated')
    parser.add_argument('--camera', default='', metavar='NAME', help='the camera to check, if '
                        'there are several (default: the first)')
    parser.add_argument('--seconds', type=float, default=LISTENING_TIME,
                        help='how long to listen (default: %(default)g)')
    parser.add_argument('--json', action='store_true', help='print JSON instead of the table')
    parser.add_argument('--report', type=Path, metavar='FILE', help='also write a zip file for a '
                        'bug report: versions, findings, parameters, diagnostics, and one '
                        'recorded file: the newest of BAG, else of the running black box, else of '
                        'the newest recording in the default folder')
    options = parser.parse_args(args)
    try:
        seen, findings = _observe(options)
        if options.report:
            _report(options, seen, findings)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        hint = ': source ROS 2 (/opt/ros/.../setup.bash) and install every package in package.xml'
        print(f'error: {error}{hint if isinstance(error, ModuleNotFoundError) else ""}',
              file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    if options.json:
        print(json.dumps(as_json(seen, findings), indent=2))
    else:
        print(table(seen, findings))
    return 0 if ready(findings) else TOO_BUSY if too_busy(seen, findings) else 1


def too_busy(seen: Observations, findings: Sequence[Finding]) -> str:
    """Return the load as text if only the load prevents a flight, else ''."""
    faults = {finding.what for finding in findings if finding.level == ERROR}
    return str(seen.machine.load) if seen.busy and not ready(findings) and (
        faults <= {'processor'}) else ''


def _observe(options: argparse.Namespace) -> tuple[Observations, list[Finding]]:
    """
    Return the observations of the bag, or of the running system, and the findings in them.

    :raises ValueError: for a bag, file or option that is wrong. :raises OSError: likewise.
    :raises ModuleNotFoundError: ROS is not installed.
    """
    VALID_SECONDS.check('--seconds', options.seconds)
    remaps = parse_remaps(options.remap)
    if not re.fullmatch(r'[\w/]*', options.namespace):
        raise ValueError(f'--namespace {options.namespace}: must be letters, digits, _ and /')
    if options.bag is None:
        # Only here: a recording is judged without ROS.
        from flock_follower.nodes.observer import observe
        if sys.stderr.isatty():
            print(f'listening for {options.seconds:g} s ...', file=sys.stderr)
        seen = observe(options.seconds, options.namespace, remaps, options.camera)
        return seen, judge_all(seen)
    flown = None if options.config else parameters_flown(options.bag.expanduser(), TABLE)
    values = flown or read_parameters(options.config or resource('config/follower.yaml'), TABLE)
    return check_bag(options.bag, values, options.camera, options.namespace, remaps)


def _report(options: argparse.Namespace, seen: Observations,
            findings: Sequence[Finding]) -> None:
    """Write the file for a bug report, with the newest recording, and print its size."""
    recorder = seen.status('black_box')
    running = Path(recorder.values.get('recording', '')) if recorder else Path()
    home = os.environ.get('ROS_HOME', '')
    recording = options.bag or (running if running.name and running.exists() else newest_recording(
        recordings_folder({'record_folder': ''}, home, options.namespace)))
    write_report(options.report, seen, findings, recording)
    print(f'{options.report}: {options.report.stat().st_size / 1e6:.1f} MB, recording: '
          f'{recording or "none found"}', file=sys.stderr)


def as_json(seen: Observations, findings: Sequence[Finding]) -> dict[str, Any]:
    """Return what ``--json`` prints."""
    return {'ready': ready(findings), 'bag': seen.source or None,
            'seconds': round(seen.duration, 3),
            'findings': [finding._asdict() for finding in findings]}


def table(seen: Observations, findings: Sequence[Finding]) -> str:
    """Return the findings, each with its advice on a line of its own, and the verdict."""
    lines = []
    for finding in findings:
        lines.append(f'{_MARKS[finding.level]:<8}{finding.what}: {finding.measured} '
                     f'(should be: {finding.wanted})')
        if finding.advice:
            lines.append(f'        -> {finding.advice}')
    levels = [finding.level for finding in findings]
    verdict = {(True, True): 'ready to fly', (True, False): 'not ready to fly',
               (False, True): 'usable', (False, False): 'not usable as it is'}[
                   seen.live, ready(findings)]
    unknown = [finding.what for finding in findings if finding.level == UNMEASURED]
    needed = still_needed(findings)
    counts = ', '.join(
        f'{count} {name.removesuffix("s") if count == 1 else name}' for count, name in (
            (levels.count(ERROR), 'errors'), (levels.count(WARNING), 'warnings'),
            (levels.count(OK), 'ok'), (levels.count(UNMEASURED), 'not measured')))
    if unknown:
        counts += f' ({"needed: " if needed else ""}{", ".join(needed or unknown)})'
    busy = too_busy(seen, findings)
    return '\n'.join([*lines, '', *textwrap.wrap(f'{verdict}: {counts}', COLUMNS),
                      *([f'too busy: {busy}'] if busy else [])])


def write_report(path: Path, seen: Observations, findings: Sequence[Finding],
                 recording: Path | None) -> None:
    """
    Write the zip file of a bug report.

    :param recording: a bag: its newest file, and the YAML files beside it, are included; None if
        there is no bag.
    :raises OSError: naming the file, if it cannot be written.
    """
    with whole_file(path) as file, zipfile.ZipFile(file, 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr('versions.txt', versions())
        archive.writestr('check.txt', f'{table(seen, findings)}\n')
        for name, content in (
                ('check.json', as_json(seen, findings)), ('parameters.json', seen.parameters),
                ('diagnostics.json', {
                    node: asdict(status) for node, status in seen.statuses.items()})):
            archive.writestr(name, json.dumps(content, indent=1, default=str))
        for each in _files(recording) if recording else ():
            if each.stat().st_size <= MAX_RECORDING_SIZE:
                archive.write(each, f'recording/{each.name}')


def versions() -> str:
    """Return the versions of Python, the system and the installed packages, one per line."""
    packages = sorted(f'{each.name} {each.version}' for each in distributions())
    return '\n'.join([f'Python {platform.python_version()}', platform.platform(), *packages, ''])


def newest_recording(recordings: Path) -> Path | None:
    """Return the newest recording of the black box in a folder; None if there is none."""
    numbers = {path: int(name[1]) for path in recordings.glob('*_*')
               if (name := NAME.fullmatch(path.name)) and any(path.glob('*.mcap'))}
    return max(numbers, key=numbers.__getitem__, default=None)


def _files(recording: Path) -> list[Path]:
    """Return the YAML files of a bag and its newest file of messages."""
    if recording.is_file():
        return [recording]
    data = [file for file in recording.iterdir() if file.suffix in ('.mcap', '.db3')]
    return [*recording.glob('*.yaml'), *sorted(data, key=lambda file: file.stat().st_mtime)[-1:]]


if __name__ == '__main__':
    sys.exit(main())
