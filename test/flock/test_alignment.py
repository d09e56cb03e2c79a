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

"""Frames are aligned from any yaw and geometry, as exactly as reported, with loss and delay."""

from __future__ import annotations

import math

from made_up_flock import Conditions, LEADER, MadeUpFlock, Report
import numpy as np
import pytest

from flock_follower.messages import OdometryState


def flown(conditions: Conditions, seconds: float) -> MadeUpFlock:
    flock = MadeUpFlock(conditions)
    flock.run(seconds)
    return flock


def rms(records: list[Report]) -> float:
    return math.sqrt(np.mean(np.square(np.concatenate([r.errors for r in records]))))


@pytest.mark.parametrize(('shape', 'attitude_std'), [
    ('line', 0.0), ('ring', 0.0), ('side by side', 0.03), ('one sees the other', 0.03)])
def test_every_geometry_is_aligned_from_any_yaw(shape: str, attitude_std: float) -> None:
    flock = flown(Conditions(shape, 0, attitude_std=attitude_std), 7.0)
    followers = flock.names[1:]
    known = {LEADER, *followers} if any(0 in row for row in flock.sees) else {*followers}
    for name, sees in zip(followers, flock.sees[1:]):
        reported = {of: r for (who, of), r in flock.received.items() if who == name}
        assert reported.keys() == known - {name} - {flock.names[of] for of in sees}
        for record in reported.values():
            assert record.since is not None and record.since < (2.5 if attitude_std else 6.0)
        assert not reported or rms(list(reported.values())) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize('conditions', [
    Conditions('wedge', 1, sight_memory=1.0), Conditions('ring', 2, attitude_std=0.03),
    Conditions('side by side', 3, attitude_std=0.02, askew=0.06),
    Conditions('line', 1, loss=0.5, delay=0.3)], ids=lambda c: c.shape)
def test_what_is_claimed_of_frames_and_places_is_true(conditions: Conditions) -> None:
    """Errors of sightings that last, a marker askew, half of the messages lost, the rest late."""
    flock = flown(conditions, 10.0)
    assert 0.2 < np.mean(flock.nees) / 4.0 < 2.0
    chi2 = [c for r in flock.received.values() for c in r.chi2]
    assert 0.2 < np.mean(chi2) / 3.0 < 2.0


def test_sightings_of_something_else_are_neither_used_nor_sent() -> None:
    flock = flown(Conditions('line', 1, outliers=0.05, attitude_std=0.03), 8.0)
    assert flock.events['does not fit the alignment'] > 10
    errors = np.concatenate([r.errors for r in flock.received.values()])
    assert np.quantile(errors, 0.999) < 0.5


def test_yaw_of_hovering_ones_is_unknown_without_attitudes() -> None:
    flock = flown(Conditions('side by side', still=True), 12.0)
    assert flock.received == {}
    sender = flock.sharing['follower_1'].senders['follower_2']
    assert 'a vehicle must move' in sender.unusable_reason(flock.stamp(flock.time, ''))
    assert flock.events['not aligned with follower_2'] > 90
    seeing = flown(Conditions('side by side', still=True, attitude_std=0.03), 5.0)
    assert set(seeing.received) == {('follower_1', 'follower_2'), ('follower_2', 'follower_1')}


@pytest.mark.slow
@pytest.mark.parametrize('step', [0.3, 0.15])
def test_a_teller_whose_odometry_steps_is_aligned_anew(step: float) -> None:
    flock = flown(Conditions('line', 2, attitude_std=0.03), 4.0)
    flock.odometry[2] += [step, -step, 0.0]
    before = set(flock.received)
    flock.received.clear()
    flock.run(2.0)
    assert 'aligned anew with follower_2' in flock.events
    assert ('own odometry leapt' in flock.events) == (step > 0.2)
    assert max(max(r.errors) for r in flock.received.values()) < 0.4
    flock.received.clear()
    flock.run(3.0)
    assert before == set(flock.received)
    assert rms(list(flock.received.values())) < 0.1


@pytest.mark.slow
def test_a_sender_of_false_states_is_refused_and_harms_no_other() -> None:
    flock = flown(Conditions('wedge', 4, attitude_std=0.03), 4.0)
    rng = np.random.default_rng(0)

    def lie(name: str, message: OdometryState) -> list[OdometryState]:
        if name != 'follower_4':
            return [message]
        away = message.position + rng.uniform(-30.0, 30.0, 3)
        return [message._replace(position=away), message]
    flock.spoil = lie
    flock.received.clear()
    flock.run(5.0)
    honest = [r for (who, of), r in flock.received.items()
              if 'follower_4' not in (who, of)]
    assert honest and rms(honest) < 0.15
    assert not any(of == 'follower_4' and r.ticks > 10 for (_, of), r in flock.received.items())


def test_a_clock_that_is_ahead_is_refused_and_one_behind_is_told() -> None:
    flock = flown(Conditions('line', 0, attitude_std=0.03,
                             clocks={'follower_2': 0.2, 'follower_3': -0.3}), 5.0)
    assert flock.events['message from the future'] > 50
    senders = flock.sharing['follower_1'].senders
    assert 'clock is behind' in senders['follower_3'].slow and senders['follower_4'].slow == ''
    assert senders['follower_2'].unusable_reason(
        flock.stamp(flock.time, '')) == 'has a clock that is ahead'


@pytest.mark.slow
def test_words_continue_after_loss_with_their_uncertainty() -> None:
    chi2, spread = [], []
    for seed in range(2):
        flock = flown(Conditions('one sees the other', seed, attitude_std=0.03), 5.0)
        flock.sees[2] = []
        flock.run(20.0)
        record = flock.received['follower_1', 'follower_2']
        assert record.ticks > 230
        assert max(record.errors) < 0.6
        chi2 += record.chi2[-50:]
        frame = flock.sharing['follower_1'].senders['follower_2'].frame
        spread.append(frame.stds[0])
    assert 0.2 < np.mean(chi2) / 3.0 < 2.0
    # Both odometries walk by 2.5 cm/sqrt(s) on 3 axes, 0.27 m; 8 m on, the yaw adds to it.
    assert min(spread) > 0.27 and max(spread) < 0.45


def test_a_teller_that_falls_silent_is_heard_no_longer_than_said() -> None:
    flock = flown(Conditions('line', 0, attitude_std=0.03), 4.0)
    flock.silent.add('follower_4')
    flock.run(1.5)
    flock.received.clear()
    flock.run(1.0)
    assert flock.received and not any(of == 'follower_4' for _, of in flock.received)
