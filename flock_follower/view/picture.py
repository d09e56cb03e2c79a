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

"""The picture of the live page: the camera's image with the scene drawn in."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, quaternion_to_matrix, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.encoding import encode_jpeg
from flock_follower.perception.images import draw_line, FARTHEST_PIXEL, GrayImage
from flock_follower.view.flight import shadow
from flock_follower.view.scene import ARROW, BOX, COLORS, ELLIPSOID, LINE, Shape, TEXT

WIDTH = 640  # px: a wider image is reduced, for the link and the processor
QUALITY = 70  # of the JPEG: 640x480 px take about 40 kB
FONT_SCALE = 0.6  # scale of OpenCV's font: letters 13 px high
_SIGNS: Final = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5)
                          for z in (-0.5, 0.5)])
#: The edges of a box, as pairs of rows of ``_SIGNS``.
_EDGES: Final = [(i, j) for i in range(8) for j in range(i + 1, 8)
                 if np.count_nonzero(_SIGNS[i] != _SIGNS[j]) == 1]
#: Rotations (3, 3) that turn each pair of an ellipsoid's axes into the first two.
_TURNS: Final = [np.roll(np.eye(3), k, axis=1) for k in range(3)]

Canvas = NDArray[np.uint8]


def draw_picture(image: GrayImage, camera: CameraModel | None, T_odom_camera: Transform | None,
                 shapes: list[Shape]) -> bytes:
    """
    Return the JPEG of an image (H, W) uint8 with shapes drawn in.

    Nothing is drawn in without a calibration or a pose of the camera (optical frame).

    :raises ValueError: if the image cannot be encoded, or is not of the calibration's size.
    """
    height, width = image.shape
    scale = min(1.0, WIDTH / width)
    if camera is not None:
        camera.check_image(width, height)
    if scale < 1.0:
        image = np.asarray(cv2.resize(image, (WIDTH, max(round(height * scale), 1)),
                                      interpolation=cv2.INTER_AREA), np.uint8)
    canvas: Canvas = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_GRAY2BGR)
    if camera is not None and T_odom_camera is not None:
        to_camera = T_odom_camera.inverse()
        for shape in shapes:
            for line in outlines(shape):
                pixels = camera.project(to_camera.apply(line))
                # The middle of a pixel is whole: that of the reduced image, too.
                draw_line(canvas, (pixels + 0.5) * scale - 0.5, _color(shape.paint))
            if shape.kind == TEXT:
                at = camera.project(to_camera.apply(np.asarray(shape.position)[None]))[0]
                _text(canvas, (at + 0.5) * scale - 0.5, shape.text, _color(shape.paint, 0.5))
    return encode_jpeg(canvas, QUALITY)


def outlines(shape: Shape) -> list[Array]:
    """Return the lines of a shape, each (n, 3), m, in the frame of the odometry."""
    if shape.kind in (LINE, ARROW):
        return [np.asarray(shape.points, float)]
    rotation, center = quaternion_to_matrix(shape.quaternion), np.asarray(shape.position, float)
    if shape.kind == BOX:
        corners = center + (_SIGNS * shape.size) @ rotation.T
        return [corners[[i, j]] for i, j in _EDGES]
    if shape.kind == ELLIPSOID:
        # Three great ellipses.
        found: list[Array] = []
        for turn in _TURNS:
            ring = shadow(np.eye(3), turn @ shape.size)
            flat = np.hstack([ring, np.zeros((len(ring), 1))])
            found.append(center + flat @ turn @ rotation.T)
        return found
    return []


def _color(paint: str, white: float = 0.0) -> Any:
    """Return blue, green and red of a paint; ``white`` is the share of white in it."""
    red, green, blue, _ = COLORS[paint]
    return tuple(255.0 * (white + (1.0 - white) * share) for share in (blue, green, red))


def _text(canvas: Canvas, at: Array, text: str, color: Any) -> None:
    """Write ASCII text, dark-edged, centered above a pixel; what does not fit is moved inside."""
    if not (np.abs(at) < FARTHEST_PIXEL).all():
        return
    plain = text.encode('ascii', 'replace').decode()
    (width, height), _ = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, 1)
    rows, columns = canvas.shape[:2]
    if not (0.0 <= at[0] < columns and -2.0 * rows < at[1] < rows):
        return
    x = int(min(max(at[0] - 0.5 * width, 2), max(columns - width - 2, 2)))
    y = int(min(max(at[1], height + 4), rows - 4))
    for paint, thickness in ((0, 0, 0), 3), (color, 1):
        cv2.putText(canvas, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, paint, thickness,
                    cv2.LINE_AA)
