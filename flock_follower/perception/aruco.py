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
Pixel coordinates are OpenCV's: (0, 0) at the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.corners import bloom, moved_outward, refine_corners, shortest_side
from flock_follower.perception.images import GrayImage

#: Part of an image: first column, first row, column and row past the end, px.
Region = tuple[int, int, int, int]
#: Standard deviation of a corner coordinate, px, measured on rendered markers: of corners where
#: fitted edges meet, and of corners refined by gradients where there are no clean edges.
SIGMA_EDGES = 0.08
SIGMA_GRADIENT = 0.6

# Any: neither version's type stubs know the other's names.
_cv_aruco: Any = cv2.aruco
_MODERN = hasattr(_cv_aruco, 'ArucoDetector')


@dataclass(frozen=True)
class DetectionParams:
    """
    What the search for markers may cost and miss.

    ``windows`` are the sides, px, of the adaptive threshold: smallest, largest, step; the time
    is proportional to how many there are. ``min_perimeter`` is the smallest marker outline
    looked at, as a share of the longer image side.
    """

    windows: tuple[int, int, int] = (7, 19, 12)
    min_perimeter: float = 0.05


class Detections(NamedTuple):
    """
    The markers in an image.

    ``ids`` (N,); ``corners`` (N, 4, 2), px, in the marker's own order top-left, top-right,
    bottom-right, bottom-left; ``sigma`` (N,), standard deviation of a corner coordinate, px;
    ``sigma_bloom`` (N,), of what moves all edges of a marker outwards alike, px.
    """

    ids: NDArray[np.int64]
    corners: Array
    sigma: Array
    sigma_bloom: Array


DEFAULT_PARAMS = DetectionParams()


def dictionary_names() -> list[str]:
    """Return the names of the predefined dictionaries of the OpenCV at hand."""
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


def draw_marker(dictionary: str, marker_id: int, side_px: int, border_bits: int = 1) -> GrayImage:
    """
    Return a marker as (side_px, side_px) uint8, without its white quiet zone.

    :raises ValueError: for an unknown dictionary or id, or a side shorter than its cells.
    """
    book, size = _dictionary(dictionary), dictionary_size(dictionary)
    if not 0 <= marker_id < size:
        raise ValueError(f'marker_id = {marker_id}: {dictionary} has 0 to {size - 1}')
    if border_bits < 1:
        raise ValueError(f'border_bits = {border_bits}: must be at least 1')
    cells = int(book.markerSize) + 2 * border_bits
    if side_px < cells:
        raise ValueError(f'side_px = {side_px}: must be at least {cells}, one per cell')
    draw = _cv_aruco.generateImageMarker if _MODERN else _cv_aruco.drawMarker
    image: GrayImage = draw(book, marker_id, side_px, borderBits=border_bits)
    return image


def detect(image: GrayImage, dictionary: str, params: DetectionParams = DEFAULT_PARAMS,
           camera: CameraModel | None = None, region: Region | None = None) -> Detections:
    """
    Return the markers of one dictionary in a grey image (H, W) uint8, corners refined.

    ``region`` restricts the search; corners are in pixels of the whole image all the same.

    With the image's camera the edges are fitted as straight lines in undistorted coordinates;
    without, in pixels, which costs 0.1 px on a large marker behind a wide lens.

    :raises ValueError: for an unknown dictionary.
    """
    x0, y0, x1, y1 = region or (0, 0, image.shape[1], image.shape[0])
    found, ids = _search(np.ascontiguousarray(image[y0:y1, x0:x1]), dictionary, params)
    count = len(ids)
    corners, sigma, sigma_bloom = np.empty((count, 4, 2)), np.empty(count), np.empty(count)
    cells = marker_cells(dictionary)
    for i in range(count):
        rough = np.asarray(found[i], dtype=float).reshape(4, 2) + np.array([x0, y0])
        refined = (refine_corners(image, rough, cells) if camera is None else
                   refine_corners(image, rough, cells, camera.undistort, _bender(camera)))
        if refined is None:
            corners[i] = _gradient_corners(image, rough, cells)
            sigma[i] = sigma_bloom[i] = SIGMA_GRADIENT
        else:
            swelling = bloom(image, refined, _code(dictionary, int(ids[i])))
            corners[i] = moved_outward(refined, swelling.shifts)
            sigma[i], sigma_bloom[i] = SIGMA_EDGES, swelling.sigma
    return Detections(ids, corners, sigma, sigma_bloom)


@lru_cache(maxsize=64)
def _code(dictionary: str, marker_id: int) -> Any:
    """Return a marker's cells (n, n), True where white."""
    return draw_marker(dictionary, marker_id, marker_cells(dictionary)) > 127


def _search(image: GrayImage, dictionary: str,
            params: DetectionParams) -> tuple[Any, NDArray[np.int64]]:
    """Return the corners that OpenCV finds, unrefined, and the ids (N,)."""
    book, cv_params = _dictionary(dictionary), _cv_params(params)
    if _MODERN:
        corners, ids, _ = _cv_aruco.ArucoDetector(book, cv_params).detectMarkers(image)
    else:
        corners, ids, _ = _cv_aruco.detectMarkers(image, book, parameters=cv_params)
    # None, (N, 1) or (N,), as the version likes.
    return corners, np.array([] if ids is None else ids, dtype=np.int64).ravel()


@lru_cache(maxsize=16)
def _cv_params(params: DetectionParams) -> Any:
    cv_params = (_cv_aruco.DetectorParameters() if _MODERN
                 else _cv_aruco.DetectorParameters_create())
    cv_params.adaptiveThreshWinSizeMin = params.windows[0]
    cv_params.adaptiveThreshWinSizeMax = params.windows[1]
    cv_params.adaptiveThreshWinSizeStep = params.windows[2]
    cv_params.minMarkerPerimeterRate = params.min_perimeter
    # Read a cell by its middle, finely sampled: blur and noise blend its rim with the next cell's.
    cv_params.perspectiveRemovePixelPerCell = 8
    cv_params.perspectiveRemoveIgnoredMarginPerCell = 0.25
    cv_params.cornerRefinementMethod = _cv_aruco.CORNER_REFINE_NONE
    return cv_params


def _bender(camera: CameraModel) -> Any:
    return lambda xy: camera.project(np.column_stack([xy, np.ones(len(xy))]))


def _gradient_corners(image: GrayImage, corners: Array, cells: int) -> Array:
    """Return corners (4, 2) refined by the gradients around each, within half a cell."""
    half = int(np.clip(round(0.5 * shortest_side(corners) / cells), 2, 10))
    refined = corners.astype(np.float32).reshape(4, 1, 2).copy()
    if not np.all((refined >= 0) & (refined < [image.shape[1], image.shape[0]])):
        return corners  # cornerSubPix raises where one is outside the image
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    result = cv2.cornerSubPix(image, refined, (half, half), (-1, -1), criteria)
    return np.asarray(result, dtype=float).reshape(4, 2)
