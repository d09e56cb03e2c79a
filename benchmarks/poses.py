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

"""
Judge the measured poses in a bag, ``neighbors/NAME/pose``, against the truth in it or in another.

``python benchmarks/poses.py BAG [--truth BAG] [--name NAME]``: the poses of any detector that are
in the optical frame of a camera. ``evaluate`` writes those of this package into its result.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

import numpy as np

from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import matrix_to_rotation_vector
from flock_follower.messages import NANOSECONDS
from flock_follower.messages.poses import from_pose, pose_topic
from flock_follower.messages.state_reader import from_odometry
from flock_follower.odometry.buffer import interpolate, OdometrySample
from flock_follower.perception.tracker import camera_mounting

FIGURES = ('count', 'position_rms_m', 'attitude_rms_rad', 'nees_position', 'nees_attitude')


def errors_of(measured: Transform, covariance: Array, true: Transform) -> list[float]:
    """Return errors of position, m, and attitude, rad, and the NEES of each, 3 if honest."""
    place = true.translation - measured.translation
    turn = matrix_to_rotation_vector(true.rotation @ measured.rotation.T)
    return [float(np.linalg.norm(place)), float(np.linalg.norm(turn)),
            float(place @ np.linalg.solve(covariance[:3, :3], place)),
            float(turn @ np.linalg.solve(covariance[3:, 3:], turn))]


def summary(errors: list[list[float]]) -> dict[str, float]:
    """Return the figures of errors, see FIGURES."""
    rows = np.array(errors).reshape(-1, 4)
    return dict(zip(FIGURES, (len(rows), *np.sqrt((rows[:, :2]**2).mean(axis=0)).tolist(),
                              *rows[:, 2:].mean(axis=0).tolist())))


def truth_of(bag: Path, name: str) -> tuple[list[list[OdometrySample]], int]:
    """
    Return the true motion of the follower and of a neighbor, and the start, ns, of their stamps.

    :raises BagError: for a bag that cannot be read.
    """
    true: dict[str, list[OdometrySample]] = {'': [], name: []}
    with open_bag(bag) as opened:
        start = opened.start_ns
        for topic, msgtype, _, data in opened.messages(['/truth/odom', '/truth/neighbors']):
            state = from_odometry(deserialize(data, msgtype))
            own = '' if topic == '/truth/odom' else state.child
            if own in true:
                true[own].append(OdometrySample(
                    (state.stamp - start) / NANOSECONDS, state.position, state.quaternion,
                    state.velocity, state.angular_velocity))
    return [*true.values()], start


def judge(poses: Path, truth: Path, T_body_camera: Transform, name: str) -> dict[str, float]:
    """
    Return the figures of the poses of a neighbor.

    :raises BagError: for a bag that cannot be read.
    """
    true, start = truth_of(truth, name)
    errors = []
    with open_bag(poses) as bag:
        for _, msgtype, _, data in bag.messages([f'/{pose_topic(name)}']):
            measured = from_pose(deserialize(data, msgtype))
            assert measured.covariance is not None
            stamp = (measured.stamp - start) / NANOSECONDS
            own, other = (pose_at(samples, stamp) for samples in true)
            if own is not None and other is not None:
                errors.append(errors_of(
                    Transform.from_quaternion(measured.position, measured.quaternion),
                    measured.covariance, (own @ T_body_camera).inverse() @ other))
    return summary(errors)


def pose_at(samples: list[OdometrySample], stamp: float) -> Transform | None:
    """Return the pose at a stamp, s; None if no sample is on either side."""
    after = next((k for k, sample in enumerate(samples) if sample.stamp >= stamp), 0)
    if not after:
        return None
    sample = interpolate(samples[after - 1], samples[after], stamp)
    return Transform.from_quaternion(sample.position, sample.quaternion)


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('bag', type=Path)
    parser.add_argument('--truth', type=Path, help='default: BAG')
    parser.add_argument('--name', default='leader')
    parser.add_argument('--camera_position', type=float, nargs=3, default=[0.1, 0.0, 0.0])
    parser.add_argument('--camera_rpy', type=float, nargs=3, default=[0.0, 0.0, 0.0])
    options = parser.parse_args()
    for figure, value in judge(
            options.bag, options.truth or options.bag,
            camera_mounting(options.camera_position, options.camera_rpy), options.name).items():
        print(f'{figure}: {value:.4g}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
