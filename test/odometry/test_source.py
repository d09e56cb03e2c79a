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


"""Odometry of every kind is read as the same motion of base_link, and what is wrong is told."""

from __future__ import annotations

import contextlib
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from rewritten_odometry import IMU_POSITION, IMU_RPY, rewrite, Source

from flock_follower.bags.message_types import empty
from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_to_matrix,
    Transform,
)
from flock_follower.messages import OdometryState, set_quaternion, set_vector
from flock_follower.messages.state_writer import odometry
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.odometry.static_frames import StaticFrames

START = 1_700_000_000_000_000_000
RATE = 100
IMU = SourceParams(child_position=IMU_POSITION, child_rpy=IMU_RPY)


def motion(t: float) -> tuple[Array, Array, Array, Array]:
    """Return position, attitude, velocity in odom and rates in the body of a lively flight."""
    def attitude(at: float) -> Array:
        return quaternion_from_rpy(0.1 * np.sin(2.0 * at), 0.08 * np.cos(1.5 * at), 0.9 * at)

    position = np.array([np.sin(0.7 * t), 1.2 * np.cos(0.5 * t), 1.5 + 0.2 * np.sin(t)])
    velocity = np.array([0.7 * np.cos(0.7 * t), -0.6 * np.sin(0.5 * t), 0.2 * np.cos(t)])
    R = quaternion_to_matrix(attitude(t))
    after, before = (quaternion_to_matrix(attitude(t + dt)) for dt in (1e-5, -1e-5))
    W = R.T @ (after - before) / 2e-5
    return position, attitude(t), velocity, np.array([W[2, 1], W[0, 2], W[1, 0]])


def message(t: float, position_noise: Array | None = None) -> Any:
    position, attitude, velocity, rates = motion(t)
    if position_noise is not None:
        position = position + position_noise
    return odometry(empty, START + round(t * 1e9), 'odom', 'base_link', position, attitude,
                    quaternion_to_matrix(attitude).T @ velocity, rates,
                    np.diag([1e-4] * 6), np.diag([4e-4] * 6))


def taken(source: OdometrySource, sent: Any, t: float) -> OdometryState:
    state = source.take(sent, START + round(t * 1e9))
    assert state is not None
    return state


def read(source: OdometrySource, kind: Source, seconds: float, rate: float = RATE,
         noise: float = 0.0, start: float = 0.0) -> list[tuple[float, OdometryState]]:
    """Return what a source makes of a flight that it joins at ``start``, s, with the times."""
    alter, rng = rewrite(kind), np.random.default_rng(0)
    return [(t, taken(source, alter(message(t, noise * rng.standard_normal(3)), t), t))
            for t in (start + np.arange(0.0, seconds - 1e-9, 1.0 / rate)).tolist()]


def first_second(kind: Source, start: float, rate: float, seconds: float = 1.0
                 ) -> tuple[OdometrySource, list[tuple[float, OdometryState]]]:
    source = OdometrySource(IMU if kind.imu else None)
    return source, read(source, kind, seconds, rate, 0.001, start)


@pytest.mark.parametrize('kind', [
    Source(imu=True), Source(twist='odom'), Source(twist='none', rates=False),
    Source(imu=True, twist='odom', rates=False, covariances=False)], ids=str)
@pytest.mark.parametrize('rate', [10.0, 200.0])
def test_every_source_tells_the_motion_of_base_link(kind: Source, rate: float) -> None:
    source = OdometrySource(IMU if kind.imu else None)
    off, places, turns, rates_off = [], [], [], []
    for t, state in read(source, kind, 5.0, rate, noise=0.001):
        position, attitude, velocity, rates = motion(t)
        places.append(state.position - position)
        turns.append(quaternion_to_matrix(state.quaternion) - quaternion_to_matrix(attitude))
        if t > 3.0:
            off.append(state.velocity - velocity)
            rates_off.append(state.angular_velocity - rates)
    for errors, most in ((places, 0.005), (turns, 1e-6), (rates_off, 0.03)):
        np.testing.assert_allclose(errors, 0.0, atol=most)
    assert np.sqrt(np.mean(np.square(off))) < 0.03
    assert np.abs(off).max() < 0.1
    assert source.twist.found == kind.twist and kind.twist in source.twist.describe


def test_where_rates_cease_they_are_derived_from_there_on() -> None:
    source = OdometrySource()
    for t in np.arange(0.0, 4.0, 0.01).tolist():
        state = taken(source, rewrite(Source(rates=t < 2.0))(message(t), t), t)
        assert ('angular velocity' in source.missing) is (t >= 2.0)
        np.testing.assert_allclose(state.angular_velocity, motion(t)[3], atol=0.05)


@pytest.mark.parametrize('reported', [0.5, 0.0])
def test_until_the_readings_differ_nothing_is_decided(reported: float) -> None:
    source = OdometrySource()
    derived = []
    for k in range(1000):
        t = 0.01 * k
        state = taken(source, odometry(
            empty, START + round(t * 1e9), 'odom', 'base_link', [0.5 * t, 0.0, 1.0],
            [0.0, 0.0, 0.0, 1.0], [reported, 0.0, 0.0]), t)
        derived.append(state.derived)
        if t > 0.5:
            np.testing.assert_allclose(state.velocity, [0.5, 0.0, 0.0], atol=0.02)
    assert source.twist.found == ('' if reported else 'none')
    assert reported == 0.0 or 'not known yet' in source.twist.describe
    # It is used as soon as the positions could contradict it, and do not; zeros are none.
    assert derived[20:] == [reported == 0.0] * 980


def test_it_starts_from_child_frame_if_reading_does_not_matter() -> None:
    source = OdometrySource()
    _, states = first_second(Source(), 0.0, 100.0, 0.1)
    assert not any(state.derived for _, state in states[1:])
    assert source.twist.reading(np.array([0.5, 0.0, 0.0]), np.array([0.5, 0.09, 0.0])) == 'child'
    assert source.twist.reading(np.array([0.5, 0.0, 0.0]), np.array([0.5, 0.11, 0.0])) == 'none'
    assert source.twist.reading(np.zeros(3), np.zeros(3)) == 'none'


@pytest.mark.parametrize('kind', [
    Source(twist='odom'), Source(imu=True, twist='odom', rates=False, covariances=False),
    Source(twist='none', rates=False)], ids=str)
@pytest.mark.parametrize('rate', [10.0, 200.0])
@pytest.mark.parametrize('start', [0.0, 2.0])
def test_a_wrong_start_is_small_soon_over_and_admitted(kind: Source, rate: float,
                                                       start: float) -> None:
    source, states = first_second(kind, start, rate, 1.6)
    for t, state in states:
        off = state.velocity - motion(t)[2]
        spread = state.velocity_covariance + 1e-9 * np.eye(3)
        if t - start > 0.35:  # before, the derived velocity is still being found itself
            assert off @ np.linalg.solve(spread, off) < 12.0  # 99 % of 3 axes
            assert np.abs(off).max() < 0.15
        if t - start > 1.1:
            assert np.abs(off).max() < 0.1
            assert source.twist.found == kind.twist


@pytest.mark.parametrize('twist', ['child', 'odom', 'none'])
def test_no_finding_makes_a_step_in_velocity(twist: str) -> None:
    source = OdometrySource()
    states = read(source, Source(twist=twist), 6.0, noise=0.001)
    velocities = np.array([state.velocity for _, state in states])
    # 0.7 m/s^2 of the motion itself, and what the derivation trembles.
    assert np.abs(np.diff(velocities[50:], axis=0)).max() < 0.04


def test_contradicted_velocity_is_dropped_and_trusted_again() -> None:
    """In another frame for 4 s, then as before: what it is now counts."""
    source = OdometrySource()
    wrong = Source(twist='odom')
    kinds = [Source()] * 600 + [wrong] * 400 + [Source()] * 1000
    alters = {Source(): rewrite(Source()), wrong: rewrite(wrong)}
    off, found = [], []
    for k, kind in enumerate(kinds):
        t = 0.01 * k
        state = taken(source, alters[kind](message(t), t), t)
        off.append(float(np.linalg.norm(state.velocity - motion(t)[2])))
        if source.twist.found not in found[-1:]:
            found.append(source.twist.found)
        if k == 599:
            assert source.twist.found == 'child'
    assert found == ['', 'child', 'none', '', 'child']
    assert max(off[1000:]) < 0.06  # what the derivation trembles


@pytest.mark.parametrize('begin', [0.0, 5.0])
@pytest.mark.parametrize('wrong', [0.8, 8.0, 99.0, 1e5])
def test_no_part_of_a_contradicted_velocity_is_used(wrong: float, begin: float) -> None:
    source = OdometrySource()
    for k in range(700):
        t = 0.01 * k
        state = taken(source, odometry(
            empty, START + round(t * 1e9), 'odom', 'base_link', [0.5 * t, 0.0, 1.0],
            [0.0, 0.0, 0.0, 1.0], [0.5 + (wrong if t >= begin else 0.0), 0.0, 0.0]), t)
        # A velocity that no vehicle has is refused at once, another one by the positions.
        known = t > 0.2 if wrong > 100.0 else not begin <= t < begin + 1.1
        assert not known or abs(state.velocity[0] - 0.5) < 0.05


def test_what_a_source_leaves_out_is_told() -> None:
    source = OdometrySource(SourceParams(std=(0.2, 0.1, 0.3, 0.4)))
    (_, state), *_ = read(source, Source(rates=False, covariances=False), 0.01)
    assert set(source.missing) == {'angular velocity', *(
        f'{part} covariance of the {what}' for part in ('linear', 'angular')
        for what in ('pose', 'twist'))}
    np.testing.assert_allclose(np.sqrt(state.pose_covariance.diagonal()), [0.2] * 3 + [0.1] * 3)
    np.testing.assert_allclose(np.sqrt(state.twist_covariance.diagonal()[3:]), [0.4] * 3)


def test_what_is_no_motion_is_dropped_and_told() -> None:
    source = OdometrySource()
    read(source, Source(), 1.0)
    lost = message(1.0)
    set_quaternion(lost.pose.pose.orientation, [0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match='lost'):
        source.take(lost, START)
    nowhere = message(1.0)
    set_vector(nowhere.pose.pose.position, [0.0, np.nan, 0.0])
    with pytest.raises(ValueError, match='position'):
        source.take(nowhere, START)
    assert source.take(message(0.99), START) is None
    assert source.take(message(0.9), START) is None
    assert [reason for reason, _ in source.new_events()] == [
        'odom stamp repeated', 'odom out of order']
    assert source.take(message(0.0), START) is not None  # a bag from its beginning
    assert source.new_events() == []


def test_a_jump_of_the_position_is_survived_and_told() -> None:
    source = OdometrySource(SourceParams(twist_frame='none'))
    read(source, Source(twist='none'), 3.0)
    for k in range(300, 400):
        state = taken(source, message(0.01 * k, np.array([2.0, 0.0, 0.0])), 0.01 * k)
        assert np.linalg.norm(state.velocity - motion(0.01 * k)[2]) < 0.1
    assert [reason for reason, _ in source.new_events()] == ['odom jumped']


def test_velocity_with_absurd_variance_is_not_used() -> None:
    source = OdometrySource(SourceParams(twist_frame='child'))
    read(source, Source(), 3.0)
    for k in range(300, 310):  # as rtabmap does after it was lost
        odd = message(0.01 * k)
        set_vector(odd.twist.twist.linear, np.zeros(3))
        odd.twist.covariance = np.diag([9999.0] * 6).reshape(36)
        state = taken(source, odd, 0.01 * k)
        assert np.linalg.norm(state.velocity - motion(0.01 * k)[2]) < 0.05
    assert 'velocity' in source.missing


@pytest.mark.parametrize('velocity', [np.nan, 200.0])
def test_invalid_velocity_is_counted_until_one_is_valid(velocity: float) -> None:
    source = OdometrySource()
    read(source, Source(), 3.0)
    for k in range(300, 330):
        t, invalid = 0.01 * k, k in (300, 310, 311, 312)
        sent = message(t)
        sent.twist.covariance = 1e-6 * np.eye(6).reshape(36)
        if invalid:
            set_vector(sent.twist.twist.linear, np.full(3, velocity))
        state = taken(source, sent, t)
        assert state.derived == invalid == ('velocity' in source.missing)
        assert (state.velocity_covariance[0, 0] > 1e-4) == invalid  # not that of the message
        assert np.linalg.norm(state.velocity - motion(t)[2]) < 0.05
    assert [reason for reason, _ in source.new_events()] == 2 * ['odom velocity invalid']


@pytest.mark.parametrize(('row', 'column', 'value', 'lacking'), [
    (0, 1, -50.0, 'linear'), (4, 3, 50.0, 'angular'), (0, 1, 0.99e-2, ''), (1, 4, 50.0, '')])
def test_correlation_above_1_is_no_covariance(
        row: int, column: int, value: float, lacking: str) -> None:
    source, sent = OdometrySource(SourceParams(std=(0.2, 0.1, 0.3, 0.4))), message(0.0)
    covariance = 0.01 * np.eye(6)
    covariance[row, column] = covariance[column, row] = value
    sent.pose.covariance = covariance.reshape(36)
    used = taken(source, sent, 0.0).pose_covariance
    assert np.linalg.eigvalsh(used)[0] > 0.0
    assert [part for part in ('linear', 'angular')
            if f'{part} covariance of the pose' in source.missing] == [lacking] * bool(lacking)
    np.testing.assert_allclose(np.sqrt(used.diagonal()), [
        0.2 if lacking == 'linear' else 0.1] * 3 + [0.1] * 3)


def test_another_frame_begins_anew() -> None:
    source = OdometrySource()
    read(source, Source(), 3.0)
    other = message(3.0)
    other.header.frame_id = 'map'
    assert source.take(other, START) is not None
    assert [reason for reason, _ in source.new_events()] == ['odom changed its frames']


@pytest.mark.parametrize('configured', [False, True])
def test_static_frames_place_each_child_unless_configured(configured: bool) -> None:
    frames, x = StaticFrames(), 0.5
    frames.add('base_link', 'imu', Transform(np.eye(3), np.array([x, 0.0, 0.0])))
    params = SourceParams(child_position=(0.2, 0.0, 0.0)) if configured else SourceParams()
    source = OdometrySource(params, frames)
    for k, (child, offset) in enumerate((
            ('base_link', 0.0), ('imu', x), ('base_link', 0.0), ('unknown', 0.0), ('imu', x))):
        sent = message(0.1 * k)
        sent.child_frame_id = child
        sent.pose.pose.orientation.x = sent.pose.pose.orientation.y = 0.0
        sent.pose.pose.orientation.z, sent.pose.pose.orientation.w = 0.0, 1.0
        place = taken(source, sent, 0.1 * k).position
        assert sent.pose.pose.position.x - place[0] == pytest.approx(
            0.2 if configured else offset), child
        line = f'imu is at [{x}, 0.0, 0.0] m on base_link by tf_static'
        assert source.placement == ('' if configured or not k else line if child == 'imu' else (
            "the child frame of odom, 'base_link', is taken as base_link"))


def test_latency_and_period_are_told() -> None:
    source = OdometrySource()
    for k in range(10):
        source.take(message(0.1 * k), START + round(1e8 * k) + 60_000_000)
    assert source.latency == pytest.approx(0.06)
    assert source.period == pytest.approx(0.1)


@given(st.lists(st.floats(), min_size=13, max_size=13), st.integers(0, 2**31 - 1))
def test_whatever_comes_what_is_returned_is_finite(numbers: list[float], sec: int) -> None:
    source = OdometrySource()
    states = [state for _, state in read(source, Source(), 0.1)]
    odd = message(0.1)
    set_vector(odd.pose.pose.position, numbers[:3])
    set_quaternion(odd.pose.pose.orientation, numbers[3:7])
    set_vector(odd.twist.twist.linear, numbers[7:10])
    set_vector(odd.twist.twist.angular, numbers[10:13])
    odd.header.stamp.sec = sec
    with contextlib.suppress(ValueError):
        states.append(source.take(odd, START))
    states.append(source.take(message(0.2), START))
    for state in states:
        if state is not None:
            assert all(np.isfinite(value).all() for value in state[3:11])
