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

"""Images of markers at known poses, by casting rays: what the detector's tests look at."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.odometry.buffer import OdometrySample
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker, NeighborConfig
from flock_follower.perception import markers
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import detect, marker_corners
from flock_follower.perception.measurement import PosePrior
from flock_follower.perception.pose import locate, target
from flock_follower.perception.tracker import Sighting, Tracker

T = TypeVar('T')
DICTIONARY = 'DICT_4X4_50'
SIDE = 0.16  # m
#: A marker's cells (n, n) by its id, border included, True where white.
marker_code = partial(markers.marker_code, DICTIONARY)
#: T_body_marker of a marker on the tail that faces backwards; x of the body is ahead.
TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
CONFIG = NeighborConfig(DICTIONARY, (MarkedNeighbor('leader', (Marker(0, SIDE, TAIL),)),))


def known(value: T | None) -> T:
    """Return a value that must not be None."""
    assert value is not None
    return value


class Hovering:
    """A drone that hovers at a pose, and sees an image every ``period`` s."""

    def __init__(self, camera: CameraModel, mounting: Transform, pose: Transform | None = None,
                 config: NeighborConfig = CONFIG, period: float = 1.0 / 30.0) -> None:
        self.camera, self.pose, self.period = camera, pose or Transform(), period
        self.tracker, self.stamp = Tracker(config, mounting), -period

    def see(self, image: GrayImage) -> Sighting:
        self.stamp += self.period
        self.tracker.feed_odometry(OdometrySample(
            self.stamp, self.pose.translation, self.pose.quaternion, np.zeros(3), np.zeros(3)))
        return self.tracker.process_image(self.stamp, image, self.camera)


class Cover(NamedTuple):
    """Something before a marker that hides a strip of it along one side, and what is beyond."""

    side: str
    """Left, right, top or bottom."""
    share: float
    """Of the marker's side length that is hidden."""
    level: float
    """Its brightness."""

    def hides(self, x: Array, y: Array) -> Any:
        """Return where it hides places on the marker, in side lengths from its middle."""
        outwards = {'left': -x, 'right': x, 'top': y, 'bottom': -y}[self.side]
        return outwards > 0.5 - self.share


def make_camera(model: str = 'plumb_bob', width: int = 640, height: int = 480) -> CameraModel:
    """Return a camera with the distortion of a real one of 640x480, or the middle of it."""
    focal, distortion = {
        'plumb_bob': (610.0, [-0.28, 0.09, 0.001, -0.0007, 0.0]),
        'rational_polynomial': (610.0, [0.2, -0.1, 0.001, -0.0007, 0.05, 0.1, -0.05, 0.02]),
        'equidistant': (380.0, [0.03, -0.01, 0.004, -0.001]),
    }[model]
    matrix = np.array([[focal, 0.0, width / 2 + 2.5], [0.0, focal - 2.0, height / 2 - 1.8],
                       [0.0, 0.0, 1.0]])
    return CameraModel(matrix, np.array(distortion), model, width, height)


def facing(position: tuple[float, float, float], turn: tuple[float, float, float]) -> Transform:
    """Return T_camera_marker of a marker that faces the camera but for a rotation vector, rad."""
    return Transform(rotation_vector_to_matrix(turn) @ np.diag([1.0, -1.0, -1.0]),
                     np.array(position))


def render(camera: CameraModel, shown: dict[int, Transform], *, blur: float = 0.6,
           noise: float = 2.0, motion: tuple[float, float] = (0.0, 0.0), black: float = 30.0,
           white: float = 200.0, rays: int = 5, gamma: float = 1.0, cover: Cover | None = None,
           codes: Mapping[int, Any] | None = None, seed: int = 0) -> GrayImage:
    """
    Return the image of markers, T_camera_marker by id, each with a quiet zone of one cell.

    Every pixel is the mean of ``rays`` x ``rays`` rays through the lens; ``motion`` is how far,
    px, the image moves meanwhile; ``blur`` and ``noise`` are standard deviations, px and levels.
    With ``gamma``, levels are those of light before it: what is bright swells. ``codes`` are
    cells, True where white, border included, of markers that are not as the dictionary says.
    """
    rng = np.random.default_rng(seed)
    coarse = rng.normal(0.0, 25.0, (camera.height // 8 + 2, camera.width // 8 + 2))
    image = 0.5 * (black + white) + np.kron(coarse, np.ones((8, 8)))[:camera.height, :camera.width]
    for marker_id, pose in shown.items():
        code = (codes or {}).get(marker_id, marker_code(marker_id))
        _paint(image, camera, pose, code, cover, motion, black, white, rays)
    if blur:
        size = 2 * max(4, int(np.ceil(3.5 * blur))) + 1
        image = cv2.GaussianBlur(image, (size, size), blur, borderType=cv2.BORDER_REPLICATE)
    image = 255.0 * (np.maximum(image, 0.0) / 255.0)**(1.0 / gamma)
    image += rng.normal(0.0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _paint(image: Array, camera: CameraModel, pose: Transform, code: Any, cover: Cover | None,
           motion: tuple[float, float], black: float, white: float, rays: int) -> None:
    code = np.pad(code, 1, constant_values=True)
    cells = len(code)
    half = 0.5 * SIDE * cells / (cells - 2)
    outline = camera.project(pose.apply(marker_corners(2.0 * half)))
    x0, y0 = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 6, 0)
    x1, y1 = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 7,
                        (camera.width, camera.height))
    u, v = np.meshgrid(np.arange(x0, x1, dtype=float), np.arange(y0, y1, dtype=float))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    ray = camera.undistort(pixels)
    # From pixel to pixel the lens is linear to 0.001 px.
    steps = [np.gradient(ray.reshape(*u.shape, 2), axis=axis).reshape(-1, 2) for axis in (1, 0)]
    total = np.zeros(u.shape)
    offsets = (np.arange(rays) + 0.5) / rays - 0.5
    for k in range(rays * rays):
        moment = ((k * 7) % rays**2 + 0.5) / rays**2 - 0.5  # of the exposure
        xy = (ray + (offsets[k % rays] + moment * motion[0]) * steps[0]
              + (offsets[k // rays] + moment * motion[1]) * steps[1])
        direction = np.column_stack([xy, np.ones(len(xy))])
        normal = pose.rotation[:, 2]
        depth = (normal @ pose.translation) / (direction @ normal)
        hit = direction * depth[:, None]
        on_marker = pose.inverse().apply(hit)[:, :2]
        column = np.floor((on_marker[:, 0] / half + 1.0) * cells / 2).astype(int)
        row = np.floor((1.0 - on_marker[:, 1] / half) * cells / 2).astype(int)
        inside = (row >= 0) & (row < cells) & (column >= 0) & (column < cells)
        values = image[y0:y1, x0:x1].ravel().copy()
        values[inside] = np.where(code[row[inside], column[inside]], white, black)
        if cover is not None:
            values[cover.hides(*(on_marker.T / SIDE))] = cover.level
        total += values.reshape(u.shape)
    image[y0:y1, x0:x1] = total / rays**2


def seen_corners(image: GrayImage, camera: CameraModel, side: float) -> Array:
    """Return the corners (4, 2), px, of marker 0, where perception has its pose in the image."""
    marker = Marker(0, side, Transform())
    sought = target(MarkedNeighbor('leader', (marker,)), DICTIONARY)
    found = detect(image, DICTIONARY)
    assert list(found.ids) == [0]
    measured = known(locate(image, camera, sought, 0, found.corners[0], PosePrior()))
    return camera.project(measured.T_camera_body.apply(marker_corners(side)))
