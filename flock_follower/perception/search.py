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

A further search finds given markers whose code motion has smeared, or of which something covers a
side. Regions are those below each of some gray levels: of a smeared print no window separates
black from white. If a side is covered, the outline is two corners and the sides from there, which
are prolonged by several shares. Cells are compared with the prints as motion would smear them. The
code is not read: the fit of the pose to the most similar one must show it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import combinations
import math
from typing import Any

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
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
from flock_follower.perception.smear_print import N_SHARP, smear_model

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
#: Portions of the search of a whole image, one in an image: a quick one, a thorough one with each
#: window, and one at half the size for smeared and covered markers.
_PORTION_WINDOWS = (_SEARCH_WINDOWS, _SEARCH_WINDOWS[:1], (), *(
    (each,) for each in _SEARCH_WINDOWS[1:]))
N_PORTIONS = len(_PORTION_WINDOWS)
_MIN_DARKNESS = 7  # steps of the logarithm by which a dark pixel is below the window's mean
_MIN_OUTLINE = 40  # px, length of an outline
_MAX_ELONGATION = 32.0  # squared length over area; of a square 16
_STRAIGHT_SHARE = 0.012  # of the outline's length: smaller deviations are no corners
_MAX_HIDDEN_SHARE = 0.35  # of the visible area: a reflex may hide up to this
_BLUNT_SHARE = 0.05  # of that largest hidden area: less is a blunt corner, not a reflex
_MOST_CHOICES = 5  # of four sides of a hull
_MAX_CORNERS = 7  # of a hull: one with more is no square, whatever hides it
#: Correlation of cells with the print, relative to the cells beside them, from which on a
#: quadrilateral may be a marker. Of clutter, 99 % have less.
_LIKENESS = 0.75
#: Gray levels from one threshold to the next for smeared and covered markers.
_LEVEL_STEP = 12
#: Largest RMS, a share of the contrast, of a fit to a smeared print whose code was not read. Of
#: right fits it is 0.01 to 0.03, of one to another print, in another pose, 0.07.
_MAX_RMS = 0.04
_MAX_DEVIATION = 1.5  # px from a side: less is no corner
#: Least sine of the angle between a side that is whole and those beside.
_MIN_SINE = 0.6
#: Least and largest length of the visible sides beside, over that of the whole side.
_SIDE_RATIOS = 0.3, 2.5
#: Hidden shares of a marker that are tried.
_HIDDEN_SHARES = (0.0, 0.1, 0.18, 0.26)
#: Least number of sides between cells of different colors of a code that is sought in smeared and
#: covered prints: that of id 17 of DICT_4X4_50, one white square with 8, resembles clutter.
_MIN_COLOR_CHANGES = 12
#: Correlation with a smeared or covered print from which on a quadrilateral may be a marker.
_MIN_RESEMBLANCE = 0.85
#: Number of quadrilaterals, the likest ones, that are read cell by cell.
_MOST_READ = 6
#: From three sides, see _chains, to four corners.
_FROM_CHAIN = np.array([[1, 0, 0, 1], [0, 1, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
#: Inverse of the columns that _from_square makes of the unit square.
_TO_SQUARE = np.linalg.inv([[0.0, -1.0, 1.0], [0.0, 0.0, 1.0], [1.0, -1.0, 1.0]])


def near(image: GrayImage, camera: CameraModel, dictionary: str, neighbor: MarkedNeighbor,
         expected: Transform, thorough: bool, disturbed: bool = False) -> Detections:
    """
    Return the markers near the expected pose of a neighbor (``T_camera_body``).

    :param thorough: whether to search thoroughly, for the neighbor's own markers.
    :param disturbed: whether such a search is for smeared and covered markers.
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
    return _search(image, (x0, y0, x1, y1), 0.5 * scale if disturbed else scale, dictionary,
                   neighbor.markers if thorough else None,
                   windows=() if disturbed else _SEARCH_WINDOWS)


def everywhere(image: GrayImage, dictionary: str, markers: Sequence[Marker] | None = None,
               border: int = 1,
               windows: Sequence[tuple[int, int]] = _SEARCH_WINDOWS) -> Detections:
    """
    Return the markers in an image.

    :param markers: the markers for a thorough search; None: a quick search for the whole
        dictionary.
    :param border: of a quick search, see ``markers.detect``.
    :param windows: of a thorough search, as _SEARCH_WINDOWS; none: at half the size, for smeared
        and covered markers.
    """
    height, width = image.shape
    scale = (0.5 if width >= LARGE_WIDTH else 1.0) * (1.0 if windows else 0.5)
    return _search(image, (0, 0, width, height), scale, dictionary, markers, border, windows)


def portion(image: GrayImage, dictionary: str, markers: Sequence[Marker], number: int,
            border: int = 1) -> Detections:
    """
    Return the markers that one portion of a search of the whole image finds.

    :param number: of the portion, below :data:`N_PORTIONS`; 0 is a quick search for the whole
        dictionary.
    """
    return everywhere(image, dictionary, markers if number else None, border,
                      _PORTION_WINDOWS[number])


def _search(image: GrayImage, region: tuple[int, int, int, int], scale: float, dictionary: str,
            markers: Sequence[Marker] | None, border: int = 1,
            windows: Sequence[tuple[int, int]] = _SEARCH_WINDOWS) -> Detections:
    x0, y0, x1, y1 = region
    part = cv2.resize(
        image[y0:y1, x0:x1], (max(round(scale * (x1 - x0)), 1), max(round(scale * (y1 - y0)), 1)),
        interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    found = detect(part, dictionary, border) if markers is None else (
        _read(part, dictionary, markers, windows) if windows
        else _find_similar(part, dictionary, markers))
    # Pixel centers are whole numbers: half a pixel off before scaling, and after.
    scales = np.array([part.shape[1] / (x1 - x0), part.shape[0] / (y1 - y0)])
    corners: Array = (found.corners + 0.5) / scales - 0.5 + np.array([x0, y0])
    return found._replace(corners=corners)


def _read(image: GrayImage, dictionary: str, markers: Sequence[Marker],
          windows: Sequence[tuple[int, int]]) -> Detections:
    """Return the given markers in an image, the most similar outline first."""
    logarithm = cv2.LUT(image, _LOGARITHM)
    outlines = outwards(quadrilaterals(logarithm, windows), 0.5)
    cells = marker_cells(dictionary)
    square = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], dtype=np.float32)
    seen = _local(_sample_cells(logarithm, outlines, cells))
    found: list[tuple[int, Array]] = []
    for marker in markers:
        printed = np.pad(marker_code(dictionary, marker.marker_id), 1, constant_values=True)
        likeness = seen.dot(_local(np.array([np.rot90(printed, turn).ravel()
                                             for turn in range(4)])).T)
        code = cell_code(marker, dictionary)
        likest = likeness.max(axis=1)
        for k in np.argsort(-likest)[:min((likest > _LIKENESS).sum(), _MOST_READ)].tolist():
            outline = np.roll(outlines[k], int(likeness[k].argmax()), axis=0)
            if not any(known == marker.marker_id and math.dist(
                    other.mean(axis=0), outline.mean(axis=0)) < math.dist(*other[:2])
                    for known, other in found) and shows_code(
                        image, cv2.perspectiveTransform(
                            code.grid[None] + 0.5, cv2.getPerspectiveTransform(
                                square, outline.astype(np.float32)))[0], code):
                found.append((marker.marker_id, outline))
    return _detections(found)


def _find_similar(image: GrayImage, dictionary: str, markers: Sequence[Marker]) -> Detections:
    """
    Return where an image resembles given markers, smeared or with a covered side.

    No code is read: the fit of the pose must show it.
    """
    cells = marker_cells(dictionary)
    sought = [marker for marker in markers if sum(
        np.count_nonzero(np.diff(marker_code(dictionary, marker.marker_id), axis=axis))
        for axis in (0, 1)) >= _MIN_COLOR_CHANGES]
    smooth = cv2.blur(image, (3, 3))
    contours = _contours(
        cv2.threshold(smooth, level, 255, cv2.THRESH_BINARY_INV)[1]
        for level in range(int(smooth.min()) + _LEVEL_STEP, int(smooth.max()), _LEVEL_STEP))
    chains = _chains(contours)
    found: list[tuple[float, bool, int, Array]] = []
    for hidden in _HIDDEN_SHARES:
        outlines = outwards(_whole(contours) if not hidden else _pixels(
            chains * [1.0, 1.0, *[1.0 / (1.0 - hidden)] * 2] @ _FROM_CHAIN), 0.5)
        visible = np.repeat(np.arange(-1, cells + 1) + 0.5 < (1.0 - hidden) * cells, cells + 2)
        seen = _unit(_sample_cells(image, outlines, cells)[:, visible])
        for marker in sought:
            likeness = seen.dot(_unit(smear_model(marker, dictionary).by_cell[:, visible]).T)
            found += [(likeness[k].max(), likeness[k].argmax() >= 4 * N_SHARP, marker.marker_id,
                       np.roll(outlines[k], int(likeness[k].argmax()) % 4, axis=0))
                      for k in np.argsort(-likeness.max(axis=1, initial=0.0))[:1].tolist()]
    found = sorted((each for each in found if each[0] > _MIN_RESEMBLANCE),
                   key=lambda each: -each[0])
    smeared = any(each[1] for each in found[:1])
    # A fit to a smeared print takes long.
    return _detections([each[2:] for each in found[:1 if smeared else 2]],
                       _MAX_RMS if smeared else 0.0)


def _detections(found: Sequence[tuple[int, Array]], most_rms: float = 1.0) -> Detections:
    return Detections(np.array([each[0] for each in found], dtype=np.int64),
                      np.reshape([each[1] for each in found], (-1, 4, 2)), most_rms)


def _sample_cells(image: GrayImage, outlines: Array, cells: int) -> Array:
    """Return the brightness of cells, also of those around, (n, (cells + 2)^2), in outlines."""
    rows, columns = np.mgrid[-1:cells + 1, -1:cells + 1] + 0.5
    middles = np.stack([columns.ravel() / cells, rows.ravel() / cells, np.ones(rows.size)])
    if not len(outlines):
        return np.zeros((0, rows.size))
    x, y, w = np.moveaxis(_from_square(outlines).dot(middles), 1, 0)
    return cv2.remap(image, (x / w).astype(np.float32), (y / w).astype(np.float32),
                     cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)


def _unit(samples: Array) -> Array:
    """Return samples (n, s) of mean 0 and norm 1."""
    return (differs := samples - samples.mean(axis=1, keepdims=True)) / np.maximum(
        np.linalg.norm(differs, axis=1, keepdims=True), 1e-6)


def _from_square(outlines: Array) -> Array:
    """
    Return the homographies (n, 3, 3) from the unit square to quadrilaterals (n, 4, 2).

    In homogeneous coordinates the fourth corner is a sum of multiples of the others. The columns
    are these multiples, in terms of those of the unit square. cv2 takes one at a time.
    """
    corners = np.insert(outlines.astype(float), 2, 1.0, axis=2)
    first = corners[:, :3]
    across = np.cross(np.roll(first, -1, axis=1), np.roll(first, -2, axis=1))
    multiples = (across * corners[:, 3:]).sum(axis=2, keepdims=True)
    return np.asarray((multiples * first).transpose(0, 2, 1).dot(_TO_SQUARE))


def _local(brightness: Array) -> Array:
    """Return by how much cells of squares (n, c) differ from those around, as :func:`_unit`."""
    return _unit(brightness.astype(float).dot(_differences(math.isqrt(brightness.shape[1]))))


@lru_cache(maxsize=16)
def _differences(side: int) -> Array:
    """Return the matrix that subtracts from each cell the mean of the 3 x 3 cells around it."""
    cells = np.eye(side * side).reshape(-1, side, side)
    return np.array([(cell - cv2.blur(cell, (3, 3))).ravel() for cell in cells])


def quadrilaterals(logarithm: GrayImage,
                   windows: Sequence[tuple[int, int]] = _SEARCH_WINDOWS) -> Array:
    """Return the quadrilaterals, (n, 4, 2), px, clockwise, that may be the outlines of markers."""
    smooth = cv2.blur(logarithm, (3, 3))
    return _whole(_contours(cv2.morphologyEx(
        cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV,
                              window, _MIN_DARKNESS),
        cv2.MORPH_OPEN, np.ones((brush, brush), dtype=np.uint8)) for window, brush in windows))


def _contours(masks: Iterable[GrayImage]) -> list[Any]:
    """Return the outer contours, counterclockwise, of regions large enough for a marker."""
    return [contour for dark in masks for contour in cv2.findContours(
                dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0]
            if len(contour) >= 4 and sum(cv2.boundingRect(contour)[2:]) >= _MIN_OUTLINE // 2
            and cv2.contourArea(contour, True) < 0.0]  # those of holes are clockwise


def _whole(contours: Iterable[Any]) -> Array:
    """
    Return the quadrilaterals, as above, of the convex hulls of contours.

    If a hull has more corners, four of its sides are prolonged until they meet. A corner is blunt
    if they hide next to nothing; otherwise the others are where a reflex ends, and several choices
    of four are possible.
    """
    hulls = [cv2.approxPolyDP(hull, _STRAIGHT_SHARE * length, True)[:, 0]
             for hull in map(cv2.convexHull, contours)
             if _MIN_OUTLINE < (length := cv2.arcLength(hull, True)) < math.sqrt(
                 _MAX_ELONGATION * cv2.contourArea(hull))]
    found = [np.zeros((0, 4), dtype=complex)]
    for count in range(4, _MAX_CORNERS + 1):
        corners = np.reshape([hull for hull in hulls if len(hull) == count],
                             (-1, count, 2)) @ (1.0, 1.0j)
        chosen = np.array([*combinations(range(count), 4)])
        begin, along = corners[:, chosen], (np.roll(corners, -1, axis=1) - corners)[:, chosen]
        after, turned = np.roll(begin, -1, axis=2) - begin, np.roll(along, -1, axis=2)
        sine = _cross(along, turned)
        met = begin + along * (_cross(after, turned) / np.where(sine > 1e-9, sine, np.nan))
        area, met_area = (0.5 * _cross(each, np.roll(each, -1, axis=-1)).sum(axis=-1)
                          for each in (corners, met))
        hidden = np.nan_to_num(met_area / area[:, None] - 1.0, nan=np.inf)
        blunt = hidden.min(axis=1, keepdims=True) < _BLUNT_SHARE * _MAX_HIDDEN_SHARE
        found.append(met[(hidden < _MAX_HIDDEN_SHARE) & (
            hidden.argsort(axis=1).argsort(axis=1) < np.where(blunt, 1, _MOST_CHOICES))])
    return _pixels(np.concatenate(found))


def _cross(a: Any, b: Any) -> Any:
    """Return the vector products of complex numbers."""
    return (a.conj() * b).imag


def _pixels(corners: Any) -> Array:
    """Return complex numbers (n, 4) as pixels (n, 4, 2)."""
    return np.stack([corners.real, corners.imag], axis=2)


def _chains(contours: Iterable[Any]) -> Any:
    """
    Return three sides of what may be markers whose fourth side is covered, (n, 4), px.

    Complex numbers: two adjacent corners, clockwise, and from each along the next side as far as
    the longer one is visible.
    """
    outlines = [cv2.approxPolyDP(contour, _MAX_DEVIATION, True)[::-1, 0] @ (1.0, 1.0j)
                for contour in contours]
    corners = np.concatenate([np.zeros((0, 4)), *(
        each[(np.arange(len(each))[:, None] + np.arange(4)) % len(each)] for each in outlines)])
    before, middle, after = np.abs(np.diff(corners)).T
    along = np.diff(corners) / np.stack([before, middle, after], axis=1)
    longer = np.maximum(before, after)
    chosen = (_cross(along[:, :-1], along[:, 1:]).min(axis=1) > _MIN_SINE) & (
        middle > _MIN_OUTLINE / 5.0) & (longer < _SIDE_RATIOS[1] * middle) & (
        np.minimum(before, after) > _SIDE_RATIOS[0] * middle)
    return np.stack([corners[:, 1], corners[:, 2], longer * along[:, 2],
                     -longer * along[:, 0]], axis=1)[chosen]
