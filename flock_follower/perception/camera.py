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
Pinhole and fisheye cameras as ``sensor_msgs/CameraInfo`` describes them.

Pixel coordinates are OpenCV's: x right, y down, (0, 0) at the center of the top-left pixel.
Points are in the camera's optical frame: x right, y down, z forward, m.

With (x, y) = (X/Z, Y/Z), r^2 = x^2 + y^2, each model maps (x, y) to distorted (x', y'), and
``[u, v] = K[:2, :2] [x', y'] + K[:2, 2]``:

- plumb_bob, D = (k1, k2, p1, p2, k3), and rational_polynomial, D = (k1, ..., k3, k4, k5, k6):
  g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
  x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2), y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y;
  four more coefficients s1, ..., s4 add s1 r^2 + s2 r^4 to x', s3 r^2 + s4 r^4 to y' (a thin
  prism), and two more tilt the sensor about x by tx, about y by ty, rad;
- equidistant (fisheye), D = (k1, k2, k3, k4): t = atan r,
  (x', y') = (x, y) t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r.

Another lens also needs ``planner.sight`` (field of view) and ``flock_desk.camera.lens``.

The models are implemented here, not taken from cv2: cv2's undistortion stops before it has
converged, its option for accuracy differs between OpenCV 4 and 5, and the Jacobians of its fisheye
functions have another order.
"""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array
from flock_follower.ranges import Range

#: Number of coefficients of each distortion model (names of ``sensor_msgs/distortion_models``).
#: Those of plumb_bob begin rational_polynomial's: of both the number counts, 4, 5, 8, 12 or 14.
DISTORTION_MODELS = {'plumb_bob': 5, 'rational_polynomial': 8, 'equidistant': 4}
#: Focal lengths as a share of the image's longer side, beyond what any lens has (the widest
#: fisheye 0.2): outside, K is in other units, or noise.
FOCAL_LENGTH_RANGE = (0.02, 1000.0)
#: Largest distance of the optical axis from the middle, as a share of the image size: K for
#: images of twice or half the size is off by 0.5 and 0.25.
MAX_AXIS_OFFSET = 0.15
#: Place of the optical axis as a share of the image size, beyond what the smallest region of a
#: sensor has: outside, K is noise.
AXIS_RANGE = Range(-100.0, 101.0)
_SIZE = Range(1, 65535, 'px', whole=True)
#: Beyond this radius in normalized coordinates (84 degrees off axis) nothing is projected.
_RADIUS_LIMIT = 10.0
#: Least r^2 at which a fisheye's radial factor is computed: at 0 it is 0 / 0.
_MIN_SQUARED_RADIUS = 1e-8


def off_center(shares: Array) -> bool:
    """Return whether the optical axis, as shares (2,) of the image size, is far off-center."""
    return bool(np.abs(shares - 0.5).max() > MAX_AXIS_OFFSET)


def marked_rectified(topic: str) -> bool:
    """Return whether the name of a topic says that its images are rectified, for any transport."""
    return bool({'rect', 'rectified'}.intersection(re.split('[/_]', topic.lower())))


class CameraModel:
    """
    The intrinsic calibration of one camera; not to be altered.

    ``radius`` is the radius in normalized coordinates up to which the distortion is one-to-one.

    :param matrix: K, shape (3, 3), px.
    :param distortion: D; if the model allows it (no coefficients, or the first four or five),
        missing coefficients are zero; additional zeros at the end are ignored.
    :param model: a key of ``DISTORTION_MODELS``; empty means plumb_bob.
    :param width: image width, px.
    :param height: image height, px.
    :raises ValueError: naming the fault of the calibration.
    """

    def __init__(self, matrix: ArrayLike, distortion: ArrayLike, model: str, width: int,
                 height: int) -> None:
        self.model = model or 'plumb_bob'
        if self.model not in DISTORTION_MODELS:
            raise ValueError(f'distortion_model = {model!r}: must be one of '
                             f'{", ".join(DISTORTION_MODELS)}')
        self.matrix = _checked_matrix(np.array(matrix, dtype=float))
        self.distortion = _checked_distortion(distortion, self.model)
        _SIZE.check('width', width)
        _SIZE.check('height', height)
        self.width, self.height = width, height
        low, high = (share * max(width, height) for share in FOCAL_LENGTH_RANGE)
        for focal in self.matrix.diagonal()[:2].tolist():
            Range(low, high, 'px').check(f'K: focal length for {width}x{height}', focal)
        for share in (self.matrix[:2, 2] / (width, height)).tolist():
            AXIS_RANGE.check(f'K: optical axis as a share of {width}x{height}', share)
        self._linear, self._middle = self.matrix[:2, :2], self.matrix[:2, 2:]
        fisheye = self.model == 'equidistant'
        p1, p2 = self._tangential = (0.0, 0.0) if fisheye else self.distortion[2:4].tolist()
        # This times x x, y y, x y (3, n): what p1 and p2 add to (x', y').
        self._aside: Array | None = np.array(
            [[3.0 * p2, p2, 2.0 * p1], [p1, 3.0 * p1, 2.0 * p2]]) if p1 or p2 else None
        # Of rational_polynomial: the thin prism, (4,), and the tilt of the sensor, (3, 3).
        self._prism = self.distortion[8:12] if self.distortion[8:12].any() else None
        self._tilt = _tilt(*self.distortion[12:14]) if self.distortion[12:14].any() else None
        radii = np.linspace(0.0, _RADIUS_LIMIT, 2001)
        falling = np.flatnonzero(~(np.diff(radii * self._scale(radii**2)[0]) > 0.0))
        self.radius = float(radii[falling[0]]) if falling.size else _RADIUS_LIMIT
        if self.radius == 0.0:
            raise ValueError(f'D = {self.distortion.tolist()}: folds the image at its center')

    @classmethod
    def from_calibration(cls, K: ArrayLike, D: ArrayLike, distortion_model: str,
                         width: int, height: int, P: ArrayLike | None = None,
                         *, rectified: bool = False) -> CameraModel:
        """
        Return the camera of a calibration as ``CameraInfo`` spells it.

        K is (3, 3) or flat (9,). For images that are undistorted already (rectified), the camera
        matrix is the left (3, 3) of P, (3, 4) or flat (12,), there is no distortion, and poses are
        in the rectified frame.

        :raises ValueError: naming the fault of the calibration.
        """
        if not rectified:
            return cls(_reshaped('K', K, (3, 3)), np.asarray(D, float), distortion_model,
                       width, height)
        if P is None or not np.any(P):
            raise ValueError(f'P = {None if P is None else 0}: a rectified image needs the '
                             'projection matrix P')
        return cls(_reshaped('P', P, (3, 4))[:, :3], np.zeros(5), 'plumb_bob', width, height)

    @classmethod
    def from_info(cls, info: Any, rectified: bool = False) -> CameraModel:
        """
        Return the camera of a ``CameraInfo`` message, of its region of interest and binning.

        K and size are those of the full image, whose optical axis is near its middle. A K for an
        image of 0.7 to 1.3 times the size keeps the axis there: that cannot be known.

        :raises ValueError: naming the fault of the calibration.
        """
        camera = cls.from_calibration(
            info.k, info.d, info.distortion_model, info.width, info.height, info.p,
            rectified=rectified)
        shares = camera.matrix[:2, 2] / (info.width, info.height)
        if off_center(shares):
            raise ValueError(
                f'optical axis at {shares[0]:.0%}, {shares[1]:.0%} of {info.width}x{info.height} '
                '(K, width and height of the full image, or of the image sent without roi and '
                'binning): K is for another image')
        return camera.scaled(
            info.roi.x_offset, info.roi.y_offset, info.roi.width or info.width,
            info.roi.height or info.height, max(info.binning_x, 1), max(info.binning_y, 1))

    def scaled(self, x_offset: int, y_offset: int, width: int, height: int,
               binning_x: int = 1, binning_y: int = 1) -> CameraModel:
        """
        Return the camera of a region of interest of the full image, then binned.

        :param x_offset: first column, and ``y_offset`` first row, of the region, px of the full
            image. :param width: width, and ``height`` height, of the region before binning, px.
        :raises ValueError: if the region is not inside the image.
        """
        if (x_offset < 0 or y_offset < 0 or min(binning_x, binning_y) < 1
                or not 0 < width <= self.width - x_offset
                or not 0 < height <= self.height - y_offset):
            raise ValueError(
                f'roi = {width}x{height}+{x_offset}+{y_offset}, binning {binning_x}x{binning_y}: '
                f'must lie inside {self.width}x{self.height}')
        # A binned pixel's center lies half a binned pixel from its edge: shift, scale, shift.
        matrix = self.matrix.copy()
        matrix[:2, 2] += 0.5 - np.array([x_offset, y_offset])
        matrix[:2] /= np.array([[binning_x], [binning_y]])
        matrix[:2, 2] -= 0.5
        return CameraModel(matrix, self.distortion, self.model,
                           width // binning_x, height // binning_y)

    def check_image(self, width: int, height: int) -> None:
        """
        Refuse an image of another size than the calibration's, px.

        :raises ValueError: naming both sizes.
        """
        if (width, height) != (self.width, self.height):
            raise ValueError(f'image = {width}x{height}: camera_info is for '
                             f'{self.width}x{self.height}')

    def project(self, points: ArrayLike) -> Array:
        """
        Return the pixels (N, 2) of points (N, 3) in the optical frame, m.

        NaN if a point is behind the camera, or so far off the axis that the distortion is not
        one-to-one.
        """
        return self.distort(_normalized(np.asarray(points, dtype=float).reshape(-1, 3))[0])

    def distort(self, xy: Array) -> Array:
        """
        Return the pixels (N, 2) of normalized coordinates (N, 2) = (X/Z, Y/Z).

        NaN if the distortion is not one-to-one there.
        """
        # Rows of x and of y: numpy takes a row in one loop, but a column of two in many.
        x_y = xy.T
        products = np.empty((3, len(xy)))
        np.multiply(x_y, x_y, out=products[:2])
        r2 = products[0] + products[1]
        g = self._radial(r2)
        if cv2.norm(r2, cv2.NORM_INF) > self.radius**2:
            g = np.where(r2 <= self.radius**2, g, np.nan)
        distorted = x_y * g
        if self._aside is not None:
            np.multiply(x_y[0], x_y[1], out=products[2])
            distorted += self._aside.dot(products)
        if self._prism is not None:
            s1, s2, s3, s4 = self._prism
            distorted += r2 * np.stack([s1 + s2 * r2, s3 + s4 * r2])
        if self._tilt is not None:
            tilted = self._tilt[:, :2].dot(distorted) + self._tilt[:, 2:]
            distorted = tilted[:2] / tilted[2]
        pixels: Array = self._linear.dot(distorted)
        pixels += self._middle
        return pixels.T

    def linear_map(self, x: float, y: float) -> Array:
        """Return d pixel / d (x, y), (2, 2), px, at one place in normalized coordinates."""
        mapped: Array = self._linear.dot(np.array(self._slopes(x, y)).reshape(2, 2))
        return mapped

    def linearize(self, points: ArrayLike) -> tuple[Array, Array]:
        """
        Return the pixels (N, 2) of points (N, 3) in the optical frame, m, and their Jacobian.

        The Jacobian d pixel / d point is (N, 2, 3), px/m.
        """
        p = np.asarray(points, dtype=float).reshape(-1, 3)
        xy, depth = _normalized(p)
        outside = ~((xy * xy).sum(axis=1) <= self.radius**2)
        if outside.any():
            xy[outside] = np.nan
        by_point = np.empty((len(p), 2, 3))
        by_xy = np.array(self._slopes(xy[:, 0], xy[:, 1])).T.reshape(-1, 2, 2)
        by_point[:, :, :2] = self.matrix[:2, :2] @ by_xy
        by_point[:, :, 2] = -(by_point[:, :, :2] * xy[:, None]).sum(axis=2)
        by_point /= depth[:, :, None]
        return self.distort(xy), by_point

    def undistort(self, pixels: ArrayLike) -> Array:
        """
        Return the normalized coordinates (N, 2) = (X/Z, Y/Z) of pixels (N, 2).

        Newton's method on the exact distortion, to 1e-10; NaN if no point projects there.
        """
        pixels = np.asarray(pixels, dtype=float).reshape(-1, 2)
        inverse = np.linalg.inv(self.matrix[:2, :2]).T
        xy = (pixels - self._middle.T) @ inverse
        for _ in range(50):
            # Out of the one-to-one region Newton would wander: hold it at the edge.
            length = np.linalg.norm(xy, axis=1, keepdims=True)
            xy *= np.minimum(1.0, (1.0 - 1e-12) * self.radius / np.maximum(length, 1e-12))
            error = (pixels - self.distort(xy)) @ inverse
            if not np.any(np.abs(error) > 1e-13):
                break
            a, b, c, d = self._slopes(xy[:, 0], xy[:, 1])
            determinant = a * d - b * c
            determinant = np.where(determinant > 1e-12, determinant, np.inf)
            xy += np.stack([d * error[:, 0] - b * error[:, 1],
                            a * error[:, 1] - c * error[:, 0]], axis=1) / determinant[:, None]
        xy[~(np.max(np.abs(error), axis=1, initial=0.0) < 1e-10)] = np.nan
        return xy

    def _radial(self, r2: Any) -> Any:
        """Return the radial factor g(r^2)."""
        if self.model == 'equidistant':
            k1, k2, k3, k4 = self.distortion.tolist()
            r = np.sqrt(np.maximum(r2, _MIN_SQUARED_RADIUS))
            t = np.arctan(r)
            t2 = t * t
            return t * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        k1, k2, _, _, k3, *rational = self.distortion.tolist()
        g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)) if k3 else 1.0 + r2 * (k1 + r2 * k2)
        if rational:
            k4, k5, k6 = rational[:3]
            g = g / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return g

    def _scale(self, r2: Any) -> tuple[Any, Any]:
        """Return the radial factor g(r^2) and its derivative dg / d(r^2)."""
        g = self._radial(r2)
        if self.model == 'equidistant':
            k1, k2, k3, k4 = self.distortion.tolist()
            safe = np.maximum(r2, _MIN_SQUARED_RADIUS)
            t2 = np.arctan(np.sqrt(safe))**2
            slope = 1.0 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            return g, (slope / (1.0 + safe) - g) / (2.0 * safe)
        k1, k2, _, _, k3, *rational = self.distortion.tolist()
        dg = k1 + r2 * (2 * k2 + r2 * (3 * k3))
        if rational:
            k4, k5, k6 = rational[:3]
            m = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
            dg = (dg - g * (k4 + r2 * (2 * k5 + r2 * (3 * k6)))) / m
        return g, dg

    def _slopes(self, x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
        """Return d x' / dx, d x' / dy, d y' / dx and d y' / dy at (x, y)."""
        p1, p2 = self._tangential
        g, dg = self._scale(x * x + y * y)
        across = 2.0 * x * y * dg + 2.0 * (p1 * x + p2 * y)
        slopes = (g + 2.0 * x * x * dg + 2.0 * p1 * y + 6.0 * p2 * x, across, across,
                  g + 2.0 * y * y * dg + 6.0 * p1 * y + 2.0 * p2 * x)
        if self._prism is None and self._tilt is None:
            return slopes
        return self._rare_slopes(x, y, g, slopes)

    def _rare_slopes(self, x: Any, y: Any, g: Any, slopes: tuple[Any, Any, Any, Any]
                     ) -> tuple[Any, Any, Any, Any]:
        """Return the slopes with a thin prism and a tilted sensor."""
        (p1, p2), r2 = self._tangential, x * x + y * y
        s1, s2, s3, s4 = (0.0,) * 4 if self._prism is None else self._prism
        a, b, c, d = slopes
        by_x, by_y = 2.0 * (s1 + 2.0 * s2 * r2), 2.0 * (s3 + 2.0 * s4 * r2)
        a, b, c, d = a + by_x * x, b + by_x * y, c + by_y * x, d + by_y * y
        if self._tilt is None:
            return a, b, c, d
        u = x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + s2 * r2)
        v = y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + s4 * r2)
        (m, n, o), (q, r, s), (t, w, z) = self._tilt.tolist()
        depth = t * u + w * v + z
        across, down = (m * u + n * v + o) / depth, (q * u + r * v + s) / depth
        m, n, q, r = ((m - t * across) / depth, (n - w * across) / depth,
                      (q - t * down) / depth, (r - w * down) / depth)
        return m * a + n * c, m * b + n * d, q * a + r * c, q * b + r * d


def _normalized(points: Array) -> tuple[Array, Array]:
    """Return (X/Z, Y/Z) (N, 2), NaN if a point is behind the camera, and depths (N, 1), m."""
    depth = points[:, 2:]
    if not depth.min(initial=1.0) > 1e-9:
        depth = np.where(depth > 1e-9, depth, np.nan)
    return points[:, :2] / depth, depth


def _tilt(tx: float, ty: float) -> Array:
    """Return the homography (3, 3) onto a sensor tilted about x and then y, rad, as OpenCV's."""
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(tx), np.sin(tx)],
                        [0.0, -np.sin(tx), np.cos(tx)]])
    about_y = np.array([[np.cos(ty), 0.0, -np.sin(ty)], [0.0, 1.0, 0.0],
                        [np.sin(ty), 0.0, np.cos(ty)]])
    turned = about_y @ about_x
    onto = np.array([[turned[2, 2], 0.0, -turned[0, 2]], [0.0, turned[2, 2], -turned[1, 2]],
                     [0.0, 0.0, 1.0]])
    homography: Array = onto @ turned
    return homography


def _reshaped(name: str, values: ArrayLike, shape: tuple[int, int]) -> Array:
    array = np.asarray(values, dtype=float)
    if array.size != shape[0] * shape[1]:
        raise ValueError(f'{name} has {array.size} elements: must have {shape[0] * shape[1]}')
    return array.reshape(shape)


def _checked_matrix(matrix: Array) -> Array:
    if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)):
        raise ValueError(f'K = {matrix.tolist()}: must be 3 x 3 finite numbers')
    if not matrix.any():
        raise ValueError('K = 0: the camera is not calibrated (camera_info carries no matrix)')
    (focal, skew, _), (below, other, _), last = matrix.tolist()
    if not (focal > 0.0 and other > 0.0 and abs(skew) <= focal and below == 0.0
            and last == [0.0, 0.0, 1.0]):
        raise ValueError(f'K = {matrix.tolist()}: must have positive focal lengths, a skew of at '
                         'most the first, 0 below it, and the last row 0 0 1')
    return matrix


def _checked_distortion(distortion: ArrayLike, model: str) -> Array:
    d: Array = np.array(distortion, dtype=float).ravel()
    count = DISTORTION_MODELS[model]
    lengths = [4] if model == 'equidistant' else [4, 5, 8, 12, 14]
    if not np.all(np.isfinite(d)):
        raise ValueError(f'D = {d.tolist()}: must be finite')
    if d.size > count and not d[count:].any():
        d = d[:count]
    if d.size and d.size not in lengths:
        raise ValueError(f'D has {d.size} elements: {model} takes '
                         f'{" or ".join(map(str, lengths))}')
    # Simulators leave D empty; OpenCV writes plumb_bob without k3.
    return d if d.size >= count else np.append(d, np.zeros(count - d.size))
