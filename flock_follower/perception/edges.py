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
Finds the edges of a marker in an image, near the places where they should be.

Brightness profiles are taken across the known edges between black and white. The derivative of a
profile, smoothed as widely as the image is blurred, peaks at the edge. Unlike the level half-way
between black and white, the peak hardly moves if blur dims a narrow cell.

``solve_normal`` and ``normal_covariance`` serve every fit. Both solve normal equations of least
squares by Cholesky, and only if the equations determine every unknown: Gaussian elimination also
answers equations that only rounding keeps from being singular, and their inverse is no covariance.

The arrays are small: the number of operations takes time, not the number of points. ``dot`` takes
half as long as ``@``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import DERIVATIVES, EdgeModel, median

#: How much more uncertain, in variance, all unknowns together may be than each would be alone.
#: For good fits of rendered markers it is at most 5e3; at 1e16 nothing is left but rounding.
MAX_INFLATION = 1e8
_CHOLESKY = cv2.DECOMP_CHOLESKY


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

    None if that is not positive definite, or worse conditioned than :data:`MAX_INFLATION`.
    """
    solved, inverse = cv2.invert(information, flags=_CHOLESKY)
    # In units in which each unknown alone has variance 1, the trace of the inverse bounds the
    # condition; Cholesky's elimination minds no units.
    if not (solved and 0.0 < inverse.diagonal().dot(information.diagonal()) < MAX_INFLATION):
        return None
    symmetric: Array = 0.5 * (inverse + inverse.T)
    return symmetric


#: px between samples of a profile: least, and most; but as a share of the cell more may be needed.
SPACING = (0.3, 1.2)
WIDEST = 0.1
_HALF = DERIVATIVES // 2  # samples either side that a peak is looked for, and of the kernel
_REACH = 2 * _HALF  # likewise of a profile
_KERNEL_SIGMA = 2.0  # samples
#: A point and a step, (1, 2), times this: the places along a profile.
_STEPS = np.stack([np.ones(2 * _REACH + 1), np.arange(-_REACH, _REACH + 1.0)]).astype(np.float32)
_LEAST, _MOST = np.minimum.reduce, np.maximum.reduce
_MIN_SLOPE = 1.0  # grey levels per px: weaker edges are ignored
#: Fainter edges, as a share of the median slope, are ignored. Those in a shadow have 0.2 of it;
#: those of cells narrower than _NARROW, px, are faint because they run into one another.
_FAINT, _FAINT_NARROW, _NARROW = 0.15, 0.3, 4.0
_MIN_SHARE = 0.5  # of the edges must be found
_WIDE = 0.5  # px between samples, for sharp images of large markers
_FAR = 25.0  # squared, in variances: an edge farther away does not disturb its neighbour,
_NEAR = 2.5  # halved: one nearer than this is corrected for as if it were there
_LEAST_FACING = 0.17  # cosine: a marker seen from further aside is left out
_LEAST_DEPTH = 0.02  # m
_LEAST_VARIANCE = 1e-9  # px^2: to divide by
_FARTHEST = 1e4  # m: a pose beyond, or NaN, is invalid
#: Indices one inside the range: a maximum at its rim is no peak, and has only one neighbour.
_WITHIN = np.array([1, *range(1, 2 * _HALF), 2 * _HALF - 1])
_ONES, _MINUS, _SUM = np.ones(2), -np.ones(2), np.ones(3)
_DIFFERENCE = np.array([1.0, -1.0])
_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
#: a x b of rows a, b: their outer products, (n, 9), times this.
_CROSS = np.zeros((9, 3))
_CROSS[[5, 6, 1], [0, 1, 2]] = 1.0
_CROSS[[7, 2, 3], [0, 1, 2]] = -1.0


def _correlation() -> Any:
    """Return what takes a profile (17,) to its smoothed derivative at the middle 9 samples."""
    k = np.arange(-_HALF, _HALF + 1.0)
    kernel = k * np.exp(-0.5 * (k / _KERNEL_SIGMA)**2)
    kernel /= kernel @ k  # one grey level per sample gives 1
    matrix = np.zeros((2 * _REACH + 1, 2 * _HALF + 1), dtype=np.float32)
    for i in range(2 * _HALF + 1):
        matrix[i:i + 2 * _HALF + 1, i] = kernel
    return matrix


_CORRELATION = _correlation()


class Lines(NamedTuple):
    """
    Edges in the image as a pose has them.

    ``pixels`` and ``normals`` (n, 2), px, unit, from black to white; ``design`` (n, 8): what a
    step of ``center`` (3,), m, a turn about it, rad, and the two shifts of bloom, px, move an
    edge by along its normal, px. ``scale`` (2,): px per m across edges of either axis.
    ``cells`` (c, 2), px: the middles of the markers' cells.
    """

    model: EdgeModel
    pixels: Array
    normals: Array
    design: Array
    center: Array
    scale: tuple[float, float]
    cells: Array

    @property
    def narrowest(self) -> tuple[float, float]:
        """Return how far apart the closest edges across either axis are, px."""
        (across_x, across_y), (x, y) = self.model.narrowest, self.scale
        return across_x * x, across_y * y

    def moved(self, step: Array, by_step: Array) -> Lines:
        """Return the lines after a small step (6,) or more, which moves them by (n,), px."""
        return self._replace(pixels=self.pixels + by_step[:, None] * self.normals,
                             center=self.center + step[:3])


def facing(model: EdgeModel, pose: Transform) -> Any:
    """Return which markers turn their front to the camera, less than 80 degrees aside, (m,)."""
    if not within_reason(pose):
        return np.zeros(len(model.centers), dtype=bool)
    sight = model.centers + pose.translation.dot(pose.rotation)  # along the body's axes
    along = (sight * model.facings).dot(_SUM)
    return -along > _LEAST_FACING * np.sqrt((sight * sight).dot(_SUM))


def within_reason(pose: Transform) -> bool:
    x, y, z = pose.translation.tolist()
    return abs(x) + abs(y) + abs(z) < _FARTHEST


def project(camera: CameraModel, model: EdgeModel, pose: Transform) -> Lines | None:
    """
    Return the edges as a pose, ``T_camera_body``, has them; None if the lens does not see all.

    All markers of the model must face the camera.
    """
    count = len(model)
    if not within_reason(pose):
        return None
    R = pose.rotation.T
    places = model.places.dot(R)
    places += pose.translation
    if not count or not _LEAST(places[:, 2]) > _LEAST_DEPTH:
        return None
    xy = places[:, :2] / places[:, 2:]
    pixels = camera.distort(xy)
    if not math.isfinite(pixels.sum()):
        return None
    points, xy = places[:count], xy[:count]
    center = model.shares.dot(points)
    # The lens bends little over one marker: its linear map in the middle serves for directions.
    lens = camera.linear_map(float(center[0] / center[2]), float(center[1] / center[2]))
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
    return Lines(model, pixels[:count], normals, design, center,
                 _scale(along, model.examples, float(center[2])), pixels[count:])


def cross(a: Array, b: Array) -> Array:
    """Return the vector products (n, 3) of (n, 3): np.cross takes three times as long."""
    products: Array = (a[:, :, None] * b[:, None]).reshape(-1, 9).dot(_CROSS)
    return products


def _scale(along: Array, examples: tuple[int, int], depth: float) -> tuple[float, float]:
    """Return px per m across edges of either axis, from their unnormalised tangents (n, 2)."""
    (ax, ay), (bx, by) = (along[k].tolist() for k in examples)
    area = abs(ax * by - ay * bx) / depth
    return area / max(math.hypot(ax, ay), 1e-9), area / max(math.hypot(bx, by), 1e-9)


class Found(NamedTuple):
    """
    Where edges are in the image.

    ``offsets`` (n,), px, along the normals from where the lines are; ``found`` (n,), bool;
    ``variance`` (n,), px^2, of the peaks' widths, kernel and blur together. ``known``: the
    indices of those found across either axis.
    """

    offsets: Array
    found: Any
    variance: Array
    known: tuple[Any, Any]


def find(image: GrayImage, lines: Lines, spacing: tuple[float, float]) -> Found | None:
    """
    Return where brightness rises most steeply along each line's normal.

    None if too few edges, or too faint ones, are there. ``spacing``, px, between samples
    across edges of either axis.
    """
    model = lines.model
    step = np.array(spacing, dtype=np.float32)[model.axis]
    along = lines.normals * step[:, None]
    profiles = _sample(image, lines.pixels, along, max(spacing))
    if profiles is None:
        return None
    slope = profiles.dot(_CORRELATION)

    peak = slope.argmax(axis=1)
    within = _WITHIN[peak]
    index = model.begins + within
    values = slope.ravel()
    before, top, after = values[index - 1], values[index], values[index + 1]
    bend = np.minimum(before - 2.0 * top + after, -1e-3)
    typical = median(top)
    faint = _FAINT if min(lines.narrowest) > _NARROW else _FAINT_NARROW
    found = (peak == within) & (top > faint * typical)
    if (typical < _MIN_SLOPE * max(spacing)
            or np.count_nonzero(found) < max(_MIN_SHARE * len(found), 12)):
        return None
    offsets = (within - _HALF + 0.5 * (before - after) / bend) * step
    first, second = ((found & one).nonzero()[0] for one in model.across)
    return Found(offsets, found, (-top / bend) * (step * step), (first, second))


def _sample(image: GrayImage, pixels: Array, along: Array, widest: float) -> Any:
    """
    Return the brightness (n, 17) in steps ``along`` (n, 2) about ``pixels`` (n, 2), bilinear.

    The image's edge repeats outside. None if hardly anything is inside. ``widest`` is the
    longest step, px.
    """
    # Not cv2.remap: up to OpenCV 4 it rounds coordinates to 1/32 px, alike for a whole edge.
    height, width = image.shape
    reach = _REACH * widest + 2.0
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
    at = starts.reshape(-1, 2).dot(_STEPS).reshape(2, count, -1)
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


def apart(lines: Lines, found: Found) -> tuple[Found, tuple[float, float]]:
    """
    Return where edges are without what neighbours push them by, and the blur of either axis, px.

    Blurred by s in all, an edge at 0 and its opposite at d give the smoothed derivative
    C = exp(-x^2 / 2 s^2) - exp(-(x - d)^2 / 2 s^2). With e = exp(-d^2 / 2 s^2), its peak is at
    about -d e / (1 + (d^2 / s^2 - 1) e), and -C / C'' is s^2 (1 - e) / (1 + (d^2 / s^2 - 1) e).
    """
    model, offsets = lines.model, found.offsets
    known = found.known
    variance = _typical(found.variance, known)
    if any(cell**2 < _FAR * v for cell, v in zip(lines.narrowest, variance)):
        room = model.room * np.array(lines.scale)[model.axis][:, None]
        square = room * room
        for again in (True, True, False):
            blurred = np.maximum(variance, _LEAST_VARIANCE)[model.axis]
            normalised = square / blurred[:, None]
            e = np.exp(np.minimum(-0.5 * normalised, -_NEAR))
            bend = 1.0 + ((normalised - 1.0) * e).dot(_ONES)
            if again:
                variance = _typical(found.variance * bend / (1.0 - e.dot(_ONES)), known)
        offsets -= (room * e).dot(_DIFFERENCE) / bend
    return found._replace(offsets=offsets), (math.sqrt(variance[0]), math.sqrt(variance[1]))


def _typical(variance: Array, known: tuple[Any, Any]) -> tuple[float, float]:
    """Return the median variance of the known edges of either axis, px^2; 0 without one."""
    first, second = known
    return (median(variance[first]) if len(first) else 0.0,
            median(variance[second]) if len(second) else 0.0)


def blurs(widths: tuple[float, float], spacing: tuple[float, float]) -> list[float]:
    """
    Return the blur across edges of either axis, px.

    ``widths``, px, are those of the peaks found with a kernel of ``spacing``.
    """
    return [math.sqrt(max(width**2 - (_KERNEL_SIGMA * step)**2, 0.0))
            for width, step in zip(widths, spacing)]


def matched(lines: Lines, blur: list[float]) -> tuple[float, float]:
    """Return the spacing at which the kernel is about as wide as the image is blurred, px."""
    # Wider than the blur averages more noise, as long as the next edge stays out of it.
    first, second = (
        min(max(sigma / _KERNEL_SIGMA, min(_WIDE, 0.12 * cell), SPACING[0]),
            max(SPACING[1], WIDEST * cell))
        for sigma, cell in zip(blur, lines.narrowest))
    return first, second


def searching(lines: Lines) -> tuple[float, float]:
    """Return the spacing, px, at which edges half a cell away are still within reach."""
    first, second = (max(cell / (2 * _HALF), SPACING[0]) for cell in lines.narrowest)
    return first, second
