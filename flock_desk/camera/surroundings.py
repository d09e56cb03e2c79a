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
The surroundings, cast ray by ray: exact perspective, occlusion and haze.

A ray with direction (x, y, 1) meets a plane where homogeneous coordinates linear in (x, y) say, so
each surface costs three linear forms and one division per ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flock_desk.camera.lens import dots, Rays, rounded, shuffled, turned
from flock_desk.camera.scene import Image, Scenery, Surface, Texture
from flock_follower.geometry import Transform


class Surroundings:
    """Casts rays at everything that stands still, for every image anew."""

    def __init__(self, rays: Rays, scenery: Scenery) -> None:
        self._rays, self._scenery = rays, scenery
        surfaces = scenery.surfaces
        self._centres = np.array([s.pose.translation for s in surfaces]).reshape(-1, 3).round(9)
        self._axes = [np.array([s.pose.rotation[:, k] for s in surfaces]).reshape(-1, 3).round(9)
                      for k in range(3)]
        self._two_sided = np.array([s.two_sided for s in surfaces], dtype=bool)
        self._half = [np.array([getattr(s, name) for s in surfaces])[:, None]
                      for name in ('half_width', 'half_height')]
        self._light = scenery.brightness(self._axes[2])

    def seen(self, cameras: Sequence[Transform]) -> Image:
        """Return their light (height, width): the mean over poses of the optical frame."""
        total = np.zeros(self._rays.shape, dtype=np.float32)
        for k, camera in enumerate(cameras):
            total += self._once(rounded(camera), *self._jitter(k, len(cameras)))
        total *= np.float32(1.0 / len(cameras))
        return total

    def _jitter(self, k: int, count: int) -> tuple[Image, Image]:
        """
        Return where in each pixel (height, width) the one ray of sub-pose k passes.

        In every pixel the rays of all sub-poses are spread evenly, in another order than in its
        neighbours: else a place in the pixel would go with a time, and blur be too long or short.
        """
        rows, columns = np.ogrid[:self._rays.shape[0], :self._rays.shape[1]]
        order = (k + columns + 2 * rows) % count
        across, down = (np.arange(count) + 0.5) / count, shuffled(count)
        du, dv = ((m - 0.5).astype(np.float32)[order] for m in (across, down))
        return du, dv

    def _once(self, camera: Transform, du: Image, dv: Image) -> Image:
        canvas = _Canvas(self._rays, du, dv)
        for facet in self._facets(rounded(camera.inverse())):
            canvas.paint(facet, self._scenery.surfaces[facet.surface], self._light[facet.surface])
        air = np.float32(self._scenery.haze)
        value = canvas.value + (1 - canvas.cover) * air
        clear = 1 - 1 / (1 + canvas.nearness * np.float32(self._scenery.visibility))
        return np.asarray(air + (value - air) * clear, dtype=np.float32)

    def _facets(self, pose: Transform) -> list[_Facet]:
        """Return what faces the camera and is in sight, farthest first; pose in the camera."""
        centres = turned(pose, self._centres) + pose.translation
        right, up, normal = (turned(pose, axis) for axis in self._axes)
        facing = dots(normal, centres)
        a, b = self._half[0] * right, self._half[1] * up
        corners = np.stack([centres - a + b, centres + a + b, centres + a - b, centres - a - b], 1)
        windows = self._rays.windows(corners)
        rows, columns = windows[:, 1] - windows[:, 0], windows[:, 3] - windows[:, 2]
        visible = (facing < -1e-6) | (self._two_sided & (facing > 1e-6))
        visible &= (rows > 0) & (columns > 0)
        farthest = dots(corners, corners).max(axis=1)
        towards = normal / np.where(visible, facing, np.inf)[:, None]
        forms = np.stack([towards, right, up], axis=1).astype(np.float32)
        left = dots(right, centres) - self._half[0][:, 0]
        top = dots(up, centres) + self._half[1][:, 0]
        return [_Facet(k, tuple(windows[k]), forms[k], left[k], top[k], abs(facing[k]))
                for k in np.argsort(-farthest, kind='stable') if visible[k]]


class _Facet(NamedTuple):
    """A surface in sight."""

    surface: int
    """Its place in the scenery."""
    window: tuple[int, int, int, int]
    forms: Image
    """(3, 3): 1 / depth, and right and up times it, as forms of a ray's (x, y, 1)."""
    left: float
    """Coordinate along right of the left edge, seen from the camera, m."""
    top: float
    """Coordinate along up of the top edge, m."""
    height: float
    """Distance of the camera from the plane, m."""


class _Canvas:
    """What a ray through each pixel sees: value and cover (premultiplied), 1 / depth of it."""

    def __init__(self, rays: Rays, du: Image, dv: Image) -> None:
        self._focal = rays.camera.focal_x
        self._x, self._y = rays.within(np.s_[:, :], du, dv)
        self.value: Image = np.zeros_like(self._x)
        self.cover: Image = np.zeros_like(self._x)
        self.nearness: Image = np.zeros_like(self._x)

    def paint(self, facet: _Facet, surface: Surface, brightness: float) -> None:
        """Add a surface in front of what is there, and behind what is nearer."""
        top, bottom, left, right = facet.window
        at = np.s_[top:bottom, left:right]
        x, y = self._x[at], self._y[at]
        a, b, c = facet.forms.T
        nearness = a[0] * x + (b[0] * y + c[0])
        with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
            depth = 1 / nearness
            across = (a[1] * x + (b[1] * y + c[1])) * depth - np.float32(facet.left)
            down = np.float32(facet.top) - (a[2] * x + (b[2] * y + c[2])) * depth
            hit = ((across >= 0) & (across < np.float32(2 * surface.half_width))
                   & (down >= 0) & (down < np.float32(2 * surface.half_height))
                   & (nearness > self.nearness[at]))
            if not hit.any():
                return
            near = nearness[hit]
            value, opacity = self._look_up(surface.texture, across[hit], down[hit], near,
                                           facet.height)
        value = value * np.float32(brightness)
        if opacity is None:
            self.value[at][hit] = value
            self.cover[at][hit] = 1
            self.nearness[at][hit] = near
        else:
            behind, covered = self.value[at][hit], self.cover[at][hit]
            self.value[at][hit] = behind + opacity * (value - behind)
            self.cover[at][hit] = covered + opacity * (1 - covered)
            self.nearness[at][hit] = np.where(opacity > 0.5, near, self.nearness[at][hit])

    def _look_up(self, texture: Texture, across: Image, down: Image, nearness: Image,
                 height: float) -> tuple[Image, Image | None]:
        """
        Return value and opacity at places on a surface, m from its left and its top.

        The level is the one whose samples are as large as a pixel's footprint on the surface:
        the geometric mean of its sides, (depth / focal) sqrt(depth / height).
        """
        if len(texture.values) == 1:
            return texture.values, None
        scale = np.float32(1.0 / texture.texel)
        columns, rows = (across * scale).astype(np.int32), (down * scale).astype(np.int32)
        height_px, width_px = texture.shape
        if len(texture.starts) == 1:
            index = (rows & (height_px - 1)) * width_px + (columns & (width_px - 1))
        else:
            # A float's bits, read as an integer, are its logarithm to base 2 within 0.09.
            finest = 1.0 / (self._focal * height**0.5 * texture.texel) ** (2.0 / 3.0)
            base = int(np.float32(round(finest, 9)).view(np.int32)) // 4
            level = (3 * (base - (nearness.view(np.int32) >> 2)) + 2**21) >> 22
            level = np.minimum(np.maximum(level, 0), len(texture.starts) - 1)
            index = (((rows >> level) & ((height_px >> level) - 1)) * (width_px >> level)
                     + ((columns >> level) & ((width_px >> level) - 1)) + texture.starts[level])
        return texture.values[index], (
            None if texture.opacities is None else texture.opacities[index])
