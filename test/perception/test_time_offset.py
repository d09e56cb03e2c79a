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

"""The clock offset of a camera: found within its deviation, applied once significant."""

from __future__ import annotations

from typing import NamedTuple

from marker_images import known
import numpy as np
import pytest

from flock_follower.geometry import quaternion_from_rpy, Transform
from flock_follower.odometry.buffer import OdometryBuffer, OdometrySample
from flock_follower.perception.neighbor_filter import NeighborFilter
from flock_follower.perception.neighbor_motion import POSITION
from flock_follower.perception.time_offset import TimeOffset

DT = 1.0 / 30.0
NOISE = 0.001  # m, of a measured point
AHEAD = 0.16  # s from an image's stamp to the newest odometry when it is processed


class Own(NamedTuple):
    """The true motion of the ego vehicle: it rolls, pitches and yaws a little."""

    shaking: float = 1.0

    def at(self, t: float) -> OdometrySample:
        s = self.shaking
        roll, pitch, yaw = (s * 0.02 * np.sin(11.0 * t), s * 0.02 * np.sin(13.0 * t + 1.0),
                            s * 0.15 * np.sin(1.7 * t))
        place = np.array([0.4 * t, 0.1 * np.sin(t), 1.5])
        return OdometrySample(t, place, quaternion_from_rpy(roll, pitch, yaw),
                              np.array([0.4, 0.1 * np.cos(t), 0.0]), np.zeros(3), place)


def leader(t: float, reversing: float = 0.0) -> np.ndarray:
    return np.array([2.0 + 0.4 * t + reversing * np.sin(2.5 * t), 0.3 * np.sin(0.7 * t), 1.6])


def flown(offset: float, seconds: float, estimated: TimeOffset, own: Own | None = None,
          seed: int = 1, reversing: float = 0.0, rate: float = 200.0,
          noise: float = NOISE) -> list[float]:
    """
    Return the offset applied after each image of a flight with an offset.

    The images' stamps are DT apart; each is exposed ``offset`` later.

    :param rate: of the odometry, Hz.
    """
    own, odometry = own or Own(), OdometryBuffer()
    rng, applied, k = np.random.default_rng(seed), [], 0
    for stamp in np.arange(0.2, 0.2 + seconds, DT).tolist():
        while k / rate < stamp + AHEAD:
            odometry.add(own.at(k / rate))
            k += 1
        t = stamp + offset
        point = own.at(t).smooth_pose.inverse().apply(leader(t, reversing))
        estimated.take('leader', stamp, point + rng.normal(0.0, noise, 3), Transform(), odometry)
        applied.append(estimated.applied)
    return applied


@pytest.mark.parametrize('offset', [-0.1, -0.03, 0.01, 0.06, 0.1])
@pytest.mark.parametrize('reversing', [0.0, 0.1])
def test_an_offset_is_found_within_its_deviation_and_applied(offset: float,
                                                             reversing: float) -> None:
    found = TimeOffset()
    applied = flown(offset, 10.0, found, reversing=reversing)
    assert found.deviation < 0.003
    assert abs(found.estimate - offset) < 3.0 * found.deviation
    assert applied[0] == 0.0
    assert abs(applied[-1] - offset) < max(0.002, 3.0 * found.deviation)


@pytest.mark.parametrize('noise', [NOISE, 6.0 * NOISE])
def test_deviations_cover_the_errors(noise: float) -> None:
    normalized = []
    for seed in range(12):
        found = TimeOffset()
        flown(0.02, 5.0, found, seed=seed, rate=50.0, noise=noise)
        normalized.append((found.estimate - 0.02) / found.deviation)
    assert 0.2 < np.sqrt(np.mean(np.square(normalized))) < 1.3


def test_large_offsets_are_applied_within_two_seconds() -> None:
    applied = flown(0.06, 2.0, TimeOffset())
    assert abs(applied[-1] - 0.06) < 0.004


@pytest.mark.parametrize('shaking', [1.0, 0.05])
@pytest.mark.parametrize('seed', range(3))
def test_without_an_offset_nothing_is_applied(seed: int, shaking: float) -> None:
    found = TimeOffset()
    assert set(flown(0.0, 8.0, found, Own(shaking), seed=seed)) == {0.0}
    assert abs(found.estimate) < 3.0 * found.deviation


def test_one_who_does_not_turn_cannot_tell_and_says_so() -> None:
    found = TimeOffset()
    assert set(flown(0.02, 4.0, found, Own(shaking=0.0))) == {0.0}
    assert found.deviation > 0.02


def test_fixed_offset_is_kept_and_known_one_is_the_start() -> None:
    found = TimeOffset(0.01, fixed=True)
    assert set(flown(0.02, 4.0, found)) == {0.01} and found.describe == '10.0 ms applied'
    known = TimeOffset(0.02)
    assert max(abs(a - 0.02) for a in flown(0.02, 4.0, known)) < 0.002


def test_no_offset_beyond_the_limit_is_applied() -> None:
    found = TimeOffset(0.15)
    applied = flown(0.25, 6.0, found)
    assert found.estimate > 0.2
    assert max(applied) == applied[-1] == 0.2


def test_a_state_is_moved_as_the_offset_moves_it() -> None:
    track, moving = NeighborFilter(), np.zeros(15)
    moving[POSITION] = 0.3, -0.6, 0.1  # m/s
    for k in range(30):
        track.update(k * DT, Transform(translation=np.array([2.0, 0.0, 0.0])), np.zeros(3),
                     1e-6 * np.eye(6))
    before = known(track.newest)
    track.add_error(0.02 * moving, 0.02)
    after = known(track.newest)
    assert after.stamp == pytest.approx(before.stamp + 0.02)
    np.testing.assert_allclose(after.position - before.position, 0.02 * moving[POSITION])
    added = np.linalg.eigvalsh(after.covariance - before.covariance)
    assert added.min() > -1e-12
    assert np.trace((after.covariance - before.covariance)[3:6, 3:6]) > 0.01
