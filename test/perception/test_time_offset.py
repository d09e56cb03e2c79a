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

"""The camera's time offset: found, applied once sure, and not where there is none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from flock_follower.geometry import (
    quaternion_from_rpy,
    rotation_vector_to_matrix,
    Transform,
)
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception.camera_schedule import View
from flock_follower.perception.neighbor_filter import NeighborFilter
from flock_follower.perception.time_offset import SURE, TimeOffset

DT = 1.0 / 30.0
NOISE = np.array([0.002, 0.0006, 0.0006, 0.02, 0.02, 0.02])  # m, rad, of a measurement


class Own(NamedTuple):
    """One's own true motion: it rolls, pitches and yaws a little, as in any flight."""

    shaking: float = 1.0

    def at(self, t: float) -> OdometrySample:
        s = self.shaking
        roll, pitch, yaw = (s * 0.05 * np.sin(11.0 * t), s * 0.04 * np.sin(13.0 * t + 1.0),
                            s * 0.15 * np.sin(1.7 * t))
        rates = s * np.array([0.55 * np.cos(11.0 * t), 0.52 * np.cos(13.0 * t + 1.0),
                              0.255 * np.cos(1.7 * t)])
        return OdometrySample(t, np.array([0.4 * t, 0.1 * np.sin(t), 1.5]),
                              quaternion_from_rpy(roll, pitch, yaw),
                              np.array([0.4, 0.1 * np.cos(t), 0.0]), rates,
                              np.array([0.4 * t, 0.1 * np.sin(t), 1.5]))


def leader(t: float) -> Transform:
    return Transform(np.eye(3), np.array([2.0 + 0.4 * t, 0.3 * np.sin(0.7 * t), 1.6]))


def flown(offset: float, seconds: float, estimated: TimeOffset, own: Own | None = None,
          seed: int = 1) -> tuple[list[float], NeighborFilter]:
    """
    Return what was applied after each image, and the filter, of a flight with such an offset.

    The images' stamps are DT apart; each is exposed ``offset`` later.
    """
    own = own or Own()
    rng, tracker, applied = np.random.default_rng(seed), NeighborFilter(), []
    for k in range(round(seconds / DT)):
        stamp = k * DT
        seen_from = own.at(stamp + offset).smooth_pose
        error = NOISE * rng.standard_normal(6)
        true = seen_from.inverse() @ leader(stamp + offset)
        T_own_leader = Transform(rotation_vector_to_matrix(error[3:]) @ true.rotation,
                                 true.translation + error[:3])
        view = View.of(own.at(stamp + estimated.applied), Transform(), 0.0)
        body = view.own.smooth_pose @ T_own_leader
        turn = np.kron(np.eye(2), view.own.smooth_pose.rotation)
        tracker.update(stamp, body, np.zeros(3), turn @ np.diag(NOISE**2) @ turn.T)
        moving = view.moving(body.translation - view.own.travel)
        if tracker.step is None:
            estimated.begin('leader', moving)
        else:
            change = estimated.take('leader', tracker.step, moving)
            tracker.shift(change * estimated.following('leader'))
        applied.append(estimated.applied)
    return applied, tracker


@pytest.mark.parametrize('offset', [-0.03, 0.005, 0.02])
def test_an_offset_is_found_within_its_deviation_and_applied(offset: float) -> None:
    found = TimeOffset()
    applied, _ = flown(offset, 6.0, found)
    assert found.applied == found.estimate
    assert found.deviation < 0.001
    assert abs(found.estimate - offset) < 2.0 * found.deviation
    assert applied[0] == 0.0
    first = next(a for a in applied if a)
    assert abs(first - offset) < SURE * 4.0  # it was sure


def test_large_offsets_are_applied_within_a_second_or_two() -> None:
    applied, _ = flown(0.02, 2.0, TimeOffset())
    assert abs(applied[-1] - 0.02) < 0.003


@pytest.mark.parametrize('seed', range(4))
def test_without_an_offset_nothing_is_applied(seed: int) -> None:
    found = TimeOffset()
    applied, _ = flown(0.0, 8.0, found, seed=seed)
    assert set(applied) == {0.0}
    assert abs(found.estimate) < 3.0 * found.deviation


def test_one_who_does_not_turn_cannot_tell_and_says_so() -> None:
    found = TimeOffset()
    applied, _ = flown(0.02, 4.0, found, Own(shaking=0.0))
    assert set(applied) == {0.0}
    assert found.deviation > SURE


def test_what_is_fixed_is_neither_estimated_nor_altered() -> None:
    found = TimeOffset(0.01, fixed=True)
    applied, _ = flown(0.02, 4.0, found)
    assert set(applied) == {0.01}
    known = TimeOffset(0.02)
    applied, _ = flown(0.02, 4.0, known)
    assert max(abs(a - 0.02) for a in applied) < 0.002


def test_no_offset_beyond_the_limit_is_applied() -> None:
    found = TimeOffset()
    found.know(-0.5, 1e8)
    assert found.apply() == found.applied == -0.2


def test_what_the_offset_did_to_the_state_is_gone_with_the_image_that_makes_it_known() -> None:
    applied, _ = flown(0.02, 4.0, TimeOffset())
    moment = next(i for i, a in enumerate(applied) if a)
    states = []
    for offset in (TimeOffset(0.02, fixed=True), TimeOffset(), TimeOffset(0.0, fixed=True)):
        _, tracker = flown(0.02, (moment + 1) * DT + 1e-6, offset)
        estimate = tracker.predict(moment * DT)
        assert estimate is not None
        states.append(np.concatenate([estimate.position, 0.1 * estimate.velocity]))
    known, found, without = states
    assert np.linalg.norm(found - known) < 0.3 * np.linalg.norm(without - known)
    assert np.linalg.norm(without - known) > 0.01


def test_what_is_known_and_applied_is_told_in_words() -> None:
    found = TimeOffset()
    assert found.describe == '0.0 +- 60.0 ms, not applied: 0.0 ms is'
    flown(0.02, 4.0, found)
    assert found.describe.startswith(('19.', '20.'))
    assert found.describe.endswith(' ms, applied')
    assert TimeOffset(0.012, fixed=True).describe == '12.0 ms, as configured'
