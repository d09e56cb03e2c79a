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
The one place that calls ``cv2.aruco``, the same for OpenCV 4.6 and 4.7 to 5.

OpenCV 4.6 (Ubuntu 24.04) has free functions and ``DetectorParameters_create()``, and crashes on
``DetectorParameters()``; 4.7 brought ``ArucoDetector`` and 5 dropped the functions.
Pixel coordinates are OpenCV's: (0, 0) at the center of the top-left pixel.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array
from flock_follower.parameters import neighbors_file
from flock_follower.parameters.neighbors_file import NeighborConfig
from flock_follower.perception.images import GrayImage

# Any: neither version's type stubs know the other's names.
_cv_aruco: Any = cv2.aruco
_MODERN = hasattr(_cv_aruco, 'ArucoDetector')


class Detections(NamedTuple):
    """
    The markers in an image.

    ``ids`` (N,); ``corners`` (N, 4, 2), px, in the marker's own order top-left, top-right,
    bottom-right, bottom-left. A corner is the crossing of the outline's edges in a sharp image.
    ``most_rms``: the largest of a fit to the print as a whole, as ``SmearFit`` has it; 0: it is
    not to be fitted.
    """

    ids: NDArray[np.int64]
    corners: Array
    most_rms: float = 1.0


NO_DETECTIONS = Detections(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)))


def dictionary_names() -> list[str]:
    """Return the names of the predefined dictionaries of the installed OpenCV."""
    return sorted(name for name in dir(_cv_aruco) if name.startswith('DICT_'))


@lru_cache(maxsize=16)
def _dictionary(name: str) -> Any:
    if name not in dictionary_names():
        raise ValueError(f'dictionary = {name!r}: must be one of {", ".join(dictionary_names())}')
    return _cv_aruco.getPredefinedDictionary(getattr(_cv_aruco, name))


def dictionary_size(name: str) -> int:
    """
    Return how many markers a dictionary has: ids run from 0 to one less.

    :raises ValueError: for an unknown dictionary.
    """
    return int(_dictionary(name).bytesList.shape[0])


def marker_cells(name: str) -> int:
    """
    Return the cells along a marker's side, the black border of one cell included.

    :raises ValueError: for an unknown dictionary.
    """
    return int(_dictionary(name).markerSize) + 2


@lru_cache(maxsize=16)
def correctable_cells(name: str) -> int:
    """
    Return how many cells may be misread so that a marker is still nearest to its own code.

    Computed from the codes: before version 5, OpenCV has 0 for AprilTags, and 12 instead of 5 for
    MIP_36h12.

    :raises ValueError: for an unknown dictionary.
    """
    words = dictionary_words(name)
    turned = np.concatenate([np.rot90(words, turn, axes=(1, 2)) for turn in range(4)])
    colors, others = (np.where(each.reshape(len(each), -1), 1.0, -1.0).astype(np.float32)
                      for each in (words, turned))
    alike = colors @ others.T
    np.fill_diagonal(alike, -np.inf)  # itself
    differing = round(float(colors.shape[1] - alike.max()) / 2.0)
    return max((differing - 1) // 2, 0)


def draw_marker(dictionary: str, marker_id: int, side_px: int) -> GrayImage:
    """
    Return a marker as (side_px, side_px) uint8, without its white quiet zone.

    :raises ValueError: for an unknown dictionary or id, or a side shorter than its cells.
    """
    book, size = _dictionary(dictionary), dictionary_size(dictionary)
    if not 0 <= marker_id < size:
        raise ValueError(f'marker_id = {marker_id}: {dictionary} has 0 to {size - 1}')
    cells = marker_cells(dictionary)
    if side_px < cells:
        raise ValueError(f'side_px = {side_px}: must be at least {cells}, one per cell')
    draw = _cv_aruco.generateImageMarker if _MODERN else _cv_aruco.drawMarker
    return np.asarray(draw(book, marker_id, side_px))


@lru_cache(maxsize=64)
def marker_code(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """
    Return a marker's cells (n, n), the border included, first row on top, True for white ones.

    :raises ValueError: for an unknown dictionary or id.
    """
    return draw_marker(dictionary, marker_id, marker_cells(dictionary)) > 127


@lru_cache(maxsize=16)
def dictionary_words(dictionary: str) -> NDArray[np.bool_]:
    """
    Return the inner cells of all markers, (size, b, b), True for white ones.

    :raises ValueError: for an unknown dictionary.
    """
    return np.stack([marker_code(dictionary, marker_id)[1:-1, 1:-1]
                     for marker_id in range(dictionary_size(dictionary))])


def detect(image: GrayImage, dictionary: str, border: int = 1) -> Detections:
    """
    Return the markers of one dictionary in a gray image (H, W) uint8, contiguous.

    :param border: cells of the black border; prints with one more are found, too.
    :raises ValueError: for an unknown dictionary.
    """
    book, cv_params = _dictionary(dictionary), _cv_params(border)
    book.maxCorrectionBits = correctable_cells(dictionary)
    if _MODERN:
        found = _cv_aruco.ArucoDetector(book, cv_params).detectMarkers(image)
    else:
        found = _cv_aruco.detectMarkers(image, book, parameters=cv_params)
    # cv2's corners are the middles of the outermost black pixels.
    corners = outwards(np.array(found[0], dtype=float).reshape(-1, 4, 2), 0.5)
    # None, (N, 1) or (N,), as the version likes.
    ids = np.zeros(0) if found[1] is None else found[1]
    return Detections(np.array(ids, dtype=np.int64).ravel(), corners)


def outwards(corners: Array, by: float) -> Array:
    """Return corners (N, 4, 2), px, of quadrilaterals with sides ``by`` px farther outside."""
    legs = [corners - np.roll(corners, k, axis=1) for k in (1, -1)]
    legs = [leg / np.maximum(np.linalg.norm(leg, axis=2, keepdims=True), 1e-9) for leg in legs]
    sine = np.abs(legs[0][..., 0] * legs[1][..., 1] - legs[0][..., 1] * legs[1][..., 0])
    return np.asarray(corners + by * (legs[0] + legs[1]) / np.maximum(sine, 0.2)[..., None])


@lru_cache(maxsize=4)
def _cv_params(border: int) -> Any:
    cv_params = (_cv_aruco.DetectorParameters() if _MODERN
                 else _cv_aruco.DetectorParameters_create())
    # One threshold instead of three takes a third of the time.
    cv_params.adaptiveThreshWinSizeMin = cv_params.adaptiveThreshWinSizeMax = 15
    cv_params.minMarkerPerimeterRate = 0.05
    # Read a cell by its middle, finely sampled: blur and noise blend its rim with the next cell's.
    cv_params.perspectiveRemovePixelPerCell = 8
    cv_params.perspectiveRemoveIgnoredMarginPerCell = 0.25
    cv_params.markerBorderBits = border
    cv_params.cornerRefinementMethod = _cv_aruco.CORNER_REFINE_NONE
    return cv_params


def marker_corners(side_length: float) -> Array:
    """Return a marker's corners (4, 3) in its own frame, m: top-left, then clockwise."""
    return 0.5 * side_length * np.array(
        [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def load(path: str | Path) -> NeighborConfig:
    """
    Read a neighbors file; its dictionary must be in the installed OpenCV.

    :raises ValueError, OSError: see :func:`flock_follower.parameters.neighbors_file.load`.
    """
    return neighbors_file.load(path, dictionary_size)


def parse(document: Any) -> NeighborConfig:
    """
    Return the configuration of a parsed YAML document; see :func:`load`.

    :raises ValueError: naming the key, its value and the valid range.
    """
    return neighbors_file.parse(document, dictionary_size)
