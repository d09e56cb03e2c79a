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

"""Whether the cells of a marker show its code: the last word on what has been tracked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from flock_follower.geometry import Array
from flock_follower.perception import aruco, local_light
from flock_follower.perception.images import GrayImage
from flock_follower.perception.local_light import Windows
from flock_follower.perception.neighbors import Marker

_MIN_CONTRAST = 10.0  # grey levels between the black border and the quiet zone
#: A marker is looked for this far from its place, cells, in steps of half a cell;
_RANGE = 2.5
_SHIFTS = np.arange(-_RANGE, _RANGE + 0.1, 0.5)
#: it is there where its correlation with the pattern is above this.
_LIKENESS = 0.6
_MIN_BORDER = 0.6  # share of the border's cells that must be black
#: Where else a cell is looked at, in cells from its middle.
_BESIDE = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])
_MIN_AROUND = 0.5  # share of those of the quiet zone that must be white where light is uneven


@dataclass(frozen=True, eq=False)
class CellCode:
    """
    What a marker's cells should show.

    ``centers`` (c, 3): middles of its ``bits.size`` inner cells, then of ``border`` black ones,
    then of the white ones around, on the neighbour's body, m; ``grid`` (c, 2) their columns and
    rows. ``bits`` (b,): +1 white, -1 black;
    ``errors`` of them may be misread.
    ``others`` (w, b): every other word of the dictionary, and each in its turns. ``windows``:
    which cells are compared where light is uneven.
    """

    centers: Array
    grid: Array
    bits: Array
    border: int
    errors: int
    others: Any
    windows: Windows
    #: Takes pixels (c, 2) to how far, px, it is from cell to cell along rows and columns: (2, c).
    by_cell: Array


@lru_cache(maxsize=64)
def cell_code(marker: Marker, dictionary: str) -> CellCode:
    """Return the cells of a marker of a dictionary."""
    cells = aruco.marker_cells(dictionary)
    rows, columns = (index.ravel() for index in np.mgrid[-1:cells + 1, -1:cells + 1])
    from_edge = np.minimum(np.minimum(rows, columns), cells - 1 - np.maximum(rows, columns))
    order = np.argsort(-np.minimum(from_edge, 1), kind='stable')  # inner, border, around
    x, y = columns[order] + 0.5 - cells / 2.0, cells / 2.0 - rows[order] - 0.5
    centers = marker.side_length / cells * np.stack([x, y, np.zeros(len(order))], axis=1)
    words = aruco.dictionary_words(dictionary)
    turned = np.stack([np.rot90(words, k, axes=(1, 2)) for k in range(4)], axis=1)
    signs = np.where(turned, 1.0, -1.0).reshape(len(words), 4, -1).astype(np.float32)
    bits = signs[marker.marker_id, 0].copy()
    signs[marker.marker_id, 0] = -bits  # not one of the others
    grid, border = np.stack([columns[order], rows[order]], axis=1), int((from_edge == 0).sum())
    white = np.concatenate([bits > 0.0, np.zeros(border, dtype=bool),
                            np.ones(len(order) - bits.size - border, dtype=bool)])
    return CellCode(
        marker.T_body_marker.apply(centers), grid, bits, border,
        max(aruco.correctable_cells(dictionary), 1), signs.reshape(-1, bits.size),
        local_light.windows(grid, white),
        # A marker is seen almost as a parallelogram: its axes come from the outermost cells.
        np.linalg.pinv(np.column_stack([grid, np.ones(len(grid))]))[:2])


def shows_code(image: GrayImage, pixels: Array, code: CellCode) -> bool:
    """
    Return whether an image shows a marker's code, its cells' middles being at ``pixels`` (c, 2).

    Its border must be black, the quiet zone around white, at most ``code.errors`` of its
    cells the wrong way, and no other word of the dictionary nearer. Where one threshold for all
    cells does not show that, a shadow may lie across: then each is compared with those around.
    """
    brightness = _brightness(image, pixels)
    inner = code.bits.size
    border = brightness[inner:inner + code.border]
    dark, light = median(border), median(brightness[inner + code.border:])
    if light - dark < _MIN_CONTRAST:
        return False
    middle, half = 0.5 * (light + dark), 0.5 * (light - dark)
    read = np.minimum(np.maximum((brightness[:inner] - middle) * (1.0 / half), -1.0), 1.0)
    if (np.count_nonzero(border < middle) >= _MIN_BORDER * code.border
            and np.count_nonzero(read * code.bits <= 0.0) <= code.errors
            and _is_word(read, code)):
        return True
    if _shows_in_uneven_light(local_light.read(brightness[None], code.windows)[0], code):
        return True
    # A shadow's edge in the middle of cells has them neither bright nor dark there.
    beside = (pixels + (_BESIDE @ (code.by_cell @ pixels))[:, None]).reshape(-1, 2)
    return _shows_in_uneven_light(local_light.read(
        _brightness(image, beside).reshape(len(_BESIDE), -1), code.windows).mean(axis=0), code)


def _shows_in_uneven_light(read: Array, code: CellCode) -> bool:
    """Return whether all cells (c,), black -1 to white 1, are those of a marker."""
    inner, around = read[:code.bits.size], read[code.bits.size + code.border:]
    border = read[code.bits.size:code.bits.size + code.border]
    # There is more that can be made to fit: half as much may be wrong, and doubt counts as well.
    wrong = float(np.clip(0.5 - inner * code.bits, 0.0, 1.0).sum())
    return (wrong < max(0.5 * code.errors, 1.0) and _is_word(inner, code)
            and np.count_nonzero(border < 0.0) >= _MIN_BORDER * code.border
            and np.count_nonzero(around > 0.0) >= _MIN_AROUND * len(around))


def _is_word(read: Array, code: CellCode) -> bool:
    """Return whether inner cells (b,), black -1 to white 1, resemble no other word as much."""
    return bool(code.bits.dot(read) > code.others.dot(read).max())


def shift_to_code(image: GrayImage, pixels: Array, code: CellCode) -> tuple[float, float] | None:
    """
    Return by how many cells, to the right and down, a marker is off where it is expected.

    Its cells' middles are expected at ``pixels`` (c, 2); it is looked for within ``_RANGE`` cells.
    None where nothing resembles it.
    """
    pattern = np.concatenate([code.bits, -np.ones(code.border),
                              np.ones(len(pixels) - code.bits.size - code.border)])
    pattern -= pattern.mean()
    axes = code.by_cell @ pixels
    shifts = np.stack(np.meshgrid(_SHIFTS, _SHIFTS), axis=2).reshape(-1, 2)
    at = pixels[None] + (shifts @ axes)[:, None]
    brightness = _brightness(image, at.reshape(-1, 2)).reshape(len(shifts), -1)
    spread = brightness.std(axis=1) * len(pixels)**0.5 * np.linalg.norm(pattern)
    likeness = brightness @ pattern / np.maximum(spread, 1e-6)
    best = int(np.argmax(likeness))
    if likeness[best] < _LIKENESS:
        return None
    right, down = shifts[best].tolist()
    return right, down


def _brightness(image: GrayImage, pixels: Array) -> Any:
    """Return the brightness (n,) at pixels (n, 2), the image's edge repeated outside."""
    at = pixels.astype(np.float32)[:, None]
    return cv2.remap(image, at, None, cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE).ravel().astype(np.float32)


def median(values: Any) -> float:
    """Return the upper median: np.median takes ten times as long."""
    ordered = values.copy()
    ordered.sort()
    return float(ordered[len(ordered) // 2])
