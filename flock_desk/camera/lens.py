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
The camera's lens: which ray each pixel sees, and which pixel sees a point.

Distortion is computed here, not by the perception that the images are to test. On arrays of rays
only elementwise + - * / are used, on poses rounded before: the same bits result on any IEEE-754
processor, whatever its vector instructions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flock_desk.camera.scene import Image
from flock_follower.geometry import Array, Transform

Window = tuple[slice, slice]  # rows, columns of an image

NEAR = 0.05  # m: nothing nearer to the camera is seen
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

    def project(self, points: Array) -> Array:
        """
        Return the pixels (N, 2) that see points (N, 3) of the optical frame ahead of it.

        What is further off the axis than any pixel of the image appears just outside of it.
        """
        x, y = (points[:, k] / points[:, 2] for k in (0, 1))
        radius = np.maximum(np.sqrt(x * x + y * y), 1e-9)
        scale = np.minimum(1.0, self._reach / radius)
        x, y, radius = x * scale, y * scale, radius * scale
        r2 = radius * radius
        if self.model == 'equidistant':
            k1, k2, k3, k4 = self.distortion
            t = np.arctan(radius)
            t2 = t * t
            bent = t * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / radius
            x, y = x * bent, y * bent
        else:
            k1, k2, p1, p2, k3 = self.distortion
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            x, y = (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                    y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
        return np.stack([self.focal_x * x + self.centre_x, self.focal_y * y + self.centre_y], 1)

    @cached_property
    def _reach(self) -> float:
        """Return a tangent of the angle off the axis a little beyond all pixels'."""
        u, v = (np.array([-0.5, size / 2, size - 0.5]) for size in (self.width, self.height))
        x, y = self.rays(*np.meshgrid(u, v))
        return float(1.1 * np.sqrt(x * x + y * y).max())


class Rays:
    """The rays of all pixels of a camera."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        u, v = np.meshgrid(np.arange(camera.width, dtype=float),
                           np.arange(camera.height, dtype=float))
        self.shape = u.shape
        self.x, self.y = (m.astype(np.float32) for m in camera.rays(u, v))
        # How a ray changes over a pixel: true to 0.0001 px for all rays within the pixel.
        self.steps = []
        """By one pixel to the right and by one down: (x, y) each."""
        for du, dv in ((0.5, 0.0), (0.0, 0.5)):
            ahead, behind = camera.rays(u + du, v + dv), camera.rays(u - du, v - dv)
            self.steps.append([(a - b).astype(np.float32) for a, b in zip(ahead, behind)])
        # Least and greatest y in every row, x in every column: both increase, but for rounding
        # beyond an image circle, where they are constant.
        self._rows, self._columns = (
            (np.maximum.accumulate(m.min(axis=axis)), np.maximum.accumulate(m.max(axis=axis)))
            for m, axis in ((self.y, 1), (self.x, 0)))

    def within(self, window: Window, du: Image, dv: Image) -> tuple[Image, Image]:
        """
        Return directions through places within a window's pixels.

        :param du: offsets from the pixels' centres, px, (rows, columns); ``dv`` likewise.
        """
        (x_u, y_u), (x_v, y_v) = self.steps
        return (self.x[window] + du * x_u[window] + dv * x_v[window],
                self.y[window] + du * y_u[window] + dv * y_v[window])

    def windows(self, polygons: Array) -> NDArray[np.int64]:
        """
        Return where, (N, 4), the image shows polygons (N, k, 3) of the optical frame.

        Each is (first row, last row + 1, first column, last column + 1), empty if out of sight.
        """
        depth = polygons[..., 2]
        xy = polygons[..., :2] / np.maximum(depth, NEAR)[..., None]
        low, high = xy.min(axis=1), xy.max(axis=1)
        for k in np.flatnonzero(depth.min(axis=1) < NEAR):
            visible = in_front(polygons[k])
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


def turned(pose: Transform, vectors: Array) -> Array:
    """Return vectors (N, 3) turned by a pose, without BLAS, whose rounding varies."""
    return np.stack([dots(vectors, row) for row in pose.rotation], axis=1)


def dots(a: Array, b: Array) -> Array:
    """Return the scalar products (...,) of vectors (..., 3), without BLAS."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def rounded(pose: Transform) -> Transform:
    """Return the pose to nine decimals: last-bit differences between processors vanish."""
    return Transform(pose.rotation.round(9), pose.translation.round(9))


def shuffled(count: int) -> Array:
    """Return the middles of so many equal parts of [0, 1], in an order far from their own."""
    ranks = np.argsort(np.argsort((np.arange(1, count + 1) * 0.618) % 1.0))
    return (ranks + 0.5) / count


def in_front(polygon: Array) -> Array:
    """Return the part of a polygon (k, 3) that lies beyond the near plane."""
    return clipped(polygon, polygon[:, 2] - NEAR)


def clipped(polygon: Array, heights: Array) -> Array:
    """Return the part of a polygon (k, 3) above a plane, given its corners' heights (k,)."""
    points = []
    for p, q, a, b in zip(polygon, np.roll(polygon, -1, axis=0), heights, np.roll(heights, -1)):
        if a > 0.0:
            points.append(p)
        if (a > 0.0) != (b > 0.0):
            points.append(p + (q - p) * (a / (a - b)))
    return np.array(points, dtype=float).reshape(-1, 3)
