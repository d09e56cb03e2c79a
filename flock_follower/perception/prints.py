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
Whether a marker in an image is the print in the neighbors file: its border, its orientation.

The fit of the pose does not detect the two faults. A print with a border of two cells (Kalibr's)
is fitted at a wrong distance. If a print is rotated by a quarter or half turn, the body appears
tilted by this angle, and its position is wrong by up to twice its distance from the marker.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
import math
from typing import NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, rpy_from_matrix, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.parameters.neighbors_file import Marker
from flock_follower.perception.images import gray_levels, GrayImage
from flock_follower.perception.markers import marker_code

#: Cells of the black border that are told apart; the first is that of our prints.
BORDER_WIDTHS = (1, 2, 3)
#: Each border, and how far inside its outline, cells, a detector may find one: if black is wide, a
#: threshold taken from the surroundings leaves only its rim dark.
_OUTLINES = tuple((border, 0.5 * half) for border in BORDER_WIDTHS for half in range(2 * border))
#: Samples along a cell, either way: where edges are tells borders apart.
_SAMPLES = 3
#: Least correlation of an image with a print of another border.
_MIN_LIKENESS = 0.7
#: Correlation with ours from which on no other border is tried.
_OURS = 0.95
#: The other border must leave unexplained (1 - correlation) this share at most of what ours does.
_MAX_LEFT = 0.8
#: Wide borders are searched for in two of so many searches of whole images.
_ROUNDS = 8
#: A neighbor that leans by more, rad, carries a turned print, or is about to crash.
MAX_LEAN = math.radians(60.0)
WRONG_BORDER, TURNED = 'print with another border', 'print turned'
#: Reasons why a marker is refused although it was found.
REASONS = (WRONG_BORDER, TURNED)


#: An outline, as a square.
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=np.float32)


@lru_cache(maxsize=16)
def _prints(dictionary: str, marker_id: int) -> tuple[Array, Array, list[int]]:
    """
    Return the prints of a marker with each border, as each of _OUTLINES would be found.

    The places of their samples (n, 2) if the outline is the unit square, how white they are, (n,),
    and at which sample each print but the first begins.
    """
    code = marker_code(dictionary, marker_id)[1:-1, 1:-1]
    places, white = [], []
    for border, inside in _OUTLINES:
        cells = len(code) + 2 * border
        along = ((np.arange(_SAMPLES * cells) + 0.5) / _SAMPLES - inside) / (cells - 2 * inside)
        places.append(np.stack(np.meshgrid(along, along), axis=2).reshape(-1, 2))
        white.append(np.kron(np.pad(code, border), np.ones((_SAMPLES, _SAMPLES))).ravel())
    begins = np.cumsum([len(each) for each in white])[:-1].tolist()
    return np.concatenate(places), np.concatenate(white), begins


def border_cells(image: GrayImage, corners: Array, dictionary: str, marker_id: int) -> int:
    """Return the width of a marker's black border, cells; ``corners`` (4, 2), px, outline it."""
    places, white, begins = _prints(dictionary, marker_id)
    to_image = cv2.getPerspectiveTransform(_SQUARE, corners.astype(np.float32))

    def likeness_of(part: slice) -> float:
        seen = gray_levels(image, cv2.perspectiveTransform(places[None, part], to_image)[0])
        return float(np.corrcoef(seen, white[part])[0, 1]) if seen.std() > 0.0 else 0.0

    parts = [slice(*ends) for ends in pairwise([0, *begins, len(white)])]
    likeness = [likeness_of(parts[0])]
    if likeness[0] <= _OURS:
        likeness += [likeness_of(part) for part in parts[1:]]
    best = int(np.argmax(likeness))
    clear = likeness[best] > _MIN_LIKENESS and (
        1.0 - likeness[best] < _MAX_LEFT * (1.0 - likeness[0]))
    return _OUTLINES[best][0] if clear else BORDER_WIDTHS[0]


class Fault(NamedTuple):
    """Why a detected marker is refused: one of REASONS, the observation, the remedy."""

    reason: str
    seen: str
    remedy: str


def wrong_border(image: GrayImage, corners: Array, dictionary: str, marker: Marker
                 ) -> Fault | None:
    """Return the fault of a detected marker's border, or None."""
    cells = border_cells(image, corners, dictionary, marker.marker_id)
    return None if cells == BORDER_WIDTHS[0] else Fault(
        WRONG_BORDER, f'marker {marker.marker_id} has a black border of {cells} cells',
        f'print it with a border of one cell: marker --dictionary {dictionary}')


def border_sought(rounds: int) -> int:
    """Return the border, cells, to search for after a number of searches of whole images."""
    which = rounds % _ROUNDS
    return BORDER_WIDTHS[which if which < len(BORDER_WIDTHS) else 0]


def lean(R_camera_body: Array, up: Array) -> float:
    """Return the tilt of a body, rad; ``up`` (3,) as in ``PosePrior``."""
    return math.acos(min(max(float(R_camera_body[:, 2] @ up), -1.0), 1.0))


def mounted_turned(marker: Marker, quarters: int) -> Array:
    """Return the rotation (3, 3) of a marker on its body, turned left by some quarter turns."""
    return np.asarray(marker.T_body_marker.rotation @ rotation_vector_to_matrix(
        [0.0, 0.0, 0.5 * math.pi * quarters]))


def turned_print(pose: Transform, up: Array | None, marker: Marker) -> Fault | None:
    """Return the fault of a marker if its body is not upright, or None."""
    angle = 0.0 if up is None else lean(pose.rotation, up)
    if up is None or angle <= MAX_LEAN:
        return None
    R_camera_marker = pose.rotation @ marker.T_body_marker.rotation
    leans = [lean(R_camera_marker @ mounted_turned(marker, k).T, up) for k in range(4)]
    best = int(np.argmin(leans))
    seen = f'the carrier of marker {marker.marker_id} leans by {math.degrees(angle):.0f} deg'
    if leans[best] > MAX_LEAN:
        return Fault(TURNED, seen,
                     'correct rpy in neighbors_file, camera_rpy, or the axes of odom')
    rpy = ', '.join(f'{value:.4f}' for value in rpy_from_matrix(mounted_turned(marker, best)))
    return Fault(TURNED, seen, f'turn the print by {min(best, 4 - best) * 90} deg, or set its rpy '
                 f'to [{rpy}]')
