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
A rendered camera: a leader before its surroundings, through a distorting lens, onto a sensor.

The surroundings are a stored panorama, out of focus, in the attitude of the middle of the
exposure: everything except the leader is assumed to be far away. The leader's image is the mean
over poses that are spread over the exposure. Pixel coordinates are OpenCV's: (0, 0) is the center
of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from statistics import NormalDist
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from flock_desk.camera.lens import Camera
from flock_follower.geometry import Array, R_FLU_OPTICAL, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.perception.markers import draw_marker, marker_cells

Image = NDArray[np.float32]

#: The surroundings: a photograph in all directions.
PANORAMA = Path(__file__).resolve().parents[1] / 'data' / 'panorama.jpg'
NEAR = 0.05  # m: nothing nearer to the camera is seen
_SHIFT = 4  # bits behind the point in the corners of polygons
_MARGIN = 2  # px around a body
_TEXELS = 8  # per cell of a print; between two of them light changes linearly
_RAY_SPACING = 16  # px between the rays whose place in the panorama is computed
_SKY = 0.60  # radiance of the panorama's largest value
_SUN_DIRECTION = np.array([-0.48, 0.36, 0.8])  # unit vector in the world
_AMBIENT_SHARE = 0.55  # share of the light that comes from everywhere
_FULL = 1.25  # share of the full well: more light than this saturates
_SCALE = 65535 / _FULL  # of light in 16 bits
_LEVEL_BITS = 11  # of the levels of light in the table of noise
_DRAW_BITS = 8  # of the quantiles of noise in that table
_SPREAD = 0.607  # px: of the lens's blur, 17 % of a pixel's light on either side


@dataclass(frozen=True)
class Sensor:
    """Model of the image sensor: exposure, noise, gamma."""

    exposure: float = 0.005
    """s."""
    sub_poses: int = 4
    """Poses within the exposure that are rendered and averaged."""
    full_well: float = 12000.0
    """Photo-electrons at the largest value: fewer make more shot noise."""
    read_noise: float = 12.0
    """Standard deviation, electrons."""
    gain: float = 1.5
    """Share of the full well that a radiance of 1 fills in the image's center."""
    gamma: float = 2.2
    vignetting: float = 0.35
    """Relative light 1 / (1 + this r^2)^2, r the tangent of the angle off axis; 1 is cos^4."""

    def times(self, stamp: float) -> Array:
        """Return the times of the sub-poses about the middle of the exposure, s."""
        return stamp + self.exposure * ((np.arange(self.sub_poses) + 0.5) / self.sub_poses - 0.5)


class Renderer:
    """
    Renders one leader before its surroundings.

    :param body: the leader's faces.
    :param seed: of the noise.
    :param fineness: its square is the number of samples of the leader per pixel and sub-pose.
    :param prints: bodies at rest: the faces in the frame of each body, and its pose.
    """

    def __init__(self, camera: Camera, sensor: Sensor, body: Sequence[Face] | None = None,
                 seed: int = 1, fineness: int = 4,
                 prints: Sequence[tuple[Sequence[Face], Transform]] = ()) -> None:
        self.camera, self.sensor = camera, sensor
        self._seed = seed
        u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
        rays = np.dstack([*camera.rays(u, v), np.ones_like(u)]).astype(np.float32)
        self._panorama = _Panorama(camera)
        self._leader = _Drawing(camera, rays, leader() if body is None else body, fineness)
        self._prints = [(_Drawing(camera, rays, faces, fineness), pose)
                        for faces, pose in prints]
        fall = 1.0 + sensor.vignetting * (rays[..., 0] ** 2 + rays[..., 1] ** 2)
        self._exposed = (_SCALE * sensor.gain / fall ** 2).astype(np.float32)
        self._table = _noise_table(sensor)

    def image(self, index: int, cameras: Sequence[Transform],
              leaders: Sequence[Transform]) -> NDArray[np.uint8]:
        """
        Return the image of the sensor: mono8, (height, width).

        :param index: number of the image: its noise depends on it and the seed alone.
        :param cameras: poses of the optical frame in the world, spread over the exposure.
        :param leaders: poses of the leader's body in the world at the same times; none at all
            leave it out.
        """
        return self.develop(index, self.radiance(cameras, leaders))

    def radiance(self, cameras: Sequence[Transform], leaders: Sequence[Transform]) -> Image:
        """Return the light on the sensor (height, width) behind an ideal lens, without noise."""
        surroundings = self._panorama.seen(cameras[len(cameras) // 2].rotation)
        total = np.zeros_like(surroundings)
        for k, camera in enumerate(cameras):
            image = surroundings.copy()
            bodies = [*self._prints, *((self._leader, leader) for leader in leaders[k:k + 1])]
            for drawing, pose in sorted(bodies, key=lambda each: -math.dist(
                    each[1].translation, camera.translation)):
                drawing.draw(image, camera, pose)
            total += image
        return total / np.float32(len(cameras))

    def develop(self, index: int, radiance: Image) -> NDArray[np.uint8]:
        """Return the image (height, width), mono8: vignetting, lens blur, noise, gamma."""
        exposed = np.minimum(radiance * self._exposed, np.float32(65535)).astype(np.uint16)
        blurred = cv2.GaussianBlur(exposed, (3, 3), _SPREAD, borderType=cv2.BORDER_REPLICATE)
        code = blurred.astype(np.int32) >> (16 - _LEVEL_BITS) << _DRAW_BITS
        noise = np.random.default_rng([self._seed, index]).bytes(code.size)
        code |= np.frombuffer(noise, np.uint8).reshape(code.shape)
        return self._table.take(code, mode='clip')


def _noise_table(sensor: Sensor) -> NDArray[np.uint8]:
    """Return the pixel values (levels * draws,) of each level of light with each noise."""
    count, levels = 2 ** _DRAW_BITS, 2 ** _LEVEL_BITS
    draws = np.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
    draws /= np.sqrt(np.mean(draws * draws))
    light = ((np.arange(levels) + 0.5) * _FULL / levels)[:, None]
    read = sensor.read_noise / sensor.full_well
    noisy = light + draws * np.sqrt(light / sensor.full_well + read * read)
    return np.rint(255.0 * np.clip(noisy, 0.0, 1.0) ** (1.0 / sensor.gamma)).astype(
        np.uint8).ravel()


class _Panorama:
    """
    The surroundings in all directions, from ``PANORAMA``.

    A row is an elevation, a column an azimuth, anticlockwise seen from above; the first and last
    row are repeated up to the zenith and down to the nadir.
    """

    def __init__(self, camera: Camera) -> None:
        stored: Any = cv2.imread(str(PANORAMA), cv2.IMREAD_GRAYSCALE)
        self._light = (_SKY * (stored / 255.0) ** 2.2).astype(np.float32)
        self._shape = camera.height, camera.width
        # Middles of cells, from one cell before the image to one behind it.
        u, v = np.meshgrid(*(np.arange(-0.5 - _RAY_SPACING / 2, size + _RAY_SPACING, _RAY_SPACING)
                             for size in (camera.width, camera.height)))
        self._rays = np.stack([*camera.rays(u, v), np.ones_like(u)])

    def seen(self, rotation: Array) -> Image:
        """Return the light (height, width) of a camera whose axes ``rotation`` takes to ENU."""
        rows, columns = self._light.shape
        per_rad = columns / (2.0 * math.pi)
        heading = math.atan2(rotation[1, 2], rotation[0, 2])
        ahead, left, up = np.tensordot(
            rotation_vector_to_matrix([0.0, 0.0, -heading]) @ rotation, self._rays, 1)
        column = per_rad * (np.arctan2(left, ahead) + heading)
        row = (rows - 1) / 2.0 - per_rad * np.arctan2(up, np.hypot(ahead, left))
        places = cv2.resize(np.dstack([column, np.clip(row, 0.0, rows - 1.0)]).astype(np.float32),
                            None, fx=_RAY_SPACING // 2, fy=_RAY_SPACING // 2,
                            interpolation=cv2.INTER_LINEAR)
        # Every other pixel is enough: the panorama is coarser than most cameras.
        seen = cv2.remap(self._light, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        full: Image = cv2.resize(seen, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        return full[_RAY_SPACING:_RAY_SPACING + self._shape[0],
                    _RAY_SPACING:_RAY_SPACING + self._shape[1]]


def _window_bounds(pixels: Array, low: Any, high: Any) -> tuple[Any, Any]:
    """Return first and last + 1 column and row (2,) of the part of a window with pixels (n, 2)."""
    return (np.maximum(np.floor(pixels.min(axis=0)).astype(int) - _MARGIN, low),
            np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 1 + _MARGIN, high))


def _part(image: Image, low: Any, high: Any, n: int = 1) -> Image:
    """Return a window of an image that has n samples per pixel."""
    (left, top), (right, bottom) = n * low, n * high
    return image[top:bottom, left:right]


class _Drawing:
    """Draws one body: faces, farther ones first, and prints as cast rays show them."""

    def __init__(self, camera: Camera, rays: Image, faces: Sequence[Face], n: int) -> None:
        self._camera, self._rays, self._faces, self._n = camera, rays, faces, n
        self._starts = np.cumsum([0, *(len(face.outline) for face in faces[:-1])])
        self._points = np.concatenate([face.outline for face in faces])
        self._normals, self._middles = (
            np.array([getattr(face, name) for face in faces]) for name in ('normal', 'middle'))
        # Of the plane of each face above the middle of its box, m.
        self._heights = np.sum(
            self._normals * (self._points[self._starts] - self._middles), axis=1)
        self._textures = [None if face.cells is None else _texture(face.cells) for face in faces]

    def draw(self, image: Image, camera: Transform, body: Transform) -> None:
        """Draw the body on light (height, width); poses of the optical frame and the body."""
        n, pose = self._n, camera.inverse() @ body
        points = pose.apply(self._points)
        ahead = points[:, 2] > NEAR
        if not ahead.any():
            return
        pixels = self._camera.project(np.where(ahead[:, None], points, 1.0))
        low, high = _window_bounds(pixels[ahead], 0, (self._camera.width, self._camera.height))
        if not (low < high).all():
            return
        size = (high - low).tolist()
        fine = np.zeros((n * size[1], n * size[0], 2), np.float32)
        light = _AMBIENT_SHARE + (1.0 - _AMBIENT_SHARE) * np.maximum(
            self._normals @ body.rotation.T @ _SUN_DIRECTION, 0.0)
        # The center of a sample lies half a sample from the edge of its pixel.
        corners = np.rint((((pixels - low) + 0.5) * n - 0.5) * 2 ** _SHIFT).astype(np.int32)
        eye = pose.inverse().translation
        shown = np.logical_and.reduceat(ahead, self._starts) & (
            np.sum(self._normals * (eye - self._middles), axis=1) > self._heights)
        for k in np.argsort(-np.linalg.norm(self._middles - eye, axis=1), kind='stable'):
            if not shown[k]:
                continue
            face, texture = self._faces[k], self._textures[k]
            part = slice(self._starts[k], self._starts[k] + len(face.outline))
            if texture is None:
                cv2.fillConvexPoly(fine, corners[part], (light[k] * face.value, 1.0),
                                   shift=_SHIFT)
                continue
            first, end = _window_bounds(pixels[part], low, high)
            if (first < end).all():
                self._print(_part(fine, first - low, end - low, n),
                            _part(self._rays, first, end), points[part],
                            texture * np.array([light[k], 1.0], np.float32))
        drawn = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
        seen = _part(image, low, high)
        seen[:] = drawn[..., 0] + (1.0 - drawn[..., 1]) * seen

    def _print(self, behind: Image, rays: Image, corners: Array, texture: Image) -> None:
        """Draw a print whose corners (4, 3) are in the optical frame, on light and cover."""
        # A ray meets the plane of the print at corner 0 + s (1 - 0) + t (3 - 0), in shares s, t.
        # Texels are at places / nearness.
        to_print = np.linalg.inv(np.stack(
            [corners[1] - corners[0], corners[3] - corners[0], corners[0]], axis=1))
        to_print[:2] *= np.reshape(texture.shape[1::-1], (2, 1))
        column, row, nearness = cv2.split(cv2.transform(rays, to_print))
        nearness, n = np.maximum(nearness, np.float32(1e-3)), self._n
        places = cv2.resize(cv2.merge([column / nearness, row / nearness]) - np.float32(0.5),
                            None, fx=n, fy=n, interpolation=cv2.INTER_LINEAR)
        seen = cv2.remap(texture, places, None, cv2.INTER_LINEAR, borderValue=0)
        behind[:] = seen + (1.0 - seen[..., 1:]) * behind


def _texture(cells: Array) -> Image:
    """Return light and cover (rows, columns, 2) of the cells of a print."""
    fine = np.kron(cells, np.ones((_TEXELS, _TEXELS)))
    return np.dstack([fine, np.ones_like(fine)]).astype(np.float32)


#: The camera optical frame on the follower's body (FLU).
T_BODY_OPTICAL = Transform(R_FLU_OPTICAL, np.array([0.10, 0.0, 0.0]))
#: The marker on the leader's body (FLU): on the tail, facing backwards.
T_BODY_MARKER = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                          np.array([-0.20, 0.0, 0.0]))
SIDE_LENGTH = 0.16  # m, of the marker
INK_RADIANCE = 0.03  # share of a white surface's
PAPER_RADIANCE = 0.72  # share of a white surface's
#: Corners of a marker, in half sides.
_UNIT_SQUARE = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


class Face(NamedTuple):
    """A flat convex part of a body, in the frame of that body; all values are reflectances."""

    outline: Array
    """(k, 3), m; of a print from its top left corner clockwise."""
    normal: Array
    """(3,), outwards."""
    middle: Array
    """(3,), m, of the box that it is part of: farther boxes are painted first."""
    value: float = 0.0
    cells: Array | None = None
    """(rows, columns), of a print."""


def box(pose: Transform, size: ArrayLike, value: float) -> list[Face]:
    """Return the faces of a box about its pose's origin, of a size (3,), m."""
    half, faces = np.asarray(size, dtype=float) / 2.0, []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = sign * np.eye(3)[axis]
            outline = np.roll(np.pad(_UNIT_SQUARE, ((0, 0), (1, 0))), axis, axis=1) + normal
            faces.append(Face(pose.apply(half * outline), pose.rotation @ normal,
                              pose.translation, value))
    return faces


def marker_print(cells: Array, cell: float, middle: Transform = T_BODY_MARKER) -> Face:
    """
    Return a print seen from the z side of its pose.

    :param cells: (rows, columns), 0 black, 1 white; :param cell: size of each, m.
    """
    half = np.array([cells.shape[1], cells.shape[0], 0.0]) * cell / 2.0
    return Face(middle.apply(half * np.pad(_UNIT_SQUARE, ((0, 0), (0, 1)))), middle.rotation[:, 2],
                middle.translation, cells=INK_RADIANCE + (PAPER_RADIANCE - INK_RADIANCE) * cells)


def board(face: Face, thickness: float = 0.01) -> list[Face]:
    """Return the board, half a cell wider than a print of 8 x 8, that it is stuck on."""
    sides = face.outline[1] - face.outline[0], face.outline[0] - face.outline[3]
    lengths = [float(np.linalg.norm(side)) for side in sides]
    axes = np.stack([*(side / n for side, n in zip(sides, lengths)), face.normal], axis=1)
    return box(Transform(axes, face.middle - 0.6 * thickness * face.normal),
               [*(9 / 8 * n for n in lengths), thickness], 0.60)


def second_print(dictionary: str = 'DICT_4X4_50') -> Face:
    """Return marker 0 of a dictionary alone, in the body frame of a leader that would carry it."""
    cells = marker_cells(dictionary)
    code = draw_marker(dictionary, 0, cells) > 127
    return marker_print(np.pad(code, 1, constant_values=True).astype(float), SIDE_LENGTH / cells)


def leader(marker: Face | None = None) -> list[Face]:
    """Return a quadrotor with a marker on its tail, by default marker 0 of DICT_4X4_50."""
    marker = marker or second_print()
    faces = [*box(Transform(), [0.30, 0.11, 0.07], 0.025), *board(marker), marker]
    for x in (-0.16, 0.16):
        for y in (-0.25, 0.25):
            arm = rotation_vector_to_matrix([0.0, 0.0, np.arctan2(y, x)])
            for place, size, turn in (
                    ((0.6, 0.6, 0.0), [0.24, 0.018, 0.014], arm),
                    ((1.0, 1.0, 0.018), [0.026, 0.026, 0.034], np.eye(3)),  # a motor
                    ((0.8, 0.8, -0.05), [0.01, 0.01, 0.1], np.eye(3))):  # a leg
                faces += box(Transform(turn, np.array([x, y, 1.0]) * place), size, 0.025)
    return faces
