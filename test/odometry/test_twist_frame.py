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

"""The frame of a velocity is found by the positions, whatever noise and steps these have."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import Array, quaternion_from_yaw, quaternion_to_matrix
from flock_follower.odometry.derivation import CHILD, NONE, ODOM, TwistFrame

RATE = 20.0


def flown(seconds: float, twist: str, noise: float = 0.0, steps: Array | None = None,
          speed: float = 0.7, rate: float = RATE, seed: int = 0) -> tuple[TwistFrame, float]:
    """
    Return what is found of a flight in circles, and when, s.

    The velocity is in the frame ``twist``, right to ``noise`` m/s; so are positions to ``noise``
    m. ``steps`` are lengths, m, of steps of the position, one every two seconds.
    """
    rng = np.random.default_rng(seed)
    watched, when, correction = TwistFrame(), np.inf, np.zeros(3)
    for k, t in enumerate(np.arange(0.0, seconds, 1.0 / rate).tolist()):
        yaw = 1.0 + 0.5 * t
        R = quaternion_to_matrix(quaternion_from_yaw(yaw))
        if steps is not None and k % round(2.0 * rate) == 0:
            direction = rng.standard_normal(3)
            correction += rng.choice(steps) * direction / np.linalg.norm(direction)
        position = 2.0 * speed * np.array([np.sin(yaw), -np.cos(yaw), 0.0]) + correction
        velocity = R @ [speed, 0.0, 0.0] + noise * rng.standard_normal(3)
        sent = R.T @ velocity if twist == CHILD else velocity
        watched.take(t, position + noise * rng.standard_normal(3), R @ sent, sent)
        if watched.found:
            when = min(when, t)
    return watched, when


@pytest.mark.parametrize('rate', [4.0, 200.0])
@pytest.mark.parametrize('twist', [CHILD, ODOM])
def test_it_is_found_soon_at_any_rate(twist: str, rate: float) -> None:
    watched, when = flown(10.0, twist, 0.01, rate=rate)
    assert watched.frame == twist
    assert when < max(1.2, 6.3 / rate)


def test_evidence_adds_up_before_a_frame_is_found() -> None:
    """Readings 0.1 m/s apart are two deviations apart: a log likelihood ratio of 2 per window."""
    watched = TwistFrame()
    for k in range(round(1.3 * RATE)):  # two windows, of 0.5 s: 4
        watched.take(k / RATE, np.zeros(3), np.zeros(3), np.array([0.1, 0.0, 0.0]))
    assert watched.found == ''
    for k in range(round(1.3 * RATE), round(2.1 * RATE)):  # two more: 8
        watched.take(k / RATE, np.zeros(3), np.zeros(3), np.array([0.1, 0.0, 0.0]))
    assert watched.found == CHILD


@pytest.mark.parametrize('twist', [CHILD, ODOM])
@pytest.mark.parametrize('seed', range(2))
def test_steps_of_the_position_contradict_nothing(twist: str, seed: int) -> None:
    # As in a real flight, whose filter corrected itself by 1 to 29 cm at a time.
    watched, _ = flown(300.0, twist, 0.005, np.array([0.05, 0.1, 0.3]), seed=seed)
    assert watched.frame == twist


def test_readings_that_hardly_differ_decide_nothing() -> None:
    """At rest, noise and a bias of the velocity would decide in the end."""
    watched = TwistFrame()
    for k in range(round(60.0 * RATE)):
        watched.take(k / RATE, np.zeros(3), np.zeros(3), np.array([0.04, 0.0, 0.0]))
    assert watched.found == ''


def test_velocity_that_is_none_is_dropped_despite_steps() -> None:
    watched = TwistFrame()
    for k in range(200):
        t = k / RATE
        watched.take(t, np.array([0.7 * t + 0.2 * (t > 1.0), 0.0, 0.0]), np.zeros(3), np.zeros(3))
    assert watched.frame == NONE
    assert watched.contradiction == pytest.approx(0.7)


def contradicted(after: float, speed: float = 0.7, seconds: float = 12.0) -> list[str]:
    """
    Return what is found, s by s, of one whose velocity is frozen at nonsense from 4 s to 6 s.

    :param after: speed, m/s, from 6 s on, when the velocity is right again.
    """
    watched, place, found = TwistFrame(), np.zeros(3), list[str]()
    R = quaternion_to_matrix(quaternion_from_yaw(1.5))
    for k in range(round(RATE * seconds)):
        t = k / RATE
        velocity = np.array([speed if t < 6.0 else after, 0.0, 0.0])
        place = place + velocity / RATE
        twist = np.array([0.0, 0.0, 1.0]) if 4.0 <= t < 6.0 else velocity
        watched.take(t, place, twist, R.T @ twist)  # as the child frame has it, and the header's
        if k % round(RATE) == 0:
            found.append(watched.found)
    return found


@pytest.mark.parametrize('after', [0.7, 0.0], ids=['moving', 'at rest'])
def test_evidence_against_a_velocity_expires_within_5_s(after: float) -> None:
    found = contradicted(after)
    assert found[4] == CHILD
    assert found[6] == NONE
    assert found[11] == CHILD
    assert after == 0.0 or found[8] == CHILD  # as fast as it was lost


def test_source_without_velocity_is_unused_where_all_is_still() -> None:
    watched = TwistFrame()
    for k in range(2000):
        t = k / RATE
        place = np.array([0.7 * min(t, 3.0), 0.0, 0.0])
        watched.take(t, place, np.zeros(3), np.zeros(3))
    assert watched.found == NONE
