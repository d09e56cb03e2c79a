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
Run the suite, as ``make test`` does: what computes, then what waits for nodes in real time.

At ordinary priority, so it goes on beside other work; the halves do not disturb each other. Every
20 s a line reports tests done, their number, the time left, and the log. A test of nodes that
failed while other programs had the processors may have failed for that: it is repeated alone at
the end, and that result counts. Exit code 0 if all passed, 1 if one failed, 3 if only tests failed
that were too busy alone, too.

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
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PROGRESS = 20.0  # s between two lines
PYTEST = [sys.executable, '-m', 'pytest', '--timeout', '600', '--timeout-method', 'thread']
PARALLEL = ['-n', '2', '--dist', 'loadfile', '--no-loadscope-reorder']
#: Where conftest.py writes how far a run is.
STATUS = 'FLOCK_FOLLOWER_TEST_STATUS'
TOO_BUSY = 3


def main(args: Sequence[str] | None = None) -> int:
    """Run the tests and return the exit code."""
    parser = argparse.ArgumentParser(prog='suite', description='Run the tests, with progress.')
    parser.add_argument('tests', nargs='*', metavar='TEST', help='default: all')
    parser.add_argument('-m', dest='markers', default='', help='which: an expression of markers')
    options = parser.parse_args(args)
    if options.tests or options.markers:
        chosen = [*options.tests, *(['-m', options.markers] if options.markers else [])]
        runs = {'test': [*PARALLEL, *chosen]}
    else:
        runs = {'test-computing': [*PARALLEL, '-m', 'not ros and not sweep'],
                'test-nodes': [*PARALLEL, '-m', 'ros and not sweep']}
    codes, again = [], list[str]()
    for name, arguments in runs.items():
        code, status = run(name, arguments)
        busy = status.get('busy', [])
        # Without a count of the failed ones something else went wrong.
        explained = code == 1 and 0 < status.get('failed', 0) == len(busy)
        codes.append(0 if explained else code)
        again += busy
    if again:
        print(f'{len(again)} tests failed while other programs had the processors: again, alone',
              flush=True)
        code, status = run('test-again', [*again, '-p', 'no:xdist'])
        busy = len(status.get('busy', []))
        too_busy = code == 1 and 0 < status.get('failed', 0) == busy
        codes.append(TOO_BUSY if too_busy else code)
        if too_busy:
            print(f'too busy: {busy} tests failed alone, too, while other programs had the '
                  'processors: close them, and test again', flush=True)
    failed = [code for code in codes if code not in (0, TOO_BUSY)]
    return failed[0] if failed else max(codes)


def run(name: str, arguments: Sequence[str]) -> tuple[int, dict[str, Any]]:
    """Run pytest with progress; return its exit code, and what conftest.py wrote."""
    log, state = ROOT / 'build' / f'{name}.log', ROOT / 'build' / f'{name}.json'
    log.parent.mkdir(exist_ok=True)
    state.unlink(missing_ok=True)
    began = due = time.monotonic()
    with open(log, 'wb') as output, subprocess.Popen(
            [*PYTEST, '-v', *arguments], cwd=ROOT, stdout=output, stderr=subprocess.STDOUT,
            env={**os.environ, STATUS: str(state)}) as child:
        try:
            while child.poll() is None:
                if time.monotonic() >= due:
                    due += PROGRESS
                    print(progress(name, status_of(state), time.monotonic() - began, log),
                          flush=True)
                time.sleep(0.2)
        except KeyboardInterrupt:
            child.wait()
            raise
    text = log.read_text(encoding='utf-8', errors='replace')
    if child.returncode:
        print(text, flush=True)
    else:
        print(f'{name}: {text.strip().splitlines()[-1].strip("= ")}; log: {relative(log)}',
              flush=True)
    return child.returncode, status_of(state)


def progress(name: str, status: dict[str, Any], elapsed: float, log: Path) -> str:
    """Return the line: tests done, their number, the time left by the mean so far."""
    done, total = status.get('done', 0), status.get('total', 0)
    left = f'about {clock(elapsed / done * (total - done))} left' if done else 'just begun'
    counted = f'{done} of {total} done' if total else 'collecting'
    return (f'{name}: {counted}, {status.get("failed", 0)} failed, {clock(elapsed)} so far, '
            f'{left}; log: {relative(log)}')


def status_of(path: Path) -> dict[str, Any]:
    """Return the status that conftest.py wrote last, {} before the first."""
    try:
        status = json.loads(path.read_text(encoding='utf-8'))
    except (OSError, ValueError):  # not yet, or just being written
        return {}
    return dict(status)


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds."""
    return f'{int(seconds) // 60}:{int(seconds) % 60:02d}'


def relative(path: Path) -> Path:
    """Return a path as a user of this folder would write it."""
    return path.relative_to(ROOT)


if __name__ == '__main__':
    sys.exit(main())
