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
The edges of a neighbor's markers, projected to the image by a pose; normal equations.

Every fit uses ``solve_normal`` and ``normal_covariance``. Both solve normal equations of least
squares by Cholesky, and only if the equations determine every unknown. Gaussian elimination would
also solve singular equations with rounding errors, whose inverse is no covariance.

The arrays are small, so the time depends on the number of numpy calls, not on the number of
points. ``dot`` takes half as long as ``@``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import EdgeModel

#: How much more uncertain, in variance, all unknowns together may be than each would be alone.
#: For good fits of rendered markers it is at most 5e3; at 1e16 only rounding is left.
MAX_INFLATION = 1e8
_CHOLESKY = cv2.DECOMP_CHOLESKY
_LEAST_FACING = 0.17  # cosine: a marker seen from further aside is left out
_LEAST_DEPTH = 0.02  # m
_DIVERGED = 1e4  # m: a fit that leads beyond, or to NaN, has diverged
#: np.min and np.max without their overhead.
_LEAST, _MOST = np.minimum.reduce, np.maximum.reduce
#: Sums both columns of (n, 2).
_ONES = np.ones(2)
#: Sums both columns of (n, 2), negated.
_MINUS = -_ONES
#: A row vector times this is turned by a right angle.
_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
#: a x b of rows a, b: their outer products, (n, 9), times this.
_CROSS = np.zeros((9, 3))
_CROSS[[5, 6, 1], [0, 1, 2]] = 1.0
_CROSS[[7, 2, 3], [0, 1, 2]] = -1.0


def solve_normal(information: Array, moment: Array) -> Array | None:
    """
    Return x (n,) of ``information`` (n, n) x = ``moment`` (n,), None without a definite matrix.

    NaN in either gives NaN in x.
    """
    solved, x = cv2.solve(information, moment[:, None], flags=_CHOLESKY)
    return x[:, 0] if solved else None


def normal_covariance(information: Array) -> Array | None:
    """
    Return the inverse (n, n), symmetric and positive definite, of a symmetric matrix (n, n).

    None if the matrix is not positive definite, or its condition is worse than
    :data:`MAX_INFLATION`.
    """
    solved, inverse = cv2.invert(information, flags=_CHOLESKY)
    # In units in which each unknown alone has variance 1, the trace of the inverse bounds the
    # condition; Cholesky's elimination minds no units.
    if not (solved and 0.0 < inverse.diagonal().dot(information.diagonal()) < MAX_INFLATION):
        return None
    symmetric: Array = 0.5 * (inverse + inverse.T)
    return symmetric


def apply_step(pose: Transform, center: Array, step: Array) -> Transform:
    """Return a pose after a step (6,) or longer: translation of a point, and rotation about it."""
    turn = rotation_vector_to_matrix(step[3:6])
    return Transform(turn.dot(pose.rotation),
                     center + step[:3] + turn.dot(pose.translation - center))


class Lines(NamedTuple):
    """
    Edges in the image, projected by a pose.

    ``pixels`` and ``normals`` (n, 2), px, unit, from black to white; ``design`` (n, 8): the motion
    of each edge along its normal, px, by a step of ``center`` (3,), m, a turn about it, rad, and
    the two shifts of bloom, px. ``scale`` (2,): px per m across edges of either axis;
    ``narrowest`` (2,): the least distance of two edges along each axis, px. ``cells`` (c, 2), px:
    the middles of the markers' cells.
    """

    model: EdgeModel
    pixels: Array
    normals: Array
    design: Array
    center: Array
    scale: tuple[float, float]
    narrowest: tuple[float, float]
    cells: Array

    def after_step(self, step: Array, by_step: Array) -> Lines:
        """Return the lines after a small step (6,) or more, which moves them by (n,), px."""
        return self._replace(pixels=self.pixels + by_step[:, None] * self.normals,
                             center=self.center + step[:3])


def facing(model: EdgeModel, pose: Transform) -> tuple[bool, ...]:
    """Return for each marker whether it faces the camera, with an angle below 80 degrees."""
    if not has_converged(pose):
        return (False,) * len(model.codes)
    to_body = pose.translation.dot(pose.rotation)  # along the body's axes
    # In plain numbers: for every image, and so few.
    return tuple(-(x * u + y * v + z * w) > _LEAST_FACING * math.hypot(x, y, z)
                 for (x, y, z), (u, v, w) in zip(
                     (model.centers + to_body).tolist(), model.facings.tolist()))


def has_converged(pose: Transform) -> bool:
    return sum(map(abs, pose.translation.tolist())) < _DIVERGED


def project(camera: CameraModel, model: EdgeModel, pose: Transform) -> Lines | None:
    """
    Return the edges by a pose, ``T_camera_body``; None if the lens does not see all of them.

    All markers of the model must face the camera.
    """
    count = len(model)
    if not has_converged(pose):
        return None
    R = pose.rotation.T
    places = model.places.dot(R)
    places += pose.translation
    if not count or np.count_nonzero(places[:, 2] > _LEAST_DEPTH) < len(places):
        return None
    xy = np.divide(places[:, :2].T, places[:, 2], out=np.empty((2, len(places)))).T
    pixels = camera.distort(xy)
    if not math.isfinite(cv2.norm(pixels)):
        return None
    points, xy = places[:count], xy[:count]
    center = model.shares.dot(points)
    # The lens bends little over one marker: its linear map in the middle serves for directions.
    x, y, z = center.tolist()
    lens = camera.linear_map(x / z, y / z)
    # The normal in the image is across the projected tangent: projection keeps no right angles.
    tangents = model.tangents.dot(R)
    along = (tangents[:, :2] - tangents[:, 2:] * xy).dot(lens.T)
    normals = along.dot(_TURN)
    normals /= np.sqrt((along * along).dot(_ONES))[:, None]
    rows = normals.dot(lens)
    design = np.empty((count, 8))
    design[:, :2] = rows
    design[:, 2] = (rows * xy).dot(_MINUS)
    design[:, :3] /= points[:, 2:]
    # A turn r moves a point by r x arm, and g . (r x arm) = (arm x g) . r.
    design[:, 3:6] = cross(points - center, design[:, :3])
    design[:, 6:] = model.bloom
    (scale_x, scale_y), (room_x, room_y) = _scale(along, model.examples, z), model.narrowest
    return Lines(model, pixels[:count], normals, design, center, (scale_x, scale_y),
                 (room_x * scale_x, room_y * scale_y), pixels[count:])


def cross(a: Array, b: Array) -> Array:
    """Return the vector products (n, 3) of (n, 3): np.cross takes three times as long."""
    products: Array = (a[:, :, None] * b[:, None]).reshape(-1, 9).dot(_CROSS)
    return products


def _scale(along: Array, examples: tuple[int, int], depth: float) -> tuple[float, float]:
    """Return px per m across edges of either axis, from their unnormalized tangents (n, 2)."""
    (ax, ay), (bx, by) = (along[k].tolist() for k in examples)
    area = abs(ax * by - ay * bx) / depth
    return area / max(math.hypot(ax, ay), 1e-9), area / max(math.hypot(bx, by), 1e-9)


def profiles_across(image: GrayImage, pixels: Array, along: Array, steps: Any,
                    widest: float) -> Any:
    """
    Return the brightness (n, s) in steps ``along`` (n, 2) about ``pixels`` (n, 2), bilinear.

    Outside the image its border pixels are repeated. None if almost all samples are outside.
    ``steps`` (2, s) has a row of ones and the numbers of the steps; ``widest`` is the longest
    step, px.
    """
    # Not cv2.remap: up to OpenCV 4 it rounds coordinates to 1/32 px, alike for a whole edge.
    height, width = image.shape
    reach = steps.shape[1] // 2 * widest + 2.0
    places = pixels.T.copy()
    low_x, low_y = (_LEAST(places, axis=1) - reach).tolist()
    high_x, high_y = (_MOST(places, axis=1) + reach).tolist()
    left, top = max(int(low_x), 0), max(int(low_y), 0)
    right, bottom = min(int(high_x) + 1, width), min(int(high_y) + 1, height)
    if right - left < 2 or bottom - top < 2:
        return None
    stride = right - left
    part = image[top:bottom, left:right].astype(np.float32).ravel()
    count = len(pixels)
    starts = np.empty((2, count, 2), dtype=np.float32)
    starts[0, :, 0], starts[1, :, 0] = places[0] - left, places[1] - top
    starts[:, :, 1] = along.T
    at = starts.reshape(-1, 2).dot(steps).reshape(2, count, -1)
    x, y = at
    if low_x < 0.0 or low_y < 0.0 or high_x > width or high_y > height:
        np.clip(x, 0.0, np.float32(stride - 1.001), out=x)
        np.clip(y, 0.0, np.float32(bottom - top - 1.001), out=y)
    whole = np.floor(at)
    at -= whole
    column, index = whole.astype(np.intp)  # other integers would be turned into these
    index *= stride
    index += column
    next_row = part[stride:]
    above, below = part.take(index), next_row.take(index)
    above += x * (part[1:].take(index) - above)
    below += x * (next_row[1:].take(index) - below)
    below -= above
    below *= y
    below += above
    return below
