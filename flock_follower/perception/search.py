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

"""Searches an image for markers: near an expected place, or everywhere; quickly, or thoroughly."""

from __future__ import annotations

from collections.abc import Sequence
import math

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edge_fit import marker_corners
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import (
    detect,
    DetectionParams,
    Detections,
    MarkedNeighbor,
    Marker,
    marker_cells,
    marker_code,
    NO_DETECTIONS,
)
from flock_follower.perception.print_model import cell_code, grey_levels, shows_code

#: Sides of the adaptive threshold's window, px: one finds a marker of the size it is scaled to;
#: three, OpenCV's own, find more, also in the dark, and take three times as long.
ONE_WINDOW = DetectionParams(windows=(15, 15, 10))
THREE_WINDOWS = DetectionParams(windows=(3, 23, 10), min_perimeter=0.03, threshold=4.0)
#: Near an expected place the image is scaled so that the marker's side has this many px.
SIDE = 56.0
#: A square may be a marker if its cells correlate so much with the print.
_LIKENESS = 0.4
#: White is the brightest within so many px, wider than a marker's black cells.
_BRUSH = np.ones((61, 61), dtype=np.uint8)
#: From this width on, px, a whole image is searched at half its size.
LARGE = 1280


def near(image: GrayImage, camera: CameraModel, dictionary: str, neighbor: MarkedNeighbor,
         expected: Transform, thorough: bool) -> Detections:
    """
    Return the markers about where a neighbour is expected (``T_camera_body``).

    :param thorough: whether to look with three windows instead of one.
    """
    outlines = [camera.project((expected @ marker.T_body_marker).apply(
        marker_corners(marker.side_length))) for marker in neighbor.markers]
    outlines = [outline for outline in outlines if np.all(np.isfinite(outline))]
    if not outlines:
        return NO_DETECTIONS
    side = max(float(np.max(np.linalg.norm(o - np.roll(o, 1, axis=0), axis=1))) for o in outlines)
    places = np.concatenate(outlines)
    margin = max(24.0, 0.75 * side)
    height, width = image.shape
    x0, y0 = np.clip(places.min(axis=0) - margin, 0, (width, height)).astype(int).tolist()
    x1, y1 = np.clip(places.max(axis=0) + margin, 0, (width, height)).astype(int).tolist()
    if min(x1 - x0, y1 - y0) < margin:
        return NO_DETECTIONS
    scale = float(np.clip(SIDE / max(side, 1.0), 0.1, 2.0))
    if 0.75 < scale < 1.3:
        scale = 1.0
    return _search(image, (x0, y0, x1, y1), scale, dictionary, thorough, neighbor.markers)


def everywhere(image: GrayImage, dictionary: str, thorough: bool,
               markers: Sequence[Marker] = ()) -> Detections:
    """
    Return the markers in an image; see :func:`near`.

    :param markers: those that a thorough search also looks for in uneven light.
    """
    height, width = image.shape
    return _search(image, (0, 0, width, height), 0.5 if width >= LARGE else 1.0, dictionary,
                   thorough, markers)


def _search(image: GrayImage, region: tuple[int, int, int, int], scale: float, dictionary: str,
            thorough: bool, markers: Sequence[Marker]) -> Detections:
    x0, y0, x1, y1 = region
    part = image[y0:y1, x0:x1]
    if scale != 1.0:
        size = max(round(scale * (x1 - x0)), 1), max(round(scale * (y1 - y0)), 1)
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1.0
                          else cv2.INTER_LINEAR)
    part = np.ascontiguousarray(part)
    found = detect(part, dictionary, THREE_WINDOWS if thorough else ONE_WINDOW)
    if thorough:
        found = _in_uneven_light(part, found, dictionary, markers)
        if not len(found.ids):
            white = cv2.morphologyEx(part, cv2.MORPH_CLOSE, _BRUSH)
            flat = cv2.divide(part, np.maximum(white, 8), scale=235.0)
            found = _in_uneven_light(
                part, detect(flat, dictionary, THREE_WINDOWS), dictionary, markers)
    # Pixel centres are whole numbers: half a pixel off before scaling, and after.
    scales = np.array([part.shape[1] / (x1 - x0), part.shape[0] / (y1 - y0)])
    corners: Array = (found.corners + 0.5) / scales - 0.5 + np.array([x0, y0])
    return Detections(found.ids, corners)


def _in_uneven_light(image: GrayImage, found: Detections, dictionary: str,
                     markers: Sequence[Marker]) -> Detections:
    """Return the markers found, also those whose code a shadow or a reflex hides from OpenCV."""
    ids, corners = found.ids.tolist(), [*found.corners]
    cells = marker_cells(dictionary)
    square = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], dtype=np.float32)
    rows, columns = np.mgrid[-1:cells + 1, -1:cells + 1] + 0.5
    middles = np.stack([columns.ravel(), rows.ravel()], axis=1)
    prints = [(marker, [_local(np.rot90(np.pad(
        marker_code(dictionary, marker.marker_id), 1, constant_values=True), turn))
        for turn in range(4)]) for marker in markers]
    for outline in found.unread:
        to_image = cv2.getPerspectiveTransform(square, outline.astype(np.float32))
        light = _local(grey_levels(image, _mapped(to_image, middles)).reshape(rows.shape))
        for marker, turns in prints:
            alike = [float((light * turned).sum()) for turned in turns]
            turn = int(np.argmax(alike))
            turned = np.roll(outline, turn, axis=0)
            if alike[turn] < _LIKENESS or any(
                    known == marker.marker_id and math.dist(
                        other.mean(axis=0), outline.mean(axis=0)) < math.dist(*other[:2])
                    for known, other in zip(ids, corners)):
                continue
            code = cell_code(marker, dictionary)
            to_image = cv2.getPerspectiveTransform(square, turned.astype(np.float32))
            if shows_code(image, _mapped(to_image, code.grid + 0.5), code):
                ids.append(marker.marker_id)
                corners.append(turned)
    return Detections(np.array(ids, dtype=np.int64), np.reshape(corners, (-1, 4, 2)))


def _local(cells: Array) -> Array:
    """Return how much brighter each of the cells (n, n) is than those around, of norm 1."""
    cells = cells.astype(np.float32)
    compared: Array = cells - cv2.blur(cells, (3, 3))
    return compared / max(float(np.linalg.norm(compared)), 1e-6)


def _mapped(to_image: Array, points: Array) -> Array:
    """Return points (n, 2) of a plane in an image, px."""
    mapped: Array = cv2.perspectiveTransform(points[None].astype(np.float32), to_image)[0]
    return mapped
