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

"""Sensors in lock step: noise, field of view, occlusion, radio messages and ranges."""

from __future__ import annotations

import numpy as np
import pytest

from flock_desk.scenarios.scenario import RangeErrors
from flock_desk.sensors.sensing import (
    facing,
    hidden,
    in_view,
    PerceptionNoise,
    Radio,
    Radios,
    relative_noise,
)

SIDES = ['front', 'left', 'back', 'right']


def turned(*degrees: float) -> np.ndarray:
    """Return rotations about z (n, 3, 3)."""
    return np.array([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]] for angle in np.radians(degrees)
                     for c, s in [(np.cos(angle), np.sin(angle))]])


def test_noise_along_and_across_sight_has_documented_size() -> None:
    covariance = relative_noise(np.array([[1.2, 1.6, 0.0]]), PerceptionNoise())[0]
    along, across = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    assert np.sqrt(along @ covariance @ along) == pytest.approx(0.0003 + 0.0003 * 4.0)
    assert np.sqrt(across @ covariance @ across) == pytest.approx(0.0005 * 2.0)
    assert np.sqrt(covariance[2, 2]) == pytest.approx(0.001)


@pytest.mark.parametrize('yaw', [0.0, 90.0])
def test_the_camera_sees_vehicles_in_front_of_it(yaw: float) -> None:
    offsets = np.array([[2.0, 0.0, 0.0], [2.0, 0.9, 0.0], [2.0, 1.1, 0.0], [-2.0, 0.0, 0.0],
                        [2.0, 0.0, 0.7], [2.0, 0.0, 0.8], [0.2, 0.0, 0.0]])
    body = turned(*[yaw] * len(offsets))
    assert in_view(offsets @ body[0].T, body, PerceptionNoise()).tolist() == [
        True, True, False, False, True, False, False]


def test_each_camera_sees_its_side_four_wide_ones_all_round() -> None:
    angles = np.radians(np.arange(0.0, 360.0, 2.0))
    circle = 2.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    level, wide = turned(*[0.0] * len(circle)), PerceptionNoise(half_width=1.1, farthest=5.0)
    for k, side in enumerate(SIDES):
        assert in_view(circle[::45], level[::45], PerceptionNoise(), [side]).tolist() == [
            k == j for j in range(4)]
    assert in_view(circle, level, wide, SIDES).all()
    assert not in_view(circle, level, PerceptionNoise(), SIDES).all()
    assert not in_view(3.0 * circle, level, wide, SIDES).any()


@pytest.mark.parametrize(('yaw', 'side'), [(0, 'back'), (90, 'left'), (180, 'front'),
                                           (270, 'right')])
def test_each_face_shows_its_marker_to_its_side(yaw: float, side: str) -> None:
    offset = np.array([[2.0, 0.0, 0.0]])  # seen from behind
    assert [each for each in SIDES if facing(offset, turned(yaw), 0.7, [each])[0]] == [side]


def test_a_vehicle_between_hides_the_one_behind_it() -> None:
    line = np.array([[2.0, 0.0, 0.0], [4.0, 0.1, 0.0], [4.0, 1.0, 0.0], [-4.0, 0.0, 0.0]])
    there = np.ones(4, dtype=bool)
    assert hidden(line, there, 0.25).tolist() == [False, True, False, False]
    there[0] = False  # it is gone
    assert not hidden(line, there, 0.25).any()
    beside = np.array([[2.0, 0.26, 0.0], [4.0, 0.0, 0.0]])
    assert not hidden(beside, there[:2], 0.25).any()


def test_messages_arrive_late_in_own_flock_only_some_are_lost() -> None:
    radio = Radio[str](3, 0.25, 0.0, [np.random.default_rng(k) for k in range(6)])
    radio.send(1.0, 4, ['a', 'b'])
    assert radio.arrived(1.2) == []
    assert sorted(radio.arrived(1.25)) == [(3, 'a'), (3, 'b'), (5, 'a'), (5, 'b')]
    assert radio.arrived(2.0) == []
    lossy = Radio[int](2, 0.0, 0.3, [np.random.default_rng(k) for k in range(2)])
    lossy.send(0.0, 0, list(range(1000)))
    assert len(lossy.arrived(0.0)) == pytest.approx(700, abs=50)


def test_radios_err_as_the_scenario_says() -> None:
    errors = RangeErrors(20.0, noise=0.05, bias=0.1, bias_walk=0.0, outliers=0.1, outlier=1.0)
    radios = Radios(errors, [np.random.default_rng([run, 7]) for run in range(400)])
    measured = np.array([radios.measure(np.full(400, 3.0)) for _ in range(200)]) - 3.0
    bias = np.median(measured, axis=0)
    assert np.std(bias) == pytest.approx(0.1, rel=0.15)
    left = measured - bias
    assert np.std(left[np.abs(left) < 0.15]) == pytest.approx(0.05, rel=0.1)
    assert np.mean(left > 0.3) == pytest.approx(0.1 * 0.7, rel=0.1)
    assert np.mean(left < -0.3) < 1e-3
