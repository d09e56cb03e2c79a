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

The neighbours and the markers they carry, read from YAML.

A file holds the dictionary of the markers and a list of neighbours::

    dictionary: DICT_4X4_50
    neighbors:
      - name: leader             # child_frame_id of its estimates
        marker_id: 0
        side_length: 0.16        # m, outer edge to outer edge of the black border
        position: [-0.20, 0.0, 0.0]         # marker centre on the neighbour's body (FLU), m
        rpy: [1.5707963, 0.0, -1.5707963]   # marker frame on the body, fixed-axis, rad

A neighbour that carries several has, instead of the last four keys, a list of them::

      - name: leader
        markers:
          - {marker_id: 0, side_length: 0.16, position: [...], rpy: [...]}
          - {marker_id: 1, side_length: 0.10, position: [...], rpy: [...]}

Each neighbour may have keys for the planner::

        role: follower           # leader (the default), follower, or avoid: kept clear of only
        radius: 0.3              # m, of its hull: distances are kept between hulls; 0

``tag_position: [x, y, z]``, m, on its body, is the antenna that ranges are measured to;
without it ranges are measured to the body's origin.

The marker frame is OpenCV's: x right and y up as one faces the marker, z out of it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
import yaml

from flock_follower.files import read_text
from flock_follower.geometry import Array, quaternion_from_rpy, Transform
from flock_follower.perception.images import GrayImage
from flock_follower.ranges import Range, suggestion

# Any: neither version's type stubs know the other's names.
_cv_aruco: Any = cv2.aruco
_MODERN = hasattr(_cv_aruco, 'ArucoDetector')


class Detections(NamedTuple):
    """
    The markers in an image.

    ``ids`` (N,); ``corners`` (N, 4, 2), px, in the marker's own order top-left, top-right,
    bottom-right, bottom-left, where the outline's edges would cross if it were sharp.
    """

    ids: NDArray[np.int64]
    corners: Array


NO_DETECTIONS = Detections(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)))


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
    Return how many cells of a marker may be misread while it is still nearest to its own code.

    :raises ValueError: for an unknown dictionary.
    """
    return int(_dictionary(name).maxCorrectionBits)


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
    image: GrayImage = draw(book, marker_id, side_px)
    return image


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


def detect(image: GrayImage, dictionary: str) -> Detections:
    """
    Return the markers of one dictionary in a grey image (H, W) uint8, contiguous.

    :raises ValueError: for an unknown dictionary.
    """
    book, cv_params = _dictionary(dictionary), _cv_params()
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
    """Return corners (N, 4, 2), px, of quadrilaterals whose sides are ``by`` px further out."""
    legs = [corners - np.roll(corners, k, axis=1) for k in (1, -1)]
    legs = [leg / np.maximum(np.linalg.norm(leg, axis=2, keepdims=True), 1e-9) for leg in legs]
    sine = np.abs(legs[0][..., 0] * legs[1][..., 1] - legs[0][..., 1] * legs[1][..., 0])
    moved: Array = corners + by * (legs[0] + legs[1]) / np.maximum(sine, 0.2)[..., None]
    return moved


@lru_cache(maxsize=1)
def _cv_params() -> Any:
    cv_params = (_cv_aruco.DetectorParameters() if _MODERN
                 else _cv_aruco.DetectorParameters_create())
    # One threshold instead of three takes a third of the time.
    cv_params.adaptiveThreshWinSizeMin = cv_params.adaptiveThreshWinSizeMax = 15
    cv_params.minMarkerPerimeterRate = 0.05
    # Read a cell by its middle, finely sampled: blur and noise blend its rim with the next cell's.
    cv_params.perspectiveRemovePixelPerCell = 8
    cv_params.perspectiveRemoveIgnoredMarginPerCell = 0.25
    cv_params.cornerRefinementMethod = _cv_aruco.CORNER_REFINE_NONE
    return cv_params


#: A marker's side, m: shorter than the thickness of its print or larger than the drone is a slip.
SIDE_LENGTHS = Range(0.01, 2.0, 'm')
#: Each coordinate of a marker on the body.
POSITIONS = Range(-5.0, 5.0, 'm')
ANGLES = Range(-2.0 * math.pi, 2.0 * math.pi, 'rad')
#: Of a hull; the planner has the same.
RADII = Range(0.0, 5.0, 'm')
ROLES = ('leader', 'follower', 'avoid')
_MARKER_KEYS = {'marker_id', 'side_length', 'position', 'rpy'}


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker: its id, its side, m, and where it sits on its neighbour's body (FLU)."""

    marker_id: int
    side_length: float
    T_body_marker: Transform


@dataclass(frozen=True, eq=False)
class MarkedNeighbor:
    """One neighbour, and the markers mounted rigidly on it, at least one."""

    name: str
    markers: tuple[Marker, ...]
    role: str = 'leader'
    """One of ``ROLES``."""
    radius: float = 0.0
    """Radius of its hull, m."""
    tag_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the antenna is on its body (FLU), m, that ranges are measured to."""


@dataclass(frozen=True, eq=False)
class NeighborConfig:
    """The neighbours to look for; names and marker ids are unique, all of one dictionary."""

    dictionary: str
    neighbors: tuple[MarkedNeighbor, ...]

    def by_marker(self) -> dict[int, tuple[MarkedNeighbor, Marker]]:
        """Return the neighbours with their markers, by marker id."""
        return {marker.marker_id: (neighbor, marker)
                for neighbor in self.neighbors for marker in neighbor.markers}


def marker_corners(side_length: float) -> Array:
    """Return a marker's corners (4, 3) in its own frame, m: top-left, then clockwise."""
    return 0.5 * side_length * np.array(
        [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def load(path: str | Path) -> NeighborConfig:
    """
    Read a neighbours file.

    :raises ValueError: naming the file, the key, its value and the valid range.
    :raises OSError: if the file cannot be read.
    """
    text = read_text(path)
    try:
        return parse(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise ValueError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


def parse(document: Any) -> NeighborConfig:
    """
    Return the configuration of a parsed YAML document.

    :raises ValueError: naming the key, its value and the valid range.
    """
    _check_keys('the document', document, {'dictionary', 'neighbors'})
    dictionary = str(document['dictionary'])
    ids = Range(0, dictionary_size(dictionary) - 1, whole=True)
    neighbors = tuple(_parse_neighbor(where, entry, ids)
                      for where, entry in _entries('neighbors', document['neighbors']))
    taken: set[object] = set()
    for i, neighbor in enumerate(neighbors):
        for key, value in (('name', neighbor.name),
                           *(('marker_id', marker.marker_id) for marker in neighbor.markers)):
            if value in taken:
                raise ValueError(f'neighbors[{i}].{key} = {value!r}: must be unique')
            taken.add(value)
    return NeighborConfig(dictionary, neighbors)


def _parse_neighbor(where: str, entry: Any, ids: Range) -> MarkedNeighbor:
    several = isinstance(entry, Mapping) and 'markers' in entry
    _check_keys(where, entry, {'name', 'markers'} if several else {'name', *_MARKER_KEYS},
                {'role', 'radius', 'tag_position'})
    name, role, radius = entry['name'], entry.get('role', 'leader'), entry.get('radius', 0.0)
    if not isinstance(name, str) or name.split() != [name]:
        raise ValueError(f'{where}.name = {name!r}: must be a word')
    if role not in ROLES:
        raise ValueError(f'{where}.role = {role!r}: must be one of {", ".join(ROLES)}')
    RADII.check(f'{where}.radius', radius)
    x, y, z = _triple(f'{where}.tag_position', entry.get('tag_position', [0.0] * 3), POSITIONS)
    if several:
        places = _entries(f'{where}.markers', entry['markers'])
        for place, marker in places:
            _check_keys(place, marker, _MARKER_KEYS)
    else:
        places = [(where, entry)]
    markers = tuple(_parse_marker(place, marker, ids) for place, marker in places)
    return MarkedNeighbor(name, markers, role, float(radius), (x, y, z))


def _parse_marker(where: str, entry: Any, ids: Range) -> Marker:
    ids.check(f'{where}.marker_id', entry['marker_id'])
    SIDE_LENGTHS.check(f'{where}.side_length', entry['side_length'])
    position = _triple(f'{where}.position', entry['position'], POSITIONS)
    roll, pitch, yaw = _triple(f'{where}.rpy', entry['rpy'], ANGLES)
    return Marker(entry['marker_id'], float(entry['side_length']), Transform.from_quaternion(
        position, quaternion_from_rpy(roll, pitch, yaw)))


def _entries(where: str, values: Any) -> list[tuple[str, Any]]:
    """Return the entries of a list, each with its place in the file."""
    if not isinstance(values, list) or not values:
        raise ValueError(f'{where} = {values!r}: must be a list of at least one entry')
    return [(f'{where}[{i}]', value) for i, value in enumerate(values)]


def _check_keys(where: str, entry: Any, keys: set[str],
                optional: Collection[str] = frozenset()) -> None:
    if not isinstance(entry, Mapping):
        raise ValueError(f'{where} = {entry!r}: must map {", ".join(sorted(keys))}')
    unknown = sorted(map(str, set(entry) - keys - {*optional}))
    if unknown:
        raise ValueError(f'{where} has an unknown key {unknown[0]}: ' + suggestion(
            unknown[0], {*keys, *optional}, 'must be one of'))
    for key in sorted(keys - set(entry)):
        raise ValueError(f'{where} lacks {key}')


def _triple(where: str, values: Any, valid: Range) -> list[float]:
    if not isinstance(values, list) or len(values) != 3 or not all(map(valid.holds, values)):
        raise ValueError(f'{where} = {values!r}: must be three values, each {valid}')
    return [float(value) for value in values]
