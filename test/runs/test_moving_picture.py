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

"""The moving picture of a flight."""

import io
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('matplotlib')
Image = pytest.importorskip('PIL.Image')
moving_picture = pytest.importorskip('flock_desk.runs.moving_picture').moving_picture


def test_it_has_eight_pictures_a_second_without_estimate_too():
    times = np.arange(31) / 30
    estimated = np.where(times < 0.5, np.nan, 2.0)
    table = {'time': times, 'true_distance': np.full(31, 2.0), 'distance': estimated,
             'visible': np.ones(31)}
    follower = np.outer(times, [0.3, 0.1, 0.0])
    leader, level = follower + np.array([2.0, 0.0, 0.0]), np.tile([0.0, 0.0, 0.0, 1.0], (31, 1))
    record = SimpleNamespace(
        name='leader', duration=1.0, table=table, paths={'leader': leader, 'follower': follower},
        params=SimpleNamespace(law=SimpleNamespace(d0=1.0, d1=8.0)),
        scenario=SimpleNamespace(prints=()),
        log={'leader_position': leader, 'follower_position': follower,
             'leader_quaternion': level, 'follower_quaternion': level})
    picture = Image.open(io.BytesIO(moving_picture(record)))
    assert picture.format == 'WEBP' and picture.n_frames == 8 and picture.width == 900
