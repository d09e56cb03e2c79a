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

"""One's own odometry: interpolation, its limits, and the smooth position."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import (
    Array,
    quaternion_conjugate,
    quaternion_from_rpy,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
    yaw_from_quaternion,
)
from flock_follower.odometry.buffer import Missing, OdometryBuffer, OdometrySample

VELOCITY = np.array([1.0, -0.5, 0.2])
RATE = 0.8  # rad/s about z


def sample(stamp: float, position: Array | None = None,
           velocity: Array = VELOCITY) -> OdometrySample:
    """Return a sample of a steady flight, turning at RATE."""
    return OdometrySample(stamp, stamp * VELOCITY if position is None else position,
                          quaternion_from_yaw(RATE * stamp), velocity, np.array([0, 0, RATE]))


def filled(stamps: Array) -> OdometryBuffer:
    buffer = OdometryBuffer()
    for stamp in stamps:
        buffer.add(sample(float(stamp)))
    return buffer


def state(buffer: OdometryBuffer, stamp: float) -> OdometrySample:
    found = buffer.at(stamp)
    assert isinstance(found, OdometrySample), found
    return found


@pytest.mark.parametrize('stamp', [0.0, 0.005, 0.0125, 0.4999, 0.5])
def test_between_samples_a_steady_flight_is_exact(stamp: float) -> None:
    found = state(filled(np.arange(101) * 0.005), stamp)
    assert found.stamp == pytest.approx(stamp)
    np.testing.assert_allclose(found.position, stamp * VELOCITY, atol=1e-12)
    np.testing.assert_allclose(found.velocity, VELOCITY)
    assert yaw_from_quaternion(found.quaternion) == pytest.approx(RATE * stamp)


def test_attitude_takes_shorter_arc_for_either_sign() -> None:
    buffer = OdometryBuffer()
    a, b = quaternion_from_rpy(0.1, 0.0, 3.1), -quaternion_from_rpy(0.1, 0.0, -3.1)
    for stamp, q in ((0.0, a), (0.02, b)):
        buffer.add(OdometrySample(stamp, np.zeros(3), q, np.zeros(3), np.zeros(3)))
    expected = quaternion_to_matrix(quaternion_from_rpy(0.1, 0.0, np.pi))
    np.testing.assert_allclose(quaternion_to_matrix(state(buffer, 0.01).quaternion), expected,
                               atol=1e-12)


def test_shortly_past_the_newest_its_velocities_carry_on() -> None:
    found = state(filled(np.arange(11) * 0.005), 0.075)
    np.testing.assert_allclose(found.position, 0.075 * VELOCITY, atol=1e-12)
    assert yaw_from_quaternion(found.quaternion) == pytest.approx(RATE * 0.075)
    assert found.stamp == pytest.approx(0.075)


def test_what_is_missing_is_said() -> None:
    buffer = OdometryBuffer()
    assert buffer.at(1.0) is Missing.EMPTY
    buffer = filled(np.array([1.0, 1.005, 1.3, 1.305]))
    assert buffer.at(0.9) is Missing.TOO_OLD
    assert buffer.at(1.1) is Missing.GAP
    assert isinstance(buffer.at(1.0025), OdometrySample)
    assert buffer.at(1.34) is Missing.TOO_NEW
    assert isinstance(buffer.at(1.33), OdometrySample)
    assert buffer.at(1.33, extrapolate=False) is Missing.TOO_NEW


def test_memory_is_bounded_in_time_and_number() -> None:
    buffer = filled(np.arange(2000) * 0.005)
    assert len(buffer) in (400, 401)  # 2 s at 200 Hz
    assert buffer.at(7.9) is Missing.TOO_OLD
    buffer = filled(np.arange(5000) * 1e-6)
    assert len(buffer) == OdometryBuffer.CAPACITY


def test_late_and_repeated_samples_are_ignored() -> None:
    buffer = filled(np.arange(11) * 0.005)
    assert not buffer.add(sample(0.02, position=np.full(3, 99.0)))
    assert not buffer.add(sample(0.05, position=np.full(3, 99.0)))
    assert len(buffer) == 11
    np.testing.assert_allclose(state(buffer, 0.02).position, 0.02 * VELOCITY)


def test_a_jump_back_in_time_starts_anew() -> None:
    buffer = filled(100.0 + np.arange(11) * 0.005)
    assert buffer.add(sample(10.0))
    assert len(buffer) == 1
    assert buffer.newest == 10.0
    assert buffer.at(100.0) is Missing.TOO_NEW


def test_travel_is_smooth_where_the_position_jumps() -> None:
    buffer = OdometryBuffer()
    rng = np.random.default_rng(4)
    for k in range(101):
        stamp = 0.005 * k
        jump = np.array([0.5, 0.0, 0.0]) if stamp > 0.25 else np.zeros(3)
        buffer.add(sample(stamp, stamp * VELOCITY + jump + rng.normal(0.0, 0.01, 3)))
    first = state(buffer, 0.0)
    for stamp in (0.1, 0.2512, 0.4, 0.5, 0.52):
        found = state(buffer, stamp)
        np.testing.assert_allclose(found.travel - first.travel, stamp * VELOCITY, atol=1e-9)
        np.testing.assert_allclose(found.travel + found.correction, found.position, atol=1e-12)
        np.testing.assert_allclose(found.smooth_pose.translation, found.travel)


def test_travel_bridges_a_gap_by_the_positions() -> None:
    buffer = OdometryBuffer()
    buffer.add(sample(0.0, np.zeros(3)))
    buffer.add(sample(1.0, np.array([7.0, 0.0, 0.0])))
    np.testing.assert_allclose(state(buffer, 1.0).travel, [7.0, 0.0, 0.0])


def turning(noise: float, lag: float, share: float) -> tuple[list[float], list[float]]:
    """
    Return the errors of raw and steadied attitudes, rad, at 30 Hz, while it rolls back and forth.

    The angular velocities are a ``share`` of those of ``lag`` s ago.
    """
    buffer, rng = OdometryBuffer(), np.random.default_rng(5)
    size, turn = 1.0 / 6.0, 6.0  # rad, rad/s
    errors: tuple[list[float], list[float]] = [], []

    def roll(t: float) -> Array:
        return rotation_vector_to_quaternion([size * np.sin(turn * t), 0.0, 0.0])

    for k in range(500):
        t = k / 200.0
        rate = share * size * turn * np.cos(turn * (t - lag))
        # The sign of a quaternion does not matter.
        q = (-1)**k * quaternion_multiply(
            roll(t), rotation_vector_to_quaternion(rng.normal(0, noise, 3)))
        buffer.add(OdometrySample(t, np.zeros(3), q, np.zeros(3), np.array([rate, 0.0, 0.0])))
        if k % 7 == 6:
            found = state(buffer, t - 0.0021)
            for error, each in zip(errors, (found, buffer.steadied(found))):
                error.append(float(np.linalg.norm(quaternion_to_rotation_vector(
                    quaternion_multiply(quaternion_conjugate(roll(t - 0.0021)),
                                        each.quaternion)))))
    return errors[0][10:], errors[1][10:]


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(('noise', 'lag', 'share', 'most'), [
    (0.0004, 0.0, 1.0, 0.45), (0.00524, 0.0, 1.0, 0.45),
    (0.00524, 0.005, 1.0, 0.6),  # noise above the effect of a lag
    (0.0004, 0.01, 1.0, 1.1), *((0.0004, 0.0, share, 1.1) for share in (0.0, -1.0, 10.0))])
def test_white_noise_is_smoothed_wrong_rates_do_not_turn_it(
        noise: float, lag: float, share: float, most: float) -> None:
    raw, steadied = turning(noise, lag, share)
    assert rms(steadied) < most * rms(raw)


def test_a_state_without_company_is_left_as_it_is() -> None:
    buffer = OdometryBuffer()
    buffer.add(sample(0.0))
    alone = state(buffer, 0.0)
    assert buffer.steadied(alone) is alone
    buffer.add(sample(0.2))
    late = state(buffer, 0.2)
    assert buffer.steadied(late) is late  # the other is too long ago


def test_samples_after_an_image_do_not_count_for_it() -> None:
    buffer = filled(np.arange(101) * 0.005)
    before = buffer.steadied(state(buffer, 0.3)).quaternion
    for k in range(1, 6):  # a jump of the attitude, after the image
        later = sample(0.5 + 0.005 * k)
        buffer.add(later._replace(quaternion=quaternion_multiply(
            later.quaternion, rotation_vector_to_quaternion([0.002, 0.0, 0.0]))))
    np.testing.assert_array_equal(buffer.steadied(state(buffer, 0.3)).quaternion, before)
