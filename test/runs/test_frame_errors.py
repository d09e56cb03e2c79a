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

"""Errors against the truth, and their consistency with the covariances."""

from __future__ import annotations

from marker_images import TAIL
import numpy as np
import pytest

from flock_desk.runs.frame_errors import FrameErrors
from flock_follower.geometry import (
    Array,
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
)
from flock_follower.messages import OdometryState
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.neighbor_filter import Estimate
from flock_follower.perception.tracker import camera_mounting

SECOND = 10**9
START = 1_700_000_000 * SECOND
LEADER = MarkedNeighbor('leader', (Marker(0, 0.16, TAIL),))
CAMERA = CameraModel(np.array([[610.0, 0, 319.5], [0, 610.0, 239.5], [0, 0, 1]]), np.zeros(5),
                     'plumb_bob', 640, 480)
AHEAD = np.array([2.0, 0.3, 0.1])
VELOCITY = np.array([0.5, -0.2, 0.0])
BIAS = np.array([0.03, 0.0, -0.02])  # of the ego velocity
#: Deviations along the axes of odom before it drifts.
POSITION_SIGMA = np.array([0.01, 0.02, 0.03])
VELOCITY_SIGMA = np.array([0.05, 0.10, 0.02])


def state(stamp: int, position: Array, yaw: float = 0.0, velocity: Array | None = None,
          child: str = 'base_link') -> OdometryState:
    """Return a state; the velocity is in the header's frame."""
    return OdometryState(
        START + stamp, 'odom', child, np.asarray(position, dtype=float), quaternion_from_yaw(yaw),
        VELOCITY if velocity is None else velocity, np.zeros(3), np.zeros((6, 6)),
        np.zeros((6, 6)), quaternion_to_matrix(quaternion_from_yaw(yaw)))


def estimate(position: Array, velocity: Array, yaw: float = 0.0,
             drift: float = 0.0) -> Estimate:
    R = quaternion_to_matrix(quaternion_from_yaw(drift))
    covariance = np.zeros((15, 15))
    covariance[:3, :3] = R @ np.diag(POSITION_SIGMA**2) @ R.T
    covariance[3:6, 3:6] = R @ np.diag(VELOCITY_SIGMA**2) @ R.T
    return Estimate(0.0, position, velocity, quaternion_to_matrix(quaternion_from_yaw(yaw)),
                    np.zeros(3), np.zeros(3), covariance)


def collected(frames: int = 10, *, drift: float = 0.0, turned: float = 0.0, noise: float = 0.0,
              ahead: Array = AHEAD, leader_yaw: float = 0.0) -> dict[str, Array]:
    """Fly straight behind a leader for some frames, the odometry turned by ``drift``, rad."""
    errors = FrameErrors([LEADER], camera_mounting([0.1, 0, 0], [0, 0, 0]), START)
    errors.models[''] = CAMERA
    rng = np.random.default_rng(1)
    R = quaternion_to_matrix(quaternion_from_yaw(drift))
    for k in range(frames):
        stamp = k * SECOND // 20
        place = VELOCITY * k / 20
        # An error of the ego velocity that lasts is in the leader's, too.
        errors.odometry(state(stamp, R @ place, drift, R @ (VELOCITY + BIAS)))
        errors.truth(state(stamp, place), own=True)
        errors.truth(state(stamp, place + ahead, leader_yaw, child='leader'))
        errors.frame(START + stamp, {'leader': estimate(
            R @ (place + ahead + noise * POSITION_SIGMA * rng.standard_normal(3)),
            R @ (VELOCITY + BIAS + noise * VELOCITY_SIGMA * rng.standard_normal(3)),
            drift + turned, drift)},
            {'leader': 'track'})
    return errors.table('leader')


def test_one_stamp_far_ahead_hides_no_later_state() -> None:
    errors = FrameErrors([LEADER], camera_mounting([0.1, 0, 0], [0, 0, 0]), START)
    errors.odometry(state(3600 * SECOND, np.zeros(3)))
    for k in range(10):
        errors.odometry(state(k * SECOND // 20, VELOCITY * k / 20))
        errors.frame(START + k * SECOND // 20, {}, {})
    np.testing.assert_allclose(
        errors.table('leader')['own'], np.arange(10)[:, None] * VELOCITY / 20, atol=1e-6)


def test_drift_common_to_both_is_no_error() -> None:
    table = collected(drift=0.4)
    for name in ('position', 'velocity'):
        np.testing.assert_allclose(table[name], 0.0, atol=1e-9)
    np.testing.assert_allclose(table['distance'], np.linalg.norm(AHEAD))
    np.testing.assert_allclose(table['turned'], 0.0, atol=1e-7)
    np.testing.assert_allclose(table['visible'], 1.0)


def test_errors_of_covariance_size_have_nees_of_three() -> None:
    table = collected(3000, noise=1.0, drift=0.4)
    assert np.mean(table['nees_position']) == pytest.approx(3.0, abs=0.15)
    assert np.mean(table['nees_velocity']) == pytest.approx(3.0, abs=0.15)
    np.testing.assert_allclose(table['velocity_sigma'], np.tile(VELOCITY_SIGMA, (3000, 1)))
    np.testing.assert_allclose(np.std(table['position'], axis=0), POSITION_SIGMA, rtol=0.1)


def test_a_wrong_attitude_is_an_angle() -> None:
    np.testing.assert_allclose(collected(turned=0.5)['turned'], 0.5, atol=1e-7)


@pytest.mark.parametrize(('ahead', 'yaw', 'visible'), [
    ([2.0, 0.0, 0.0], 0.0, 1.0), ([2.0, 1.5, 0.0], 0.0, 0.0), ([-2.0, 0.0, 0.0], 0.0, 0.0),
    ([0.35, 0.0, 0.0], 0.0, 0.0), ([2.0, 0.0, 0.0], np.pi, 0.0)])
def test_only_whole_marker_seen_from_front_is_in_view(
        ahead: list[float], yaw: float, visible: float) -> None:
    table = collected(3, ahead=np.array(ahead), leader_yaw=yaw)
    np.testing.assert_array_equal(table['visible'], visible)


def test_truth_is_interpolated_but_not_across_a_gap() -> None:
    errors = FrameErrors([LEADER], Transform(np.eye(3), np.zeros(3)), START)
    for stamp in (0, SECOND // 10, 2 * SECOND, 2 * SECOND + SECOND // 10):
        own = state(stamp, VELOCITY * stamp / SECOND)
        errors.odometry(own)
        errors.truth(own, own=True)
        errors.truth(own._replace(position=own.position + AHEAD, child='leader'))
    for stamp in (SECOND // 20, SECOND, 2 * SECOND + SECOND // 20):
        errors.frame(START + stamp, {'leader': estimate(
            VELOCITY * stamp / SECOND + AHEAD + np.array([0.0, 0.0, 0.5]), VELOCITY)}, {})
    table = errors.table('leader')
    np.testing.assert_allclose(table['position'][:, 2], [0.5, np.nan, 0.5])
    np.testing.assert_allclose(table['true_distance'][[0, 2]], np.linalg.norm(AHEAD))
