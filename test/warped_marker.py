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
Images of a marker by ``cv2.warpPerspective``, in light, shade and motion.

Nothing here is shared with the renderers that perception was made with: a model that one has
written oneself agrees with one. Light is linear until the camera's gamma.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
from marker_images import marker_code, SIDE
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage

_TEXELS = 48  # per cell
_SIZE = (320, 240)  # px
_FINER = 3  # pixels of the large image per pixel, each way
_PAPER, _INK = 0.72, 0.03  # reflectance
# Of the sensor: light that fills it, blur of the lens, px, full well, noise, share of that.
_GAIN, _LENS, _ELECTRONS, _READ_NOISE = 1.2, 0.6, 12000.0, 0.004


class WarpedMarker:
    """Marker 0 before a cluttered background, seen by a pinhole camera."""

    def __init__(self, seed: int = 0) -> None:
        self.camera = CameraModel([[610.0, 0.0, 159.5], [0.0, 610.0, 119.5], [0.0, 0.0, 1.0]],
                                  [], 'plumb_bob', *_SIZE)
        code = np.pad(marker_code(0), 1, constant_values=True)
        self.cell = SIDE / (len(code) - 2)  # m
        self._print = np.kron(np.where(code, _PAPER, _INK), np.ones((_TEXELS, _TEXELS)))
        edge = np.arange(len(self._print)) + 0.5 - len(self._print) / 2
        # Texels to m on the marker: x right, y up.
        scale = self.cell / _TEXELS
        self._on_marker = np.array([[scale, 0.0, scale * edge[0]], [0.0, -scale, -scale * edge[0]],
                                    [0.0, 0.0, 1.0]])
        self._x, self._y = np.meshgrid(scale * edge / SIDE, -scale * edge / SIDE)
        rng = np.random.default_rng([seed, 77])
        self._background = np.clip(0.25 + np.sum([
            cv2.resize(rng.normal(0.0, 0.06, (n, n)), _SIZE, interpolation=cv2.INTER_CUBIC)
            for n in (5, 11, 25, 60)], axis=0), 0.02, 0.9)

    def image(self, poses: Sequence[Transform], seed: int, *,
              shade: tuple[float, float, float] | None = None, gamma: float = 2.2) -> GrayImage:
        """
        Return the image of a marker at T_camera_marker, several spread over the exposure.

        :param shade: of a half plane of the marker: its direction, rad, from the marker's x axis;
            where it begins, side lengths from the marker's middle; the share of light left there.
        """
        light = np.ones_like(self._print)
        if shade is not None:
            direction, offset, left = shade
            across = self._x * np.cos(direction) + self._y * np.sin(direction)
            light = np.where(across > offset, left, light)
        shown = np.mean([self._seen(pose, self._print * light) for pose in poses], axis=0)
        shown = cv2.GaussianBlur(np.minimum(shown * _GAIN, 1.0), (0, 0), _LENS)
        noise = np.random.default_rng([seed, 5]).normal(0.0, 1.0, shown.shape)
        shown = shown + noise * np.sqrt(np.maximum(shown, 0.0) / _ELECTRONS + _READ_NOISE**2)
        return np.rint(255.0 * np.clip(shown, 0.0, 1.0)**(1.0 / gamma)).astype(np.uint8)

    def _seen(self, pose: Transform, lit: Array) -> Array:
        plane = np.column_stack([pose.rotation[:, :2], pose.translation])
        finer = np.array([[_FINER, 0.0, (_FINER - 1) / 2], [0.0, _FINER, (_FINER - 1) / 2],
                          [0.0, 0.0, 1.0]])
        warp = finer @ self.camera.matrix @ plane @ self._on_marker
        both = np.dstack([lit, np.ones_like(lit)]).astype(np.float32)  # and what it covers
        shown, cover = np.moveaxis(cv2.resize(cv2.warpPerspective(
            both, warp, (_FINER * _SIZE[0], _FINER * _SIZE[1])), _SIZE,
            interpolation=cv2.INTER_AREA), 2, 0)
        seen: Array = shown + (1.0 - cover) * self._background
        return seen
