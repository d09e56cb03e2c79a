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
Rays of a distorting lens meeting plane surfaces.

A ray with direction (x, y, 1) meets a plane where homogeneous coordinates linear in (x, y) say, so
each surface costs three linear forms and one division per ray, and perspective is exact. On
arrays of rays only elementwise + - * / are used, on poses rounded before: the same bits result
on any IEEE-754 processor, whatever its vector instructions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, Transform
from flock_follower.simulation.camera.scene import Image, Surface, Texture

Window = tuple[slice, slice]  # rows, columns of an image

_NEAR = 0.05  # m: nothing nearer to the camera is seen
_WIDEST = 1.45  # rad off the axis: a ray (x, y, 1) further out than 83 degrees is taken for this


@dataclass(frozen=True)
class Camera:
    """
    The intrinsic calibration, as in ``sensor_msgs/CameraInfo``.

    Its distortion is inverted here, not taken from the perception that the images are to test.

    :raises ValueError: for an unknown model or a wrong number of coefficients.
    """

    width: int = 640
    height: int = 480
    focal_x: float = 611.3
    """px."""
    focal_y: float = 610.6
    centre_x: float = 322.4
    centre_y: float = 236.9
    model: str = 'plumb_bob'
    """'plumb_bob' (k1, k2, p1, p2, k3) or 'equidistant' (k1, k2, k3, k4)."""
    distortion: tuple[float, ...] = (-0.116, 0.087, 0.0007, -0.0005, 0.0)

    def __post_init__(self) -> None:
        count = {'plumb_bob': 5, 'equidistant': 4}.get(self.model)
        if count is None:
            raise ValueError(f'model = {self.model!r}: must be plumb_bob or equidistant')
        if len(self.distortion) != count:
            raise ValueError(f'distortion = {self.distortion}: {self.model} takes {count} values')

    def rays(self, u: Array, v: Array) -> tuple[Array, Array]:
        """
        Return the directions (x, y), z = 1, in the optical frame, that pixels (u, v) see.

        Pixels beyond a wide lens's image circle see what its rim does; vignetting darkens them.
        """
        xd, yd = (u - self.centre_x) / self.focal_x, (v - self.centre_y) / self.focal_y
        if self.model == 'equidistant':
            k1, k2, k3, k4 = self.distortion
            radius = np.maximum(np.sqrt(xd * xd + yd * yd), 1e-9)
            t2 = _WIDEST**2
            t = seen = np.minimum(
                radius, _WIDEST * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))
            for _ in range(20):  # Newton on t (1 + k1 t^2 + ...) = radius
                t2 = t * t
                error = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - seen
                t = t - error / (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4))))
            scale = np.tan(t).round(9) / radius
            return xd * scale, yd * scale
        if not any(self.distortion):
            return xd, yd
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xd, yd
        for _ in range(30):  # a fixed point: contracting for every lens without folds
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            x, y = ((xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
                    (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial)
        return x, y


class Rays:
    """The rays of all pixels of a camera."""

    def __init__(self, camera: Camera) -> None:
        u, v = np.meshgrid(np.arange(camera.width, dtype=float),
                           np.arange(camera.height, dtype=float))
        self.shape, self.focal = u.shape, camera.focal_x
        self.x, self.y = (m.astype(np.float32) for m in camera.rays(u, v))
        # How a ray changes over a pixel: true to 0.0001 px for all rays within the pixel.
        self._steps = []
        for du, dv in ((0.5, 0.0), (0.0, 0.5)):
            ahead, behind = camera.rays(u + du, v + dv), camera.rays(u - du, v - dv)
            self._steps.append([(a - b).astype(np.float32) for a, b in zip(ahead, behind)])
        # Least and greatest y in every row, x in every column: both increase, but for rounding
        # beyond an image circle, where they are constant.
        self._rows, self._columns = (
            (np.maximum.accumulate(m.min(axis=axis)), np.maximum.accumulate(m.max(axis=axis)))
            for m, axis in ((self.y, 1), (self.x, 0)))

    def within(self, window: Window, du: Image, dv: Image) -> tuple[Image, Image]:
        """
        Return directions (S, rows, columns) through places within a window's pixels.

        :param du: offsets from the pixels' centres, px, that broadcast to the result's shape.
        """
        (x_u, y_u), (x_v, y_v) = self._steps
        return (self.x[window] + du * x_u[window] + dv * x_v[window],
                self.y[window] + du * y_u[window] + dv * y_v[window])

    def windows(self, polygons: Array) -> NDArray[np.int64]:
        """
        Return where, (N, 4), the image shows polygons (N, k, 3) of the optical frame.

        Each is (first row, last row + 1, first column, last column + 1), empty if out of sight.
        """
        depth = polygons[..., 2]
        xy = polygons[..., :2] / np.maximum(depth, _NEAR)[..., None]
        low, high = xy.min(axis=1), xy.max(axis=1)
        for k in np.flatnonzero(depth.min(axis=1) < _NEAR):
            visible = _in_front(polygons[k])
            if len(visible):
                xy = visible[:, :2] / visible[:, 2:]
                low[k], high[k] = xy.min(axis=0), xy.max(axis=0)
            else:
                low[k], high[k] = np.inf, -np.inf
        # One pixel more on every side: rays pass beside the pixels' centres, too.
        spans = []
        for axis, (least, most) in ((1, self._rows), (0, self._columns)):
            spans.append(np.maximum(np.searchsorted(most, low[:, axis]) - 1, 0))
            spans.append(np.minimum(np.searchsorted(least, high[:, axis], 'right') + 1,
                                    len(least)))
        return np.stack(spans, axis=1)


class Sheet:
    """Surfaces as arrays, in the frame they move with."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = surfaces
        self._centres = np.array([s.pose.translation for s in surfaces]).reshape(-1, 3).round(9)
        self._axes = [np.array([s.pose.rotation[:, k] for s in surfaces]).reshape(-1, 3).round(9)
                      for k in range(3)]
        self._two_sided = np.array([s.two_sided for s in surfaces], dtype=bool)
        self._half = [np.array([getattr(s, name) for s in surfaces])[:, None]
                      for name in ('half_width', 'half_height')]

    def seen(self, rays: Rays, pose: Transform) -> list[Facet]:
        """Return what faces the camera and is in sight, farthest first; pose in the camera."""
        centres = turned(pose, self._centres) + pose.translation
        right, up, normal = (turned(pose, axis) for axis in self._axes)
        facing = dots(normal, centres)
        a, b = self._half[0] * right, self._half[1] * up
        corners = np.stack([centres - a + b, centres + a + b, centres + a - b, centres - a - b], 1)
        windows = rays.windows(corners)
        rows, columns = windows[:, 1] - windows[:, 0], windows[:, 3] - windows[:, 2]
        visible = (facing < -1e-6) | (self._two_sided & (facing > 1e-6))
        visible &= (rows > 0) & (columns > 0)
        farthest = dots(corners, corners).max(axis=1)
        towards = normal / np.where(visible, facing, np.inf)[:, None]
        forms = np.stack([towards, right, up], axis=1).astype(np.float32)
        left = dots(right, centres) - self._half[0][:, 0]
        top = dots(up, centres) + self._half[1][:, 0]
        return [Facet(k, tuple(windows[k]), forms[k], left[k], top[k], abs(facing[k]))
                for k in np.argsort(-farthest, kind='stable') if visible[k]]

    def normals(self, pose: Transform) -> Array:
        """Return the normal of each surface, (N, 3), in the frame the pose leads to."""
        return turned(pose, self._axes[2])


class Facet(NamedTuple):
    """A surface in sight."""

    surface: int
    """Its place in the sheet."""
    window: tuple[int, int, int, int]
    forms: Image
    """(3, 3): 1 / depth, and right and up times it, as forms of a ray's (x, y, 1)."""
    left: float
    """Coordinate along right of the left edge, seen from the camera, m."""
    top: float
    """Coordinate along up of the top edge, m."""
    height: float
    """Distance of the camera from the plane, m."""


class Canvas:
    """What a bundle of rays sees: value and cover (premultiplied), and 1 / depth of it."""

    def __init__(self, rays: Rays, window: Window, du: Image, dv: Image) -> None:
        self._focal, self._window = rays.focal, window
        self._x, self._y = rays.within(window, du, dv)
        self.value = np.zeros_like(self._x)
        self.cover = np.zeros_like(self._x)
        self.nearness = np.zeros_like(self._x)

    def paint(self, facet: Facet, surface: Surface, brightness: float) -> None:
        """Add a surface in front of what is there, and behind what is nearer."""
        top, bottom, left, right = facet.window
        row, column = self._window[0].start, self._window[1].start
        at = np.s_[:, top - row:bottom - row, left - column:right - column]
        x, y = self._x[at], self._y[at]
        a, b, c = facet.forms[:, :, None, None, None].transpose(1, 0, 2, 3, 4)
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


def turned(pose: Transform, vectors: Array) -> Array:
    """Return vectors (N, 3) turned by a pose, without BLAS, whose rounding varies."""
    return np.stack([dots(vectors, row) for row in pose.rotation], axis=1)


def dots(a: Array, b: Array) -> Array:
    """Return the scalar products (...,) of vectors (..., 3), without BLAS."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def rounded(pose: Transform) -> Transform:
    """Return the pose to nine decimals: last-bit differences between processors vanish."""
    return Transform(pose.rotation.round(9), pose.translation.round(9))


def _in_front(polygon: Array) -> Array:
    """Return the part of a polygon (k, 3) that lies beyond the near plane."""
    points = []
    for p, q in zip(polygon, np.roll(polygon, -1, axis=0)):
        if p[2] > _NEAR:
            points.append(p)
        if (p[2] > _NEAR) != (q[2] > _NEAR):
            points.append(p + (q - p) * ((_NEAR - p[2]) / (q[2] - p[2])))
    return np.array(points, dtype=float).reshape(-1, 3)
