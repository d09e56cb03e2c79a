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
from flock_follower.perception.images import GrayImage

# Any: neither version's type stubs know the other's names.
_cv_aruco: Any = cv2.aruco
_MODERN = hasattr(_cv_aruco, 'ArucoDetector')


@dataclass(frozen=True)
class DetectionParams:
    """
    What the search for markers may cost and miss.

    ``windows`` are the sides, px, of the adaptive threshold: smallest, largest, step; the time
    is proportional to how many there are. ``min_perimeter`` is the smallest marker outline
    looked at, as a share of the longer image side. ``threshold``: by how many grey levels black
    must be darker than the mean of the window.
    """

    windows: tuple[int, int, int] = (7, 19, 12)
    min_perimeter: float = 0.05
    threshold: float = 7.0


class Detections(NamedTuple):
    """
    The markers in an image.

    ``ids`` (N,); ``corners`` (N, 4, 2), px, in the marker's own order top-left, top-right,
    bottom-right, bottom-left, where the outline's edges would cross if it were sharp.
    """

    ids: NDArray[np.int64]
    corners: Array


NONE = Detections(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)))
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


def correctable_cells(name: str) -> int:
    """
    Return how many cells of a marker may be misread and it is still nearest to its own code.

    :raises ValueError: for an unknown dictionary.
    """
    return int(_dictionary(name).maxCorrectionBits)


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


@lru_cache(maxsize=64)
def marker_code(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """
    Return a marker's cells (n, n), the border included, first row on top, True where white.

    :raises ValueError: for an unknown dictionary or id.
    """
    return draw_marker(dictionary, marker_id, marker_cells(dictionary)) > 127


@lru_cache(maxsize=16)
def dictionary_words(dictionary: str) -> NDArray[np.bool_]:
    """
    Return the inner cells of all markers, (size, b, b), True where white.

    :raises ValueError: for an unknown dictionary.
    """
    return np.stack([marker_code(dictionary, marker_id)[1:-1, 1:-1]
                     for marker_id in range(dictionary_size(dictionary))])


def detect(image: GrayImage, dictionary: str,
           params: DetectionParams = DEFAULT_PARAMS) -> Detections:
    """
    Return the markers of one dictionary in a grey image (H, W) uint8, contiguous.

    :raises ValueError: for an unknown dictionary.
    """
    book, cv_params = _dictionary(dictionary), _cv_params(params)
    if _MODERN:
        corners, ids, _ = _cv_aruco.ArucoDetector(book, cv_params).detectMarkers(image)
    else:
        corners, ids, _ = _cv_aruco.detectMarkers(image, book, parameters=cv_params)
    if ids is None or not len(ids):
        return NONE
    # (N, 1) or (N,), as the version likes.
    return Detections(np.array(ids, dtype=np.int64).ravel(),
                      # cv2's are the middles of the outermost black pixels.
                      outwards(np.array(corners, dtype=float).reshape(-1, 4, 2), 0.5))


def outwards(corners: Array, by: float) -> Array:
    """Return corners (N, 4, 2), px, of quadrilaterals whose sides are ``by`` px further out."""
    legs = [corners - np.roll(corners, k, axis=1) for k in (1, -1)]
    legs = [leg / np.maximum(np.linalg.norm(leg, axis=2, keepdims=True), 1e-9) for leg in legs]
    sine = np.abs(legs[0][..., 0] * legs[1][..., 1] - legs[0][..., 1] * legs[1][..., 0])
    moved: Array = corners + by * (legs[0] + legs[1]) / np.maximum(sine, 0.2)[..., None]
    return moved


@lru_cache(maxsize=16)
def _cv_params(params: DetectionParams) -> Any:
    cv_params = (_cv_aruco.DetectorParameters() if _MODERN
                 else _cv_aruco.DetectorParameters_create())
    cv_params.adaptiveThreshWinSizeMin = params.windows[0]
    cv_params.adaptiveThreshWinSizeMax = params.windows[1]
    cv_params.adaptiveThreshWinSizeStep = params.windows[2]
    cv_params.adaptiveThreshConstant = params.threshold
    cv_params.minMarkerPerimeterRate = params.min_perimeter
    # Read a cell by its middle, finely sampled: blur and noise blend its rim with the next cell's.
    cv_params.perspectiveRemovePixelPerCell = 8
    cv_params.perspectiveRemoveIgnoredMarginPerCell = 0.25
    cv_params.cornerRefinementMethod = _cv_aruco.CORNER_REFINE_NONE
    return cv_params
