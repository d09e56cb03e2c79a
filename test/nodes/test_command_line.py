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
from pathlib import Path
import subprocess
import sys

import pytest

from flock_desk.parameter_tables import NODES
from flock_desk.program import PROGRAMS
from flock_desk.runs.processes import free_udp_port
from flock_follower.nodes.support.usage import asked_for, misplaced
from flock_follower.resources import resource

FOLLOWER = resource('config/follower.yaml')


def run(node: str, *arguments: str) -> tuple[int, str, str]:
    ended = subprocess.run([sys.executable, '-m', PROGRAMS[node], *arguments],
                           capture_output=True, text=True, timeout=20.0)
    return ended.returncode, ended.stdout, ended.stderr


@pytest.mark.parametrize('node', NODES)
def test_help_tells_what_a_node_is_and_its_parameters_and_starts_nothing(node: str) -> None:
    code, out, error = run(node, '--help')
    assert (code, error) == (0, '')
    module = import_module(PROGRAMS[node])
    assert out.startswith((module.__doc__ or '').strip().splitlines()[0].replace('``', ''))
    for spec in module.SPECS:
        assert f'\n  {spec.name} ' in out
    assert f'\nUsage: {node} [--ros-args -p NAME:=VALUE' in out and '/PARAMETERS.md:' in out
    assert run(node, '-h') == (code, out, error)


@pytest.mark.parametrize('command', ['call', 'recorder', 'check'])
def test_the_commands_have_help_too(command: str) -> None:
    code, out, error = run(command, '--help')
    assert (code, error) == (0, '') and out.startswith(f'usage: {command} ')


def test_help_is_asked_for_before_what_is_of_ros() -> None:
    assert asked_for(['planner', '-h']) and asked_for(['--help', '--ros-args'])
    assert not asked_for(['planner']) and not asked_for(['planner', '--ros-args', '-h'])


@pytest.mark.parametrize('arguments', [
    ['-p', 'v_max:=1.0'], ['v_max:=1.0'], ['--params-file', 'mine.yaml', '--ros-args']])
def test_what_ros_would_skip_without_a_word_ends_a_node(arguments: list[str]) -> None:
    code, _, error = run('planner', *arguments)
    assert (code, error) == (1, f'error: {arguments[0]}: must come after --ros-args, '
                                'as --ros-args -p v_max:=1.0\n')


def test_a_bag_and_what_is_of_ros_are_not_misplaced() -> None:
    assert not misplaced(['replay', 'bags/sample', '--ros-args', '-p', 'rate:=2.0'])


@pytest.mark.parametrize('node', ['planner', 'mavlink_bridge', 'relative_pose'])
def test_a_parameter_file_that_misses_the_node_ends_it(tmp_path: Path, node: str) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text(f'{node}s: {{ros__parameters: {{odom_twist_frame: odom}}}}')
    code, _, error = run(node, '--ros-args', '--params-file', str(path))
    assert (code, error) == (1, f'error: {path}: holds parameters for /{node}s, but none for '
                                f'/{node}: name the section /{node}, or /**/{node}\n')


def test_a_parameter_file_for_others_is_told() -> None:
    code, _, error = run('simulator', '--ros-args', '--params-file', str(FOLLOWER),
                         '-p', 'scenario:=nowhere.yaml', '-p',
                         f'connection:=127.0.0.1:{free_udp_port()}')
    assert code == 1
    assert 'holds no parameters for /simulator, only for /**/follower, /**/relative_pose, ' in (
        error.splitlines()[0])


def test_a_missing_package_of_ros_is_one_line() -> None:
    script = ('import sys; sys.argv = ["planner"]; sys.modules["std_srvs"] = None; '
              'import flock_follower.nodes.planner')
    ended = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True)
    assert ended.returncode == 1
    assert ended.stderr.startswith('error: ') and ended.stderr.count('\n') == 1
    assert 'std_srvs' in ended.stderr and 'is ROS 2 there' in ended.stderr
