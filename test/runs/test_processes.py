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

"""Children do not outlive the program that started them."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest

from flock_desk.runs.processes import (
    BUSY_SHARE,
    BUSY_WINDOW,
    claim_domain,
    SchedulingDelay,
    TooBusyError,
    wait_until,
)
from flock_desk.runs.record import clear, locked

PROGRAM = """
import os, pathlib, sys, time
from flock_desk.runs.processes import Processes
with Processes(dict(os.environ), pathlib.Path(sys.argv[1])) as processes:
    child = processes.start('sleeper', 'timeit', ['-n1', '-r1', 'import time; time.sleep(600)'])
    print(child.pid, flush=True)
    time.sleep(600)
"""


def lives(pid: int) -> bool:
    """Return whether a process runs, be it another's child."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.ros
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_children_end_with_the_program_that_started_them(tmp_path: Path, number: int):
    with subprocess.Popen([sys.executable, '-c', PROGRAM, str(tmp_path)], text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as program:
        assert program.stdout is not None
        child = int(program.stdout.readline())
        assert lives(child)
        program.send_signal(number)
        assert program.wait(10.0) != 0
        wait_until(lambda: not lives(child), 1.0, 'the child to end')


@pytest.mark.parametrize('share, busy', [(BUSY_SHARE - 0.02, False), (BUSY_SHARE + 0.02, True)])
def test_processes_that_wait_for_a_processor_end_the_flight(
        tmp_path: Path, share: float, busy: bool) -> None:
    children = tmp_path / '6' / 'task' / '6' / 'children'
    children.parent.mkdir(parents=True)
    children.write_text('7 ')
    delay = SchedulingDelay(6, tmp_path)

    def counters(thread: int, time: float, share: float) -> None:
        folder = tmp_path / '7' / 'task' / str(thread)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / 'schedstat').write_text(
            f'{round(5e8 * time * (1.0 - share))} {round(5e8 * time * share)} 3')

    counters(2, 0.0, 0.99)  # a thread that ends: what it did is over
    counters(1, 1e4, 0.99)  # what was before the flight does not count, either
    delay.check(0.0)
    (tmp_path / '7' / 'task' / '2' / 'schedstat').unlink()
    for seconds in range(1, 12):
        folder = tmp_path / '7' / 'task' / '1' / 'schedstat'
        ran, waited, _ = map(int, folder.read_text().split())
        folder.write_text(f'{ran + round(1e9 * (1 - share))} {waited + round(1e9 * share)} 3')
        if busy and seconds >= BUSY_WINDOW:
            with pytest.raises(TooBusyError, match='waited for a processor for 90%'):
                delay.check(seconds)
        else:
            delay.check(seconds)


def test_two_flights_do_not_write_to_one_folder(tmp_path: Path) -> None:
    folder = tmp_path / 'fly'
    with locked(folder), pytest.raises(RuntimeError, match='another flight writes to'), locked(
            folder):
        pass
    with locked(folder):
        (folder / 'record').mkdir()
        for name in ('record/record.mcap', 'planner.log', 'report.html', 'mine.txt'):
            (folder / name).touch()
        clear(folder)
        assert {path.name for path in folder.iterdir()} == {'.lock', 'mine.txt'}
    clear(tmp_path / 'nowhere')


@pytest.mark.ros
def test_no_two_claims_give_one_domain():
    ours = {claim_domain() for _ in range(5)}
    other = subprocess.run(
        [sys.executable, '-c', 'from flock_desk.runs.processes import claim_domain\n'
         'print(*(claim_domain() for _ in range(50)))'],
        stdout=subprocess.PIPE, text=True, check=True)
    theirs = set(map(int, other.stdout.split()))
    assert len(ours) == 5 and len(theirs) == 50 and not ours & theirs
    assert ours | theirs <= set(range(1, 101))
