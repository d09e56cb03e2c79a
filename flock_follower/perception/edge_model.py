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
Where a marker has edges between black and white, and cells: what the edge fit looks for.

Edge points lie on the borders of the marker's cells, away from the ends of every straight run,
where blur rounds the corner off.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from flock_follower.geometry import Array
from flock_follower.perception import aruco
from flock_follower.perception.cells import cell_code, CellCode
from flock_follower.perception.neighbors import Neighbor

_END = 0.4  # cells kept clear of the ends of a run
_BORDER_POINTS = 10  # along each outer edge
_INNER_SPACING = 0.6  # cells
#: Of brightness across an edge, taken of every one.
DERIVATIVES = 9


@dataclass(frozen=True, eq=False)
class EdgeModel:
    """
    The n edge points of all m markers of a neighbour, on its body (FLU), m.

    ``places`` (n + c, 3) are the points, then the middles of the markers' cells. ``tangents``
    (n, 3), unit, have black on the left and white on the right as one faces the marker.
    ``axis`` (n,) is 0 for edges across the marker's x axis, 1 across y. ``room`` (n, 2) is how far
    the next edge is on the black side, and on the white side, m. ``marker`` (n,) and
    ``cell_marker`` (c,) are the index of the marker. Per marker: ``centers`` and ``facings``
    (m, 3), its middle and its normal, and ``codes``.
    """

    places: Array
    tangents: Array
    axis: Any
    room: Array
    marker: Any
    cell_marker: Any
    centers: Array
    facings: Array
    codes: tuple[CellCode, ...]
    #: What the two shifts of bloom, px, do along the normals: (n, 2). Normals point from black to
    #: white, white swells to black.
    bloom: Array = field(init=False)
    #: Which edges are across either axis: (2, n).
    across: Any = field(init=False)
    #: How many edges are across either axis: (2,).
    counts: Array = field(init=False)
    #: An edge of either axis; the narrowest room across either, m.
    examples: tuple[int, int] = field(init=False)
    narrowest: tuple[float, float] = field(init=False)
    #: The mean of the points is this times them: (n,).
    shares: Array = field(init=False)
    #: Where the derivatives of each edge begin, of :data:`DERIVATIVES` each.
    begins: Any = field(init=False)
    _parts: dict[bytes, EdgeModel] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Derive what depends on the edges' directions."""
        object.__setattr__(self, 'bloom', -np.eye(2)[self.axis])
        object.__setattr__(self, 'across', np.array([[0], [1]]) == self.axis)
        object.__setattr__(self, 'counts', self.across.sum(axis=1).astype(float))
        object.__setattr__(self, 'examples', (int(self.axis.argmin()), int(self.axis.argmax())))
        object.__setattr__(self, 'narrowest', tuple(
            float(self.room[one].min(initial=np.inf)) for one in self.across))
        object.__setattr__(self, 'shares', np.full(len(self), 1.0 / max(len(self), 1)))
        object.__setattr__(self, 'begins', DERIVATIVES * np.arange(len(self)))

    def __len__(self) -> int:
        """Return the number of edge points."""
        return len(self.tangents)

    def only(self, markers: Any) -> EdgeModel:
        """Return the model of the chosen markers (m,), bool; their order is kept."""
        if markers.all():
            return self
        key = markers.tobytes()
        if key not in self._parts:
            edges, cells = markers[self.marker], markers[self.cell_marker]
            renumbered = np.cumsum(markers) - 1
            self._parts[key] = EdgeModel(
                self.places[np.concatenate([edges, cells])], self.tangents[edges],
                self.axis[edges], self.room[edges], renumbered[self.marker[edges]],
                renumbered[self.cell_marker[cells]], self.centers[markers],
                self.facings[markers], tuple(c for c, m in zip(self.codes, markers) if m))
        return self._parts[key]


@lru_cache(maxsize=64)
def edge_model(neighbor: Neighbor, dictionary: str) -> EdgeModel:
    """Return the edges and cells of a neighbour's markers, all of one dictionary."""
    points, tangents, axis, room, index = [], [], [], [], []
    for k, marker in enumerate(neighbor.markers):
        code = aruco.marker_code(dictionary, marker.marker_id)
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
        np.repeat(np.arange(len(codes)), [len(code.centers) for code in codes]),
        np.stack([m.T_body_marker.translation for m in neighbor.markers]),
        np.stack([m.T_body_marker.rotation[:, 2] for m in neighbor.markers]), codes)


_Edge = tuple[tuple[float, ...], tuple[float, ...], tuple[float, float], int]


def _edges(code: Any) -> list[_Edge]:
    """
    Return places and tangents in the marker's frame, room, and axis; lengths in cells.

    ``code`` (c, c) is True where white, its first row on top.
    """
    cells = len(code)
    edges: list[_Edge] = []
    for turned in (False, True):
        grid = np.pad(code.T if turned else code, 1, constant_values=True)
        for column in range(cells + 1):  # the edge between this column of the grid and the next
            step = grid[:, column + 1].astype(int) - grid[:, column].astype(int)
            for first, last in _runs(step):
                light = float(step[first])
                for along in _along(first - 1.0, last - 1.0, column in (0, cells)):
                    room = _room(grid[int(along) + 1], column, light > 0.0)
                    x, y = column - cells / 2.0, along - cells / 2.0
                    # Rows run down, the marker's y axis up: white to the right is the normal +x,
                    # white below is the normal -y. The tangent is the normal turned left.
                    edges.append(((y, -x, 0.0), (light, 0.0, 0.0), room, 1) if turned else
                                 ((x, -y, 0.0), (0.0, light, 0.0), room, 0))
    return edges


def _runs(step: Any) -> list[tuple[int, int]]:
    """Return the stretches [first, last) of equal steps other than 0."""
    runs, first = [], 0
    for i in range(1, len(step) + 1):
        if i == len(step) or step[i] != step[first]:
            if step[first]:
                runs.append((first, i))
            first = i
    return runs


def _along(start: float, end: float, border: bool) -> Array:
    """Return where along a run to look, in cells."""
    count = _BORDER_POINTS if border else (
        1 + int(np.ceil((end - start - 2.0 * _END) / _INNER_SPACING)))
    return np.linspace(start + _END, end - _END, count)


def _room(line: Any, column: int, rising: bool) -> tuple[float, float]:
    """Return how many cells are of one colour on the black side of an edge, and on the white."""
    left = right = 1
    while column - left >= 0 and line[column - left] == line[column]:
        left += 1
    while column + 1 + right < len(line) and line[column + 1 + right] == line[column + 1]:
        right += 1
    return (float(left), float(right)) if rising else (float(right), float(left))
