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
The leader in an image: polygons, and its printed marker between them.

It is seen at several moments of the exposure; their mean is its motion blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from flock_desk.camera.lens import (
    dots,
    in_front,
    NEAR,
    Rays,
    rounded,
    turned,
    Window,
)
from flock_desk.camera.painting_order import PaintingOrder
from flock_desk.camera.printed_surface import PrintedSurface
from flock_desk.camera.scene import Image, Scenery, Surface
from flock_follower.geometry import Array, Transform

_SHIFT = 4  # bits behind the point in the corners of polygons
_MARGIN = 2  # px around the leader
_STRAIGHT = 0.06  # m: longer lines may look bent
_ROUND = 24  # corners of a disc


class Patch(NamedTuple):
    """The part of an image that shows the leader."""

    window: Window
    value: Image
    """(rows, columns): its light, multiplied by its cover."""
    cover: Image
    """(rows, columns): the share of each pixel that it covers."""


class _View(NamedTuple):
    """Parts that face the camera, farthest first."""

    parts: list[int]
    pixels: Array
    """(n, 2), the outlines of one after the other in the image."""
    ends: list[int]
    """Where in ``pixels`` each ends."""

    def some(self, first: int, last: int) -> _View:
        """Return a slice of the parts."""
        begin = self.ends[first - 1] if first else 0
        ends = self.ends[first:last]
        return _View(self.parts[first:last], self.pixels[begin:max(ends, default=begin)],
                     [end - begin for end in ends])


class LeaderDrawing:
    """
    Draws a leader.

    Surfaces of one value become polygons, half a sample wider on every side than they are, and
    those with opacities discs of their mean; of others, which are printed, there may be one.

    :param surfaces: in the body frame.
    :param fineness: its square is the number of samples per pixel and moment.
    :raises ValueError: for more than one printed surface.
    """

    def __init__(self, rays: Rays, scenery: Scenery, surfaces: Sequence[Surface],
                 fineness: int) -> None:
        self._rays, self._scenery, self._fineness = rays, scenery, fineness
        printed = [k for k, s in enumerate(surfaces)
                   if s.texture.opacities is None and len(s.texture.values) > 1]
        if len(printed) > 1:
            raise ValueError(f'surfaces = {len(printed)} printed ones: must be at most 1')
        self._order = PaintingOrder([_outline(s) for s in surfaces], *printed)
        # From here on a part is a piece of a surface; the printed one is whole.
        pieces = self._order.pieces
        self._surfaces = [surfaces[k] for k, _ in pieces]
        self._outlines = [_finer(corners) for _, corners in pieces]
        self._values = np.array([_mean(s, s.texture.values) for s in self._surfaces])
        self._opacities = [_opacity(s) for s in self._surfaces]
        self._centres = np.array([s.pose.translation for s in self._surfaces]).reshape(-1, 3)
        self._normals = np.array([s.pose.rotation[:, 2] for s in self._surfaces]).reshape(-1, 3)
        self._two_sided = np.array([s.two_sided for s in self._surfaces], dtype=bool)
        self._printed = next((k for k, (s, _) in enumerate(pieces) if s in printed), -1)
        self._print = PrintedSurface(rays, surfaces[printed[0]]) if printed else None

    def seen(self, cameras: Sequence[Transform], leaders: Sequence[Transform]) -> Patch | None:
        """Return the leader as cameras at these poses see it, on average; None out of sight."""
        if not self._surfaces:
            return None
        poses = [rounded(camera.inverse() @ leader) for camera, leader in zip(cameras, leaders)]
        views = [self._view(pose) for pose in poses]
        window = self._window(np.concatenate([view.pixels for view in views]))
        if window is None:
            return None
        total = np.zeros((*_shape(window), 2), np.float32)
        for pose, leader, view in zip(poses, leaders, views):
            total += self._moment(window, pose, leader, view)
        total *= np.float32(1.0 / len(poses))
        return Patch(window, total[..., 0], total[..., 1])

    def _view(self, pose: Transform) -> _View:
        facing = dots(turned(pose, self._normals), turned(pose, self._centres) + pose.translation)
        shown = (self._two_sided | (facing < 0.0)).tolist()
        parts = [k for k in self._order.order(pose.inverse().translation) if shown[k]]
        outlines = [self._outlines[k] for k in parts] or [np.zeros((0, 3))]
        points = turned(pose, np.concatenate(outlines)) + pose.translation
        ends = np.cumsum([len(outline) for outline in outlines]).tolist()
        if len(points) and points[:, 2].min() < NEAR:
            cut = [in_front(points[i:j]) for i, j in zip([0, *ends[:-1]], ends)]
            parts = [k for k, outline in zip(parts, cut) if len(outline)]
            points = np.concatenate(cut)
            ends = np.cumsum([len(outline) for outline in cut if len(outline)]).tolist()
        return _View(parts, self._rays.camera.project(points), ends)

    def _window(self, pixels: Array) -> Window | None:
        """Return the part of the image that holds pixels (n, 2), or None."""
        if not len(pixels):
            return None
        height, width = self._rays.shape
        left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - _MARGIN, 0).tolist()
        right, bottom = (np.ceil(pixels.max(axis=0)).astype(int) + 1 + _MARGIN).tolist()
        right, bottom = min(right, width), min(bottom, height)
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None

    def _moment(self, window: Window, pose: Transform, leader: Transform,
                view: _View) -> Image:
        """Return light and cover (rows, columns, 2) at one moment."""
        light = self._scenery.brightness(turned(leader, self._normals))
        values = (light * self._values).tolist()
        canvas = np.zeros((*_shape(window), 2), np.float32)
        if self._print is None or self._printed not in view.parts:
            self._draw(canvas, window, view, values)
            return canvas
        i = view.parts.index(self._printed)
        # All that cannot hide part of the printed one is drawn together, before: it is faster.
        starts = [0, *view.ends[:-1]]
        low, high = (f.reduceat(view.pixels, starts) for f in (np.minimum, np.maximum))
        hides = np.all((high > low[i]) & (low < high[i]), axis=1)
        hides[:i + 1] = False
        j = int(np.argmax(hides)) if hides.any() else len(hides)
        self._draw(canvas, window, view.some(0, j), values)
        printed = self._print.seen(pose, window, max(self._fineness // 2, 1))
        if printed is not None:
            inner, (value, cover) = printed
            _cover(canvas[_within(inner, window)], value * np.float32(light[self._printed]), cover)
        self._draw(canvas, window, view.some(j, len(hides)), values)
        return canvas

    def _draw(self, canvas: Image, window: Window, view: _View, values: list[float]) -> None:
        """Put plain surfaces in front; the printed one is left out."""
        inner = self._window(view.pixels)
        if inner is None:
            return
        n = self._fineness
        rows, columns = _shape(inner)
        fine = np.zeros((n * rows, n * columns, 2), np.float32)
        # Samples' centres lie half a sample from the edge of their pixel.
        origin = np.array([inner[1].start, inner[0].start]) - 0.5
        points = np.rint(((view.pixels - origin) * n - 0.5) * 2 ** _SHIFT).astype(np.int32)
        for k, i, j in zip(view.parts, [0, *view.ends[:-1]], view.ends):
            if k == self._printed:
                continue
            if self._opacities[k] == 1.0:
                cv2.fillConvexPoly(fine, points[i:j], (values[k], 1.0), shift=_SHIFT)
            else:
                _shade(fine, points[i:j], values[k], self._opacities[k])
        # Sums one by one: the order of a library's may vary. Both values go as one number.
        lines = sum(fine[k::n] for k in range(1, n)) + fine[::n]
        pairs = lines.view(np.complex64)[..., 0]
        drawn = (sum(pairs[:, k::n] for k in range(1, n)) + pairs[:, ::n])[..., None].view(
            np.float32) * np.float32(1.0 / (n * n))
        _cover(canvas[_within(inner, window)], drawn[..., 0], drawn[..., 1])


def _outline(surface: Surface) -> Array:
    """Return the corners (k, 3), m, in the body frame; of a translucent one those of a disc."""
    w, h = surface.half_width, surface.half_height
    x, y = np.array([-1.0, 1.0, 1.0, -1.0]), np.array([1.0, 1.0, -1.0, -1.0])
    if surface.texture.opacities is not None:
        angle = np.arange(_ROUND) * 2 * np.pi / _ROUND
        x, y = np.cos(angle), np.sin(angle)
    return surface.pose.apply(np.stack([w * x, h * y, 0.0 * x], axis=1))


def _mean(surface: Surface, values: Image) -> float:
    rows, columns = surface.texture.shape
    return float(values[:rows * columns].mean())


def _opacity(surface: Surface) -> float:
    """Return the opacity of a disc that is all that its texture shows."""
    opacities = surface.texture.opacities
    return 1.0 if opacities is None else _mean(surface, opacities) * 4.0 / np.pi


def _finer(outline: Array) -> Array:
    """Return an outline (k, 3) whose sides are short enough to look straight through a lens."""
    corners = []
    for a, b in zip(outline, np.roll(outline, -1, axis=0)):
        side = b - a
        count = max(int(np.sqrt(dots(side, side)) / _STRAIGHT), 1)
        corners.append(a + (np.arange(count) / count)[:, None] * side)
    return np.concatenate(corners)


def _shade(canvas: Image, points: Array, value: float, opacity: float) -> None:
    """Draw a translucent polygon on light and cover."""
    low = np.maximum((points.min(axis=0) >> _SHIFT) - 1, 0)
    high = np.minimum((points.max(axis=0) >> _SHIFT) + 2, canvas.shape[1::-1])
    if np.any(low >= high):
        return
    part = canvas[low[1]:high[1], low[0]:high[0]]
    painted = part.copy()
    cv2.fillConvexPoly(painted, points - (low << _SHIFT).astype(np.int32), (value, 1.0),
                       shift=_SHIFT)
    painted -= part
    painted *= np.float32(opacity)
    part += painted


def _cover(canvas: Image, value: Image, cover: Image) -> None:
    """Put light and cover (rows, columns) in front of both on a canvas (rows, columns, 2)."""
    clear = 1 - cover
    for k, front in enumerate((value, cover)):
        canvas[..., k] *= clear
        canvas[..., k] += front


def _shape(window: Window) -> tuple[int, int]:
    return window[0].stop - window[0].start, window[1].stop - window[1].start


def _within(inner: Window, window: Window) -> Window:
    """Return a window's place in another that holds it."""
    return (slice(inner[0].start - window[0].start, inner[0].stop - window[0].start),
            slice(inner[1].start - window[1].start, inner[1].stop - window[1].start))
