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
Judge detectors alone, without odometry, on the images of bags with truth.

``python benchmarks/detector_alone.py BAG ... [--dictionary NAME] [--images N]``: every image goes
through ``relative_pose`` with ``odometry: none`` (see launch/detector.launch.py), and through the
others of ``benchmarks/detectors.py`` with the pose by IPPE. Recall is the share of all images;
distance and attitude are compared with the truth.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
import sys

from detectors import ARUCO, detectors, Look
import numpy as np
from poses import errors_of, pose_at, truth_of

from flock_desk.camera.renderer import SIDE_LENGTH, T_BODY_MARKER, T_BODY_OPTICAL
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.geometry import Array, Transform
from flock_follower.messages import NANOSECONDS, stamp_to_nanoseconds
from flock_follower.perception import markers
from flock_follower.perception.images import compute_in_one_thread
from flock_follower.perception.neighbor_motion import FilterParams
from flock_follower.perception.parameter_table import HAND_ACCELERATION, HAND_ANGULAR_NOISE
from flock_follower.perception.pending_images import Perceiver
from flock_follower.perception.tracker import Tracker
from flock_follower.system.files import resource

OURS, LEADER = 'detector.launch.py', 'leader'
TURNED = np.deg2rad(20.0)  # rad: a larger error of the attitude is counted
UNKNOWN = np.full((6, 6), np.nan)  # covariance of a detector that has none


def judge(bag: Path, dictionary: str, images: int = 0) -> dict[str, dict[str, float]]:
    """
    Return the figures of each detector on the images of a bag, 0 for all of them.

    :raises BagError: for a bag that cannot be read.
    """
    config = replace(markers.load(resource('config/neighbors.yaml')), dictionary=dictionary)
    perceiver = Perceiver(Tracker(config, Transform(), FilterParams(
        acceleration=HAND_ACCELERATION, angular_noise=HAND_ANGULAR_NOISE), alone=True),
        max_wait=0.0)
    looks: dict[str, Look] = {}
    truth, start = truth_of(bag, LEADER)
    errors: defaultdict[str, list[list[float]]] = defaultdict(list)
    count = 0
    with open_bag(bag) as opened:
        for topic, msgtype, now, data in opened.messages():
            if topic == '/camera_info':
                perceiver.take_camera_info(deserialize(data, msgtype))
                model = perceiver.model()
                if model is not None and not looks:
                    looks = {name: Look(model, corners, SIDE_LENGTH)
                             for name, corners in detectors(dictionary).items()}
            elif 'image' in topic and (not images or count < images):
                message = deserialize(data, msgtype)
                stamp = stamp_to_nanoseconds(message.header.stamp)
                perceiver.take_image(message, stamp, now / NANOSECONDS)
                seen = perceiver.process(now / NANOSECONDS)
                own, other = (pose_at(each, (stamp - start) / NANOSECONDS) for each in truth)
                if seen is None or seen.pixels is None or own is None or other is None:
                    continue
                count += 1
                true = (own @ T_BODY_OPTICAL).inverse() @ other
                measured: dict[str, tuple[Transform, Array] | None] = {
                    OURS: seen.sighting.poses.get(LEADER, lambda: None)()}
                for name, look in looks.items():
                    marker = look(seen.pixels)
                    measured[name] = None if marker is None else (
                        marker @ T_BODY_MARKER.inverse(), UNKNOWN)
                for name, pose in measured.items():
                    if pose is not None:
                        errors[name].append([*errors_of(*pose, true), float(
                            np.linalg.norm(pose[0].translation)
                            - np.linalg.norm(true.translation))])
    return {name: _figures(np.array(rows), count) for name, rows in errors.items()}


def _figures(rows: Array, count: int) -> dict[str, float]:
    return {'recall': len(rows) / count,
            'distance_bias_m': float(rows[:, 4].mean()),
            'distance_rms_m': float(np.sqrt(np.mean(rows[:, 4]**2))),
            'attitude_median_rad': float(np.median(rows[:, 1])),
            'turned_share': float(np.mean(rows[:, 1] > TURNED)),
            'nees_position': float(rows[:, 2].mean()), 'nees_attitude': float(rows[:, 3].mean()),
            'images': count}


def main() -> int:
    """Print a line for each bag and detector."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG')
    parser.add_argument('--dictionary', default=ARUCO)
    parser.add_argument('--images', type=int, default=0, help='of each (default: all)')
    options = parser.parse_args()
    compute_in_one_thread()
    for bag in options.bags:
        for name, figures in judge(bag, options.dictionary, options.images).items():
            print(f'{bag.name}, {name}: ' + ', '.join(
                f'{figure} {value:.4g}' for figure, value in figures.items()), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
