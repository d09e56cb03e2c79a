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

"""Noise learned from innovations: of measurements its size, direction and limits; of motion."""

from __future__ import annotations

from marker_images import known
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.perception.learned_noise import (
    LEARNED,
    LearnedMotion,
    LearnedNoise,
    LEAST_SHARE,
)
from flock_follower.perception.neighbor_filter import NeighborFilter

SIGHT = np.array([1.2, -1.6, 0.0])  # 2 m away
ALONG, ACROSS = SIGHT / 2.0, np.array([0.8, 0.6, 0.0])
UP = np.array([0.0, 0.0, 1.0])
BASE = 0.001**2 * np.eye(3)  # m^2, what else there is


def fed(attitude: float, distance: float, count: int = 4 * LEARNED, seed: int = 1) -> LearnedNoise:
    """Return what was learned of noise: rad about each axis, and a share of the distance."""
    learned, rng = LearnedNoise(0.0005), np.random.default_rng(seed)
    for _ in range(count):
        true = np.linalg.cholesky(BASE + covariance(attitude, distance))
        learned.take(np.sqrt(2.0) * true @ rng.standard_normal(3), expected(learned), SIGHT)
    return learned


def expected(learned: LearnedNoise) -> Array:
    """Return the covariance of the difference of two measurements, (3, 3)."""
    return 2.0 * (learned.shares[0] * BASE + learned.covariance(SIGHT)[:3, :3])


def covariance(attitude: float, distance: float) -> Array:
    across = np.eye(3) - np.outer(ALONG, ALONG)
    return (2.0 * attitude)**2 * across + (2.0 * distance)**2 * np.outer(ALONG, ALONG)


@pytest.mark.parametrize(('attitude', 'distance'), [
    (0.002, 0.0), (0.02, 0.0), (0.0, 0.004), (0.0, 0.02)])
def test_noise_is_learned_across_sight_and_along_distance(
        attitude: float, distance: float) -> None:
    learned = fed(attitude, distance)
    assert learned.attitude == pytest.approx(attitude, rel=0.25, abs=0.0007)
    assert learned.distance == pytest.approx(distance, rel=0.35, abs=0.0005)


@pytest.mark.parametrize(('white', 'shares'), [
    (0.8, [0.8, 0.8]), (0.1, [LEAST_SHARE, LEAST_SHARE]), (2.0, [1.0, 1.0])])
def test_noise_share_of_pose_variance_is_learned_to_a_limit(
        white: float, shares: list[float]) -> None:
    learned, rng = LearnedNoise(1e-6), np.random.default_rng(3)
    seen = []
    for k in range(8 * LEARNED):
        learned.take(rng.normal(0.0, 0.01 * np.sqrt(2.0 * white), 6),
                     2.0 * (np.diag(np.repeat(learned.scales, 3) * 0.01)**2
                            + learned.covariance(SIGHT)), SIGHT)
        if k > 4 * LEARNED:
            seen.append([*learned.shares])
    np.testing.assert_allclose(np.mean(seen, axis=0), shares, rtol=0.15)
    learned.restart()
    assert learned.shares == [1.0, 1.0]


def test_attitude_moves_sideways_and_tilts_together() -> None:
    noise = fed(0.005, 0.0)
    added = noise.covariance(SIGHT)
    assert ALONG @ added[:3, :3] @ ALONG < 1e-6
    assert UP @ added[:3, :3] @ UP == pytest.approx((2.0 * noise.attitude)**2)
    np.testing.assert_allclose(added[3:, 3:], noise.attitude**2 * np.eye(3))
    # Turned about +z, what is at SIGHT moves along z x SIGHT.
    assert added[:3, 5] == pytest.approx(noise.attitude**2 * np.cross(UP, SIGHT))


def flown(period: float, seed: int, seconds: float = 12.0) -> tuple[LearnedNoise, float]:
    """
    Follow a neighbor that changes its speed by 1 m/s, at 2 m/s^2, every ``period`` s.

    Return the noise learned of measurements that err by 1 mm, and the mean NEES of the velocity.
    """
    rng, dt, learned, tracker = np.random.default_rng(seed), 1.0 / 30.0, LearnedNoise(0.0005), (
        NeighborFilter())
    noise, nees = np.diag([0.001] * 3 + [0.01] * 3)**2, []
    place, velocity = SIGHT, np.array([0.5, 0.0, 0.0])
    for k in range(round(seconds / dt)):
        t = k * dt
        forward = int(t / period) % 2 == 0
        wanted = 0.5 if forward else -0.5
        before = velocity
        velocity = velocity + np.array([1.0, 0.0, 0.0]) * np.clip(
            wanted - velocity[0], -2.0 * dt, 2.0 * dt)
        place = place + 0.5 * dt * (before + velocity)
        measured = Transform(np.eye(3), place + rng.normal(0.0, 0.001, 3))
        tracker.update(t, measured, np.zeros(3), noise)
        if tracker.change is not None:
            learned.take(*tracker.change, place)
        if t > 2.0 and tracker.newest is not None:
            error = tracker.newest.velocity - velocity
            nees.append(error @ np.linalg.solve(tracker.newest.covariance[3:6, 3:6], error))
    return learned, float(np.mean(nees))


def test_a_maneuver_is_no_noise_of_the_measurements() -> None:
    tracker, noise, changes = NeighborFilter(), np.diag([0.001] * 3 + [0.01] * 3)**2, []
    for k in range(90):
        ahead = 2.0 + 1.0 * max(k / 30.0 - 1.0, 0.0)**2  # from 1 s on at 2 m/s^2
        tracker.update(k / 30.0, Transform(translation=np.array([ahead, 0.0, 0.0])), np.zeros(3),
                       noise)
        if tracker.change is not None:
            changes.append(float(np.abs(tracker.change.difference).max()))
    assert 0.0 < max(changes) < 0.003  # m; the innovations are up to 0.011
    learned, _ = flown(2.0, 1)
    assert learned.attitude < 0.0005
    assert learned.distance < 0.0005


@pytest.mark.parametrize('period', [2.0, 1000.0])
def test_the_velocity_errs_as_its_covariance_says(period: float) -> None:
    assert 0.3 < np.mean([flown(period, seed)[1] for seed in range(3)]) < 4.5


def test_a_neighbor_unseen_may_do_more_than_it_did() -> None:
    learned = LearnedMotion()
    for k in range(300):  # it follows every single error: too fast
        learned.take(1.0 / 30.0, np.full(3, (-1)**k * 1e-3), 1e-6 * np.eye(3))
    assert max(learned.scale(1.0 / 30.0)) < 1.0
    assert learned.scale(1.0) == [1.0] * 3


def test_new_track_does_not_keep_learned_motion() -> None:
    tracker, rng = NeighborFilter(), np.random.default_rng(5)
    noise = np.diag([0.001] * 3 + [0.01] * 3)**2
    for k in range(300):
        tracker.update(k / 30.0, Transform(translation=rng.normal(0.0, 0.001, 3)), np.zeros(3),
                       noise)
    tracker.update(20.0, Transform(), np.zeros(3), noise)
    assert known(tracker.newest).velocity.tolist() == [0.0] * 3
    fresh = NeighborFilter()
    fresh.update(20.0, Transform(), np.zeros(3), noise)
    first, other = (known(each.predict(20.1)).covariance[:9, :9] for each in (tracker, fresh))
    assert np.allclose(first, other)
