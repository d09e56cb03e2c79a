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

"""The measured poses that relative_pose publishes: honest covariances, and messages of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from path_traced import camera_of, DATA, light_of, load_module, MOUNTING, tracker_of
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.geometry import quaternion_from_rpy, Transform
from flock_follower.messages.poses import from_pose, pose_with_covariance, transforms
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import odometry
from flock_follower.odometry.buffer import OdometrySample

JUDGE = Path(__file__).resolve().parents[2] / 'benchmarks' / 'poses.py'
IMAGES = 60


def test_pose_message_holds_pose_covariance_and_stamp() -> None:
    pose = Transform.from_quaternion([1.0, 2.0, 3.0], quaternion_from_rpy(0.1, 0.2, 0.3))
    covariance = np.arange(36.0).reshape(6, 6)
    state = from_pose(pose_with_covariance(empty, 5_000_000_001, 'cam', pose, covariance))
    assert (state.stamp, state.frame) == (5_000_000_001, 'cam')
    np.testing.assert_allclose(state.position, pose.translation)
    np.testing.assert_allclose(state.quaternion, pose.quaternion)
    assert state.covariance is not None and np.array_equal(state.covariance, covariance)


def test_transform_is_that_of_the_neighbor_in_the_frame_of_odom() -> None:
    q = quaternion_from_rpy(0.1, -0.2, 2.0)
    state = odometry(empty, 7, 'vio_odom', 'leader', [1.0, -2.0, 3.0], q, [0.1, 0.0, 0.0])
    message = transforms(empty, [state], '/drone1')
    [stamped] = message.transforms
    assert (stamped.header.frame_id, stamped.child_frame_id) == ('vio_odom', 'drone1/leader')
    found, given = from_pose(stamped), from_odometry(state)
    assert found.stamp == 7
    np.testing.assert_allclose(found.position, given.position, atol=1e-6)
    np.testing.assert_allclose(found.quaternion, given.quaternion, atol=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason='the path-traced flights are not here')
@pytest.mark.parametrize('flight', ['room_hover', 'room_tag', 'room_dim'])
def test_nees_of_measured_poses_of_path_traced_flights(flight: str) -> None:
    figures = figures_of(flight)
    print(flight, figures)  # shown with -s
    assert figures['count'] > 0.95 * IMAGES
    assert 1.8 < figures['nees_position'] < 4.5
    assert 1.0 < figures['nees_attitude'] < 4.5


def figures_of(name: str) -> dict[str, float]:
    """Return the figures of the first images of a flight, see benchmarks/poses.py."""
    judged, motion = load_module(JUDGE), load_module(DATA / 'traj.py')
    flight = motion.flight(name)
    own, leader, time = flight['F'], flight['L'][0], flight['t']
    with np.load(DATA / f'{name}.npz') as file:
        ends, packed, stamps = np.cumsum(file['sizes']), file['jpg'], file['stamps'][:IMAGES]
    camera, tracker = camera_of(flight), tracker_of(flight)
    times = np.arange(max(stamps[0] - 0.1, 0.0), stamps[-1] + 0.02, 0.01)
    turns = motion.rot_at(time, own['R'], times).as_quat()
    samples = [OdometrySample(*row) for row in zip(
        times.tolist(), motion.at(time, own['p'], times), turns,
        motion.vel(time, own['p'], times), motion.rate(time, own['R'], times))]

    def poses(body: dict[str, Any]) -> list[Transform]:
        return [Transform(*pose) for pose in zip(
            motion.rot_at(time, body['R'], stamps).as_matrix(),
            motion.at(time, body['p'], stamps))]

    noise, errors = np.random.default_rng(0), []
    for k, (stamp, me, other) in enumerate(zip(stamps.tolist(), poses(own), poses(leader))):
        while samples and samples[0].stamp <= stamp + 0.01:
            tracker.feed_odometry(samples.pop(0))
        light = light_of(packed, ends, k)
        electrons = 1e4 * np.clip(1.5 * light, 0.0, 1.0)
        electrons += np.sqrt(electrons + 64.0) * noise.standard_normal(light.shape)
        image = np.rint(255.0 * np.clip(1e-4 * electrons, 0.0, 1.0)**(1.0 / 2.2)).astype(np.uint8)
        for pose in tracker.process_image(stamp, image, camera).poses.values():
            measured = pose()
            errors.append(judged.errors_of(
                *measured, (me @ MOUNTING).inverse() @ other))
    figures: dict[str, float] = judged.summary(errors)
    return figures
