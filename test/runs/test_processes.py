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

from flock_follower.processes import claim_domain, wait_until

PROGRAM = """
import os, pathlib, sys, time
from flock_follower.processes import Processes
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


@pytest.mark.ros
def test_no_two_claims_give_one_domain():
    ours = {claim_domain() for _ in range(5)}
    other = subprocess.run(
        [sys.executable, '-c', 'from flock_follower.processes import claim_domain\n'
         'print(*(claim_domain() for _ in range(50)))'],
        stdout=subprocess.PIPE, text=True, check=True)
    theirs = set(map(int, other.stdout.split()))
    assert len(ours) == 5 and len(theirs) == 50 and not ours & theirs
    assert ours | theirs <= set(range(1, 101))
