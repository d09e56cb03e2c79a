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
The surroundings as cast from one place, in all directions, to be looked up in real time.

A row is an elevation, a column an azimuth. Seen from elsewhere the surroundings would look
different: everything but the leader is taken to be far away. A look-up at every other pixel in
both directions, as if out of focus, takes the place of hundreds of surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import cv2
import numpy as np

from flock_desk.camera.lens import Camera, Rays
from flock_desk.camera.scene import Image, Scenery
from flock_desk.camera.surroundings import Surroundings
from flock_follower.geometry import Array, R_FLU_OPTICAL, rotation_vector_to_matrix, Transform

_TOP = math.radians(50.0)  # the highest and lowest elevations; beyond, these are repeated
_MARGIN = math.radians(60.0)  # repeated on both sides, so that no view crosses the seam
_FACES = 4
_CELL = 16  # px between the rays whose directions are computed; between them they are interpolated


@dataclass(frozen=True, eq=False)
class Panorama:
    """
    Radiances by direction.

    :param values: (rows, columns), top to bottom and, anticlockwise seen from above, from azimuth
        -_MARGIN to 2 pi + _MARGIN.
    :param focal: samples per radian.
    """

    values: Image
    focal: float

    @classmethod
    def build(cls, scenery: Scenery, position: Array, focal: float = 360.0) -> Panorama:
        """Cast rays in all directions from a position (3,), m."""
        rows = 2 * round(_TOP * focal)
        columns = round((2.0 * math.pi + 2.0 * _MARGIN) * focal)
        elevation = ((rows - 1) / 2.0 - np.arange(rows)) / focal
        azimuth = np.arange(columns) / focal - _MARGIN
        values = np.empty((rows, columns), dtype=np.float32)
        nearest = np.rint(azimuth / (math.pi / 2.0)).astype(int)
        camera = _face_camera(focal)
        surroundings = Surroundings(Rays(camera), scenery)
        for face in range(_FACES):
            heading = face * math.pi / 2.0
            pose = Transform(rotation_vector_to_matrix([0.0, 0.0, heading]) @ R_FLU_OPTICAL,
                             position)
            # Two poses, of which each gets its own place in every pixel: it smooths edges.
            seen = surroundings.seen([pose] * 2)
            for turn in np.unique(nearest[nearest % _FACES == face]):
                mine = nearest == turn
                angle = (azimuth[mine] - turn * math.pi / 2.0)[None]
                x = -np.tan(angle) + np.zeros((rows, 1))
                y = -np.tan(elevation)[:, None] / np.cos(angle)
                values[:, mine] = cv2.remap(
                    seen, (camera.focal_x * x + camera.centre_x).astype(np.float32),
                    (camera.focal_y * y + camera.centre_y).astype(np.float32), cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE)
        return cls(values, focal)

    def places(self, x: Array, y: Array, rotation: Array) -> tuple[Image, Image]:
        """
        Return columns and rows of rays (x, y, 1) of a camera whose axes ``rotation`` takes to ENU.

        The columns are continuous over a view that is not wider than 90 degrees.
        """
        heading = math.atan2(rotation[1, 2], rotation[0, 2])
        c, s = math.cos(heading), math.sin(heading)
        turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation
        ahead, left, up = (row[0] * x + row[1] * y + row[2] for row in turned)
        column = np.arctan2(left, ahead) + (heading % (2.0 * math.pi) + _MARGIN)
        elevation = np.arctan2(up, np.hypot(ahead, left))
        return ((self.focal * column).astype(np.float32),
                ((len(self.values) - 1) / 2.0 - self.focal * elevation).astype(np.float32))


class PanoramaView:
    """What a camera that turns in a panorama sees."""

    def __init__(self, camera: Camera, scenery: Scenery, viewpoint: Array) -> None:
        self._panorama = Panorama.build(scenery, viewpoint)
        self._shape = camera.height, camera.width
        columns, rows = (_CELL * (np.arange(-(-size // _CELL) + 2) - 0.5) - 0.5
                         for size in (camera.width, camera.height))
        self._coarse = camera.rays(*np.meshgrid(columns, rows))

    def seen(self, cameras: Sequence[Transform]) -> Image:
        """Return the light (height, width) in the middle one of poses of the optical frame."""
        columns, rows = self._panorama.places(
            *self._coarse, cameras[len(cameras) // 2].rotation)
        height, width = columns.shape
        half = _CELL // 2
        inner = slice(half, -half), slice(half, -half)
        columns, rows = (
            cv2.resize(m, (width * half, height * half), interpolation=cv2.INTER_LINEAR)[inner]
            for m in (columns, rows))
        seen = cv2.remap(self._panorama.values, columns, rows, cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_REPLICATE)
        full = cv2.resize(seen, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        return full[:self._shape[0], :self._shape[1]]  # type: ignore[return-value]


def _face_camera(focal: float) -> Camera:
    """Return a camera that sees 90 degrees in azimuth, and _TOP where that reaches least."""
    half_width = math.ceil(1.01 * focal)
    half_height = math.ceil(focal * math.tan(_TOP) / math.cos(math.pi / 4.0))
    return Camera(2 * half_width, 2 * half_height, focal, focal, half_width - 0.5,
                  half_height - 0.5, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
