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
The print of a marker: its edges for the fit, its cells, and whether an image shows its code.

Edge points are on the borders between black and white cells, but not near the ends of a straight
border, where blur rounds the corner.

``shows_code`` makes the final decision on a tracked marker, unless almost all its edges are in
place. Light on a marker may be uneven: white in a shadow may be darker than black in the sun. In a
window of a few cells on one side of the shadow's edge, black and white can still be distinguished.
So each cell is compared with the cells around it, in the window that agrees best with the code.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception.images import gray_levels, GrayImage
from flock_follower.perception.markers import (
    correctable_cells,
    dictionary_words,
    marker_cells,
    marker_code,
)

#: Columns and rows of the windows, in cells: round ones, and such as fit into a narrow shadow.
SHAPES = ((3, 3), (4, 2), (2, 4), (3, 2), (2, 3))
#: The cells of a window, (k,), times this: for each the sum over the others.
_OTHERS = 1.0 - np.eye(max(columns * rows for columns, rows in SHAPES))
_MIN_APART = 4.0  # gray levels between black and white, both in the shade
#: Black or white cells are not used if their variance exceeds this share of the squared half of
#: their contrast.
_MAX_SPREAD = 0.35
_SATURATED_LEVEL = 250.0  # gray levels


class Windows(NamedTuple):
    """
    Windows on the c cells of a marker.

    ``cells`` (w, k) are the indices of the cells in each window, with repetitions if it has fewer
    than k cells. ``white`` and ``black`` (w, k) are 1 if a cell should have this color, else 0; 0
    for repetitions. ``places`` (c, p) are the positions of each cell in the flattened (w, k), with
    repetitions if there are fewer than p.
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
                # Whichever is judged by the others, both colors must be left.
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
    Return the colors (n, c) of cells from their brightness (n, c), gray levels, of n readings.

    -1: as the black cells around, 1: as the white cells around, 0: no cells for a comparison.
    """
    values = brightness.astype(float)[:, seen.cells]
    # A cell is not compared with itself, and with no saturated cell that should be black.
    light, black = values * seen.white, seen.black * (values < _SATURATED_LEVEL)
    some = np.stack([light, values * light, black, dark := values * black, values * dark])
    white, white2, blacks, black, black2 = some.reshape(-1, len(_OTHERS)).dot(_OTHERS).reshape(
        some.shape)
    whites = seen.white.dot(_OTHERS)
    light, dark = white / whites, black / np.maximum(blacks, 1.0)
    half = np.maximum(0.5 * (light - dark), 0.5 * _MIN_APART)
    spread = (white2 - white * light + black2 - black * dark) / (whites + blacks) / (half * half)
    shown = (values - 0.5 * (light + dark)) / half
    readable = (light - dark >= _MIN_APART) & (spread <= _MAX_SPREAD) & (blacks > 0.0)
    # Best is a window that is even, and in which the cell is as any black or white one.
    odd = spread + (np.abs(shown) - 1.0)**2
    odd, shown = (part.reshape(len(values), -1) for part in (
        np.where(readable, odd, np.inf), np.where(readable, shown, 0.0)))
    best = odd[:, seen.places].argmin(axis=2)
    chosen = seen.places[np.arange(seen.places.shape[0]), best]
    return np.clip(np.take_along_axis(shown, chosen, axis=1), -1.0, 1.0)


_MIN_CONTRAST = 10.0  # gray levels between the black border and the quiet zone
_MIN_BORDER = 0.6  # share of the border's cells that must be black
#: Further places at which a cell is read, in cells from its middle.
_BESIDE = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])
#: Excess of errors in the middles of the cells from which on no other places are read.
_MAX_EXCESS = 3.0
_MOST_HIDDEN = 0.3  # share of the inner cells that a reflex may hide
_MOST_HIDDEN_TRACKED = 0.4  # share of the inner cells of a tracked marker that a reflex may hide
_MIN_COVERED = 4  # of the white cells around, near an inner cell: along a side are five
_MIN_AROUND = 0.5  # share of those of the quiet zone that must be white where light is uneven


class CellCode:
    """
    The code of a marker of a dictionary: the colors of its cells.

    ``centers`` (c, 3) are the middles of the ``bits.size`` inner cells, then of ``border`` black
    cells, then of the white cells around, on the neighbor's body, m; ``grid`` (c, 2) their columns
    and rows. ``bits`` (b,): +1 white, -1 black; up to ``errors`` of them may be misread.
    ``others`` (w, b): all other codewords of the dictionary, in all rotations. ``windows``: cells
    that are compared with each other under uneven light. ``beside`` (b, c): 1 for the cells next
    to an inner cell; ``outside`` (b, a): 1 for the white cells around next but one to an inner
    cell. ``distinct``: the least number of edge points between cells of different colors that are
    none in another word. ``by_cell`` converts pixels (c, 2) to the distances between cells along
    rows and columns, px, (2, c).
    """

    def __init__(self, marker: Marker, dictionary: str) -> None:
        cells = marker_cells(dictionary)
        rows, columns = (index.ravel() for index in np.mgrid[-1:cells + 1, -1:cells + 1])
        from_edge = np.minimum(np.minimum(rows, columns), cells - 1 - np.maximum(rows, columns))
        order = np.argsort(-np.minimum(from_edge, 1), kind='stable')  # inner, border, around
        x, y = columns[order] + 0.5 - cells / 2.0, cells / 2.0 - rows[order] - 0.5
        self.centers = marker.T_body_marker.apply(
            marker.side_length / cells * np.stack([x, y, np.zeros(len(order))], axis=1))
        self.grid = np.stack([columns[order], rows[order]], axis=1)
        self.border = int((from_edge == 0).sum())
        words = dictionary_words(dictionary)
        turned = np.stack([np.rot90(words, k, axes=(1, 2)) for k in range(4)], axis=1)
        signs = np.where(turned, 1.0, -1.0).reshape(len(words), 4, -1).astype(np.float32)
        self.bits: Any = signs[marker.marker_id, 0].copy()
        signs[marker.marker_id, 0] = -self.bits  # not one of the others
        self.others: Any = signs.reshape(-1, self.bits.size)
        self.errors = max(correctable_cells(dictionary), 1)
        self.windows = windows(self.grid, np.concatenate([
            self.bits > 0.0, np.zeros(self.border, dtype=bool),
            np.ones(len(order) - self.bits.size - self.border, dtype=bool)]))
        apart = np.abs(self.grid[:self.bits.size, None] - self.grid).max(axis=2)
        self.beside: Any = (apart == 1).astype(np.float32)
        self.outside: Any = (apart[:, self.bits.size + self.border:] == 2).astype(np.float32)
        points = np.array([place[:2] for place, *_ in _edges(
            marker_code(dictionary, marker.marker_id))])
        beside = np.hypot(points[:, :1] - x, points[:, 1:] - y).argsort(axis=1)[:, :2]
        differs = np.pad(self.others != self.bits, ((0, 0), (0, 1)))  # the border never does
        self.distinct = int(differs[:, np.minimum(beside, self.bits.size)].any(axis=2).sum(
            axis=1).min())
        # A marker is seen almost as a parallelogram: its axes come from the outermost cells.
        self.by_cell = np.linalg.pinv(np.column_stack([self.grid, np.ones(len(self.grid))]))[:2]


#: The code of a marker of a dictionary, made once.
cell_code = lru_cache(maxsize=64)(CellCode)


def shows_code(image: GrayImage, pixels: Array, code: CellCode, tracked: bool = False) -> bool:
    """
    Return whether an image shows a marker's code; its cells' middles are at ``pixels`` (c, 2).

    The border must be black, the quiet zone around it white, and no other word of the dictionary
    nearer. If the marker is ``tracked``, up to ``code.errors`` cells may be covered; otherwise
    half as many may be wrong, because a mirrored print differs in few cells. If the code does not
    appear with one threshold for all cells, because of a shadow, each cell is compared with the
    cells around it.
    """
    brightness = gray_levels(image, pixels)
    inner = code.bits.size
    border = brightness[inner:inner + code.border]
    dark, light = median(border), median(brightness[inner + code.border:])
    if light - dark < _MIN_CONTRAST:
        return False
    middle, half = 0.5 * (light + dark), 0.5 * (light - dark)
    cells = np.minimum(np.maximum((brightness[:inner] - middle) * (1.0 / half), -1.0), 1.0)
    agreeing = cells * code.bits
    # What covers the white around, darkly, covers cells beside.
    covered = (np.maximum(cells, agreeing) < 0.0) & (
        code.outside.dot(brightness[inner + code.border:] < middle) >= (
            1 if tracked else _MIN_COVERED))
    if np.count_nonzero(covered) <= code.errors:
        cells[covered], agreeing[covered] = 0.0, 1.0
    if (np.count_nonzero(border < middle) >= _MIN_BORDER * code.border
            and _few_wrong(agreeing, brightness, code, tracked)
            and _is_word(cells, code)):
        return True
    shown, excess = _compare_in_uneven_light(brightness[None], code, tracked)
    if shown or excess >= _MAX_EXCESS:
        return shown
    # A shadow's edge in the middle of cells has them neither bright nor dark there.
    beside = (pixels + (_BESIDE @ (code.by_cell @ pixels))[:, None]).reshape(-1, 2)
    return _compare_in_uneven_light(gray_levels(image, beside).reshape(len(_BESIDE), -1), code,
                                    tracked)[0]


def _few_wrong(agreeing: Array, brightness: Array, code: CellCode, tracked: bool) -> bool:
    """Return whether inner cells agree well enough, (b,), -1 to 1, with a marker's."""
    correctable = np.count_nonzero(agreeing <= 0.0) <= code.errors
    if tracked:
        return correctable
    if correctable and (brightness[:code.bits.size + code.border] >= _SATURATED_LEVEL).any():
        agreeing = agreeing[code.bits > 0.0]  # a reflex turns no white cell black
    return _wrong(agreeing) < max(0.5 * code.errors, 1.0)


def _wrong(agreeing: Array) -> float:
    """Return the number of wrong cells by their agreement (n,); doubtful cells count in part."""
    return float(np.clip(0.5 - agreeing, 0.0, 1.0).sum())


def _compare_in_uneven_light(brightness: Array, code: CellCode,
                             tracked: bool) -> tuple[bool, float]:
    """
    Return whether the image shows the marker's code in uneven light, and the excess of errors.

    The excess is the number of wrong cells over the number from which on there are too many if
    none is hidden.
    ``brightness`` (n, c): gray levels at n sample points in each of c cells.
    """
    colors = read(brightness, code.windows).mean(axis=0)
    saturated: Any = (brightness >= _SATURATED_LEVEL).any(axis=0)
    end = code.bits.size + code.border
    inner, border, around = slice(code.bits.size), slice(code.bits.size, end), slice(end, None)
    # A reflex hides black cells, and brightens those beside. It cannot be told from paper that is
    # saturated as well, unless the marker was there before.
    hidden = saturated[inner] & (code.bits < 0.0)
    if tracked:
        hidden |= (code.bits < 0.0) & (colors[inner] > 0.0) & (code.beside.dot(saturated) > 0.0)
    else:
        hidden &= saturated[around].mean() <= _MOST_HIDDEN
    count, most = np.count_nonzero(hidden), _MOST_HIDDEN_TRACKED if tracked else _MOST_HIDDEN
    bits = np.where(hidden, 0.0, colors[inner])
    # There is more that can be made to fit: half as much may be wrong, and doubt counts as well.
    wrong = _wrong((bits * code.bits)[~hidden])
    # Codewords differ by more than twice the errors: hidden cells leave a difference.
    return (wrong < (0.5 if count and not tracked else max(0.5 * code.errors, 1.0))
            and count <= most * len(hidden) and (tracked or count <= 2 * code.errors)
            and _is_word(bits, code)
            and np.count_nonzero(colors[border] < 0.0) >= _MIN_BORDER * code.border
            and np.count_nonzero(colors[around] > 0.0) >= _MIN_AROUND * len(colors[around])
            ), wrong / max(0.5 * code.errors, 1.0)


def _is_word(read: Array, code: CellCode) -> bool:
    """Return whether inner cells (b,), black -1 to white 1, resemble no other word as much."""
    return bool(code.bits.dot(read) > code.others.dot(read).max())


def median(values: Any) -> float:
    """Return the upper median: np.median takes ten times as long."""
    ordered = values.copy()
    ordered.sort()
    return float(ordered[len(ordered) // 2])


_END = 0.4  # cells kept clear of the ends of a run
_BORDER_POINTS = 10  # along each outer edge
_INNER_SPACING = 0.6  # cells
#: Of brightness across an edge, taken of every one.
N_DERIVATIVES = 9


class EdgeModel:
    """
    The n edge points of all m markers of a neighbor, on its body (FLU), m.

    ``places`` (n + c, 3) are the points, then the middles of the markers' cells. ``tangents`` (n,
    3) are unit vectors with black on the left and white on the right, seen from the front.
    ``axis`` (n,) is 0 for edges across the marker's x axis, 1 across y. ``room`` (n, 2) is the
    distance to the next edge on the black side and on the white side, m. ``marker`` (n,) is the
    index of the marker. For each marker: ``centers`` and ``facings`` (m, 3), its middle and its
    normal, and ``codes``.
    """

    def __init__(self, places: Array, tangents: Array, axis: Any, room: Array, marker: Any,
                 centers: Array, facings: Array, codes: tuple[CellCode, ...]) -> None:
        self.places, self.tangents, self.axis, self.room = places, tangents, axis, room
        self.marker, self.centers, self.facings, self.codes = marker, centers, facings, codes
        # Which edges are across either axis, (2, n); how many, (2,); one of each axis.
        self.across = np.array([[0], [1]]) == axis
        self.counts = self.across.sum(axis=1).tolist()
        self.examples = int(axis.argmin()), int(axis.argmax())
        # The narrowest room across either, m.
        first, second = (float(room[one].min(initial=np.inf)) for one in self.across)
        self.narrowest = first, second
        # The motion along the normals by the two shifts of bloom, px, (n, 2): normals point from
        # black to white, white swells to black.
        self.bloom = -np.eye(2)[axis]
        # The mean of the points is this times them, (n,).
        self.shares = np.full(len(self), 1.0 / max(len(self), 1))
        # Where the derivatives of each edge begin, of N_DERIVATIVES each, (n,).
        self.begins = N_DERIVATIVES * np.arange(len(self))
        self.distinct = min((code.distinct for code in codes), default=0)
        # The cells of each marker, among all of them.
        self.cell_slices = [slice(*ends) for ends in pairwise(
            np.cumsum([0, *(len(code.centers) for code in codes)]).tolist())]
        self._parts: dict[tuple[bool, ...], EdgeModel] = {}

    def __len__(self) -> int:
        """Return the number of edge points."""
        return len(self.tangents)

    def only(self, markers: tuple[bool, ...]) -> EdgeModel:
        """Return the model of the chosen ones of the m markers; their order is kept."""
        if all(markers):
            return self
        if markers not in self._parts:
            chosen = np.array(markers)
            edges = chosen[self.marker]
            cells = np.repeat(chosen, [len(code.centers) for code in self.codes])
            renumbered = np.cumsum(chosen) - 1
            self._parts[markers] = EdgeModel(
                self.places[np.concatenate([edges, cells])], self.tangents[edges],
                self.axis[edges], self.room[edges], renumbered[self.marker[edges]],
                self.centers[chosen], self.facings[chosen],
                tuple(c for c, m in zip(self.codes, markers) if m))
        return self._parts[markers]


@lru_cache(maxsize=64)
def edge_model(neighbor: MarkedNeighbor, dictionary: str) -> EdgeModel:
    """Return the edges and cells of a neighbor's markers, all of one dictionary."""
    points, tangents, axis, room, index = [], [], [], [], []
    for k, marker in enumerate(neighbor.markers):
        code = marker_code(dictionary, marker.marker_id)
        cell, T = marker.side_length / len(code), marker.T_body_marker
        edges = _edges(code)
        points.append(T.apply(cell * np.array([e[0] for e in edges])))
        tangents.append(np.array([e[1] for e in edges]) @ T.rotation.T)
        room.append(cell * np.array([e[2] for e in edges]))
        axis.append(np.array([e[3] for e in edges]))
        index.append(np.full(len(edges), k))
    codes = tuple(cell_code(marker, dictionary) for marker in neighbor.markers)
    return EdgeModel(
        np.concatenate([*points, *(code.centers for code in codes)]), np.concatenate(tangents),
        np.concatenate(axis), np.concatenate(room), np.concatenate(index),
        np.stack([m.T_body_marker.translation for m in neighbor.markers]),
        np.stack([m.T_body_marker.rotation[:, 2] for m in neighbor.markers]), codes)


_Edge = tuple[tuple[float, ...], tuple[float, ...], tuple[float, float], int]


def _edges(code: Any) -> list[_Edge]:
    """
    Return places and tangents in the marker's frame, room, and axis; lengths in cells.

    ``code`` (c, c) is True for white cells, its first row on top.
    """
    cells = len(code)
    edges: list[_Edge] = []
    for turned in (False, True):
        grid = np.pad(code.T if turned else code, 1, constant_values=True)
        for column in range(cells + 1):  # the edge between this column of the grid and the next
            step = grid[:, column + 1].astype(int) - grid[:, column].astype(int)
            ends = [0, *(np.flatnonzero(np.diff(step)) + 1).tolist(), len(step)]
            for first, last in pairwise(ends):
                light = float(step[first])
                if not light:
                    continue
                for along in _points_along(first - 1.0, last - 1.0, column in (0, cells)):
                    room = _run_lengths(grid[int(along) + 1], column, light > 0.0)
                    x, y = column - cells / 2.0, along - cells / 2.0
                    # Rows run down, the marker's y axis up: white to the right is the normal +x,
                    # white below is the normal -y. The tangent is the normal turned left.
                    edges.append(((y, -x, 0.0), (light, 0.0, 0.0), room, 1) if turned else
                                 ((x, -y, 0.0), (0.0, light, 0.0), room, 0))
    return edges


def _points_along(start: float, end: float, border: bool) -> Array:
    """Return where along a run to look, in cells."""
    count = _BORDER_POINTS if border else (
        1 + int(np.ceil((end - start - 2.0 * _END) / _INNER_SPACING)))
    return np.linspace(start + _END, end - _END, count)


def _run_lengths(line: Any, column: int, rising: bool) -> tuple[float, float]:
    """Return the lengths, cells, of the black and of the white run of cells at an edge."""
    edges = [-1, *np.flatnonzero(np.diff(line)).tolist(), len(line) - 1]
    k = edges.index(column)
    left, right = float(column - edges[k - 1]), float(edges[k + 1] - column)
    return (left, right) if rising else (right, left)
