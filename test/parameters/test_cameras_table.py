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

"""Parameters of several cameras: what they say, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from flock_follower.files import resource
from flock_follower.parameters import planner_table, relative_pose_table
from flock_follower.parameters.cameras_table import cameras
from flock_follower.parameters.files import parse_parameters, read_parameters, TABLE

BOTH = {'relative_pose': relative_pose_table, 'planner': planner_table}


def values(**parameters: Any) -> dict[str, dict[str, Any]]:
    return parse_parameters({'/**': {'ros__parameters': parameters}}, TABLE)


def two(**left: Any) -> dict[str, Any]:
    return {'cameras': ['front', 'left'],
            'camera': {'left': {'rpy': [0.0, 0.0, 1.0], **left}}}


def test_one_camera_needs_no_name() -> None:
    for node in BOTH:
        (one,) = cameras(values(camera_rpy=[0.0, 0.1, 0.0])[node])
        assert (one.name, one.image, one.camera_info) == ('', 'image_raw', 'camera_info')
        assert one.rpy == [0.0, 0.1, 0.0]


def test_several_have_parameters_of_their_own_in_both_nodes() -> None:
    reported = values(**two(image='/left/mono', time_offset=0.01))
    for node in BOTH:
        front, left = cameras(reported[node])
        assert (front.name, front.image, front.camera_info) == (
            'front', 'front/image_raw', 'front/camera_info')
        assert (left.image, left.images('compressed')) == ('/left/mono', '/left/mono/compressed')
        assert (left.rpy, left.position, left.time_offset) == (
            [0.0, 0.0, 1.0], [0.1, 0.0, 0.0], 0.01)
    tracker = relative_pose_table.build(reported['relative_pose'])
    assert list(tracker.cameras) == ['front', 'left']
    assert tracker.cameras['left'].time_offset.applied == 0.01
    # What it looks at, and the right of its image, are so on the body.
    assert tracker.cameras['left'].T_body_camera.rotation[:, 2] == pytest.approx(
        [0.5403, 0.8415, 0.0], abs=1e-4)


def test_the_example_is_taken_and_holds_all_that_a_camera_has() -> None:
    reported = read_parameters(resource('config/two_cameras.yaml'), TABLE)
    for node, table in BOTH.items():
        table.build(reported[node])
        assert [camera.name for camera in cameras(reported[node])] == ['front', 'left']
