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

"""The debug image: an image with the measured neighbors drawn in."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import draw_line, GrayImage
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.measurement import Measurement
from flock_follower.perception.tracker import Sighting

ColorImage = NDArray[np.uint8]
Color = tuple[int, int, int]  # blue, green, red

STAGE_COLORS: dict[str, Color] = {
    'track': (90, 255, 90), 'roi': (0, 220, 255), 'full': (255, 120, 255)}
AXIS_COLORS: tuple[Color, ...] = ((70, 70, 255), (70, 255, 70), (255, 120, 70))
WHITE: Color = (255, 255, 255)

LINE = 20  # px from one line of text to the next


def annotate(image: GrayImage, camera: CameraModel, sighting: Sighting,
             config: NeighborConfig) -> ColorImage:
    """
    Return a copy of an image (H, W) uint8 as BGR (H, W, 3), with its sighting drawn over it.

    The drawing of a measured neighbor has the outlines of its markers that face the camera, in the
    color of the stage of detection; the axes of its body, x red, y green, z blue; and in white the
    ellipse of two standard deviations of the measured place. The text at the top lists distances,
    missing neighbors, and rejections.
    """
    canvas: ColorImage = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_GRAY2BGR)
    lines = []
    for neighbor in config.neighbors:
        measurement = sighting.measurements.get(neighbor.name)
        if measurement is None:
            lines.append(f'{neighbor.name}: not seen')
            continue
        body, stage = measurement.T_camera_body, measurement.stage
        for marker in neighbor.markers:
            pose = body @ marker.T_body_marker
            if pose.rotation[:, 2] @ pose.translation < 0.0:
                corners = marker_corners(marker.side_length)[[0, 1, 2, 3, 0]]
                draw_line(canvas, camera.project(pose.apply(corners)), STAGE_COLORS[stage])
        for axis, color in zip(np.eye(3), AXIS_COLORS):
            tip = 0.5 * neighbor.markers[0].side_length * axis
            draw_line(canvas, camera.project(body.apply(np.array([np.zeros(3), tip]))), color)
        draw_line(canvas, ellipse_pixels(camera, measurement), WHITE)
        lines.append(f'{neighbor.name}: {stage}, {np.linalg.norm(body.translation):.2f} m')
    lines += [f'{name}: the same marker again' for name in sighting.duplicates]
    lines += [f'other marker: {marker_id}' for marker_id in sighting.other_ids]
    lines += [f'{reason}: {detail}' for reason, detail in sighting.rejections]
    for n, text in enumerate(lines, 1):
        for color, thickness in ((0, 0, 0), 3), (WHITE, 1):
            cv2.putText(canvas, text, (4, LINE * n), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color,
                        thickness, cv2.LINE_AA)
    return canvas


def ellipse_pixels(camera: CameraModel, measurement: Measurement) -> Array:
    """Return the pixels (25, 2) of two standard deviations of a place; NaN if out of view."""
    pixels, by_point = camera.linearize(measurement.T_camera_body.apply(measurement.reference))
    spread = by_point[0] @ measurement.covariance[:3, :3] @ by_point[0].T
    values, axes = np.linalg.eigh(np.nan_to_num(spread))
    angle = np.linspace(0.0, 2.0 * np.pi, 25)[:, None]
    circle = np.hstack([np.cos(angle), np.sin(angle)])
    return np.asarray(pixels + 2.0 * circle * np.sqrt(np.maximum(values, 0.0)) @ axes.T)
