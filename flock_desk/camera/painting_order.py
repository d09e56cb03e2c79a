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
The order in which polygons are painted so that nearer ones hide farther ones, from anywhere.

A binary space partition (Fuchs, Kedem and Naylor, "On visible surface generation by a priori tree
structures", SIGGRAPH 1980): each polygon's plane parts the others, and cuts those it crosses. What
is on the viewer's side of a plane is never hidden by what is on the other side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flock_desk.camera.lens import clipped, dots
from flock_follower.geometry import Array

_THIN = 1e-6  # m: what is nearer to a plane lies in it
_Piece = tuple[int, Array]  # the polygon that it is of, and its corners (k, 3)


class PaintingOrder:
    """
    Orders polygons.

    :param polygons: plane and convex, (k, 3) each.
    :param uncut: one that stays whole, if any.
    """

    def __init__(self, polygons: Sequence[Array], uncut: int | None = None) -> None:
        self.pieces: list[_Piece] = []
        """What is to be painted."""
        self._normals: list[Array] = []
        self._heights: list[float] = []
        self._nodes: list[tuple[list[int], int, int]] = []  # pieces in the plane, front, back
        self._root = self._part(list(enumerate(polygons)), uncut)
        self._planes = np.array(self._normals).reshape(-1, 3), np.array(self._heights)

    def order(self, eye: Array) -> list[int]:
        """Return the indices of all pieces, farthest first, seen from a place (3,)."""
        ahead = (dots(self._planes[0], eye) > self._planes[1]).tolist()
        found: list[int] = []
        waiting: list[tuple[int, bool]] = [(self._root, False)]
        while waiting:
            node, beyond_is_done = waiting.pop()
            if node < 0:
                continue
            pieces, front, back = self._nodes[node]
            if beyond_is_done:
                found += pieces
                continue
            near, far = (front, back) if ahead[node] else (back, front)
            waiting += [(near, False), (node, True), (far, False)]
        return found

    def _part(self, pieces: list[_Piece], first: int | None) -> int:
        """Make a node of pieces, parted by the plane of one, and return its index; -1 for none."""
        if not pieces:
            return -1
        normals = np.array([_normal(corners) for _, corners in pieces])
        offsets = dots(normals, np.array([corners[0] for _, corners in pieces]))
        if first is None:
            first = _least_cutting(normals, offsets, [corners for _, corners in pieces])
        node, inside = len(self._nodes), []
        self._nodes.append(([], -1, -1))
        self._normals.append(normals[first])
        self._heights.append(float(offsets[first]))
        front: list[_Piece] = []
        back: list[_Piece] = []
        for polygon, corners in pieces:
            height = dots(corners, normals[first]) - offsets[first]
            if np.abs(height).max() < _THIN:
                inside.append(len(self.pieces))
                self.pieces.append((polygon, corners))
                continue
            crosses = height.max() > _THIN and height.min() < -_THIN
            if height.max() > _THIN:
                front.append((polygon, clipped(corners, height) if crosses else corners))
            if height.min() < -_THIN:
                back.append((polygon, clipped(corners, -height) if crosses else corners))
        self._nodes[node] = inside, self._part(front, None), self._part(back, None)
        return node


def _normal(corners: Array) -> Array:
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    return normal / np.sqrt(dots(normal, normal))


def _least_cutting(normals: Array, offsets: Array, polygons: list[Array]) -> int:
    """Return the polygon whose plane crosses the fewest others."""
    points = np.concatenate(polygons)
    starts = np.cumsum([0] + [len(polygon) for polygon in polygons[:-1]])
    heights = dots(normals[:, None], points[None]) - offsets[:, None]
    crossed = ((np.maximum.reduceat(heights, starts, axis=1) > _THIN)
               & (np.minimum.reduceat(heights, starts, axis=1) < -_THIN))
    return int(np.argmin(crossed.sum(axis=1)))
