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

"""How the nodes answer on the command line: help, and what cannot be started."""

from __future__ import annotations

from importlib import import_module
import os
from pathlib import Path
import subprocess
import sys
from unittest import mock

import pytest

from flock_desk.parameter_tables import NODES
from flock_desk.program import PROGRAMS
from flock_follower.nodes.support.node_parameters import ValidatedNode
from flock_follower.nodes.support.usage import asked_for, misplaced

ROOT = Path(__file__).resolve().parents[2]
BRIDGE = 'connection:=udpin:127.0.0.1:0'


def run(node: str, *arguments: str) -> int:
    """Run a node in this process, where it ends by itself; return its exit code."""
    with mock.patch.dict(os.environ), mock.patch.object(  # some set how DDS is to talk
            ValidatedNode, 'parameter_files', ()):
        return int(import_module(PROGRAMS[node]).main([node, *arguments]))


@pytest.mark.parametrize('node', NODES)
def test_help_tells_what_a_node_is_and_its_parameters_and_starts_nothing(
        node: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(node, '--help') == 0
    out, error = capsys.readouterr()
    assert error == '' and f'\nUsage: {node} [--ros-args -p NAME:=VALUE' in out
    for spec in import_module(PROGRAMS[node]).SPECS:
        assert f'\n  {spec.name} ' in out


def test_which_words_of_a_command_line_are_whose() -> None:
    assert asked_for(['planner', '-h']) and asked_for(['--help', '--ros-args'])
    assert not asked_for(['planner']) and not asked_for(['planner', '--ros-args', '-h'])
    assert not misplaced(['replay', 'bags/sample', '--ros-args', '-p', 'rate:=2.0'])


@pytest.mark.parametrize(('node', 'arguments', 'said'), [
    ('planner', '-p v_max:=1.0', '-p: must come after --ros-args, as'),
    ('planner', 'v_max:=1.0', 'v_max:=1.0: must come after --ros-args, as'),
    ('planner', '--params-file mine.yaml --ros-args', '--params-file: must come after'),
    ('planner', '--ros-args -p a_max:=-1.0', 'a_max = -1.0: must be a number in [0.1, 20] m/s^2'),
    ('relative_pose', '--ros-args -p neighbors_file:=/nowhere.yaml', '/nowhere.yaml'),
    ('relative_pose', '--ros-args -p neighbours_file:=x', 'unknown parameter neighbours_file'),
    ('mavlink_bridge', '--ros-args -p connection:=udp:nowhere', "connection = 'udp:nowhere'"),
    ('mavlink_bridge', f'--ros-args -p {BRIDGE} -p signing_key_file:=/nowhere', '/nowhere'),
    ('mavlink_bridge', f'--ros-args -p {BRIDGE} -p global_origin:=[91.0,8.5,4.0]', 'latitude'),
    ('mavlink_bridge', f'--ros-args -p {BRIDGE} -p forward_odometry:=true -r odom:=mavlink/odom',
     'forward_odometry = true: odom is the estimate of'),
    ('flock', '', "vehicle_name = ''"),
    ('flock', '--ros-args -p vehicle_name:=a/b', "vehicle_name = 'a/b'"),
    ('sharing', '--ros-args -p yaw_std_max:=4.0', 'yaw_std_max for node sharing: it was'),
    ('simulator', '--ros-args -p scenario:=outdor', "scenario = 'outdor': must be one of "),
    ('simulator', '--ros-args -p connection:=192.168.1.9:14540', 'must be a loopback address'),
    ('simulator', '--ros-args -p vehicle:=external -p leader_topic:=/ahead/truth/motion',
     "only with vehicle = 'embedded'")])
def test_what_cannot_be_started_is_one_line_and_exit_code_1(
        node: str, arguments: str, said: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(node, *arguments.split()) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith('error: ') and said in line


def test_a_parameter_file_that_misses_the_node_ends_it_or_is_told(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text('planners: {ros__parameters: {odom_twist_frame: odom}}')
    assert run('planner', '--ros-args', '--params-file', str(path)) == 1
    assert capfd.readouterr().err == (
        f'error: {path}: holds parameters for /planners, but none for /planner: name the section '
        '/planner, or /**/planner\n')
    assert run('simulator', '--ros-args', '--params-file', str(path), '-p', 'seed:=-1') == 1
    assert 'holds no parameters for /simulator, only for /planners' in capfd.readouterr().err


def test_a_missing_package_of_ros_is_one_line() -> None:
    script = ('import sys; sys.argv = ["planner"]; sys.modules["std_srvs"] = None; '
              'import flock_follower.nodes.planner')
    ended = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True)
    assert ended.returncode == 1 and ended.stderr.count('\n') == 1
    assert 'std_srvs' in ended.stderr and 'is ROS 2 there' in ended.stderr
