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

"""Which of two settings of one parameter counts: in a real node, and for who reads files."""

from __future__ import annotations

from pathlib import Path
import time
from unittest import mock

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
import rclpy
from rclpy.parameter import Parameter

from flock_desk.runs.processes import free_udp_port
from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.support.parameters import ValidatedNode
from flock_follower.parameters.files import files_in, given, read_parameters, TABLE
from flock_follower.parameters.planner_table import SPECS

OWN = 'planner:\n  ros__parameters:\n    v_max: 0.9\n'
FOLLOWER = '/**/follower:\n  ros__parameters:\n    v_max: 0.6\n    link_timeout: 2.0\n'
ALL = '/**:\n  ros__parameters:\n    v_max: 0.7\n'


def flown(*arguments: str) -> float:
    rclpy.init(args=['planner', '--ros-args', *arguments])
    with mock.patch.object(ValidatedNode, 'parameter_files',
                           files_in(['planner', '--ros-args', *arguments])):
        node = Planner()
    try:
        return float(node.get_parameter('v_max').value)
    finally:
        node.destroy_node()
        rclpy.shutdown()


@pytest.mark.parametrize(('text', 'value'), [(OWN + ALL, 0.7), (ALL + OWN, 0.9)])
def test_the_last_in_a_file_counts(text: str, value: float, tmp_path: Path) -> None:
    path = tmp_path / 'parameters.yaml'
    path.write_text(text)
    assert flown('--params-file', str(path)) == value
    assert read_parameters(path, {'planner': SPECS})['planner']['v_max'] == value
    assert given(path, '/planner')['v_max'] == value


@pytest.mark.parametrize('text', [OWN, ALL])
def test_the_last_on_the_command_line_counts(text: str, tmp_path: Path) -> None:
    path = tmp_path / 'parameters.yaml'
    path.write_text(text)
    in_file = 0.9 if text == OWN else 0.7
    assert flown('--params-file', str(path), '-p', 'v_max:=0.3') == 0.3
    assert flown('-p', 'v_max:=0.3', '--params-file', str(path)) == in_file


@pytest.mark.parametrize(('text', 'value'), [
    (FOLLOWER, 0.6), (FOLLOWER + OWN, 0.9), (OWN + FOLLOWER, 0.9)])
def test_the_section_follower_counts_least(text: str, value: float, tmp_path: Path) -> None:
    path = tmp_path / 'parameters.yaml'
    path.write_text(text)
    assert flown('--params-file', str(path)) == value
    assert flown('-p', 'v_max:=0.3', '--params-file', str(path)) == (
        0.3 if text == FOLLOWER else 0.9)
    assert read_parameters(path, TABLE)['planner']['v_max'] == value


@pytest.mark.parametrize(('values', 'said'), [
    ({'v_max': 0.5, 'a_max': 2.5, 'altitude_max': 100.0}, ''),
    ({'v_max': None, 'a_max': None}, ''),
    ({'v_max': 0.7, 'a_max': 2.5}, 'v_max = 0.7 of the planner, but 0.5 of mavlink_bridge'),
    ({'v_max': 0.5, 'a_max': 1.0}, 'a_max = 1 of the planner, but 2.5 of mavlink_bridge'),
    ({'altitude_max': 40.0}, 'altitude_max = 40 m of the planner is wider than height_max = 10')])
def test_limits_of_the_planner_that_differ_are_a_warning(
        values: dict[str, float], said: str) -> None:
    rclpy.init()
    node = MavlinkBridge(parameter_overrides=[
        Parameter('connection', value=f'udpin:127.0.0.1:{free_udp_port()}')])
    try:
        node._report.planner_changed(values)
        found = [text for level, text in node.diagnostics.problems(time.monotonic())
                 if level == DiagnosticStatus.WARN and 'of the planner' in text]
        assert bool(found) == bool(said) and said in ''.join(found)
    finally:
        node.destroy_node()
        rclpy.shutdown()
