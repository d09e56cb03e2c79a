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
Put one bug at a time into a copy of the package, and check that a test fails with it.

``test/seeded_bugs.yaml`` lists the bugs: of each source file the bugs in it, each with its name,
the text to replace, its replacement and the test that must fail. When code moves, only file, old
and new text change. ``python test/seeded_bugs.py stale`` takes the bugs with 'stale' in file or
name. The exit code is 0 only if every bug is caught.
"""

from __future__ import annotations

import argparse
from importlib.util import cache_from_source
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_suffix('.yaml')
NO_END = 300.0  # s
CAUGHT, SURVIVED = 1, 0  # exit codes of pytest


class Bug(NamedTuple):
    """One textual replacement, and the test that must fail with it."""

    file: str
    bug: str
    old: str
    new: str
    test: str


def read() -> list[Bug]:
    """Return all bugs of the table."""
    table = yaml.safe_load(TABLE.read_text(encoding='utf-8'))
    return [Bug(file, **entry) for file, entries in table.items() for entry in entries]


def run(tests: list[str], copy: Path) -> tuple[int, str]:
    """Return the exit code and the output of tests that import the copy of the package."""
    try:
        ended = subprocess.run(
            [sys.executable, '-m', 'pytest', '-x', '-q', '-p', 'no:cacheprovider',
             *tests], cwd=copy, capture_output=True, text=True, timeout=NO_END)
    except subprocess.TimeoutExpired:
        return CAUGHT, 'did not end'
    return ended.returncode, ended.stdout + ended.stderr


def judge(bug: Bug, copy: Path) -> str:
    """Return 'caught', 'survived', or what is wrong with the entry."""
    path = copy / bug.file
    source = path.read_text(encoding='utf-8') if path.is_file() else ''
    if (count := source.count(bug.old)) != 1:
        return f'the text is there {count} times' if count else 'the text is not there'
    try:
        _write(path, source.replace(bug.old, bug.new))
        code, output = run([bug.test], copy)
    finally:
        _write(path, source)
    known = {CAUGHT: 'caught', SURVIVED: 'survived'}
    return known.get(code) or f'the test does not run:\n{output}'


def _write(path: Path, source: str) -> None:
    path.write_text(source, encoding='utf-8')
    # Compiled code is told by size and whole seconds of its source: two bugs may share both.
    Path(cache_from_source(str(path))).unlink(missing_ok=True)


def main() -> int:
    """Judge the bugs, print the result of each, and return the exit code."""
    parser = argparse.ArgumentParser(description='Check that tests fail with known bugs.')
    parser.add_argument('only', nargs='?', default='', help='part of the file or name of a bug')
    only = parser.parse_args().only
    bugs = [bug for bug in read() if only in f'{bug.file}: {bug.bug}']
    if not bugs:
        parser.error(f'no bug of this name: {only}')
    start, caught = time.monotonic(), 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for path in ROOT.iterdir():
            if path.name == 'flock_follower':
                shutil.copytree(path, copy / path.name)
            elif not path.name.startswith('.') and path.name != 'build':
                (copy / path.name).symlink_to(path)
        code, output = run(list(dict.fromkeys(bug.test for bug in bugs)), copy)
        if code != SURVIVED:
            print(f'without any bug the tests must pass:\n{output}')
            return 1
        for bug in bugs:
            result = judge(bug, copy)
            caught += result == 'caught'
            print(f'{result:<9} {bug.file}: {bug.bug}', flush=True)
    print(f'{caught} of {len(bugs)} bugs caught in {time.monotonic() - start:.0f} s')
    return 0 if caught == len(bugs) else 1


if __name__ == '__main__':
    sys.exit(main())
