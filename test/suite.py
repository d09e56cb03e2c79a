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
Run the suite, as ``make test`` does: flights of all nodes alone, and then all else, two by two.

Nothing computes beside the flights, which are in real time, and all have the ordinary priority:
both parts go on beside other work. Every 20 s a line reports the tests done, their number, the
time left, and the log. A test of nodes that failed while other programs had the processors may
have failed for that: it is repeated alone at the end, and that result counts. Exit code 0 if all
passed, 1 if one failed, 3 if only tests failed for which it was too busy alone, too.

``test/suite.py [TEST ...] [-m MARKERS]``: some tests only.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PROGRESS = 20.0  # s between two lines
PYTEST = (sys.executable, '-m', 'pytest', '--timeout', '600', '--timeout-method', 'thread', '-v')
PARALLEL = ('-n', '2', '--dist', 'loadfile', '--no-loadscope-reorder')
#: The parts of the whole suite, in this order: the name of the log, and what pytest is asked for.
PARTS = {'test-flights': ('-m', 'ros and slow and not sweep'),
         'test-others': (*PARALLEL, '-m', 'not (ros and slow) and not sweep')}
#: Where conftest.py writes how far a run is.
STATUS = 'FLOCK_FOLLOWER_TEST_STATUS'
FAILED, TOO_BUSY = 1, 3  # exit codes


class Status(NamedTuple):
    """How far a run is, as conftest.py writes it; ``busy`` are those of ``failed`` it excuses."""

    total: int = 0
    done: int = 0
    failed: int = 0
    busy: tuple[str, ...] = ()


class Run(NamedTuple):
    """The end of one run of pytest: its exit code and its status."""

    code: int
    status: Status

    @property
    def excused(self) -> bool:
        """Return whether each test that failed did so on a busy machine."""
        return self.code == FAILED and 0 < self.status.failed == len(self.status.busy)


def main(args: Sequence[str] | None = None) -> int:
    """Run the tests and return the exit code."""
    parser = argparse.ArgumentParser(prog='suite', description='Run the tests, with progress.')
    parser.add_argument('tests', nargs='*', metavar='TEST', help='default: all')
    parser.add_argument('-m', dest='markers', default='', help='which: an expression of markers')
    options = parser.parse_args(args)
    if options.tests or options.markers:
        markers = ('-m', options.markers) if options.markers else ()
        ended = [run('test', (*PARALLEL, *options.tests, *markers))]
    else:
        ended = [run(*part) for part in PARTS.items()]
    again = [test for each in ended for test in each.status.busy]
    alone = []
    if again:
        print(f'{len(again)} tests failed while other programs had the processors: again, alone',
              flush=True)
        alone = [run('test-again', again)]
    code = verdict(ended, alone)
    if code == TOO_BUSY:
        print('too busy: tests failed alone, too, while other programs had the processors: '
              'close them, and test again', flush=True)
    return code


def verdict(ended: Sequence[Run], alone: Sequence[Run]) -> int:
    """Return the exit code of the suite, of its runs and of those that repeat tests alone."""
    codes = [each.code for each in ended if not each.excused]
    codes += [TOO_BUSY if each.excused else each.code for each in alone]
    return next((code for code in codes if code not in (0, TOO_BUSY)), max(codes, default=0))


def run(name: str, arguments: Sequence[str]) -> Run:
    """Run pytest with arguments and a log of that name, with progress."""
    build = ROOT / 'build'
    build.mkdir(exist_ok=True)
    status = build / f'{name}.json'
    status.unlink(missing_ok=True)
    due = began = time.monotonic()
    with open(build / f'{name}.log', 'wb') as log, subprocess.Popen(
            [*PYTEST, *arguments], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT,
            env=environment(status)) as child:
        while child.poll() is None:  # Ctrl-C reaches it, too; it ends, and is waited for
            if time.monotonic() >= due:
                due += PROGRESS
                print(progress(name, read_status(status), time.monotonic() - began), flush=True)
            time.sleep(0.2)
    text = (build / f'{name}.log').read_text(encoding='utf-8', errors='replace')
    if child.returncode:  # from the failures on, if it came so far
        print(text[max(text.find('= FAILURES ='), text.find('= ERRORS ='), 0):], flush=True)
    else:
        print(f'build/{name}.log: {text.strip().splitlines()[-1].strip("= ")}', flush=True)
    return Run(child.returncode, read_status(status))


def environment(status: Path) -> dict[str, str]:
    """Return the environment of a run that writes its status to a file."""
    # Hundreds of processes load the same modules: each is compiled once, whoever starts the suite.
    kept = {name: value for name, value in os.environ.items() if name != 'PYTHONDONTWRITEBYTECODE'}
    return {**kept, STATUS: str(status)}


def progress(name: str, status: Status, elapsed: float) -> str:
    """Return a line: tests done, their number, the time left if they go on so, and the log."""
    left = (f'about {clock(elapsed * (status.total / status.done - 1.0))} left' if status.done
            else 'collecting')
    return (f'{clock(elapsed)}: {status.done} of {status.total if status.done else "?"} tests '
            f'done, {status.failed} failed, {left}; build/{name}.log')


def read_status(path: Path) -> Status:
    """Return the status that conftest.py wrote last; that of the beginning before the first."""
    try:
        written = json.loads(path.read_text(encoding='utf-8'))
    except FileNotFoundError:
        return Status()
    return Status(written['total'], written['done'], written['failed'], tuple(written['busy']))


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds."""
    return f'{int(seconds) // 60}:{int(seconds) % 60:02d}'


if __name__ == '__main__':
    sys.exit(main())
