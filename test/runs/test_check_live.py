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

"""The command beside running nodes: the simulator as it is, and a desk with much amiss."""

from __future__ import annotations

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import pytest

from flock_desk.program import PROGRAMS
from flock_desk.runs.processes import claim_domain, free_udp_port, private_environment, Processes
from flock_follower.system.fast_dds import PROFILE_VARIABLES

pytestmark = pytest.mark.ros
#: What a busy machine makes late is no false alarm.
OF_THE_MACHINE = {'processor', 'images rate', 'images latency', 'odom rate', 'odom latency'}
DEADLINE = 60.0  # s for what takes a few


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each test a domain of its own: what other tests leave in the graph is told as amiss."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(claim_domain()))


def check(environment: dict[str, str], *arguments: str) -> tuple[int, dict[str, list[Any]]]:
    """Return the exit code, and the findings by what they are about."""
    ended = subprocess.run(
        [sys.executable, '-m', 'flock_follower.check', '--json', *arguments],
        env=environment, capture_output=True, text=True, timeout=DEADLINE)
    # Fast DDS 3 deprecates the variable that Fast DDS 2 needs.
    lines = [line for line in ended.stderr.splitlines() if PROFILE_VARIABLES[1] not in line]
    assert lines == []
    reported = json.loads(ended.stdout)
    found: dict[str, list[Any]] = {}
    for finding in reported['findings']:
        found.setdefault(finding['what'], []).append(finding)
    return ended.returncode, found


def amiss(found: dict[str, list[Any]], level: str) -> list[str]:
    return [what for what, findings in found.items() for f in findings if f['level'] == level]


@pytest.mark.slow
def test_of_the_simulator_nothing_is_amiss(tmp_path: Path) -> None:
    port = free_udp_port()
    with Processes(private_environment(int(os.environ['ROS_DOMAIN_ID'])), tmp_path) as processes:
        def start(name: str, *parameters: str) -> None:
            processes.start(name, PROGRAMS[name], [
                '--ros-args', *(word for p in parameters for word in ('-p', p))])
        start('simulator', f'connection:=127.0.0.1:{port}')
        start('mavlink_bridge', f'connection:=udpin:127.0.0.1:{port}')
        start('relative_pose')
        start('planner')
        processes.wait_for_log('relative_pose', 'camera: 640x480', DEADLINE)
        processes.wait_for_log('mavlink_bridge', 'are as recommended', DEADLINE)
        code, found = check(processes.environment, '--seconds', '4')
        errors = amiss(found, 'error')
        assert set(errors) <= OF_THE_MACHINE and code in (3, bool(errors)), found
        assert set(amiss(found, 'warning')) <= OF_THE_MACHINE, found.get('mavlink_bridge status')
        measured = {what: findings[0]['measured'] for what, findings in found.items()}
        assert measured['autopilot'].startswith('PX4')
        assert measured['ready for offboard'] == 'no obstacle'
        assert 'px wide, in 100%' in measured['marker']


def test_wrongly_started_nodes_are_reported_with_remedy(tmp_path: Path) -> None:
    with Processes(dict(os.environ), tmp_path) as processes:
        for name in ('first', 'second'):
            processes.start(name, PROGRAMS['planner'])
        processes.start('mavlink_bridge', PROGRAMS['mavlink_bridge'], [
            '--ros-args', '-p', 'use_sim_time:=true', '-p',
            f'connection:=udpin:127.0.0.1:{free_udp_port()}'])
        for name, text in (('first', 'IDLE'), ('second', 'IDLE'),
                           ('mavlink_bridge', 'waiting for system id')):
            processes.wait_for_log(name, text, DEADLINE)
        code, found = check(dict(os.environ), '--seconds', '4')
    assert code == 1
    for what, measured, advice in (
            ('nodes', 'twice: planner', 'end one of each'),
            ('command/trajectory', '2 publishers on /command/trajectory: /planner', 'end'),
            ('clock', 'use_sim_time is true in mavlink_bridge, but no node', 'without'),
            ('odom', 'no node publishes /odom', 'start its driver')):
        assert any(measured in f['measured'] and advice in f['advice'] and f['level'] == 'error'
                   for f in found.get(what, [])), (what, found.get(what, sorted(found)))


def test_an_empty_graph_is_one_line_and_ctrl_c_ends_it() -> None:
    environment = private_environment(int(os.environ['ROS_DOMAIN_ID']))
    code, found = check(environment, '--seconds', '1')
    assert code == 1 and list(found) == ['nodes']
    assert environment['ROS_DOMAIN_ID'] in found['nodes'][0]['measured']
    command = subprocess.Popen(
        [sys.executable, '-m', 'flock_follower.check', '--seconds', '60'], env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + DEADLINE
    while len(list(Path(f'/proc/{command.pid}/task').iterdir())) < 10:  # the middleware's
        assert time.monotonic() < end, 'check has not started its middleware'
        time.sleep(0.02)
    command.send_signal(signal.SIGINT)
    out, error = command.communicate(timeout=DEADLINE)
    lines = [line for line in error.splitlines()
             if 'FASTRTPS_DEFAULT_PROFILES_FILE' not in line]  # Kilted's warning
    assert (command.returncode, out, lines) == (130, '', ['interrupted'])


def test_without_ros_it_says_so() -> None:
    script = ('import sys; sys.modules["rclpy"] = None; '
              'from flock_follower.check import main; sys.exit(main(["--seconds", "1"]))')
    ended = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True)
    assert ended.returncode == 2 and 'source ROS 2' in ended.stderr
    assert ended.stderr.count('\n') == 1
