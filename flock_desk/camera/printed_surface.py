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
A printed surface in an image: a few rays per pixel, cast through the lens.

Between the cells of a print all changes at their borders. Where a ray falls on one, it is taken to
see as much of both sides as a pixel's share of that ray covers: that is exact for borders along
rows and columns, and what many more rays would show for others within a few percent.
"""

from __future__ import annotations

import numpy as np

from flock_desk.camera.lens import dots, Rays, rounded, Window
from flock_desk.camera.scene import Image, Surface, Texture
from flock_follower.geometry import Transform


class PrintedSurface:
    """A surface of which each sample of the texture is a cell of one value, such as a marker."""

    def __init__(self, rays: Rays, surface: Surface) -> None:
        self._rays, self._surface = rays, surface
        self._cells = _cells(surface.texture)

    def seen(self, pose: Transform, window: Window, n: int) -> tuple[Window, Image] | None:
        """
        Return where it is seen in a window, and light times cover and cover (2, rows, columns).

        :param pose: of the body in the optical frame.
        :param n: rays per pixel, in either direction.
        :return: None where it is out of sight; light is that of a brightness of 1.
        """
        surface, place = self._surface, rounded(pose @ self._surface.pose)
        centre = place.translation
        right, up, normal = (place.rotation[:, k] for k in range(3))
        facing = float(dots(normal, centre))
        a, b = surface.half_width * right, surface.half_height * up
        corners = np.stack([centre - a + b, centre + a + b, centre + a - b, centre - a - b])
        inner = _common(window, self._rays.windows(corners[None])[0].tolist())
        if facing > -1e-6 or inner is None:
            return None
        rows, columns = surface.texture.shape
        scale = columns / (2 * surface.half_width), -rows / (2 * surface.half_height)
        # From the middle of the first cell of the ring, in cells.
        start = (np.float32(0.5 - scale[0] * (dots(right, centre) - surface.half_width)),
                 np.float32(0.5 - scale[1] * (dots(up, centre) + surface.half_height)))
        # 1 / depth, and column and row times it, are linear in a ray's (x, y), and in the offset
        # of a ray from its pixel's centre.
        forms = [form.astype(np.float32)
                 for form in (normal / facing, scale[0] * right, scale[1] * up)]
        (x_u, y_u), (x_v, y_v) = ([m[inner] for m in step] for step in self._rays.steps)
        x, y = self._rays.x[inner], self._rays.y[inner]
        here = [f[0] * x + (f[1] * y + f[2]) for f in forms]
        along_u = [f[0] * x_u + f[1] * y_u for f in forms]
        along_v = [f[0] * x_v + f[1] * y_v for f in forms]
        middle = x.shape[0] // 2, x.shape[1] // 2
        total = np.zeros((*x.shape, 2), np.float32)
        for k in range(n * n):
            du, dv = (np.float32((m + 0.5) / n - 0.5) for m in divmod(k, n))
            nearness, *places = (at + (du * u + dv * v)
                                 for at, u, v in zip(here, along_u, along_v))
            depth = 1 / np.maximum(nearness, np.float32(1e-3))
            index, shares = np.zeros(x.shape, np.int32), []
            for axis, count in ((0, columns), (1, rows)):
                ratio = places[axis] * depth
                cell = np.minimum(np.maximum(ratio + start[axis], 0), np.float32(count + 0.999))
                first = cell.astype(np.int32)
                # Between the middles of two cells all change is at their border, over as many
                # pixels as are between the rays.
                change = sum(abs(along[axis + 1][middle] - ratio[middle] * along[0][middle])
                             for along in (along_u, along_v)) * depth[middle]
                steep = max(n / max(change, np.float32(1e-6)), np.float32(1.0))
                shares.append(np.minimum(np.maximum(
                    (cell - first) * steep + (0.5 - 0.5 * steep), 0), 1)[..., None])
                index += first * (1 if axis == 0 else columns + 2)
            corner, across, down, both = np.moveaxis(self._cells[index], -2, 0)
            total += corner + shares[0] * across + shares[1] * (down + shares[0] * both)
        total *= np.float32(1.0 / (n * n))
        return inner, np.moveaxis(total, 2, 0)


def _cells(texture: Texture) -> Image:
    """
    Return what is between the middles of four cells each, a ring of nothing around all of them.

    Value and cover are v[0] + x v[1] + y v[2] + x y v[3], x and y in [0, 1] from the first cell
    on: ((rows + 2) * (columns + 2), 4, 2).
    """
    cells = texture.values[:texture.shape[0] * texture.shape[1]].reshape(texture.shape)
    known = np.pad(np.stack([cells, np.ones_like(cells)], axis=2), ((1, 2), (1, 2), (0, 0)))
    a, b, c, d = known[:-1, :-1], known[:-1, 1:], known[1:, :-1], known[1:, 1:]
    return np.stack([a, b - a, c - a, d - c - b + a], axis=2).reshape(-1, 4, 2)


def _common(window: Window, bounds: list[int]) -> Window | None:
    """Return the part of a window within first and last + 1 row and column, or None."""
    top, bottom = max(bounds[0], window[0].start), min(bounds[1], window[0].stop)
    left, right = max(bounds[2], window[1].start), min(bounds[3], window[1].stop)
    return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None
