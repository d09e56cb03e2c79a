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

"""The camera's lens: the ray of each pixel, and the pixel of each point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flock_follower.geometry import Array

_WIDEST = 1.45  # rad off the axis: the rim of the image circle, 83 degrees


@dataclass(frozen=True)
class Camera:
    """
    The intrinsic calibration, as in ``sensor_msgs/CameraInfo``.

    Distortion is computed here, not by the perception that the images are to test.
    """

    width: int = 640
    height: int = 480
    focal_x: float = 611.3
    """px."""
    focal_y: float = 610.6
    center_x: float = 322.4
    center_y: float = 236.9
    model: str = 'plumb_bob'
    """'plumb_bob' (k1, k2, p1, p2, k3) or 'equidistant' (k1, k2, k3, k4)."""
    distortion: tuple[float, ...] = (-0.116, 0.087, 0.0007, -0.0005, 0.0)

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the distorted directions (x, y, 1), before focal lengths and center."""
        r2 = x * x + y * y
        if self.model == 'equidistant':
            radius = np.maximum(np.sqrt(r2), 1e-9)
            scale = self._bent(np.arctan(radius)) / radius
            return x * scale, y * scale
        k1, k2, p1, p2, k3 = self.distortion
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)

    def _bent(self, angle: Array) -> Array:
        """Return the distance from the middle, equidistant model, of an angle off the axis."""
        t2, (k1, k2, k3, k4) = angle * angle, self.distortion
        return angle * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def rays(self, u: Array, v: Array) -> tuple[Array, Array]:
        """
        Return the directions (x, y), z = 1, in the optical frame, that pixels (u, v) see.

        Pixels outside the image circle of a wide lens get the ray of its rim; vignetting darkens
        them.
        """
        xd, yd = (u - self.center_x) / self.focal_x, (v - self.center_y) / self.focal_y
        if self.model == 'equidistant':
            radius = np.maximum(np.hypot(xd, yd), 1e-9)
            angles = np.linspace(0.0, _WIDEST, 10_000)
            angle = np.interp(radius, self._bent(angles), angles)
            return xd * np.tan(angle) / radius, yd * np.tan(angle) / radius
        rays: tuple[Array, Array] = xd, yd
        for _ in range(30):  # a fixed point: contracting for every lens without folds
            seen = self._distort(*rays)
            rays = rays[0] + xd - seen[0], rays[1] + yd - seen[1]
        return rays

    def project(self, points: Array) -> Array:
        """
        Return the pixels (n, 2) that see points (n, 3) of the optical frame ahead of it.

        A point farther off the axis than every pixel appears just outside of the image.
        """
        aside = points[:, :2] / points[:, 2:]
        radius = np.maximum(np.hypot(aside[:, 0], aside[:, 1]), 1e-9)
        x, y = self._distort(*(aside.T * np.minimum(1.0, self._reach / radius)))
        return np.stack([self.focal_x * x + self.center_x, self.focal_y * y + self.center_y], 1)

    @cached_property
    def _reach(self) -> float:
        """Return the tangent of an angle off the axis slightly beyond that of all pixels."""
        u, v = (np.array([-0.5, size / 2, size - 0.5]) for size in (self.width, self.height))
        return float(1.1 * np.hypot(*self.rays(*np.meshgrid(u, v))).max())
