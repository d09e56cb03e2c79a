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

"""The tables of the nodes: one camera or several, the folder of the black box, the gate."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from flock_follower.bags.parameter_table import BLACK_BOX, recordings_folder
from flock_follower.gate.envelope import GateLimits
from flock_follower.mavlink.parameter_table import MAVLINK_BRIDGE
from flock_follower.parameters.cameras import cameras
from flock_follower.parameters.files import parse_parameters, read_parameters
from flock_follower.parameters.flight_names import FLIGHT_NAMES
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.parameters.spec import check_values
from flock_follower.perception.parameter_table import tracker
from flock_follower.planner.parameter_table import planner_params
from flock_follower.system.files import resource

BUILT = {'relative_pose': tracker, 'planner': planner_params}


def values(**parameters: Any) -> dict[str, dict[str, Any]]:
    return parse_parameters({'/**': {'ros__parameters': parameters}}, TABLE)


def two(**left: Any) -> dict[str, Any]:
    return {'cameras': ['front', 'left'],
            'camera': {'left': {'rpy': [0.0, 0.0, 1.0], **left}}}


def test_one_camera_needs_no_name() -> None:
    for node in BUILT:
        (one,) = cameras(values(camera_rpy=[0.0, 0.1, 0.0])[node])
        assert (one.name, one.image, one.camera_info) == ('', 'image_raw', 'camera_info')
        assert one.rpy == [0.0, 0.1, 0.0]


def test_several_have_parameters_of_their_own_in_both_nodes() -> None:
    reported = values(**two(image='/left/mono', time_offset=0.01))
    for node in BUILT:
        front, left = cameras(reported[node])
        assert (front.name, front.image, front.camera_info) == (
            'front', 'front/image_raw', 'front/camera_info')
        assert (left.image, left.images('compressed')) == ('/left/mono', '/left/mono/compressed')
        assert (left.rpy, left.position, left.time_offset) == (
            [0.0, 0.0, 1.0], [0.1, 0.0, 0.0], 0.01)
    mounted = tracker(reported['relative_pose']).cameras
    assert list(mounted) == ['front', 'left']
    assert mounted['left'].time_offset.applied == 0.01
    # What it looks at, and the right of its image, are so on the body.
    assert mounted['left'].T_body_camera.rotation[:, 2] == pytest.approx(
        [0.5403, 0.8415, 0.0], abs=1e-4)


@pytest.mark.parametrize(('given', 'message'), [
    ({'camera_rpy': [0.0, 0.0, 90.0]}, r'camera_rpy = .* in \[-6\.28319, 6\.28319\] rad'),
    (two(rpy=[0.0, 0.0, 90.0]), r'camera\.left\.rpy = .* in \[-6\.28319, 6\.28319\] rad'),
    (two(position=[100.0, 0.0, 0.0]), r'camera\.left\.position = .* in \[-10, 10\] m')])
def test_degrees_and_millimeters_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        values(**given)


@pytest.mark.parametrize('key', ['image', 'camera_info'])
@pytest.mark.parametrize('topic', ['', '/', 'left-1/image', '1st', 'a//b', 'a b', 'a/'])
def test_name_that_is_no_topic_is_refused(key: str, topic: str) -> None:
    with pytest.raises(ValueError, match=rf"camera\.left\.{key} = '{topic}': must be the name"):
        cameras(values(**two(**{key: topic}))['relative_pose'])


def test_the_example_is_taken_and_holds_all_that_a_camera_has() -> None:
    reported = read_parameters(resource('config/two_cameras.yaml'), TABLE)
    for node, build in BUILT.items():
        build(reported[node])
        assert [camera.name for camera in cameras(reported[node])] == ['front', 'left']


@pytest.mark.parametrize(('folder', 'home', 'namespace', 'expected'), [
    ('', '', '/', Path.home() / '.ros/flock_follower/black_box'),
    ('', '/ros', '/drone1', Path('/ros/flock_follower/black_box/drone1')),
    ('~/mine', '/ros', '/drone1', Path.home() / 'mine')])
def test_recordings_go_to_the_given_folder_or_that_of_ros(
        folder: str, home: str, namespace: str, expected: Path) -> None:
    given = check_values(BLACK_BOX, {'record_folder': folder})
    assert recordings_folder(given, home, namespace) == expected


def test_constants_of_the_gate_are_no_parameters() -> None:
    missing = {field.name for field in fields(GateLimits)} - {
        spec.name for spec in MAVLINK_BRIDGE}
    assert missing == {'brake_time', 'speed_horizon', 'blind_timeout'}


def test_a_user_without_a_home_folder_has_a_folder_of_recordings(
        monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless(_: Path) -> Path:
        raise RuntimeError('Could not determine home directory.')
    monkeypatch.setattr(Path, 'expanduser', homeless)
    usual = recordings_folder({'record_folder': ''}, '', '')
    assert usual == Path('/.ros/flock_follower/black_box')
    assert recordings_folder({'record_folder': '~/x'}, '', '') == Path('/x')


def test_the_names_of_flight_parameters_are_those_of_the_tables() -> None:
    declared = {spec.name for specs in TABLE.values() for spec in specs}
    assert declared == FLIGHT_NAMES, (
        f'parameters/flight_names.py: add {sorted(declared - FLIGHT_NAMES)}, '
        f'remove {sorted(FLIGHT_NAMES - declared)}')
