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

"""Ctrl-C, at any moment of a node's life, ends it within 2 s and without a traceback."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest

from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    wait_until,
)
from flock_follower.system.files import resource

MOMENTS = (0.8, 2.5)  # s: during the imports or at the start, and in flight
WRITER = """
import os
from flock_follower.nodes.support.output import never_block_output
never_block_output()
for _ in range(64):
    try:
        os.write(1, bytes(65536))
    except BlockingIOError:
        os._exit(7)
"""
STUCK = """
import ctypes
import sys
sys.argv = ['planner']  # a program, by that name
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.support.process import run, spin

class Stuck(Planner):
    def destroy_node(self):
        print('hangs', flush=True)
        ctypes.PyDLL(None).sleep(60)  # keeps the GIL, as Fast DDS does

def spin_and_say(node):
    print('spins', flush=True)
    spin(node)

run(Stuck, spin=spin_and_say)
"""


def test_a_reader_that_stands_still_does_not_hold_a_node_up():
    read, write = os.pipe()
    try:
        child = subprocess.Popen([sys.executable, '-c', WRITER], stdout=write)
        assert child.wait(timeout=20.0) == 7
        assert os.get_blocking(write)  # only the child's own end was changed
    finally:
        os.close(read)
        os.close(write)


def test_shutdown_hanging_with_locked_interpreter_ends():
    stuck = subprocess.Popen([sys.executable, '-c', STUCK], stdout=subprocess.PIPE,
                             env=private_environment())
    try:
        assert stuck.stdout.readline() == b'spins\n'
        signaled = time.monotonic()
        stuck.send_signal(signal.SIGINT)
        assert stuck.stdout.readline() == b'hangs\n'
        assert stuck.wait(timeout=10.0) == -signal.SIGALRM
        assert time.monotonic() - signaled < 2.0
    finally:
        stuck.kill()
        stuck.communicate()


@pytest.mark.slow
def test_cycles_of_start_and_ctrl_c_are_clean(tmp_path):
    for cycle, delay in enumerate(MOMENTS):
        with Processes(private_environment(), tmp_path / str(cycle)) as processes:
            connection = f'connection:=udpin:127.0.0.1:{free_udp_port()}'
            for node, arguments in (
                    ('relative_pose', ['-p', 'image_transport:=compressed']),
                    ('planner', []),
                    ('mavlink_bridge', ['-p', connection]),
                    ('replay', ['-p', f'bag:={resource("bags/sample")}', '-p', 'loop:=true'])):
                processes.start(node, f'flock_follower.nodes.{node}', ['--ros-args', *arguments])
            moment = time.monotonic() + delay
            wait_until(lambda moment=moment: time.monotonic() > moment, 10.0, 'the moment')
            children = dict(processes.children)
            for child in children.values():
                child.send_signal(signal.SIGINT)
            # Python itself may swallow one before it has reached the package: then once more.
            with contextlib.suppress(TimeoutError):
                wait_until(lambda children=children: all(
                    child.poll() is not None for child in children.values()), 1.0, 'all to end')
            processes.stop_all(timeout=2.0)
            for node, code in ((node, child.returncode) for node, child in children.items()):
                if code == -signal.SIGINT:
                    continue  # Python had not reached the package yet: not ours to keep quiet
                # SIGALRM: Fast DDS hung, and the deadline ended it.
                assert code in (0, 130, -signal.SIGALRM), (cycle, node, code, processes.log(node))
                assert 'Traceback' not in processes.log(node), (cycle, node, processes.log(node))
