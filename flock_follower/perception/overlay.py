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

"""The image as perception understood it: outlines, axes, uncertainty and words, for people."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, skew
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edge_fit import marker_corners
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import Marker, NeighborConfig
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.tracker import Sighting

ColorImage = NDArray[np.uint8]
Color = tuple[int, int, int]  # blue, green, red

STAGE_COLORS: dict[str, Color] = {
    'track': (90, 255, 90), 'roi': (0, 220, 255), 'full': (255, 120, 255)}
AXIS_COLORS: tuple[Color, ...] = ((70, 70, 255), (70, 255, 70), (255, 120, 70))
WHITE: Color = (255, 255, 255)
HALO: Color = (0, 0, 0)  # under every line, so that it shows on bright and on dark alike

STEPS = 16  # pieces of a straight line, which a lens bends
FAR = 16384.0  # px; points farther outside than any image are not drawn
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel


def annotate(image: GrayImage, camera: CameraModel, sighting: Sighting,
             config: NeighborConfig) -> ColorImage:
    """
    Return a copy of an image (H, W) uint8 as BGR (H, W, 3), with its sighting drawn over it.

    Of each neighbour: the outlines of its markers that face the camera, in the colour of the
    stage, a dot at their top left corners; its body's axes, x red, y green, z blue, as long as
    half the first marker's side; the ellipse of two deviations of its position; name, stage,
    distance and its deviation. The top left corner lists the rejections.
    """
    canvas: ColorImage = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_GRAY2BGR)
    lines = [f'{reason}: {detail}' if detail else reason
             for reason, detail in sighting.rejections]
    for neighbor in config.neighbors:
        measurement = sighting.measurements.get(neighbor.name)
        if measurement is None:
            lines.append(f'{neighbor.name}: not seen')
        else:
            _draw_neighbor(canvas, camera, measurement, neighbor.markers)
    lines += [f'{name}: the same marker again' for name in sighting.duplicates]
    if sighting.other_ids:
        lines.append(f'other markers: {", ".join(map(str, sighting.other_ids))}')
    for n, line in enumerate(lines):
        _write(canvas, (0.0, 1.3 * _em(canvas) * n), line, WHITE)
    return canvas


def body_covariance(measurement: Measurement) -> Array:
    """
    Return the covariance (3, 3), m^2, of the body's position along the camera's axes.

    The body is at p = q - R c with q the position of its point c that was measured, and a
    rotation vector r that turns R moves it by -r x R c.
    """
    arm = measurement.T_camera_body.rotation @ measurement.reference
    by_measured = np.hstack([np.eye(3), skew(arm)])
    result: Array = by_measured @ measurement.covariance @ by_measured.T
    return result


def ellipse(camera: CameraModel, position: Array, covariance: Array,
            deviations: float = 2.0) -> Array:
    """
    Return the pixels (49, 2) of the error ellipse of a position in the image.

    The covariance in the image is J P J^T to first order, with the Jacobian J of the projection
    at the position (3,), m, and P (3, 3), m^2. NaN if the position is not in view.
    """
    pixels, jacobians = camera.linearize(position)
    spread = jacobians[0] @ covariance @ jacobians[0].T
    if not np.all(np.isfinite(spread)):
        return np.full((3 * STEPS + 1, 2), np.nan)
    values, axes = np.linalg.eigh(spread)
    angle = np.linspace(0.0, 2.0 * np.pi, 3 * STEPS + 1)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    result: Array = pixels[0] + deviations * circle * np.sqrt(np.maximum(values, 0.0)) @ axes.T
    return result


def _draw_neighbor(canvas: ColorImage, camera: CameraModel, measurement: Measurement,
                   markers: Sequence[Marker]) -> None:
    color, body = STAGE_COLORS[measurement.stage], measurement.T_camera_body
    covariance = body_covariance(measurement)
    rim = ellipse(camera, body.translation, covariance)
    shown = [rim]
    for marker in markers:
        pose = body @ marker.T_body_marker
        if pose.rotation[:, 2] @ pose.translation >= 0.0:
            continue  # faces away
        outline = camera.project(_finely(pose.apply(
            marker_corners(marker.side_length)[[0, 1, 2, 3, 0]])))
        shown.append(outline)
        _polyline(canvas, outline, color, width=2)
        _polyline(canvas, outline[[0, 0]], color, width=5)
    length = 0.5 * markers[0].side_length
    for axis, axis_color in zip(np.eye(3), AXIS_COLORS):
        line = camera.project(_finely(body.apply(np.array([np.zeros(3), length * axis]))))
        shown.append(line)
        _polyline(canvas, line, axis_color, width=2)
    _polyline(canvas, rim, WHITE)
    distance = float(np.linalg.norm(body.translation))
    along = body.translation / max(distance, 1e-9)
    deviation = max(float(along @ covariance @ along), 0.0)**0.5
    _label(canvas, np.vstack(shown), color, [
        f'{measurement.name} {measurement.stage}', f'{distance:.2f} m +- {deviation:.3f}'])


def _finely(points: Array) -> Array:
    """Return a polyline (N, 3) with ``STEPS`` pieces for each of its own."""
    fraction = np.linspace(0.0, 1.0, STEPS, endpoint=False)[:, None]
    pieces = [start + fraction * (end - start) for start, end in pairwise(points)]
    return np.vstack([*pieces, points[-1:]])


def _polyline(canvas: ColorImage, pixels: Array, color: Color, width: int = 1) -> None:
    """Draw a line through pixels (N, 2), left out where they are NaN or far outside."""
    inside = np.all(np.abs(pixels) < FAR, axis=1)
    fixed = np.rint(np.where(inside[:, None], pixels, 0.0) * 2**_SHIFT).astype(np.int32)
    runs = np.split(np.arange(len(pixels)), np.flatnonzero(np.diff(inside)) + 1)
    lines = [fixed[run].reshape(-1, 1, 2) for run in runs if inside[run[0]]]
    thickness = width * _thickness(canvas)
    for hue, broad in ((HALO, thickness + 3), (color, thickness)):
        cv2.polylines(canvas, lines, False, hue, broad, cv2.LINE_AA, _SHIFT)


def _label(canvas: ColorImage, pixels: Array, color: Color, lines: Sequence[str]) -> None:
    """Write lines above what is drawn at pixels (N, 2), or below where there is no room."""
    height, width = canvas.shape[:2]
    pixels = pixels[np.all((pixels > -0.5) & (pixels < [width - 0.5, height - 0.5]), axis=1)]
    if not len(pixels):
        return
    leading = 1.3 * _em(canvas)
    block = leading * len(lines)
    top = pixels[:, 1].min() - block - 0.3 * leading
    if top < 0.0:
        top = min(pixels[:, 1].max() + 0.3 * leading, height - block)
    for n, line in enumerate(lines):
        _write(canvas, (pixels[:, 0].min(), top + n * leading), line, color)


def _write(canvas: ColorImage, corner: tuple[float, float], text: str, color: Color) -> None:
    """Write a line on a dimmed ground, its top left corner at a pixel, or left of that."""
    em = _em(canvas)
    # A ground, not a halo: OpenCV 5 sets letters of another weight wider.
    style = (cv2.FONT_HERSHEY_SIMPLEX, em / 30.0)
    length = cv2.getTextSize(text, *style, 1)[0][0] + 0.6 * em
    x = int(max(min(corner[0], canvas.shape[1] - length), 0.0))
    y = int(max(corner[1], 0.0))
    ground = canvas[y:y + round(1.3 * em), x:x + round(length)]
    ground[:] = ground // 3
    cv2.putText(canvas, text, (round(x + 0.3 * em), round(y + em)), *style, color, 1, cv2.LINE_AA)


def _em(canvas: ColorImage) -> float:
    """Return the size of text, px: legible when the image fills a window."""
    return max(14.0, canvas.shape[0] / 32.0)


def _thickness(canvas: ColorImage) -> int:
    return max(1, round(canvas.shape[0] / 600.0))
