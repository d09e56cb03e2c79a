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
A bag of a camera that is carried to and fro before a marker that stands still.

Its images are made by ``warped_marker``, not by the renderers of this package.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from warped_marker import WarpedMarker

from flock_follower.bags.bag import serialize
from flock_follower.bags.message_types import empty
from flock_follower.bags.writer import BagWriter
from flock_follower.geometry import quaternion_from_rpy, R_FLU_OPTICAL, Transform
from flock_follower.messages import ODOMETRY, odometry, set_stamp

START = 1_700_000_000_000_000_000
SIDE_LENGTH = 0.16
#: Where the camera is on base_link, as in config/follower.yaml.
T_BASE_CAMERA = Transform(R_FLU_OPTICAL, np.array([0.10, 0.0, 0.0]))
#: The marker faces where the camera comes from: x right, y up as one looks at it.
T_ODOM_MARKER = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                          np.array([1.3, 0.0, 1.0]))
IMAGE_RATE, ODOMETRY_RATE = 15, 100  # Hz


def carried(time: float) -> Transform:
    """Return base_link in odom, s after the start, carried by 0.7 m and turned by 20 degrees."""
    place = np.array([0.35 * np.sin(2.1 * time), 0.15 * np.sin(1.5 * time + 1.0),
                      1.0 + 0.08 * np.sin(1.1 * time)])
    return Transform.from_quaternion(place, quaternion_from_rpy(
        0.12 * np.sin(1.7 * time), 0.1 * np.sin(2.3 * time + 0.5), 0.17 * np.sin(1.3 * time)))


def write_carried(path: Path, seconds: float = 5.0) -> Path:
    """Write the bag."""
    marker = WarpedMarker('DICT_4X4_50', 0, SIDE_LENGTH, focal=300.0)
    rng = np.random.default_rng(3)
    with BagWriter(path) as writer:
        for n in range(round(seconds * ODOMETRY_RATE)):
            time = n / ODOMETRY_RATE
            _write_odometry(writer, time, rng)
            if n % (ODOMETRY_RATE // IMAGE_RATE) == 3:
                _write_image(writer, marker, time + 0.003, n)
    return path


def _write_odometry(writer: BagWriter, time: float, rng: np.random.Generator) -> None:
    body, step = carried(time), 1e-4
    after, before = carried(time + step), carried(time - step)
    velocity = (after.translation - before.translation) / (2.0 * step)
    W = body.rotation.T @ (after.rotation - before.rotation) / (2.0 * step)
    stamp = START + round(time * 1e9)
    message = odometry(
        empty, stamp, 'odom', 'base_link',
        body.translation + 0.001 * rng.standard_normal(3), body.quaternion,
        body.rotation.T @ velocity + 0.01 * rng.standard_normal(3),
        np.array([W[2, 1], W[0, 2], W[1, 0]]) + 0.002 * rng.standard_normal(3),
        np.diag([1e-4] * 6), np.diag([4e-4] * 6))
    writer.write('/odom', ODOMETRY, stamp + 2_000_000, serialize(message, ODOMETRY))


def _write_image(writer: BagWriter, marker: WarpedMarker, time: float, seed: int) -> None:
    pixels = marker.image([(carried(time) @ T_BASE_CAMERA).inverse() @ T_ODOM_MARKER], seed)
    stamp, camera = START + round(time * 1e9), marker.camera
    info = empty('sensor_msgs/msg/CameraInfo')
    image = empty('sensor_msgs/msg/Image')
    for message in (info, image):
        set_stamp(message.header.stamp, stamp)
        message.header.frame_id = 'camera'
        message.height, message.width = pixels.shape
    info.distortion_model, info.d = 'plumb_bob', np.zeros(5)
    info.k, info.r = camera.matrix.ravel().copy(), np.eye(3).ravel()
    info.p = np.hstack([camera.matrix, np.zeros((3, 1))]).ravel()
    image.encoding, image.step, image.data = 'mono8', pixels.shape[1], pixels.ravel()
    writer.write('/camera_info', 'sensor_msgs/msg/CameraInfo', stamp + 9_000_000,
                 serialize(info, 'sensor_msgs/msg/CameraInfo'))
    writer.write('/image_raw', 'sensor_msgs/msg/Image', stamp + 10_000_000,
                 serialize(image, 'sensor_msgs/msg/Image'))
