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

"""SIGHUP and Ctrl-C at every moment, for every node and program; nodes that cannot write logs."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import pty
import random
import signal
import subprocess
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from wire import Wire

from flock_desk.program import NODES as ALL_NODES
from flock_desk.program import PROGRAMS
from flock_desk.runs.processes import free_udp_port, private_environment, Processes, wait_until
from flock_follower import signals
from flock_follower.nodes.support.process import unwritable_logs
from flock_follower.system.files import resource

pytestmark = pytest.mark.usefixtures('default_hangup')
#: Instead of the library that a program imports first: sends it a signal, and waits for the end.
STUB = """
import os, signal, time
os.kill(os.getpid(), signal.Signals[os.environ['SIGNAL']])
for _ in range(5 if 'NOHUP' in os.environ else 200):
    time.sleep(0.1)  # Python handles a signal between two calls
print('went on', flush=True)
os._exit(7)
"""
#: Environments in which no log can be written, each for its own reason.
NO_LOGS = ({'HOME': ''}, {'ROS_LOG_DIR': '/proc/none'}, {'ROS_HOME': '/dev/null'})
#: Nodes, each with its arguments; the bridge, whose end is a flight's, has a test of its own.
NODES = {
    'relative_pose': ['--ros-args', '-p', 'image_transport:=compressed'], 'planner': [],
    'flock': ['--ros-args', '-p', 'vehicle_name:=one'],
    'replay': [str(resource('bags/sample')), '--ros-args', '-p', 'loop:=true'],
    'visualizer': [], 'black_box': [], 'view': ['--ros-args', '-p', 'port:=0'],
    'simulator': ['--ros-args', '-p', f'connection:=127.0.0.1:{free_udp_port()}']}


@pytest.fixture
def programs(tmp_path: Path) -> Iterator[dict[str, list[str]]]:
    """Give the command of every program, which gets a signal while it imports."""
    for library in ('cv2', 'numpy', 'rclpy', 'yaml', 'builtin_interfaces', 'diagnostic_msgs',
                    'nav_msgs', 'std_srvs'):
        (tmp_path / f'{library}.py').write_text(STUB)
    yield {**{name: ['-m', module] for name, module in PROGRAMS.items()},
           'flock_follower planner': ['-m', 'flock_desk.program', 'planner']}


def ends(tmp_path: Path, programs: dict[str, list[str]], number: signal.Signals,
         nohup: bool = False) -> dict[str, tuple[int, str, str]]:
    """Return the exit code and the output of each program that got a signal while it imports."""
    environment = {**private_environment(), 'SIGNAL': number.name, 'PYTHONPATH': str(tmp_path)}
    prefix = []
    if nohup:
        environment['NOHUP'], prefix = 'yes', ['nohup']
    running = {name: subprocess.Popen(
        [*prefix, sys.executable, *command], env=environment, text=True,
        cwd=Path(__file__).parents[2], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE) for name, command in programs.items()}
    return {name: (process.returncode, *output) for name, process in running.items()
            if (output := process.communicate(timeout=60.0))}


def test_a_program_that_is_ended_while_it_imports_prints_nothing(
        tmp_path: Path, programs: dict[str, list[str]]) -> None:
    for name, (code, out, error) in ends(tmp_path, programs, signal.SIGINT).items():
        assert code in (-signal.SIGINT, 128 + signal.SIGINT), (name, code, error)
        assert (out, error) == ('', ''), name


@pytest.mark.parametrize('nohup', [False, True])
def test_a_node_outlives_its_terminal_under_nohup_alone(
        tmp_path: Path, programs: dict[str, list[str]], nohup: bool) -> None:
    nodes = {name: programs[name] for name in ('mavlink_bridge', 'flock_follower planner')}
    expected = (7, 'went on\n') if nohup else (128 + signal.SIGTERM, '')
    for name, (code, out, _) in ends(tmp_path, nodes, signal.SIGHUP, nohup).items():
        assert (code, out) == expected, name


def test_a_signal_that_nohup_ignores_ends_no_program(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert signals.ending() == (signal.SIGINT, signal.SIGTERM)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert signals.ending() == (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def test_logs_that_cannot_be_written_are_found_before_ros_fails(tmp_path: Path) -> None:
    file = tmp_path / 'file'
    file.touch()
    assert unwritable_logs({'HOME': str(tmp_path)}) == ''
    assert (tmp_path / '.ros' / 'log').is_dir()
    assert unwritable_logs({'ROS_HOME': str(tmp_path)}) == ''
    assert unwritable_logs({'ROS_LOG_DIR': str(tmp_path), 'HOME': '/proc/none'}) == ''
    for environment in ({}, {'HOME': ''}, {'HOME': '/proc/none'}, {'ROS_HOME': '/proc/none'},
                        {'ROS_LOG_DIR': str(file)}, {'ROS_LOG_DIR': '/proc'},
                        {'ROS_LOG_DIR': '/dev/full/logs'}, {'ROS_LOG_DIR': '~/x'}):
        assert unwritable_logs(environment), environment


class Reports(Node):
    """Notes which nodes have reported on /diagnostics."""

    def __init__(self) -> None:
        super().__init__('reports')
        self.seen: set[str] = set()
        self.create_subscription(DiagnosticArray, '/diagnostics', lambda message: self.seen.update(
            status.name for status in message.status), 50)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def have(self, names: set[str]) -> bool:
        """Return whether all names have reported."""
        self._executor.spin_once(timeout_sec=0.05)
        return names <= self.seen


def start_on_terminal(command: list[str], environment: dict[str, str]
                      ) -> tuple[subprocess.Popen[bytes], int]:
    """Start a program that leads a session on a terminal of its own; return our end, too."""
    ours, its = pty.openpty()
    child = subprocess.Popen(
        ['setsid', '--ctty', *command], env=environment, stdin=its, stdout=its, stderr=its)
    os.close(its)
    os.set_blocking(ours, False)
    return child, ours


def test_sighup_ends_every_node_at_any_time(ros: None, tmp_path: Path) -> None:
    assert {*ALL_NODES} - {*NODES} == {'mavlink_bridge'}  # see below
    chance, reports = random.Random(44), Reports()
    with contextlib.ExitStack() as stack:
        stack.callback(reports.destroy_node)
        processes = stack.enter_context(Processes(private_environment(), tmp_path))
        for k, (name, arguments) in enumerate(NODES.items()):
            processes.environment = {**private_environment(), **NO_LOGS[k % len(NO_LOGS)]}
            processes.start(name, PROGRAMS[name], arguments)
        processes.start('recorder', PROGRAMS['recorder'], [
            str(tmp_path / 'bag'), 'odom:nav_msgs/msg/Odometry'])
        processes.start('call', PROGRAMS['call'], ['no/such', '--timeout', '60'])
        wait_until(lambda: reports.have({*NODES}), 60.0, 'all nodes')
        processes.wait_for_log('recorder', 'recording odom')
        for child in processes.children.values():
            moment = time.monotonic() + chance.uniform(0.0, 0.1)
            wait_until(lambda moment=moment: time.monotonic() > moment, 10.0, 'the moment')
            child.send_signal(signal.SIGHUP)
        for name, child in processes.children.items():
            # SIGALRM: Fast DDS hung, and the deadline ended it. Interrupted, `call` fails.
            code = child.wait(timeout=10.0)
            assert code in (130 if name == 'call' else 0, -signal.SIGALRM), (name, code)
            assert 'Traceback' not in processes.log(name), name
            assert 'logs go to the terminal alone: ' in processes.log(name), name
        processes.children.clear()


def test_a_bridge_whose_terminal_is_closed_hands_over(tmp_path: Path) -> None:
    port = free_udp_port()
    wire, environment = Wire(port), private_environment()
    try:
        with Processes(environment, tmp_path) as processes:
            bridge, terminal = start_on_terminal(
                [sys.executable, '-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args', '-p',
                 f'connection:=udpin:127.0.0.1:{port}', '-p', 'velocity_source:=autopilot', '-p',
                 'require_failsafe:=false'], {**environment, **NO_LOGS[0]})
            processes.children['bridge'] = bridge
            processes.ask('/mavlink_bridge/offboard', 40.0)
            assert not wire.modes
            os.close(terminal)
            wait_until(lambda: wire.modes, 5.0, 'the request of the hold mode')
            assert bridge.wait(timeout=10.0) in (0, -signal.SIGALRM)
            processes.children.clear()
    finally:
        wire.close()
