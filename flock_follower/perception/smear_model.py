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
The print of a marker, to be smeared by a vector as motion does while an image is exposed.

Lengths on a marker are in cells: (0, 0) is the middle of its first black one, x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from flock_follower.geometry import Array
from flock_follower.perception import aruco
from flock_follower.perception.neighbors import Marker

#: Samples per cell, each way; beyond the black border; and away from where a marker is expected
#: up to which it is looked for.
PER_CELL = 3
MARGIN = 1
AWAY = 8
#: Of the exposure, which lasts for 1.
INSTANTS = (np.arange(13) + 0.5) / 13 - 0.5
_TEXELS = 12  # of the print, per cell
_WHITE = 3  # cells around, in the print
#: Blur there is without motion, cells: of lenses, one taken to begin with, and out of focus.
LENSES = np.array([0.07, 0.11, 0.17, 0.27, 0.4])  # with less, the instants were steps in the image
FOCUSED = 3  # so many of them are
_LENS = 1
#: Lengths, cells, and directions, quarters of half a turn, of the vectors that are tried first.
_LENGTHS = (0.5, 1.0, 1.45)


@dataclass(frozen=True, eq=False)
class SmearModel:
    """
    A print to be smeared.

    ``origin`` (3,) and ``axes`` (2, 3), m: where (0, 0), and steps of a cell, are on the body.
    ``places`` (s, 2), cells, are the samples, row by row, ``around`` more of them. ``printed``
    (l, H, W, 3): how white it is, 0..1, and by how much more per cell to the right, and down,
    for each of :data:`LENSES`.
    ``smears`` (t, 2), cells, are the vectors tried first, with blur ``lenses`` (t,), and
    ``smeared`` (t, k, k) the samples then.
    ``codes`` (w, b): all words of the dictionary in all turns, 0..1, the marker's own first, of
    which ``errors`` cells may be misread. ``cells`` are along a side, the black border included.
    """

    origin: Array
    axes: Array
    places: Array
    around: Array
    printed: Any
    smears: Array
    lenses: tuple[int, ...]
    smeared: Any
    codes: Array
    errors: int
    cells: int


@lru_cache(maxsize=64)
def smear_model(marker: Marker, dictionary: str) -> SmearModel:
    """Return what it takes to smear a marker."""
    code = aruco.marker_code(dictionary, marker.marker_id)
    n = len(code)
    cell = marker.side_length / n
    R = marker.T_body_marker.rotation
    origin = marker.T_body_marker.apply(0.5 * (n - 1) * cell * np.array([[-1.0, 1.0, 0.0]]))[0]
    white = np.pad(code, _WHITE, constant_values=True).astype(float)
    level = np.kron(white, np.ones((_TEXELS, _TEXELS)))
    printed = np.array([_with_slopes(cv2.GaussianBlur(
        level, (0, 0), lens * _TEXELS, borderType=cv2.BORDER_REPLICATE)) for lens in LENSES])
    words = aruco.dictionary_words(dictionary)
    turned = np.stack([np.rot90(words, k, axes=(1, 2)) for k in range(4)], axis=1)
    order = [marker.marker_id, *(k for k in range(len(words)) if k != marker.marker_id)]
    angles = np.arange(4) * np.pi / 4
    smears = np.array([[0.0, 0.0], *(length * np.array([np.cos(a), np.sin(a)])
                                     for length in _LENGTHS for a in angles),
                       *np.zeros((len(LENSES) - FOCUSED, 2))])
    lenses = (_LENS,) * (1 + len(_LENGTHS) * len(angles)) + tuple(range(FOCUSED, len(LENSES)))
    places, size = _samples(n, MARGIN), n * PER_CELL + 2 * MARGIN
    smeared = np.array([smear_print(printed[lens], places, smear)[0]
                        for lens, smear in zip(lenses, smears)])
    return SmearModel(
        origin, cell * np.array([R[:, 0], -R[:, 1]]), places, _samples(n, MARGIN + AWAY),
        printed, smears, lenses, smeared.reshape(-1, size, size).astype(np.float32),
        turned[order].reshape(4 * len(words), -1).astype(float),
        max(aruco.correctable_cells(dictionary), 1), n)


def _with_slopes(level: Array) -> Any:
    """Return how white a print is, and by how much more per cell to the right and down."""
    down, right = np.gradient(level)
    return np.dstack([level, _TEXELS * right, _TEXELS * down]).astype(np.float32)


def _samples(cells: int, margin: int) -> Array:
    """Return places (s, 2), cells, that cover a marker and a margin, samples, around it."""
    along = (np.arange(-margin, cells * PER_CELL + margin) + 0.5) / PER_CELL - 0.5
    return np.stack(np.meshgrid(along, along), axis=2).reshape(-1, 2)


def smear_print(printed: Any, places: Array, smear: Array) -> tuple[Array, Array, Array]:
    """Return how white samples are, (s,), and by place and by smear, (s, 2), per cell."""
    at = places + INSTANTS[:, None, None] * smear
    at = ((at + 0.5 + _WHITE) * _TEXELS - 0.5).astype(np.float32)
    seen = cv2.remap(printed, at[..., 0], at[..., 1], cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE).reshape(len(INSTANTS), -1)
    mean = seen.mean(axis=0).astype(float).reshape(-1, 3)
    by_smear = INSTANTS.dot(seen).reshape(-1, 3)[:, 1:] / len(INSTANTS)
    return mean[:, 0], mean[:, 1:], by_smear
