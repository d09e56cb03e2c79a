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
The print of a marker as motion smears it, and at which places it is compared with an image.

If a camera or a marker moves while an image is exposed, each point of the image is the mean over a
line in the print: the mean over some instants of the exposure.

Lengths on a marker are in cells: (0, 0) is the middle of its first black cell, x right, y down.
"""

from __future__ import annotations

from functools import lru_cache
import math
from typing import Any

import cv2
import numpy as np

from flock_follower.geometry import Array
from flock_follower.neighbors_file import Marker
from flock_follower.perception.markers import marker_code
from flock_follower.perception.print_model import cell_code

#: Samples per cell, each way; beyond the black border; and away from where a marker is expected
#: up to which it is looked for.
PER_CELL = 3
MARGIN = 1
REACH = 8
#: An instant of the exposure stands for so much motion at most, in standard deviations of the
#: blur that there is without motion: with more, the instants were steps in the image.
_STEP = 1.6
_FEWEST, _MOST = 5, 15  # instants
_TEXELS = 12  # of the print, per cell
_WHITE = 3  # cells around, in the print
#: Blur there is without motion, cells: of lenses, one taken to begin with, and out of focus.
LENSES = np.array([0.07, 0.11, 0.17, 0.27, 0.4])  # with less, many instants were needed
FOCUSED = 3  # so many of them are
_SHARP = 1
#: Lengths, cells, of the smear vectors that are tried first, in steps of 45 degrees. None is 0,
#: where the squares have no slope by the vector and the descent stays.
_LENGTHS = (0.2, 0.5, 1.0, 1.45)


class SmearModel:
    """
    The model of a print whose image is smeared by motion.

    ``origin`` (3,) and ``axes`` (2, 3), m: place of (0, 0) on the body, and steps of one cell.
    ``places`` (s, 2), cells, are the sample points, row by row; ``around`` are more of them.
    ``on_body`` (s, 3), m: ``places`` on the body; ``middle`` (3,) of the marker; ``from_middle``
    (s, 2), cells, how far off ``places`` are; ``across`` (s, 2) is -0.5 to 0.5 across the marker.
    ``cell``, m, is the length of a cell.
    ``printed`` (l, H, W, 3): whiteness, 0..1, and its derivatives per cell to the right and down,
    for each of :data:`LENSES`.
    ``smears`` (t, 2), cells, are the vectors tried first, with blur ``lenses`` (t,), and
    ``smeared`` (t, k, k) the samples under them. ``codes`` (w, b): all codewords of the dictionary
    in all rotations, 0..1, the marker's own first; up to ``errors`` cells may be misread: half of
    those that can be corrected.
    ``cells``: number of cells along a side, with the black border.
    """

    def __init__(self, marker: Marker, dictionary: str) -> None:
        printed = marker_code(dictionary, marker.marker_id)
        self.cells = n = len(printed)
        cell, R = marker.side_length / n, marker.T_body_marker.rotation
        self.origin = marker.T_body_marker.apply(
            0.5 * (n - 1) * cell * np.array([[-1.0, 1.0, 0.0]]))[0]
        self.axes = cell * np.array([R[:, 0], -R[:, 1]])
        self.cell = cell
        self.places, self.around = _samples(n, MARGIN), _samples(n, MARGIN + REACH)
        self.on_body = self.origin + self.places @ self.axes
        self.middle = self.origin + 0.5 * (n - 1) * self.axes.sum(axis=0)
        self.from_middle = np.abs(self.places - 0.5 * (n - 1))
        self.across = self.places / (n - 1) - 0.5
        white = np.pad(printed, _WHITE, constant_values=True).astype(float)
        level = np.kron(white, np.ones((_TEXELS, _TEXELS)))
        self.printed: Any = np.array([_with_slopes(cv2.GaussianBlur(
            level, (0, 0), lens * _TEXELS, borderType=cv2.BORDER_REPLICATE)) for lens in LENSES])
        angles = np.arange(4) * np.pi / 4
        self.smears = np.array([*(length * np.array([np.cos(a), np.sin(a)])
                                  for length in _LENGTHS for a in angles),
                                *np.zeros((len(LENSES) - FOCUSED, 2))])
        self.lenses = (_SHARP,) * (len(_LENGTHS) * len(angles)) + tuple(
            range(FOCUSED, len(LENSES)))
        size = n * PER_CELL + 2 * MARGIN
        self.smeared: Any = np.array([
            smear_print(self.printed[lens], self.places, smear, LENSES[lens])[0]
            for lens, smear in zip(self.lenses, self.smears)]).reshape(-1, size, size).astype(
                np.float32)
        code = cell_code(marker, dictionary)
        self.codes = 0.5 + 0.5 * np.vstack([code.bits, code.others])
        self.errors = max(code.errors // 2, 1)


#: The model of a marker of a dictionary, made once.
smear_model = lru_cache(maxsize=64)(SmearModel)


def _with_slopes(level: Array) -> Any:
    """Return how white a print is, and by how much more per cell to the right and down."""
    down, right = np.gradient(level)
    return np.dstack([level, _TEXELS * right, _TEXELS * down]).astype(np.float32)


def _samples(cells: int, margin: int) -> Array:
    """Return places (s, 2), cells, that cover a marker and a margin, samples, around it."""
    along = (np.arange(-margin, cells * PER_CELL + margin) + 0.5) / PER_CELL - 0.5
    return np.stack(np.meshgrid(along, along), axis=2).reshape(-1, 2)


def smear_print(printed: Any, places: Array, smear: Array,
                lens: float) -> tuple[Array, Array, Array]:
    """
    Return how white samples are, (s,), and by place and by smear, (s, 2), per cell.

    :param lens: the blur of the print, cells.
    """
    instants = instants_of(smear, lens)
    at = places + instants[:, None, None] * smear
    at = ((at + 0.5 + _WHITE) * _TEXELS - 0.5).astype(np.float32)
    seen = cv2.remap(printed, at[..., 0], at[..., 1], cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE).reshape(len(instants), -1)
    mean, by_smear = _means(len(instants)).dot(seen).reshape(2, -1, 3).astype(float)
    return mean[:, 0], mean[:, 1:], by_smear[:, 1:]


def instants_of(smear: Array, lens: float) -> Array:
    """Return the instants (i,), -0.5 to 0.5, of an exposure for a smear and a blur, cells."""
    return _instants(min(max(round(math.hypot(*smear.tolist()) / (_STEP * lens)), _FEWEST), _MOST))


@lru_cache(maxsize=16)
def _instants(count: int) -> Array:
    # As far apart as they must be for the variance of an exposure that lasts for 1.
    return ((np.arange(count) + 0.5) / count - 0.5) * (count / math.sqrt(count**2 - 1.0))


@lru_cache(maxsize=16)
def _means(count: int) -> Any:
    """Return the mean over so many instants, and the mean of what grows with them, (2, i)."""
    instants = _instants(count)
    return (np.stack([np.ones(count), instants]) / count).astype(np.float32)
