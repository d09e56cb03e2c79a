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

"""Rolling shutter: when a row was exposed, and what the rows do to a marker's pose."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
from marker_images import CONFIG, make_camera, render, TAIL
import numpy as np
import pytest

from flock_follower.geometry import Array, rotation_vector_to_quaternion, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception.images import GrayImage
from flock_follower.perception.look import row_delay
from flock_follower.perception.time_offset import MountedCamera
from flock_follower.perception.tracker import camera_mounting, Tracker

CAMERA = make_camera()
READOUT = 0.03
ROWS = range(160, 330)  # where the marker is


@pytest.mark.parametrize(('height', 'share'), [
    (-0.3, 0.3), (0.0, 0.5), (0.3, 0.7), (9.0, 0.5)])  # outside the image: its middle
def test_a_row_lower_in_the_image_is_exposed_later(height: float, share: float) -> None:
    seen = np.array([0.0, height, 2.0])
    assert row_delay(CAMERA, READOUT, seen) == pytest.approx(READOUT * share, abs=0.002)


@cache
def rays_of_rows() -> list[Array]:
    """Return the rays (n, 3) of the pixels of each of ROWS."""
    u = np.arange(CAMERA.width, dtype=float)
    return [np.column_stack([CAMERA.undistort(np.column_stack([u, np.full_like(u, row)])),
                             np.ones_like(u)]) for row in ROWS]


def rolled(T_camera_marker_at: Callable[[float], Transform], seed: int = 0) -> GrayImage:
    """Return an image whose rows are exposed one after another, given the pose later, s."""
    middle = T_camera_marker_at(0.5 * READOUT)
    sharp = render(CAMERA, {0: middle}, rays=2, noise=0.0, seed=seed)
    source = np.full((CAMERA.height, CAMERA.width, 2), -1.0, dtype=np.float32)
    for row, ray in zip(ROWS, rays_of_rows()):
        pose = T_camera_marker_at(READOUT * row / CAMERA.height)
        normal = pose.rotation[:, 2]
        hit = ray * ((normal @ pose.translation) / (ray @ normal))[:, None]
        source[row] = CAMERA.project(middle.apply(pose.inverse().apply(hit)))
    image = cv2.remap(sharp, source[..., 0].copy(), source[..., 1].copy(), cv2.INTER_CUBIC,
                      borderMode=cv2.BORDER_REPLICATE)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


MOUNTING = camera_mounting([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])


@pytest.fixture(scope='module')
def pitching() -> list[tuple[float, GrayImage]]:
    """Return stamps and images of a leader at rest from a drone that pitches at its place."""
    leader = Transform(rotation_vector_to_matrix([0.0, 0.15, 0.3]), np.array([2.2, 0.0, 0.0]))

    def own(t: float) -> Transform:
        return Transform(rotation_vector_to_matrix([0.0, 0.06 * np.sin(8.0 * t), 0.0]))
    return [(stamp, rolled(lambda later, stamp=stamp: (
        own(stamp + later) @ MOUNTING).inverse() @ leader @ TAIL, k))
        for k, stamp in enumerate(0.05 * np.arange(18))]


@pytest.mark.parametrize('known', [True, False])
def test_turning_drone_with_rolling_shutter_sees_still_leader(
        known: bool, pitching: list[tuple[float, GrayImage]]) -> None:
    """It pitches up and down at up to 0.5 rad/s; the leader and its own place are at rest."""
    camera = MountedCamera(MOUNTING, readout_time=READOUT if known else 0.0)
    tracker = Tracker(CONFIG, {'': camera})
    speeds, ranges = [], []
    for k, (stamp, image) in enumerate(pitching):
        for t in np.arange(stamp - 0.05, stamp + 0.045, 0.005):
            tracker.feed_odometry(OdometrySample(
                t, np.zeros(3), rotation_vector_to_quaternion([0.0, 0.06 * np.sin(8.0 * t), 0.0]),
                np.zeros(3), np.array([0.0, 0.48 * np.cos(8.0 * t), 0.0])))
        estimate = tracker.process_image(stamp, image, CAMERA).estimates['leader']
        if k >= 6:
            speeds.append(np.linalg.norm(estimate.velocity))
            ranges.append(estimate.position[0] - 2.2)
    rms = [float(np.sqrt(np.mean(np.square(values)))) for values in (speeds, ranges)]
    if known:
        assert rms[0] < 0.04
        assert rms[1] < 0.004
    else:
        assert rms[0] > 0.06
