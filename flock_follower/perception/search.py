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
Searches an image for markers: near an expected place, or everywhere; quickly, or thoroughly.

A quick search is OpenCV's detector, which needs a complete outline, and reads all cells with one
threshold. A thorough search finds given markers even if the edge of a shadow crosses them, or a
reflex covers a part. It uses the logarithm of the image, in which a shadow darkens black and white
by the same amount. The outline is the convex hull of a dark region; if a reflex has cut a side,
this side is removed, and the two adjacent sides are extended.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
import math

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.markers import (
    detect,
    Detections,
    marker_cells,
    marker_code,
    marker_corners,
    NO_DETECTIONS,
    outwards,
)
from flock_follower.perception.print_model import cell_code, shows_code

#: Near an expected place the image is scaled so that the marker's side has this many px.
SIDE = 56.0
#: From this width on, px, a whole image is searched at half its size.
LARGE_WIDTH = 1280
_LOGARITHM = np.log(np.arange(256.0) + 12.0)  # of gray levels; below about 12 they are noise
_LOGARITHM = np.rint(np.interp(_LOGARITHM, _LOGARITHM[[0, -1]], [0, 255])).astype(np.uint8)
#: Side of the window for the mean, px, and of the brush that removes narrower areas. A narrow
#: window finds outlines across the edge of a shadow, a wide one finds blurred and noisy outlines.
#: The brush cuts off the dark rim of a shadow that crosses the paper.
_SEARCH_WINDOWS = ((7, 1), (31, 1), (11, 3))
#: Likewise for an image of half the size: a covered marker may have an outline only there.
_HALVED = (15, 1)
#: Portions of the search of a whole image, one in an image: a quick one, a thorough one with each
#: window, and one at half the size.
N_PORTIONS = 2 + len(_SEARCH_WINDOWS)
_MIN_DARKNESS = 7  # steps of the logarithm by which a dark pixel is below the window's mean
_MIN_OUTLINE = 40  # px, length of an outline
_MAX_ELONGATION = 32.0  # squared length over area; of a square 16
_STRAIGHT_SHARE = 0.012  # of the outline's length: smaller deviations are no corners
_MAX_HIDDEN_SHARE = 0.35  # of the visible area: a reflex may hide up to this
_BLUNT_SHARE = 0.05  # of that largest hidden area: less is a blunt corner, not a reflex
_MAX_CORNERS = 7  # of a hull: one with more is no square, whatever hides it
#: Correlation of cells with the print, relative to the cells beside them, from which on a
#: quadrilateral may be a marker. Of clutter, 99 % have less.
_LIKENESS = 0.75
#: Number of quadrilaterals, the likest ones, that are read cell by cell.
_MOST_READ = 6


def near(image: GrayImage, camera: CameraModel, dictionary: str, neighbor: MarkedNeighbor,
         expected: Transform, thorough: bool) -> Detections:
    """
    Return the markers near the expected pose of a neighbor (``T_camera_body``).

    :param thorough: whether to search thoroughly, for the neighbor's own markers.
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
    return _search(image, (x0, y0, x1, y1), scale, dictionary,
                   neighbor.markers if thorough else None)


def everywhere(image: GrayImage, dictionary: str, markers: Sequence[Marker] | None = None,
               border: int = 1,
               windows: Sequence[tuple[int, int]] = _SEARCH_WINDOWS) -> Detections:
    """
    Return the markers in an image.

    :param markers: the markers for a thorough search; None: a quick search for the whole
        dictionary.
    :param border: of a quick search, see ``markers.detect``.
    :param windows: of a thorough search, as _SEARCH_WINDOWS.
    """
    height, width = image.shape
    scale = 0.5 if width >= LARGE_WIDTH else 1.0
    return _search(image, (0, 0, width, height), scale, dictionary, markers, border, windows)


def portion(image: GrayImage, dictionary: str, markers: Sequence[Marker], number: int,
            border: int = 1) -> Detections:
    """
    Return the markers that one portion of a search of the whole image finds.

    :param number: of the portion, below :data:`N_PORTIONS`; 0 is a quick search for the whole
        dictionary.
    """
    if number == 0:
        return everywhere(image, dictionary, border=border)
    if number <= len(_SEARCH_WINDOWS):
        return everywhere(image, dictionary, markers, windows=_SEARCH_WINDOWS[number - 1:number])
    height, width = image.shape
    return _search(image, (0, 0, width, height), 0.25 if width >= LARGE_WIDTH else 0.5, dictionary,
                   markers, windows=(_HALVED,))


def _search(image: GrayImage, region: tuple[int, int, int, int], scale: float, dictionary: str,
            markers: Sequence[Marker] | None, border: int = 1,
            windows: Sequence[tuple[int, int]] = _SEARCH_WINDOWS) -> Detections:
    x0, y0, x1, y1 = region
    part = image[y0:y1, x0:x1]
    if scale != 1.0:
        size = max(round(scale * (x1 - x0)), 1), max(round(scale * (y1 - y0)), 1)
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1.0
                          else cv2.INTER_LINEAR)
    part = np.ascontiguousarray(part)
    found = (detect(part, dictionary, border) if markers is None
             else _read(part, dictionary, markers, windows))
    # Pixel centers are whole numbers: half a pixel off before scaling, and after.
    scales = np.array([part.shape[1] / (x1 - x0), part.shape[0] / (y1 - y0)])
    corners: Array = (found.corners + 0.5) / scales - 0.5 + np.array([x0, y0])
    return Detections(found.ids, corners)


def _read(image: GrayImage, dictionary: str, markers: Sequence[Marker],
          windows: Sequence[tuple[int, int]]) -> Detections:
    """Return the given markers in an image, the most similar outline first."""
    logarithm = cv2.LUT(image, _LOGARITHM)
    outlines = outwards(quadrilaterals(logarithm, windows), 0.5)
    if not len(outlines):
        return NO_DETECTIONS
    cells = marker_cells(dictionary)
    square = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], dtype=np.float32)
    rows, columns = np.mgrid[-1:cells + 1, -1:cells + 1] + 0.5
    middles = np.stack([columns.ravel() / cells, rows.ravel() / cells, np.ones(rows.size)])
    x, y, w = np.moveaxis(_from_square(outlines).dot(middles), 1, 0)
    seen = _local(cv2.remap(logarithm, (x / w).astype(np.float32), (y / w).astype(np.float32),
                            cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    ids: list[int] = []
    corners: list[Array] = []
    for marker in markers:
        printed = np.pad(marker_code(dictionary, marker.marker_id), 1, constant_values=True)
        likeness = seen.dot(_local(np.array([np.rot90(printed, turn).ravel()
                                             for turn in range(4)])).T)
        code = cell_code(marker, dictionary)
        likest = likeness.max(axis=1)
        likely = min(np.count_nonzero(likest > _LIKENESS), _MOST_READ)
        for k in np.argsort(-likest)[:likely].tolist():
            outline = np.roll(outlines[k], int(likeness[k].argmax()), axis=0)
            if any(known == marker.marker_id and math.dist(
                    other.mean(axis=0), outline.mean(axis=0)) < math.dist(*other[:2])
                    for known, other in zip(ids, corners)):
                continue
            to_image = cv2.getPerspectiveTransform(square, outline.astype(np.float32))
            pixels = cv2.perspectiveTransform(code.grid[None] + 0.5, to_image)[0]
            if shows_code(image, pixels, code):
                ids.append(marker.marker_id)
                corners.append(outline)
    return Detections(np.array(ids, dtype=np.int64), np.reshape(corners, (-1, 4, 2)))


def _from_square(outlines: Array) -> Array:
    """
    Return the homographies (n, 3, 3) from the unit square to quadrilaterals (n, 4, 2).

    Heckbert, "Fundamentals of texture mapping and image warping", 1989: cv2 takes one at a time.
    """
    first, second, third, fourth = np.moveaxis(outlines, 1, 0)
    skewed = first - second + third - fourth
    along, down = second - third, fourth - third
    area = along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0]
    area = np.where(np.abs(area) > 1e-9, area, 1e-9)
    g = (skewed[:, 0] * down[:, 1] - skewed[:, 1] * down[:, 0]) / area
    h = (along[:, 0] * skewed[:, 1] - along[:, 1] * skewed[:, 0]) / area
    found: Array = np.empty((len(outlines), 3, 3))
    found[:, :2, 0] = second - first + g[:, None] * second
    found[:, :2, 1] = fourth - first + h[:, None] * fourth
    found[:, :2, 2] = first
    found[:, 2, 0], found[:, 2, 1], found[:, 2, 2] = g, h, 1.0
    return found


def _local(brightness: Array) -> Array:
    """Return squares (n, c) with each cell minus the mean around it, each row of norm 1."""
    differs = brightness.astype(float).dot(_differences(math.isqrt(brightness.shape[1])))
    return differs / np.maximum(np.linalg.norm(differs, axis=1, keepdims=True), 1e-6)


@lru_cache(maxsize=16)
def _differences(side: int) -> Array:
    """Return the matrix that subtracts from each cell the mean of the 3 x 3 cells around it."""
    cells = np.eye(side * side).reshape(-1, side, side)
    return np.array([(cell - cv2.blur(cell, (3, 3))).ravel() for cell in cells])


def quadrilaterals(logarithm: GrayImage,
                   windows: Sequence[tuple[int, int]] = _SEARCH_WINDOWS) -> Array:
    """Return the quadrilaterals, (n, 4, 2), px, clockwise, that may be the outlines of markers."""
    smooth = cv2.blur(logarithm, (3, 3))
    outlines, areas = [], []
    for window, brush in windows:
        dark = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C,
                                     cv2.THRESH_BINARY_INV, window, _MIN_DARKNESS)
        if brush > 1:
            dark = cv2.morphologyEx(
                dark, cv2.MORPH_OPEN, np.ones((brush, brush), dtype=np.uint8))
        contours, tree = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        holes = [] if tree is None else (tree[0, :, 3] >= 0).tolist()
        for contour, hole in zip(contours, holes):
            if hole or len(contour) < 4 or (
                    sum(cv2.boundingRect(contour)[2:]) < _MIN_OUTLINE // 2):
                continue
            hull = cv2.convexHull(contour)
            length, area = cv2.arcLength(hull, True), cv2.contourArea(hull)
            if _MIN_OUTLINE < length < math.sqrt(_MAX_ELONGATION * area):
                outline = cv2.approxPolyDP(hull, _STRAIGHT_SHARE * length, True)
                if 4 <= len(outline) <= _MAX_CORNERS:
                    outlines.append(outline[:, 0])
                    areas.append(area)
    return _squares(outlines, _MAX_HIDDEN_SHARE * np.array(areas))


def _squares(outlines: list[Array], max_hidden: Array) -> Array:
    """
    Return the quadrilaterals that convex outlines may be the visible parts of, (n, 4, 2).

    Of more than five sides the one that hides least is removed (of equals, the one whose new
    corner is farthest left), until five are left. Of five, a side that hides next to nothing is
    removed; without such a side, any of the five may be the end of a reflex.

    :param outlines: corners (4 to _MAX_CORNERS, 2) of each, clockwise.
    :param max_hidden: the largest area that may be hidden of each, px^2.
    """
    counts = np.array([len(outline) for outline in outlines])
    index, corners = np.zeros(0, dtype=np.intp), np.zeros((0, _MAX_CORNERS, 2))
    several: list[Array] = []  # of which one side of five is removed
    for count in range(_MAX_CORNERS, 4, -1):
        with_count = (counts == count).nonzero()[0]
        index = np.concatenate([index, with_count])
        corners = np.concatenate([corners, np.reshape(
            [outlines[k] for k in with_count.tolist()], (-1, count, 2))])
        fewer, hidden = _without_sides(corners)
        hidden = np.where(hidden < max_hidden[index, None], hidden, np.inf)
        least = np.where(hidden == hidden.min(axis=1, keepdims=True),
                         fewer[:, :, 0].dot((1.0, 1e-6)), np.inf).argmin(axis=1)
        removed = hidden.min(axis=1) < (
            np.inf if count > 5 else _BLUNT_SHARE * max_hidden[index])
        if count == 5:
            several.append(fewer[(hidden < np.inf) & ~removed[:, None]])
        index, corners = index[removed], fewer[removed, least[removed]]
    whole = [outline for outline in outlines if len(outline) == 4]
    return np.concatenate([np.reshape(whole, (-1, 4, 2)), corners, *several])


def _without_sides(corners: Array) -> tuple[Array, Array]:
    """
    Return convex outlines (n, c, 2) with each side removed, (n, c, c - 1, 2), and what it hid.

    The sides before and after are prolonged until they meet. What is hidden, (n, c), px^2, is
    NaN if they do not meet.
    """
    count = corners.shape[1]
    a, b, c, d = (np.roll(corners, -k, axis=1) for k in range(4))
    (ax, ay), (bx, by), (cx, cy) = (np.moveaxis(leg, 2, 0) for leg in (b - a, c - b, d - c))
    across = ax * cy - ay * cx
    further = (bx * cy - by * cx) / np.where(across > 1e-9, across, np.nan)
    hidden = 0.5 * further * (ax * by - ay * bx)
    met = b + further[:, :, None] * (b - a)
    others = (np.arange(count)[:, None] + np.arange(3, count + 1)) % count
    return np.concatenate([met[:, :, None], corners[:, others]], axis=2), hidden
