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
The leader in a live camera: plain polygons, and a printed marker sampled ray by ray.

It is seen at several moments of the exposure; their mean is its motion blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.simulation.camera.raycast import Camera, Rays, Window
from flock_follower.simulation.camera.scene import Image, Scenery, Surface

_SCALE = 2  # rows and columns of samples in a pixel in which the body is drawn
_SHIFT = 4  # bits behind the point in its corners
_TEXELS = 32  # of the marker's texture in one of its cells: an edge is one texel wide
_MARGIN = 2  # px around the leader
#: Columns and rows within a pixel of the rays to the marker: 8 in 8 of each.
_ROOKS = np.array([[(3 * k + 1) % 8 for k in range(8)], range(8)])


class Patch(NamedTuple):
    """The part of an image that shows the leader."""

    window: Window
    value: Image
    """(rows, columns): its light, multiplied by its cover."""
    cover: Image
    """(rows, columns): the share of each pixel that it covers."""


class _Plain(NamedTuple):
    """A surface of one value."""

    outline: Array
    """(k, 3), m, in the body frame."""
    value: float
    opacity: float


class LiveLeader:
    """
    Draws a leader.

    Opaque surfaces of one value become polygons, translucent ones discs of their mean; of the
    others, which are printed, there may be one. That is drawn last: nothing hides it.

    :param surfaces: in the body frame.
    :raises ValueError: for more than one printed surface.
    """

    def __init__(self, camera: Camera, rays: Rays, world: Scenery,
                 surfaces: Sequence[Surface]) -> None:
        self._rays, self._world = rays, world
        matrix = np.array([[camera.focal_x, 0.0, camera.centre_x],
                           [0.0, camera.focal_y, camera.centre_y], [0.0, 0.0, 1.0]])
        self._lens = CameraModel(matrix, np.array(camera.distortion), camera.model,
                                 camera.width, camera.height)
        printed = [s for s in surfaces
                   if s.texture.opacities is None and len(s.texture.values) > 1]
        if len(printed) > 1:
            raise ValueError(f'surfaces = {len(printed)} printed ones: must be at most 1')
        self._marker = printed[0] if printed else None
        self._texture = _texture(printed[0]) if printed else None
        plain = [s for s in surfaces if s is not self._marker]
        self._plain = [_simplified(s) for s in plain]
        self._centres = np.array([s.pose.translation for s in plain]).reshape(-1, 3)
        self._normals = np.array([s.pose.rotation[:, 2] for s in plain]).reshape(-1, 3)
        self._two_sided = np.array([s.two_sided for s in plain], dtype=bool)

    def seen(self, cameras: Sequence[Transform], leaders: Sequence[Transform]) -> Patch | None:
        """Return the leader as cameras at these poses see it, on average; None out of sight."""
        relative = [camera.inverse() @ leader for camera, leader in zip(cameras, leaders)]
        outlines = [self._outlines(pose) for pose in relative]
        window = self._window(np.concatenate([
            pixels for each in outlines for _, pixels in each] or [np.zeros((0, 2))]))
        if window is None:
            return None
        shape = window[0].stop - window[0].start, window[1].stop - window[1].start
        total = np.zeros((*shape, 2), np.float32)
        for k, (pose, leader) in enumerate(zip(relative, leaders)):
            light = self._world.brightness(self._normals @ leader.rotation.T)
            canvas = self._body(shape, window, outlines[k], light)
            if self._marker is not None and self._texture is not None:
                self._print(canvas, window, self._marker, self._texture, pose, leader,
                            _ROOKS[:, k::len(relative)])
            total += canvas
        total *= np.float32(1.0 / len(relative))
        return Patch(window, total[..., 0], total[..., 1])

    def _outlines(self, pose: Transform) -> list[tuple[int, Array]]:
        """Return the plain surfaces that face the camera, farthest first, and their pixels."""
        centres = pose.apply(self._centres)
        facing = np.sum((self._normals @ pose.rotation.T) * centres, axis=1)
        far = np.sum(centres * centres, axis=1)
        order = [int(k) for k in np.argsort(-far, kind='stable')
                 if facing[k] < 0.0 or self._two_sided[k]]
        if not order:
            return []
        ends = np.cumsum([len(self._plain[k].outline) for k in order])
        pixels = self._lens.project(pose.apply(
            np.concatenate([self._plain[k].outline for k in order])))
        return [(k, own) for k, own in zip(order, np.split(pixels, ends[:-1]))
                if np.all(np.isfinite(own))]

    def _window(self, pixels: Array) -> Window | None:
        """Return the part of the image that holds pixels (n, 2), or None."""
        if not len(pixels):
            return None
        height, width = self._rays.shape
        left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - _MARGIN, 0)
        right, bottom = np.ceil(pixels.max(axis=0)).astype(int) + 1 + _MARGIN
        right, bottom = min(int(right), width), min(int(bottom), height)
        if left >= right or top >= bottom:
            return None
        return slice(int(top), bottom), slice(int(left), right)

    def _body(self, shape: tuple[int, int], window: Window, outlines: list[tuple[int, Array]],
              light: Array) -> Image:
        """Return light and cover (rows, columns, 2) of the plain surfaces."""
        canvas = np.zeros((_SCALE * shape[0], _SCALE * shape[1], 2), np.float32)
        origin = np.array([window[1].start, window[0].start]) - 0.5
        for k, pixels in outlines:
            surface = self._plain[k]
            # Samples' centres lie half a sample from the edge of their pixel.
            at = (pixels - origin) * _SCALE - 0.5
            points = np.rint(at * 2 ** _SHIFT).astype(np.int32)
            value = surface.value * float(light[k])
            if surface.opacity == 1.0:
                cv2.fillConvexPoly(canvas, points, (value, 1.0), shift=_SHIFT)
            else:
                _shade(canvas, points, value, surface.opacity)
        return cv2.resize(canvas, shape[::-1],  # type: ignore[return-value]
                          interpolation=cv2.INTER_AREA)

    def _print(self, canvas: Image, window: Window, marker: Surface, texture: Image,
               pose: Transform, leader: Transform, rooks: NDArray[np.int64]) -> None:
        """Put the marker in front, seen by the rays through some places in every pixel."""
        seen = pose @ marker.pose
        right, up, normal = seen.rotation.T
        facing = float(normal @ seen.translation)
        sides = marker.half_width, marker.half_height
        corners = np.array([[x * sides[0], y * sides[1], 0.0]
                            for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))])
        pixels = self._lens.project(seen.apply(corners))
        inner = self._window(pixels) if np.all(np.isfinite(pixels)) else None
        if facing >= 0.0 or inner is None:
            return
        du, dv = ((rooks + 0.5) / 8 - 0.5).astype(np.float32)[:, :, None, None]
        x, y = self._rays.within(inner, du, dv)
        # 1 / depth, and right and up times it, are linear in a ray's (x, y).
        forms = np.stack([normal / facing, right, up]).astype(np.float32)
        depth = 1 / (forms[0, 0] * x + (forms[0, 1] * y + forms[0, 2]))
        across = (forms[1, 0] * x + (forms[1, 1] * y + forms[1, 2])) * depth
        above = (forms[2, 0] * x + (forms[2, 1] * y + forms[2, 2])) * depth
        rows, columns = texture.shape[:2]
        scale = np.float32((columns - 2) / (2 * sides[0])), np.float32((rows - 2) / (2 * sides[1]))
        u = (across - np.float32(right @ seen.translation)) * scale[0] + np.float32(
            (columns - 1) / 2)
        v = np.float32((rows - 1) / 2) - (
            above - np.float32(up @ seen.translation)) * scale[1]
        flat = (u.shape[0] * u.shape[1], u.shape[2])
        printed = cv2.remap(texture, u.reshape(flat), v.reshape(flat), cv2.INTER_LINEAR,
                            borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
        printed = printed.reshape(*u.shape, 2).mean(axis=0)
        printed[..., 0] *= np.float32(self._world.brightness(
            (leader.rotation @ marker.pose.rotation[:, 2])[None])[0])
        at = (slice(inner[0].start - window[0].start, inner[0].stop - window[0].start),
              slice(inner[1].start - window[1].start, inner[1].stop - window[1].start))
        canvas[at] = printed + (1 - printed[..., 1:]) * canvas[at]


def _simplified(surface: Surface) -> _Plain:
    w, h = surface.half_width, surface.half_height
    texture = surface.texture
    top = texture.starts[1] if len(texture.starts) > 1 else None
    value = float(texture.values[:top].mean())
    if texture.opacities is None:
        outline = np.array([[-w, h, 0.0], [w, h, 0.0], [w, -h, 0.0], [-w, -h, 0.0]])
        return _Plain(surface.pose.apply(outline), value, 1.0)
    angle = np.arange(16) * np.pi / 8
    outline = np.stack([w * np.cos(angle), h * np.sin(angle), 0.0 * angle], axis=1)
    opacity = float(texture.opacities[:top].mean()) * 4.0 / np.pi  # of a disc in the square
    return _Plain(surface.pose.apply(outline), value, opacity)


def _texture(surface: Surface) -> Image:
    """Return value and cover of a printed surface, finer, and with nothing around it."""
    rows, columns = surface.texture.shape
    value = surface.texture.values[:rows * columns].reshape(rows, columns)
    fine = np.repeat(np.repeat(value, _TEXELS, axis=0), _TEXELS, axis=1)
    return np.pad(np.stack([fine, np.ones_like(fine)], axis=2), ((1, 1), (1, 1), (0, 0)))


def _shade(canvas: Image, points: NDArray[np.int32], value: float, opacity: float) -> None:
    """Draw a translucent polygon on light and cover."""
    low = np.maximum((points.min(axis=0) >> _SHIFT) - 1, 0)
    high = np.minimum((points.max(axis=0) >> _SHIFT) + 2, canvas.shape[1::-1])
    if np.any(low >= high):
        return
    part = canvas[low[1]:high[1], low[0]:high[0]]
    mask = np.zeros(part.shape[:2], np.float32)
    cv2.fillConvexPoly(mask, points - (low << _SHIFT).astype(np.int32), opacity, shift=_SHIFT)
    part *= 1 - mask[..., None]
    part += mask[..., None] * np.array([value, 1.0], np.float32)
