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
A leader that is hidden for 3 s, with a second print of its marker on a wall behind it.

Nothing of the renderers is shared with perception: see ``warped_marker``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from warped_marker import develop, Sensor

from flock_follower.geometry import Array, quaternion_from_rpy, Transform
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.perception import markers as aruco
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import parse
from flock_follower.perception.tracker import camera_mounting, Sighting, Tracker

DICTIONARY, SIDE = 'DICT_4X4_50', 0.16
CONFIG = parse({'dictionary': DICTIONARY, 'neighbors': [{
    'name': 'leader', 'marker_id': 0, 'side_length': SIDE, 'position': [-0.2, 0.0, 0.0],
    'rpy': [np.pi / 2, 0.0, -np.pi / 2]}]})
T_BODY_MARKER = CONFIG.neighbors[0].markers[0].T_body_marker
MOUNTING = camera_mounting([0.10, 0.0, 0.0], [0.0, 0.0, 0.0])
CAMERA = CameraModel(np.array([[610.0, 0.0, 319.5], [0.0, 610.0, 239.5], [0.0, 0.0, 1.0]]),
                     np.zeros(5), 'plumb_bob', 640, 480)
IMAGE_RATE, ODOMETRY_RATE = 25, 200  # Hz
HIDDEN, BACK, END = 2.0, 5.0, 7.0  # s

_FINER, _TEXELS = 4, 24
_PAPER, _INK = 0.72, 0.03


class Frame(NamedTuple):
    """What one image told, and what is true."""

    time: float
    sighting: Sighting
    leader: Array
    """Position (3,), m."""
    print: Array
    """The body's (3,), m, that a leader with this marker would have."""

    @property
    def error(self) -> float:
        """Return by how far the leader's estimate is off, m; 0 where there is none."""
        found = self.sighting.estimates.get('leader')
        return 0.0 if found is None else float(np.linalg.norm(found.position - self.leader))

    @property
    def nees(self) -> float:
        """Return the normalised error squared of its position; 0 where there is none."""
        found = self.sighting.estimates.get('leader')
        if found is None:
            return 0.0
        off = found.position - self.leader
        return float(off @ np.linalg.solve(found.covariance[:3, :3], off))


class DuplicateFlight:
    """
    The course of one flight, drawn with a seed.

    :param appears: when the print can be seen first, s.
    :param gone: when it was seen last, s.
    :param known: when the leader can be seen first, s.
    """

    def __init__(self, seed: int, *, appears: float = 0.0, gone: float = END,
                 known: float = 0.0) -> None:
        rng = self._rng = np.random.default_rng([seed, 25])
        self.seed, self._appears, self._gone, self._known = seed, appears, gone, known
        self._swing = rng.uniform(0.0, 0.3, 3) * rng.integers(0, 2)  # m: it hovers, or moves
        self._rates, self._phases = rng.uniform(0.6, 1.2, 3), rng.uniform(0.0, 6.0, 3)
        self._place = np.array([rng.uniform(1.6, 2.2), rng.uniform(-0.2, 0.2), 1.0])
        away, side = rng.uniform(1.2, 2.2), rng.choice([-1.0, 1.0])
        across = rng.uniform(0.5, 0.8)
        offset = np.array([np.sqrt(away**2 - across**2), side * across, rng.uniform(-0.2, 0.3)])
        self.wall = Transform.from_quaternion(
            self._place + offset, quaternion_from_rpy(0.0, 0.0, rng.uniform(-0.3, 0.3)))
        self._background = np.clip(0.25 + np.sum([
            cv2.resize(rng.normal(0.0, 0.06, (n, n)), (CAMERA.width, CAMERA.height),
                       interpolation=cv2.INTER_CUBIC) for n in (5, 11, 25, 60)], axis=0),
            0.02, 0.9)

    def leader(self, time: float) -> Transform:
        """Return its body in odom."""
        swing = self._swing * np.sin(self._rates * time + self._phases)
        return Transform.from_quaternion(self._place + swing, quaternion_from_rpy(
            0.03 * np.sin(1.3 * time), 0.04 * np.sin(1.9 * time), 0.2 * np.sin(0.7 * time)))

    def own(self, time: float) -> Transform:
        """Return the follower's body in odom."""
        place = np.array([0.15 * np.sin(1.1 * time), 0.1 * np.sin(0.9 * time + 1.0),
                          1.0 + 0.05 * np.sin(0.8 * time)])
        return Transform.from_quaternion(place, quaternion_from_rpy(
            0.03 * np.sin(1.7 * time), 0.03 * np.sin(2.3 * time + 0.5), 0.05 * np.sin(time)))

    def odometry(self, time: float) -> OdometrySample:
        """Return the odometry of a time, with noise."""
        step = 1e-4
        body, before, after = (self.own(time + s) for s in (0.0, -step, step))
        velocity = (after.translation - before.translation) / (2.0 * step)
        W = body.rotation.T @ (after.rotation - before.rotation) / (2.0 * step)
        noise = self._rng.standard_normal((3, 3))
        return OdometrySample(
            time, body.translation + 0.001 * noise[0], body.quaternion,
            velocity + 0.01 * noise[1],
            np.array([W[2, 1], W[0, 2], W[1, 0]]) + 0.002 * noise[2])

    def image(self, time: float) -> GrayImage:
        """Return what the camera sees."""
        seen = self._background.copy()
        T_camera_odom = (self.own(time) @ MOUNTING).inverse()
        if self._appears <= time < self._gone:
            _paint(seen, T_camera_odom @ self.wall @ T_BODY_MARKER)
        if self._known <= time and not HIDDEN <= time < BACK:
            _paint(seen, T_camera_odom @ self.leader(time) @ T_BODY_MARKER)
        return develop(seen, 1000 * self.seed + round(time * IMAGE_RATE), Sensor())

    def frames(self, tracker: Tracker | None = None, end: float = END) -> Iterator[Frame]:
        """Yield what a tracker makes of every image."""
        tracker = tracker or Tracker(CONFIG, MOUNTING)
        per_image = ODOMETRY_RATE // IMAGE_RATE
        for k in range(round(end * ODOMETRY_RATE)):
            time = k / ODOMETRY_RATE
            tracker.feed_odometry(self.odometry(time))
            if k % per_image == 1:
                yield Frame(time, tracker.process_image(time, self.image(time), CAMERA),
                            self.leader(time).translation, self.wall.translation)


def _paint(image: Array, T_camera_marker: Transform) -> None:
    """Draw a print with a quiet zone of one cell over an image (H, W) of light."""
    code = np.pad(aruco.marker_code(DICTIONARY, 0), 1, constant_values=True)
    texture = np.kron(np.where(code, _PAPER, _INK), np.ones((_TEXELS, _TEXELS)))
    half = 0.5 * SIDE * len(code) / (len(code) - 2)
    corners = CAMERA.project(T_camera_marker.apply(
        np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0],
                  [-half, -half, 0.0]])))
    height, width = image.shape
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, (width, height))
    size = high - low
    if not np.all(np.isfinite(corners)) or size.min() <= 0:
        return
    edge = len(texture) - 0.5
    warp = cv2.getPerspectiveTransform(
        np.array([[-0.5, -0.5], [edge, -0.5], [edge, edge], [-0.5, edge]], np.float32),
        ((corners - low + 0.5) * _FINER - 0.5).astype(np.float32))
    fine = tuple((_FINER * size).tolist())
    light, cover = (cv2.resize(cv2.warpPerspective(each, warp, fine), tuple(size.tolist()),
                               interpolation=cv2.INTER_AREA)
                    for each in (texture, np.ones_like(texture)))
    part = image[low[1]:high[1], low[0]:high[0]]
    part[:] = light + (1.0 - cover) * part


def wrong(frames: Sequence[Frame]) -> list[float]:
    """Return the times of estimates that are off by more than 0.3 m with a NEES above 30."""
    return [frame.time for frame in frames if frame.error > 0.3 and frame.nees > 30.0]
