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
Comparison of image motion with odometry: finds wrong axes, clock, mounting, and focal length.

If a camera turns by a small rotation vector r (camera axes: x right, y down, z ahead), its image
moves by (-f r_y, f r_x) px at any distance of the scene. A translation d adds (-f d_x, -f d_y) /
depth, with a smaller mean. So the shift between two images gives two of the three components of r.
Many pairs of images give the rotation between body and camera: of the 24 rotations that map three
axes to three axes, the rotation that explains the shifts best. A least-squares fit then gives the
remaining small rotation, and the ratio of measured to expected shifts, which is the error of the
focal length.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import permutations, product
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, skew
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.images import GrayImage

#: Width, px, to which images are scaled for the comparison.
COMPARED_WIDTH = 192
#: Rows of parts that an image is divided into.
PART_ROWS = 2
#: Columns of parts that an image is divided into.
PART_COLUMNS = 3
#: Least quality of a match, 0 to 1.
MIN_RESPONSE = 0.05
#: Number of pairs that a result needs.
MIN_PAIRS = 12
#: RMS shift of the pairs that a result needs, as a share of the focal length.
MIN_SHIFT = 0.003
#: Largest time offset that is tried, s.
MAX_OFFSET = 0.2
#: Step of the time offsets that are tried, s.
OFFSET_STEP = 0.01
#: The 24 rotations that lay axes onto axes, the identity first.
_AXIS_ROTATIONS = [matrix for p in permutations(range(3))
                   for signs in product((1.0, -1.0), repeat=3)
                   if np.linalg.det(matrix := np.diag(signs)[list(p)]) > 0.0]

#: Prior deviations of the mounting, rad, of the ratio of the shifts, and of 1 / depth of each
#: part, 1/m.
PRIOR_DEVIATIONS = np.array([0.5, 0.5, 0.5, 1.0, *[0.5] * (PART_ROWS * PART_COLUMNS)])
#: Measured errors were up to this many times the deviations.
ERROR_FACTOR = 2.0
#: Least deviation of the ratio of focal lengths.
ZOOM_ERROR = 0.03
#: Deviation of 1 / depth, as a share of it.
DEPTH_DEVIATION = 1.0
#: Least pitch as a share of yaw: turned by hand, the camera moves on an arc, which looks like a
#: longer focal length near walls, unless it pitches, too.
MIN_PITCH_SHARE = 0.2
_FIT_PASSES = 8  # reweighted fits
_OUTLIER_SIGMAS = 2.0  # scale of the weights, in medians of the residuals
#: s: between attitudes farther apart the rotation is unknown.
MAX_GAP = 0.3


class OwnPath:
    """The ego motion: the states of the odometry, in the order of their stamps."""

    def __init__(self, states: Sequence[OdometryState]) -> None:
        quaternions = np.array([state.quaternion for state in states])
        turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
        same = np.concatenate([[1.0], np.cumprod(np.where(turned, -1.0, 1.0))])
        self._stamps = np.array([state.stamp for state in states]) / NANOSECONDS
        self._quaternions = quaternions * same[:, None]
        self._states = states

    @cached_property
    def _motion(self) -> Array:
        """Return positions, m, and velocities in base_link, m/s, as rows (n, 6)."""
        velocities = np.array([state.velocity for state in self._states])
        rotations = np.array([state.twist_rotation for state in self._states])
        return np.column_stack([np.array([state.position for state in self._states]),
                                np.einsum('ni,nij->nj', velocities, rotations)])

    def attitude(self, times: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return attitudes (m, 4) at stamps (m,), s, and which of them are known (m,)."""
        stamps = self._stamps
        after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
        span = stamps[after] - stamps[after - 1]
        part = (times - stamps[after - 1]) / np.where(span > 0.0, span, 1.0)
        mixed = ((1.0 - part)[:, None] * self._quaternions[after - 1]
                 + part[:, None] * self._quaternions[after])
        known = (part >= 0.0) & (part <= 1.0) & (span <= MAX_GAP)
        return mixed / np.linalg.norm(mixed, axis=1, keepdims=True), known

    def motion(self, times: Array) -> tuple[Array, Array]:
        """Return positions (m, 3), m, in odom, and velocities (m, 3), m/s, in base_link."""
        rows = np.column_stack([np.interp(times, self._stamps, column)
                                for column in self._motion.T])
        return rows[:, :3], rows[:, 3:]


def small(image: GrayImage) -> Array:
    """Return an image reduced to ``COMPARED_WIDTH`` px, the input of :func:`measure_shifts`."""
    while image.shape[1] >= 2 * COMPARED_WIDTH:  # halving is the fastest
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    height, width = image.shape
    size = COMPARED_WIDTH, max(round(height * COMPARED_WIDTH / width), 16)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def measure_shifts(before: Array, after: Array, width: int) -> Array:
    """
    Return the shift of each part of the image right and down, px at ``COMPARED_WIDTH``.

    The result is (PARTS, 3); the last column is the quality. Between two windows at the same place
    a large shift is measured too small. So the windows are compared again, displaced by the
    measured shift.
    """
    found = np.zeros((PART_ROWS * PART_COLUMNS, 3))
    if before.shape != after.shape:
        return found
    height, columns = before.shape[0] // PART_ROWS, COMPARED_WIDTH // PART_COLUMNS
    window = cv2.createHanningWindow((columns, height), cv2.CV_32F)
    last = np.array([COMPARED_WIDTH - columns, before.shape[0] - height])
    for n, (row, column) in enumerate(product(range(PART_ROWS), range(PART_COLUMNS))):
        first = second = np.array([column * columns, row * height])
        while True:
            old, new = (image[y:y + height, x:x + columns]
                        for image, (x, y) in ((before, first), (after, second)))
            more, quality = cv2.phaseCorrelate(old - old.mean(), new - new.mean(), window)
            found[n] = *(second - first + more), quality
            shift = np.rint(found[n, :2]).astype(int)
            if second is not first or not shift.any():
                break
            second = np.clip(first + shift, 0, last)
            first = np.clip(second - shift, 0, last)
    return found * [width / COMPARED_WIDTH, width / COMPARED_WIDTH, 1.0]


class AxesFit(NamedTuple):
    """
    Shares of the squared shifts that rotation explains, up to 1.

    ``configured`` is the share with the configured axes, ``best`` the share with the best rotation
    ``turn`` (3, 3), R_base_configured (the identity if no rotation is better); each with its own
    best time offset. ``mounting`` (3,), rad, is the remaining rotation along base_link's axes:
    beyond ``turn``, the camera is rotated by exp(mounting) from its configured attitude. With
    ``mounting``, ``explained`` is the share at the best ``offset``, s (stamps of the camera minus
    stamps of the odometry), and ``together`` the share without offset. ``zoom`` is the ratio of
    the measured shifts to the shifts expected from the calibration.
    """

    configured: float
    best: float
    turn: Array
    offset: float
    explained: float
    together: float
    mounting: Array
    mounting_deviations: Array
    zoom: float
    zoom_deviation: float


def fit_axes(shifts: Sequence[Sequence[float]], path: OwnPath, camera: CameraModel,
             R_base_optical: Array, up: Array | None = None) -> AxesFit | None:
    """
    Return the fit of the axes, or None if the images hardly moved.

    :param shifts: rows of stamp before, stamp after, and the numbers of :func:`measure_shifts`.
    :param up: (3,), the measured upward direction in base_link as configured: only the identity,
        and rotations of ``up`` to z, are tried. None: ``up`` is z, and all rotations are tried.
    """
    every = np.array(shifts).reshape(-1, 2 + 3 * PART_ROWS * PART_COLUMNS)
    # The leader may fill one part, so the median stands for the image.
    median = np.median(every[:, 2:].reshape(-1, PART_ROWS * PART_COLUMNS, 3), axis=1)
    rows = np.column_stack([every[:, :2], median[:, :2] / camera.matrix[0, 0], every[:, 2:]])[
        median[:, 2] >= MIN_RESPONSE]
    if len(rows) < MIN_PAIRS or np.sqrt(np.mean(np.sum(rows[:, 2:4]**2, axis=1))) < MIN_SHIFT:
        return None
    turns = np.array([turn for n, turn in enumerate(_AXIS_ROTATIONS)
                      if n == 0 or up is None or turn[2].dot(up) > 0.5])
    to_optical = turns.transpose(0, 2, 1) @ R_base_optical
    offsets = np.arange(-MAX_OFFSET, MAX_OFFSET + 1e-9, OFFSET_STEP)
    moves = [_base_rotations(rows, path, offset) for offset in offsets.tolist()]
    shares = _shares(moves, to_optical)
    if shares.max() < 0.0:
        return None
    # If several are equal, as when it only turned about one axis, the configured one wins.
    best = 0 if shares[:, 0].max() > shares.max() - 1e-6 else int(shares.max(axis=0).argmax())
    R, curve = to_optical[best], shares[:, best]
    for _ in range(2):  # an error of the mounting looks like an offset, too
        offset = _parabola_peak(offsets, curve)
        turned, known = _base_rotations(rows, path, offset)
        moved = np.diff(known[:, :2]) * path.motion(known[:, :2].mean(axis=1) - offset)[1]
        solution, covariance = _fit_mounting(
            turned @ R, moved @ R, known[:, 4:].reshape(-1, PART_ROWS * PART_COLUMNS, 3), camera)
        curve = _shares(moves, R @ rotation_vector_to_matrix(solution[:3]))
    rates = np.sqrt(np.mean((turned @ R)[:, :2]**2, axis=0))
    error = ZOOM_ERROR if rates.min() > MIN_PITCH_SHARE * rates.max() else 1.0
    return AxesFit(
        float(shares[:, 0].max()), float(shares.max()), turns[best], offset, float(curve.max()),
        float(curve[len(offsets) // 2]), R @ solution[:3],
        ERROR_FACTOR * np.sqrt((R @ covariance[:3, :3] @ R.T).diagonal()), float(solution[3]),
        math.hypot(ERROR_FACTOR * math.sqrt(covariance[3, 3]), error))


def _fit_mounting(turned: Array, moved: Array, parts: Array, camera: CameraModel
                  ) -> tuple[Array, Array]:
    """
    Return mounting (3,), rad, zoom and each 1 / depth by least squares; covariance of the first 4.

    :param turned: rotation vectors (n, 3), rad; :param moved: displacements (n, 3), m, both in
        optical axes as configured. :param parts: their shifts (n, PARTS, 3).
    """
    x, y = ((np.arange(count) + 0.5) * size / count
            for count, size in ((PART_COLUMNS, camera.width), (PART_ROWS, camera.height)))
    middles = camera.undistort(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    rays = np.column_stack([middles, np.ones(len(middles))])
    by_point = camera.linearize(rays)[1] / camera.matrix[0, 0]
    by_turn = by_point @ np.array([skew(ray) for ray in rays])
    seen, good = parts[:, :, :2] / camera.matrix[0, 0], parts[:, :, 2] >= MIN_RESPONSE
    start = solution = (np.arange(len(PRIOR_DEVIATIONS)) == 3).astype(float)
    prior = np.diag(PRIOR_DEVIATIONS**-2)
    by_depth = (by_point @ moved[:, None, :, None]) * -np.eye(len(rays))[:, None]
    for _ in range(_FIT_PASSES):
        vectors = turned @ rotation_vector_to_matrix(solution[:3])
        by_mounting = np.array([skew(vector) for vector in vectors])
        design = np.concatenate([  # (n, PARTS, 2, 4 + PARTS)
            solution[3] * by_turn @ by_mounting[:, None],
            by_turn @ vectors[:, None, :, None], by_depth], axis=3)
        off = seen - design[..., 3:] @ solution[3:]
        length = np.linalg.norm(off, axis=2)
        # A part that shows the leader has no weight.
        scale = _OUTLIER_SIGMAS * np.median(length[good]) + 1e-5
        weights = good / (1.0 + (length / scale)**2)**2
        weights *= 2.0 * weights.sum() / max(float(np.sum(weights * length**2)), 1e-9)
        information = np.einsum('nkim,nk,nkil->ml', design, weights, design) + prior
        moment = np.einsum('nkim,nk,nki->m', design, weights, off + design @ solution)
        solution = np.linalg.solve(information, moment + prior @ start)
    # In a room the depths change as the camera turns: the effect on the rest of all alike.
    effect = DEPTH_DEVIATION * float(np.sqrt(np.mean(solution[4:]**2))) * np.linalg.solve(
        information[:4, :4], information[:4, 4:]).sum(axis=1)
    return solution, np.linalg.inv(information)[:4, :4] + np.outer(effect, effect)


def _base_rotations(rows: Array, path: OwnPath, offset: float) -> tuple[Array, Array]:
    """Return rotation vectors in base_link (n, 3), and the rows for which they are known."""
    (q1, known1), (q2, known2) = (path.attitude(rows[:, k] - offset) for k in (0, 1))
    known = known1 & known2
    v1, w1, v2, w2 = q1[known, :3], q1[known, 3:], q2[known, :3], q2[known, 3:]
    turned = w1 * v2 - w2 * v1 - np.cross(v1, v2)
    cosine = w1 * w2 + np.sum(v1 * v2, axis=1, keepdims=True)
    # The angle between two images is so small that it equals its sine.
    return 2.0 * np.sign(cosine) * turned, rows[known]


def _shares(moves: Sequence[tuple[Array, Array]], R_base_optical: Array) -> Array:
    """
    Return the shares of the squares of the shifts that rotation explains, to scale, or -1.

    :param R_base_optical: rotation, or rotations, (..., 3, 3).
    """
    shares = np.full((len(moves), *R_base_optical.shape[:-2]), -1.0)
    for n, (turned, known) in enumerate(moves):
        if len(known) >= MIN_PAIRS:
            expected = (turned @ R_base_optical)[..., 1::-1] * [-1.0, 1.0]
            together = np.sum(expected * known[:, 2:4], axis=(-2, -1))
            squares = np.sum(expected**2, axis=(-2, -1)) * np.sum(known[:, 2:4]**2)
            shares[n] = together * np.abs(together) / np.maximum(squares, 1e-30)
    return shares


def _parabola_peak(offsets: Array, curve: Array) -> float:
    """Return the maximum of the parabola through the three points about the peak."""
    peak = min(max(int(curve.argmax()), 1), len(curve) - 2)
    before, top, after = curve[peak - 1:peak + 2].tolist()
    bend = min(before - 2.0 * top + after, -1e-12)
    return float(offsets[peak] + min(max(0.5 * (before - after) / bend, -1.0), 1.0) * OFFSET_STEP)
