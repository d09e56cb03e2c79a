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

"""Poses of another detector against their path: random honest sources, and small faults."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from flock_follower.checks.pose_path import (
    judge_path,
    MIN_OUTLIER,
    MIN_WINDOW_POSES,
    PosePath,
    WholeOdometry,
)
from flock_follower.geometry import Array, quaternion_from_rpy, quaternion_to_matrix
from flock_follower.odometry.buffer import OdometrySample

ODOMETRY_RATE = 50.0  # Hz


class Motion(NamedTuple):
    """Sums of sines: the neighbor moves, the follower follows and yaws, or stays level."""

    phases: Array
    turning: float = 1.0
    moving: float = 1.0

    def neighbor(self, t: float) -> Array:
        w = self.phases[:3]
        return np.array([2.2, 0.0, 1.6]) + self.moving * np.array(
            [0.4 * np.sin(0.5 * t + w[0]), 0.6 * np.sin(0.7 * t + w[1]), 0.1 * np.sin(t + w[2])])

    def own(self, t: float) -> tuple[Array, Array]:
        """Return place and attitude: it follows 0.6 s later, and turns towards the neighbor."""
        place = self.neighbor(t - 0.6) - [2.2, 0.0, 0.1]
        u, v = self.phases[3:5]
        return place, self.turning * np.array(
            [0.03 * np.sin(4.0 * t + u), 0.03 * np.sin(5.0 * t + v),
             0.2 * np.sin(1.9 * t + u) + 0.1 * np.sin(0.7 * t - 0.4)])

    def sighted(self, t: float) -> Array:
        place, rpy = self.own(t)
        return quaternion_to_matrix(quaternion_from_rpy(*rpy)).T @ (self.neighbor(t) - place)


def judged(seed: int, noise: float, rate: float, seconds: float = 20.0, offset: float = 0.0,
           outliers: float = 0.0, on_body: bool = True, gap: tuple[float, float] = (0.0, 0.0),
           **motion: Any) -> PosePath:
    """
    Return the judgment of poses whose stamps are ``offset``, s, before the exposures.

    :param outliers: the share of the poses that are off by 0.3 m in any direction.
    :param gap: the times between which there is no odometry, s.
    """
    random = np.random.default_rng(seed)
    flown = Motion(random.uniform(0.0, 6.28, 5), **motion)
    samples = []
    for t in np.arange(0.0, seconds + 1.0, 1.0 / ODOMETRY_RATE).tolist():
        place, rpy = flown.own(t)
        velocity = (flown.own(t + 1e-3)[0] - flown.own(t - 1e-3)[0]) / 2e-3
        if not gap[0] < t < gap[1]:
            samples.append(OdometrySample(
                t, place, quaternion_from_rpy(*rpy), velocity, np.zeros(3)))
    times = np.arange(0.5, seconds + 0.5, 1.0 / rate)
    points = np.array([flown.sighted(t) if on_body else flown.neighbor(t) for t in times])
    points += random.normal(0.0, noise, points.shape)
    away = random.normal(size=points.shape)
    away *= 0.3 / np.linalg.norm(away, axis=1, keepdims=True)
    points += away * (random.random(len(times)) < outliers)[:, None]
    return judge_path(times - offset, points, WholeOdometry(samples), on_body)


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize(('noise', 'rate'), [(0.01, 5.0), (0.03, 10.0), (0.1, 30.0)])
def test_honest_poses_have_neither_outliers_nor_an_offset(
        seed: int, noise: float, rate: float) -> None:
    found = judged(seed, noise, rate)
    assert found.outliers <= 0.01 * found.judged
    assert abs(found.offset) < 3.0 * found.deviation


@pytest.mark.parametrize('offset', [-0.05, 0.05])
@pytest.mark.parametrize(('noise', 'rate'), [(0.01, 5.0), (0.03, 10.0), (0.05, 30.0)])
def test_an_offset_of_stamps_is_found_within_its_deviation(
        offset: float, noise: float, rate: float) -> None:
    found = judged(1, noise, rate, offset=offset)
    assert found.deviation < 0.016 and abs(found.offset - offset) < 2.0 * found.deviation
    assert found.outliers <= 0.01 * found.judged


@pytest.mark.parametrize('noise', [0.0, 0.01, 0.03, 0.045])
def test_outliers_of_30_cm_are_found_but_for_those_in_noise(noise: float) -> None:
    share = [each.outliers / each.judged for each in (
        judged(seed, noise, 15.0, outliers=0.05) for seed in range(3))]
    assert 0.03 < np.mean(share) < 0.08
    visible = judged(0, noise, 15.0).visible
    assert visible < 0.3


def test_noise_in_which_outliers_hide_is_known() -> None:
    assert judged(0, 0.1, 15.0).visible > 0.3 > MIN_OUTLIER


@pytest.mark.parametrize('motion', [{'turning': 0.0, 'moving': 0.0}, {'on_body': False}])
def test_an_offset_that_moves_nothing_is_unknown(motion: dict[str, Any]) -> None:
    found = judged(0, 0.03, 10.0, offset=0.05, **motion)
    assert found.deviation > 0.05 and found.judged == 200


def test_poses_without_odometry_are_not_judged() -> None:
    whole, parted = judged(0, 0.03, 10.0), judged(0, 0.03, 10.0, gap=(8.0, 12.0))
    assert whole.judged == 200 and 150 < parted.judged < 165
    assert judged(0, 0.03, 10.0, seconds=0.1 * (MIN_WINDOW_POSES - 1)).judged == 0
    assert judge_path(np.zeros(0), np.zeros((0, 3)), WholeOdometry([]), True) == PosePath()
