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

"""Simulated sensing: its filter is the real one, its noise what it says it is."""

from __future__ import annotations

import numpy as np
import pytest

from flock_desk.scenarios.courses import wind_course
from flock_desk.scenarios.scenario import Wind
from flock_desk.sensors.sensing import (
    in_view,
    PerceptionNoise,
    relative_noise,
)
from flock_desk.sensors.vio import turned


def test_noise_along_and_across_the_line_of_sight_is_what_the_figures_say() -> None:
    offset = np.array([[1.2, 1.6, 0.0]])
    covariance = relative_noise(offset, PerceptionNoise())[0]
    along, across = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    assert np.sqrt(along @ covariance @ along) == pytest.approx(0.0003 + 0.0003 * 4.0)
    assert np.sqrt(across @ covariance @ across) == pytest.approx(0.0005 * 2.0)
    assert np.sqrt(covariance[2, 2]) == pytest.approx(0.001)


def test_the_camera_sees_what_is_in_front_of_it() -> None:
    offsets = np.array([[2.0, 0.0, 0.0], [2.0, 0.9, 0.0], [2.0, 1.1, 0.0], [-2.0, 0.0, 0.0],
                        [2.0, 0.0, 0.7], [2.0, 0.0, 0.8], [0.2, 0.0, 0.0]])
    level = np.tile(np.eye(3), (len(offsets), 1, 1))
    assert in_view(offsets, level, PerceptionNoise()).tolist() == [
        True, True, False, False, True, False, False]
    left = turned(offsets, np.full(len(offsets), np.pi / 2))
    yawed = np.tile(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), (7, 1, 1))
    assert np.array_equal(in_view(left, yawed, PerceptionNoise()),
                          in_view(offsets, level, PerceptionNoise()))


def test_gusts_have_their_size_and_steady_wind_a_direction_of_its_own_each_run() -> None:
    calm = wind_course(Wind((2.0, 2.0), 0.0), 100, 0.05, np.random.default_rng(1))
    assert np.linalg.norm(calm, axis=1) == pytest.approx(2.0)
    assert not calm[:, 2].any()
    gusty = wind_course(Wind((0.0, 0.0), 1.0, 2.0), 40_000, 0.05, np.random.default_rng(1))
    assert gusty.std(axis=0) == pytest.approx([1.0, 1.0, 0.5], rel=0.15)
    lag = round(2.0 / 0.05)
    assert np.corrcoef(gusty[lag:, 0], gusty[:-lag, 0])[0, 1] == pytest.approx(
        np.exp(-1.0), abs=0.1)
