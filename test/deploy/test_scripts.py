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

"""What the service runs: it starts the launch file that is asked for, the bridge on its core."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess

import pytest

from flock_follower.system.fast_dds import PROFILE_VARIABLES

DEPLOY = Path(__file__).resolve().parents[2] / 'deploy'


def start(workspace: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(DEPLOY / 'start'), 'drone'], text=True, capture_output=True,
                          timeout=20.0, env={'PATH': os.environ['PATH'],
                                             'WORKSPACE': str(workspace), **variables})


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """Return a built workspace, whose ros2 prints what it is given."""
    (tmp_path / 'install').mkdir()
    (tmp_path / 'install' / 'setup.bash').write_text(f'export PATH={tmp_path}:$PATH\n')
    (tmp_path / 'ros2').write_text(
        f'#!/bin/sh\n[ "$1" = pkg ] && echo {tmp_path} && exit\nprintf "%s\\n" "$@"\n'
        'echo "$FASTDDS_DEFAULT_PROFILES_FILE"\necho "$FASTRTPS_DEFAULT_PROFILES_FILE"\n')
    (tmp_path / 'ros2').chmod(0o755)
    return tmp_path


def test_launch_file_and_arguments_are_those_of_settings(workspace: Path) -> None:
    ended = start(workspace, LAUNCH_FILE='camera.launch.py', LAUNCH_ARGUMENTS=(
        "recipe:=t265 odom:=/vio/odom camera_rpy:='[0.0, 0.2, 0.0]'  "
        "bridge_prefix:='taskset -c 3'"))
    assert ended.stdout.splitlines() == [
        'launch', 'flock_follower', 'camera.launch.py', 'recipe:=t265', 'odom:=/vio/odom',
        'camera_rpy:=[0.0, 0.2, 0.0]', 'bridge_prefix:=taskset -c 3', '', ''], ended.stderr


def test_without_peers_ros_keeps_to_the_loopback(workspace: Path) -> None:
    profile = workspace / 'config' / 'dds' / 'fastdds.xml'
    profile.parent.mkdir(parents=True)
    profile.touch()
    kilted, jazzy = PROFILE_VARIABLES
    for variables, profiles in (
            ({}, [str(profile)] * 2), ({jazzy: '/mine.xml'}, ['/mine.xml'] * 2),
            ({kilted: '/mine.xml'}, ['/mine.xml'] * 2),
            ({kilted: '/mine.xml', jazzy: '/old.xml'}, ['/mine.xml', '/old.xml']),
            ({'ROS_STATIC_PEERS': '10.0.0.2'}, ['', ''])):
        assert start(workspace, **variables).stdout.splitlines()[-2:] == profiles


def test_without_a_place_for_logs_it_starts_with_a_warning(workspace: Path) -> None:
    (workspace / 'ros2').write_text(f'#!/bin/sh\necho {workspace} "$ROS_LOG_DIR"\n')
    logs = workspace / 'logs'
    assert start(workspace, ROS_LOG_DIR=str(logs)).stdout.split() == [str(workspace), str(logs)]
    for folder in ('/proc/none', '/dev/full/none', str(workspace / 'ros2')):
        ended = start(workspace, ROS_LOG_DIR=folder)
        assert Path(ended.stdout.split()[1]).parent == Path('/dev/shm'), ended
        Path(ended.stdout.split()[1]).rmdir()
        assert f'ROS_LOG_DIR = {folder}' in ended.stderr


def test_unbuilt_workspace_is_named_with_its_file(tmp_path: Path) -> None:
    ended = start(tmp_path)
    assert ended.returncode == 1
    assert f'WORKSPACE = {tmp_path} in /etc/flock_follower/drone.env' in ended.stderr


def test_the_bridge_runs_all_the_same_where_it_is_not_allowed() -> None:
    ended = subprocess.run(
        ['setpriv', '--bounding-set=-sys_nice', '--inh-caps=-sys_nice', 'prlimit', '--rtprio=0',
         str(DEPLOY / 'prefer_realtime'), '0', '7', 'sh', '-c', 'chrt -p $$ | head -1'],
        text=True, capture_output=True, timeout=20.0)
    if 'setpriv' in ended.stderr:
        pytest.skip('capabilities cannot be taken away here')
    assert 'SCHED_OTHER' in ended.stdout and ended.returncode == 0
    assert 'cannot run at the real-time priority 7' in ended.stderr
