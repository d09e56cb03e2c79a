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
Comparison of image motion with the odometry's rotation: finds wrong axes and a time offset.

A camera that turns by a small rotation vector r (its own axes: x right, y down, z ahead) sees the
scene move by (-f r_y, f r_x) px, at any distance. The camera's translation adds a shift with a
smaller mean. So the shift of the middle of the image gives two of the three components of r
for each pair of images. Many pairs give the rotation between body and camera: of the 24 rotations
that lay three axes onto three others, the one that explains the shifts best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations, product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array
from flock_follower.perception.images import GrayImage

#: Width, px, to which images are scaled for the comparison; rows and columns of parts.
WIDTH = 192
ROWS, COLUMNS = 2, 3
#: Least quality of a match, 0 to 1.
RESPONSE = 0.05
#: Number of pairs, and their RMS shift as a share of the focal length, needed for a result.
FEW = 12
LEAST = 0.003
#: Largest time offset that is tried, and the step, s.
FURTHEST, STEP = 0.2, 0.01
#: The 24 rotations that lay axes onto axes, the identity first.
_QUARTER_TURNS = [matrix for p in permutations(range(3))
                  for signs in product((1.0, -1.0), repeat=3)
                  if np.linalg.det(matrix := np.diag(signs)[list(p)]) > 0.0]

#: Returns attitudes (m, 4) at stamps (m,), s, and where they are known (m,).
Attitude = Callable[[Array], tuple[Array, NDArray[np.bool_]]]


def small(image: GrayImage) -> Array:
    """Return an image reduced to ``WIDTH`` px, the input of :func:`shift`."""
    height, width = image.shape
    size = WIDTH, max(round(height * WIDTH / width), 16)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def shift(before: Array, after: Array, width: int) -> tuple[float, float, float]:
    """
    Return the shift of the scene right and down, px of images of that width, and its quality.

    The shift is the median over the parts of the image: the leader may fill one of them.
    """
    if before.shape != after.shape:
        return 0.0, 0.0, 0.0
    height, columns = before.shape[0] // ROWS, WIDTH // COLUMNS
    window = cv2.createHanningWindow((columns, height), cv2.CV_32F)
    found = []
    for row, column in product(range(ROWS), range(COLUMNS)):
        part = np.s_[row * height:(row + 1) * height, column * columns:(column + 1) * columns]
        (right, down), quality = cv2.phaseCorrelate(
            before[part] - before[part].mean(), after[part] - after[part].mean(), window)
        found.append((right, down, quality))
    right, down, quality = np.median(found, axis=0).tolist()
    scale = width / WIDTH
    return right * scale, down * scale, quality


class AxesFit(NamedTuple):
    """
    Shares of the squared shifts that rotation explains, up to 1.

    ``configured`` is the share with the configured axes, ``best`` that with the best rotation
    ``turn`` (3, 3), R_base_configured, the identity if none is better; each with the time offset
    that suits it. ``offset``, s, is that of ``best``: the camera's stamps minus those of the
    odometry; ``together`` is the share without an offset. ``zoom``: ratio of the shifts to those
    expected from the focal length, ``zoomed`` the share with that ratio.
    """

    configured: float
    best: float
    turn: Array
    offset: float
    together: float
    zoom: float
    zoomed: float


def fit_axes(shifts: Sequence[Sequence[float]], attitude: Attitude, focal: float,
             R_base_optical: Array, up: Array | None = None) -> AxesFit | None:
    """
    Return how the axes fit, or None if the images hardly moved.

    :param shifts: rows of stamp before, stamp after, shift right and down, px, and its quality.
    :param attitude: returns ``q_odom_base``, see :func:`interpolated`.
    :param focal: focal length, px.
    :param up: (3,), the upward direction in base_link as configured: besides the identity only
        rotations that make it z are tried. None: it is z already, and all rotations are tried.
    """
    rows = np.array([row for row in shifts if row[4] >= RESPONSE]).reshape(-1, 5)
    if len(rows) < FEW or np.sqrt(np.mean(np.sum(rows[:, 2:4]**2, axis=1))) < LEAST * focal:
        return None
    turns = [turn for n, turn in enumerate(_QUARTER_TURNS)
             if n == 0 or up is None or turn[2].dot(up) > 0.5]
    offsets = np.arange(-FURTHEST, FURTHEST + 1e-9, STEP)
    shares = np.full((len(offsets), len(turns)), -1.0)
    for n, offset in enumerate(offsets.tolist()):
        turned, seen = _turned(rows, attitude, offset)
        if len(seen) >= FEW:
            shares[n] = [_share(_expected(turned @ turn.T @ R_base_optical, focal), seen)
                         for turn in turns]
    if shares.max() < 0.0:
        return None
    # If several are equal, as when it only turned about one axis, the configured one wins.
    best = 0 if shares[:, 0].max() > shares.max() - 1e-6 else int(shares.max(axis=0).argmax())
    curve = shares[:, best]
    peak = int(curve.argmax())
    offset = _summit(offsets, curve, peak)
    turned, seen = _turned(rows, attitude, offset)
    expected = _expected(turned @ turns[best].T @ R_base_optical, focal)
    zoom = float(np.sum(expected * seen) / np.sum(expected**2))
    return AxesFit(float(shares[:, 0].max()), float(curve[peak]), turns[best], offset,
                   float(curve[len(offsets) // 2]), zoom, _share(zoom * expected, seen))


def _turned(rows: Array, attitude: Attitude, offset: float) -> tuple[Array, Array]:
    """Return rotation vectors in base_link (n, 3), and shifts (n, 2), if both are known."""
    (q1, known1), (q2, known2) = (attitude(rows[:, k] - offset) for k in (0, 1))
    known = known1 & known2
    v1, w1, v2, w2 = q1[known, :3], q1[known, 3:], q2[known, :3], q2[known, 3:]
    turned = w1 * v2 - w2 * v1 - np.cross(v1, v2)
    cosine = w1 * w2 + np.sum(v1 * v2, axis=1, keepdims=True)
    # The angle between two images is so small that it equals its sine.
    return 2.0 * np.sign(cosine) * turned, rows[known, 2:4]


def _expected(turned: Array, focal: float) -> Array:
    """Return the shifts (n, 2) by rotation vectors (n, 3) in optical axes."""
    return focal * np.column_stack([-turned[:, 1], turned[:, 0]])


def _share(expected: Array, seen: Array) -> float:
    """Return the share of the squares of the shifts that the expected ones explain."""
    return 1.0 - float(np.sum((seen - expected)**2) / np.sum(seen**2))


def _summit(offsets: Array, curve: Array, peak: int) -> float:
    """Return the maximum of the parabola through the three points about the peak."""
    if not 0 < peak < len(curve) - 1:
        return float(offsets[peak])
    before, top, after = curve[peak - 1:peak + 2].tolist()
    bend = before - 2.0 * top + after
    return float(offsets[peak]) + (0.0 if bend >= 0.0 else STEP * 0.5 * (before - after) / bend)


def interpolated(stamps: Array, quaternions: Array, longest: float = 0.3) -> Attitude:
    """
    Return a function that interpolates attitudes (n, 4) at ``stamps`` (n,), s, in order.

    An attitude is known between two that are at most ``longest`` s apart.
    """
    same = np.cumprod(np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0, -1, 1))
    smooth = quaternions * np.concatenate([[1.0], same])[:, None]

    def attitude(wanted: Array) -> tuple[Array, NDArray[np.bool_]]:
        after = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1)
        span = stamps[after] - stamps[after - 1]
        part = (wanted - stamps[after - 1]) / np.where(span > 0.0, span, 1.0)
        mixed = (1.0 - part)[:, None] * smooth[after - 1] + part[:, None] * smooth[after]
        known = (part >= 0.0) & (part <= 1.0) & (span <= longest)
        return mixed / np.linalg.norm(mixed, axis=1, keepdims=True), known
    return attitude
