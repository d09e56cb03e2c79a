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

"""The tables of the black box and of the bridge."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from flock_follower.mavlink.envelope import GateLimits
from flock_follower.parameters import black_box_table, mavlink_bridge_table
from flock_follower.parameters.spec import check_values


@pytest.mark.parametrize(('folder', 'home', 'namespace', 'expected'), [
    ('', '', '/', Path.home() / '.ros/flock_follower/black_box'),
    ('', '/ros', '/drone1', Path('/ros/flock_follower/black_box/drone1')),
    ('~/mine', '/ros', '/drone1', Path.home() / 'mine')])
def test_recordings_go_to_the_given_folder_or_that_of_ros(
        folder: str, home: str, namespace: str, expected: Path) -> None:
    values = black_box_table.build(
        check_values(black_box_table.SPECS, {'record_folder': folder}))
    assert black_box_table.folder(values, home, namespace) == expected


def test_constants_of_the_gate_are_no_parameters() -> None:
    missing = {field.name for field in fields(GateLimits)} - {
        spec.name for spec in mavlink_bridge_table.SPECS}
    assert missing == {'brake_time', 'speed_horizon', 'blind_timeout'}
