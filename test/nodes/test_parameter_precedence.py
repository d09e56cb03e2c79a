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

import pytest
import rclpy

from flock_follower.nodes.planner import Planner
from flock_follower.parameters.files import given, read_parameters
from flock_follower.parameters.planner_table import SPECS

OWN = 'planner:\n  ros__parameters:\n    v_max: 0.9\n'
ALL = '/**:\n  ros__parameters:\n    v_max: 0.7\n'


def flown(*arguments: str) -> float:
    rclpy.init(args=['planner', '--ros-args', *arguments])
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
