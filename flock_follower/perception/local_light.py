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
Which cells of a marker are black and which white where the light on them is uneven.

A shadow's edge across a marker may leave white in the shade darker than black in the sun. But
within a window of few cells on one side of it, black and white are apart as ever. So each cell is
compared with those around it, in that of several windows in which they agree best with what they
should be, and it is as bright as the black or the white among them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array

#: Columns and rows of the windows, in cells: round ones, and such as fit into a narrow shadow.
SHAPES = ((3, 3), (4, 2), (2, 4), (3, 2), (2, 3))
_MIN_APART = 4.0  # grey levels between black and white, both in the shade
#: Where black or white spread more than this, as a variance against half of what they are apart,
#: squared, they are not what they should be, and tell nothing.
_MAX_SPREAD = 0.35


class Windows(NamedTuple):
    """
    Windows on the c cells of a marker.

    ``cells`` (w, k) are the indices of the cells in each window, repeated where it has fewer
    than k; ``white`` and ``black`` (w, k) are 1 where a cell should have that colour, else 0, and
    0 for those repeated. ``places`` (c, p) are where in (w, k), flattened, each cell is, repeated
    where it is in fewer than p.
    """

    cells: NDArray[np.intp]
    white: Array
    black: Array
    places: NDArray[np.intp]


def windows(grid: Array, white: NDArray[np.bool_]) -> Windows:
    """Return the windows on cells at columns and rows (c, 2), white or black as (c,)."""
    column, row = (grid - grid.min(axis=0)).T
    size = max(w * h for w, h in SHAPES)
    chosen = []
    for width, height in SHAPES:
        for left in range(int(column.max()) - width + 2):
            for top in range(int(row.max()) - height + 2):
                inside = np.flatnonzero((column >= left) & (column < left + width)
                                        & (row >= top) & (row < top + height))
                # Whichever is judged by the others, both colours must be left.
                if 2 <= np.count_nonzero(white[inside]) <= len(inside) - 2:
                    chosen.append(inside)
    cells = np.array([np.resize(inside, size) for inside in chosen])
    counted = np.arange(size) < np.array([len(inside) for inside in chosen])[:, None]
    places = [np.flatnonzero((cells == k) & counted) for k in range(len(grid))]
    most = max(len(some) for some in places)
    return Windows(cells, (white[cells] & counted).astype(float),
                   (~white[cells] & counted).astype(float),
                   np.array([np.resize(some, most) for some in places]))


def read(brightness: Array, seen: Windows) -> Array:
    """
    Return the colours (n, c) of cells from their brightness (n, c), grey levels, n times alike.

    -1 is as black as those around that should be, 1 as white; 0 where nothing around tells.
    """
    values = brightness.astype(float)[:, seen.cells]
    sums = []
    for colour in (seen.white, seen.black):  # of the others: a cell does not judge itself
        some = values * colour
        sums.append([total.sum(axis=-1, keepdims=True) - total
                     for total in (colour, some, some * values)])
    (whites, white, white2), (blacks, black, black2) = sums
    light, dark = white / whites, black / blacks
    half = np.maximum(0.5 * (light - dark), 0.5 * _MIN_APART)
    spread = (white2 - white * light + black2 - black * dark) / (whites + blacks) / (half * half)
    shown = (values - 0.5 * (light + dark)) / half
    told = (light - dark >= _MIN_APART) & (spread <= _MAX_SPREAD)
    # Best is a window that is even, and in which the cell is as any black or white one.
    odd = spread + (np.abs(shown) - 1.0)**2
    odd, shown = (part.reshape(len(values), -1) for part in (
        np.where(told, odd, np.inf), np.where(told, shown, 0.0)))
    best = odd[:, seen.places].argmin(axis=2)
    chosen = seen.places[np.arange(seen.places.shape[0]), best]
    colours: Array = np.clip(np.take_along_axis(shown, chosen, axis=1), -1.0, 1.0)
    return colours
