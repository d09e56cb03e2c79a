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

"""If a parameter is set twice, the last one wins: in a real node, and for readers of files."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import pytest
import rclpy

from flock_follower.nodes.planner import Planner
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.files import read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.parameters.sections import files_in

OWN = 'planner:\n  ros__parameters:\n    v_max: 0.9\n'
ALL = '/**:\n  ros__parameters:\n    v_max: 0.7\n    link_timeout: 2.0\n'


def flown(*arguments: str) -> float:
    rclpy.init(args=['planner', '--ros-args', *arguments])
    with mock.patch.object(FlockNode, 'parameter_files',
                           files_in(['planner', '--ros-args', *arguments])):
        node = Planner()
    try:
        assert not node.has_parameter('link_timeout')  # of the bridge
        return float(node.get_parameter('v_max').value)
    finally:
        node.destroy_node()
        rclpy.shutdown()


@pytest.mark.parametrize(('text', 'arguments', 'value'), [
    (OWN + ALL, '{}', 0.7), (ALL + OWN, '{}', 0.9),
    (OWN, '{} -p v_max:=0.3', 0.3), (ALL, '{} -p v_max:=0.3', 0.3),
    (OWN, '-p v_max:=0.3 {}', 0.9), (ALL, '-p v_max:=0.3 {}', 0.7)])
def test_the_last_setting_counts(
        text: str, arguments: str, value: float, tmp_path: Path) -> None:
    path = tmp_path / 'parameters.yaml'
    path.write_text(text)
    assert flown(*arguments.format(f'--params-file {path}').split()) == value
    if arguments == '{}':
        assert read_parameters(path, TABLE)['planner']['v_max'] == value
