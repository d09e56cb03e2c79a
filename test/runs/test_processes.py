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
    claim_domain,
    DOMAINS,
    explained,
    LateError,
    Processes,
    TOO_BUSY_EXIT_CODE,
    TooBusyError,
    wait_until,
)
from flock_desk.runs.record import clear, locked
from flock_follower.checks.processor import Load

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
@pytest.mark.usefixtures('default_hangup')
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


BUSY, QUIET = Load(0.5, 1.5, 2), Load(0.01, 0.1, 2)


@pytest.mark.parametrize('error', [LateError('too late'), TimeoutError('too late')])
def test_late_data_is_excused_by_load_alone(error: Exception) -> None:
    with pytest.raises(TooBusyError, match='^too late: for 50% of the worst 2 s'), explained(BUSY):
        raise error
    for load in (QUIET, None):  # unknown is not busy
        with pytest.raises(type(error)), explained(load):
            raise error


def test_a_fault_that_no_load_explains_is_none_of_it() -> None:
    with pytest.raises(RuntimeError, match='^planner ended early$'), explained(BUSY):
        raise RuntimeError('planner ended early')


@pytest.mark.ros
def test_a_broken_child_is_named_whatever_the_load(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('flock_desk.runs.processes.LoadMeter.worst', lambda *_: BUSY)
    with pytest.raises(RuntimeError, match='^node was stopped by a signal$'), Processes(
            dict(os.environ), tmp_path) as processes:
        node = processes.start('node', 'timeit', ['-n1', '-r1', 'import time; time.sleep(600)'])
        processes.start('replay', 'timeit', ['-n1', '-r1', 'pass'], ends=True).wait()
        assert processes.broken() == ''
        node.send_signal(signal.SIGSTOP)
        wait_until(lambda: processes.broken() != '', 5.0, 'the stop')
        raise LateError('the service did not answer')


@pytest.mark.ros
def test_the_exit_code_tells_who_ended_when(tmp_path: Path) -> None:
    with Processes(dict(os.environ), tmp_path) as processes:
        for name, ends in (('replay', True), ('planner', False)):
            processes.start(name, 'timeit', ['-n1', '-r1', 'pass'], ends=ends).wait()
        node = processes.start('stopped', 'timeit', [
            '-n1', '-r1', 'import time; print(1, flush=True); time.sleep(600)'])
        processes.wait_for_log('stopped', '1')  # it handles SIGINT, as a node does
        node.send_signal(signal.SIGSTOP)
        # It should not have ended yet; a stopped process waits for no processor.
        assert processes.stop_all(timeout=0.2) == {'stopped': None, 'planner': 1, 'replay': 0}


class Starved:
    """A child that is cut off after a while by the alarm of a node."""

    pid, returncode = 7, -signal.SIGALRM

    def __init__(self) -> None:
        self._polls = iter([None] * 4)

    def poll(self) -> int | None:
        return next(self._polls, self.returncode)

    def send_signal(self, number: int) -> None:
        assert number == signal.SIGINT

    def wait(self, timeout: float) -> None:
        raise subprocess.TimeoutExpired('', timeout)


@pytest.mark.parametrize(('waited', 'code'), [
    (60.0, TOO_BUSY_EXIT_CODE), (0.0, -signal.SIGALRM)])
def test_process_that_waited_to_its_deadline_is_late_not_faulty(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waited: float, code: int) -> None:
    monkeypatch.setattr('flock_desk.runs.processes.longest_wait', lambda *_: waited)
    processes = Processes({}, tmp_path)
    processes.children['node'] = Starved()  # type: ignore[assignment]
    assert processes.stop('node') == code


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
    assert ours | theirs <= set(DOMAINS) <= set(range(1, 101))


def test_no_domain_has_the_port_of_the_truth():
    """By DDSI-RTPS 9.6.2 the first node on domain 48 listens on 7400 + 250 * 48 + 10 = 19410."""
    assert 48 not in DOMAINS and len(DOMAINS) == 99
