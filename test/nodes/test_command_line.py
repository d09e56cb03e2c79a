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

"""The nodes on the command line: help, and what cannot be started."""

from __future__ import annotations

from importlib import import_module
import os
from pathlib import Path
import subprocess
import sys
from unittest import mock

import pytest
import rclpy
from rclpy.node import Node

from flock_desk.program import NODES, PROGRAMS
from flock_follower.nodes.support import process
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.system.files import resource

BRIDGE = 'connection:=udpin:127.0.0.1:0'
SAMPLE = str(resource('bags/sample'))
#: Of Kilted, of which a variable is set for Jazzy.
PROFILE_WARNING = 'FASTRTPS_DEFAULT_PROFILES_FILE value is used'


def run(node: str, *arguments: str) -> int:
    """Run a node that ends by itself in this process; return its exit code."""
    named = [] if node in ('replay', 'flock_desk.recorder_node') else [node]
    with mock.patch.dict(os.environ), mock.patch.object(  # some set the transport of DDS
            FlockNode, 'parameter_files', ()):
        return int(import_module(PROGRAMS.get(node, node)).main([*named, *arguments]))


@pytest.mark.parametrize('node', NODES)
def test_help_describes_node_and_parameters_starts_nothing(
        node: str, capsys: pytest.CaptureFixture[str]) -> None:
    for option in ('--help', '-h'):
        assert run(node, option) == 0
        out, error = capsys.readouterr()
        assert error == '' and f'\nUsage: {node} [--ros-args -p NAME:=VALUE' in out
        for spec in import_module(PROGRAMS[node]).SPECS:
            assert f'\n  {spec.name} ' in out


def test_node_is_destroyed_after_spin_not_by_signal() -> None:
    order = []

    class Noted(Node):
        def destroy_node(self) -> None:
            order.append('destroyed')
            super().destroy_node()

    def spin(_: Noted) -> None:
        rclpy.get_default_context().try_shutdown()  # what the handler of a signal calls
        order.append('spun')
    assert process.run(lambda: Noted('noted'), [], spin) == 0
    assert order == ['spun', 'destroyed']


def refused(capfd: pytest.CaptureFixture[str], node: str, *arguments: str) -> str:
    """Return the one line in which a node refuses to start."""
    assert run(node, *arguments) == 1
    lines = [line for line in capfd.readouterr().err.splitlines()
             if 'not played' not in line and PROFILE_WARNING not in line]
    assert len(lines) == 1 and lines[0].startswith('error: '), lines
    return lines[0]


@pytest.mark.parametrize(('node', 'arguments', 'said'), [
    ('planner', '-p v_max:=1.0', '-p: must come after --ros-args, as'),
    ('planner', 'v_max:=1.0', 'v_max:=1.0: must come after --ros-args, as'),
    ('planner', '--params-file mine.yaml --ros-args', '--params-file: must come after'),
    ('planner', '--ros-args -p a_max:=-1.0', 'a_max = -1.0: must be a number in [1.5, 20] m/s^2'),
    ('relative_pose', '--ros-args -p neighbors_file:=/nowhere.yaml', '/nowhere.yaml'),
    ('relative_pose', '--ros-args -p neighbor_file:=x', 'unknown parameter neighbor_file'),
    ('mavlink_bridge', '--ros-args -p connection:=udp:nowhere', "connection = 'udp:nowhere'"),
    ('mavlink_bridge', f'--ros-args -p {BRIDGE} -p signing_key_file:=/nowhere', '/nowhere'),
    ('mavlink_bridge', f'--ros-args -p {BRIDGE} -p global_origin:=[91.0,8.5,4.0]', 'latitude'),
    ('mavlink_bridge', f'--ros-args -p {BRIDGE} -p forward_odometry:=true -r odom:=mavlink/odom',
     'forward_odometry = true: odom is the estimate of'),
    ('flock', '', "vehicle_name = ''"),
    ('flock', '--ros-args -p vehicle_name:=a/b', "vehicle_name = 'a/b'"),
    ('sharing', '--ros-args -p yaw_std_max:=4.0', 'yaw_std_max for node sharing: it was'),
    ('simulator', '--ros-args -p scenario:=outdor', "scenario = 'outdor': must be one of "),
    ('simulator', '--ros-args -p scenari:=indoor', 'did you mean scenario?'),
    ('simulator', '--ros-args -p connection:=192.168.1.9:14540', 'must be a loopback address'),
    ('simulator', '--ros-args -p vehicle:=external -p leader_topic:=/ahead/truth/motion',
     "not with vehicle = 'external'"),
    ('simulator', '--ros-args -p leader_truth_connection:=udpin:127.0.0.1:19411',
     "not with vehicle = 'embedded'"),
    ('simulator', '--ros-args -p vehicle:=external -p truth_connection:=udpin:127.0.0.1:0 '
     '-p leader_truth_connection:=tcp:5772', "'tcp:5772': must be udpin:HOST:PORT"),
    ('replay', '', 'no bag given; usage: replay BAG'),
    ('replay', '/nowhere/none', 'none: no such bag'),
    ('replay', f'{SAMPLE} --ros-args -p topics:=[vio]', 'holds no topic /vio, only /'),
    ('replay', f'{SAMPLE} --ros-args -p start:=5000.0', 'start = 5000: must be in [0'),
    ('replay', f'{SAMPLE} --ros-args -p remap:=[odom]', 'remap as ROS does: -r odom:=vio'),
    ('flock_desk.recorder_node', '{tmp} words:zoo_msgs/msg/Animal', "'zoo_msgs/msg/Animal': not"),
    ('flock_desk.recorder_node', '{tmp} words:std_msgs/String', "type 'std_msgs/String': not"),
    ('flock_desk.recorder_node', '{tmp} words:', "message type '': not installed, or not PACKAGE"),
    ('flock_desk.recorder_node', '{tmp} words:std_msgs/msg/__name__', 'not installed, or not'),
    ('flock_desk.recorder_node', '{tmp} two?words:std_msgs/msg/String', 'Invalid topic name: ')])
def test_a_start_that_fails_is_one_line_and_exit_code_1(
        node: str, arguments: str, said: str, tmp_path: Path,
        capfd: pytest.CaptureFixture[str]) -> None:
    assert said in refused(capfd, node, *arguments.format(tmp=tmp_path / 'bag').split())
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize('fault', ['missing', 'unreadable', 'a folder'])
@pytest.mark.parametrize(('node', 'option'), [
    *((node, f'{"-p " + BRIDGE if node == "mavlink_bridge" else ""} -p {spec.name}:=')
      for node in NODES for spec in import_module(PROGRAMS[node]).SPECS
      if spec.name.endswith('_file')),
    ('planner', '--params-file '), ('simulator', '-p scenario:='), ('replay', '-p bag:=')])
def test_a_file_that_cannot_be_read_is_refused_by_name(
        node: str, option: str, fault: str, tmp_path: Path,
        capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'mine.yaml'
    if fault == 'unreadable':
        path.symlink_to('/proc/self/mem')
    elif fault == 'a folder':
        path.mkdir()
    assert str(path) in refused(capfd, node, '--ros-args', *f'{option}{path}'.split())


def test_wrong_scenario_is_refused_with_file_key_and_values(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text('summary: mine\nleader:\n  motion: loop\n')
    assert f"{path}: leader.motion = 'loop': must be one of legs, circle" in refused(
        capfd, 'simulator', '--ros-args', '-p', f'scenario:={path}')


def test_parameter_file_without_node_ends_it_or_warns(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text('planners: {ros__parameters: {odom_twist_frame: odom}}')
    assert refused(capfd, 'planner', '--ros-args', '--params-file', str(path)) == (
        f'error: {path}: holds parameters for /planners, but none for /planner: name the section '
        '/planner, or /**/planner')
    assert run('simulator', '--ros-args', '--params-file', str(path), '-p', 'seed:=-1') == 1
    assert 'holds no parameters for /simulator, only for /planners' in capfd.readouterr().err


def test_a_missing_package_of_ros_is_one_line() -> None:
    script = ('import sys; sys.argv = ["planner"]; sys.modules["std_srvs"] = None; '
              'import flock_follower.nodes.planner')
    ended = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True)
    assert ended.returncode == 1 and ended.stderr.count('\n') == 1
    assert 'std_srvs' in ended.stderr and 'source ROS 2' in ended.stderr
