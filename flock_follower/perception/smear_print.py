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
The print of a marker as motion smears it, and the points at which it is compared with an image.

If a camera or a marker moves during the exposure, each point of the image is the mean over a line
in the print: here the mean over some instants of the exposure.

Lengths on a marker are in cells: (0, 0) is the middle of its first black cell, x right, y down.
"""

from __future__ import annotations

from functools import lru_cache
import math
from typing import Any

import cv2
import numpy as np

from flock_follower.geometry import Array
from flock_follower.parameters.neighbors_file import Marker
from flock_follower.perception.markers import marker_code
from flock_follower.perception.print_model import cell_code

#: Samples per cell, along rows and along columns.
SAMPLES_PER_CELL = 3
#: Samples beyond the black border.
MARGIN = 1
#: Samples from the expected place of a marker up to which it is searched for.
SEARCH_REACH = 8
#: The same for a marker that was smeared in the last image, too.
NEAR_REACH = 3
#: Motion per instant of the exposure at most, in standard deviations of the blur without motion:
#: with more, the instants would show as steps.
_STEP = 1.6
#: Fewest instants of an exposure.
_MIN_INSTANTS = 5
#: Most instants of an exposure.
_MAX_INSTANTS = 15
#: Texels of the print per cell.
_TEXELS_PER_CELL = 12
#: White cells around the print.
_WHITE_CELLS = 3
#: Blur without motion, cells: of lenses in focus, then out of focus; below 0.07 the instants would
#: show as steps.
LENS_BLURS = np.array([0.07, 0.11, 0.17, 0.27, 0.4])
#: Number of the first of these that are in focus.
N_FOCUSED = 3
#: Index of the lens that is assumed first.
_ASSUMED_LENS = 1
#: Lengths, cells, of the smear vectors that are tried first, in steps of 45 degrees. None is 0,
#: where the squares have no slope by the vector and the descent stays.
_LENGTHS = (0.2, 0.5, 1.0, 1.55, 2.2)
#: Number of these vectors, the shortest, that leave edges.
N_SHARP = 4


class SmearModel:
    """
    The model of a print whose image is smeared by motion.

    ``origin`` (3,) and ``axes`` (2, 3), m: place of (0, 0) on the body, and steps of one cell.
    ``places`` (3, s) are the sample points, row by row: column and row, cells, and 1; ``texels``
    (2, s) are the same in texels. ``around`` are more sample points, (3, a), outside the others.
    ``middle`` (3,) of the marker on the body; ``from_middle`` (2, s), cells: how far off it
    ``places`` are; ``across`` (2, s) is -0.5 to 0.5 across the marker. ``cell``, m, is the length
    of a cell. ``printed`` (l, H, W, 3): whiteness, 0..1, and its derivatives per cell to the right
    and down, for each of :data:`LENS_BLURS`. ``smears`` (t, 2), cells, are the vectors tried
    first, with blur ``lenses`` (t,); ``smeared`` (t, s) are the samples with this smear, of mean 0
    and norm 1. ``by_cell`` (4 t, c): whiteness of the cells and of those around, likewise, turned
    left by 0 to 3 quarters. ``bits`` (b,), 0..1, are the inner cells. ``flips`` (w, b) is 1 for
    each cell in which another codeword, in any rotation, differs from ``bits``. Up to ``errors``
    cells may be misread: half of the number that can be corrected. ``cells`` is the number of
    cells along a side, with the black border.
    """

    def __init__(self, marker: Marker, dictionary: str) -> None:
        printed = marker_code(dictionary, marker.marker_id)
        self.cells = n = len(printed)
        cell, R = marker.side_length / n, marker.T_body_marker.rotation
        self.origin = marker.T_body_marker.apply(
            0.5 * (n - 1) * cell * np.array([[-1.0, 1.0, 0.0]]))[0]
        self.axes = cell * np.array([R[:, 0], -R[:, 1]])
        self.cell = cell
        self.places = _samples(n, MARGIN)
        self.texels: Any = (
            (self.places[:2] + 0.5 + _WHITE_CELLS) * _TEXELS_PER_CELL - 0.5).astype(np.float32)
        self.around = {reach: _samples(n, MARGIN + reach)
                       for reach in (NEAR_REACH, SEARCH_REACH)}
        self.middle = self.origin + 0.5 * (n - 1) * self.axes.sum(axis=0)
        self.from_middle = np.abs(self.places[:2] - 0.5 * (n - 1))
        self.across = self.places[:2] / (n - 1) - 0.5
        white = np.pad(printed, _WHITE_CELLS, constant_values=True).astype(float)
        level = np.kron(white, np.ones((_TEXELS_PER_CELL, _TEXELS_PER_CELL)))
        self.printed: Any = np.array([_with_slopes(cv2.GaussianBlur(
            level, (0, 0), lens * _TEXELS_PER_CELL, borderType=cv2.BORDER_REPLICATE))
            for lens in LENS_BLURS])
        angles = np.arange(4) * np.pi / 4
        self.smears = np.array([*(length * np.array([np.cos(a), np.sin(a)])
                                  for length in _LENGTHS for a in angles),
                                *np.zeros((len(LENS_BLURS) - N_FOCUSED, 2))])
        self.lenses = (_ASSUMED_LENS,) * (len(_LENGTHS) * len(angles)) + tuple(
            range(N_FOCUSED, len(LENS_BLURS)))
        self.smeared: Any = np.array([
            smear_print(self.printed[lens], self.texels, smear, LENS_BLURS[lens])[0][0]
            for lens, smear in zip(self.lenses, self.smears)])
        self.smeared -= self.smeared.mean(axis=1, keepdims=True)
        self.smeared /= np.linalg.norm(self.smeared, axis=1, keepdims=True)
        self.smeared = self.smeared.astype(np.float32)
        middles = np.mgrid[-1:n + 1, -1:n + 1][::-1].reshape(2, -1) + 0.5 + _WHITE_CELLS
        self.by_cell = np.array([
            np.rot90(smear_print(self.printed[lens], (middles * _TEXELS_PER_CELL - 0.5).astype(
                np.float32), smear, LENS_BLURS[lens])[0][0].reshape(n + 2, -1), turn).ravel()
            for lens, smear in zip(self.lenses, self.smears) for turn in range(4)])
        code = cell_code(marker, dictionary)
        self.bits = 0.5 + 0.5 * code.bits.astype(float)
        self.flips = np.abs(0.5 * (code.others - code.bits)).astype(float)
        self.errors = max(code.errors // 2, 1)


#: The model of a marker of a dictionary, made once.
smear_model = lru_cache(maxsize=64)(SmearModel)


def _with_slopes(level: Array) -> Any:
    """Return the whiteness of a print, and its increase per cell to the right and down."""
    down, right = np.gradient(level)
    return np.dstack([level, _TEXELS_PER_CELL * right, _TEXELS_PER_CELL * down]).astype(np.float32)


def _samples(cells: int, margin: int) -> Array:
    """Return places (3, s), cells, and 1, that cover a marker and a margin, samples, around it."""
    along = (np.arange(-margin, cells * SAMPLES_PER_CELL + margin) + 0.5) / SAMPLES_PER_CELL - 0.5
    columns, rows = np.meshgrid(along, along)
    return np.array([columns.ravel(), rows.ravel(), np.ones(columns.size)])


def smear_print(printed: Any, texels: Any, smear: Array, lens: float) -> tuple[Array, Array]:
    """
    Return whiteness, and its derivatives per cell to the right and down, of samples, (3, s).

    Then by how much whiteness grows per cell of the smear, (2, s).

    :param texels: where the samples are in the print, (2, s), texels.
    :param lens: the blur of the print, cells.
    """
    instants = instants_of(smear, lens)
    step_x, step_y = (_TEXELS_PER_CELL * instants[:, None] * smear[None]).astype(np.float32).T
    seen = cv2.remap(printed, texels[0] + step_x[:, None], texels[1] + step_y[:, None],
                     cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mean, by_smear = _means(len(instants)).dot(seen.reshape(len(instants), -1)).reshape(2, -1, 3)
    return (np.array(mean.T, dtype=float, order='C'),
            np.array(by_smear.T[1:], dtype=float, order='C'))


def instants_of(smear: Array, lens: float) -> Array:
    """Return the instants (i,), -0.5 to 0.5, of an exposure for a smear and a blur, cells."""
    count = round(math.hypot(*smear.tolist()) / (_STEP * lens))
    return _instants(min(max(count, _MIN_INSTANTS), _MAX_INSTANTS))


@lru_cache(maxsize=16)
def _instants(count: int) -> Array:
    # As far apart as they must be for the variance of an exposure that lasts for 1.
    return ((np.arange(count) + 0.5) / count - 0.5) * (count / math.sqrt(count**2 - 1.0))


@lru_cache(maxsize=16)
def _means(count: int) -> Any:
    """Return the mean over so many instants, and the mean of what grows with them, (2, i)."""
    instants = _instants(count)
    return (np.stack([np.ones(count), instants]) / count).astype(np.float32)
