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
Fits the pose of a marker that motion has blurred so much that its edges run into one another.

If a camera or a marker moves by up to one and a half cells while an image is exposed, the image
has no edges left. But the blur by a motion is known: each point of the image is the mean over a
line in the print. The print, blurred by a vector, is therefore compared with the image: first at
several places and for several vectors, then, from the best of them, by Gauss-Newton on the pose,
the vector and the camera's response to light.

Lengths on a marker are in cells: (0, 0) is the middle of its first black cell, x right, y down.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, skew, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edges import (
    cross,
    moved,
    normal_covariance,
    solve_normal,
    within_reason,
)
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import median
from flock_follower.perception.smear_print import (
    instants_of,
    LENS_BLURS,
    N_FOCUSED,
    SAMPLES_PER_CELL,
    SEARCH_REACH,
    smear_print,
    SmearModel,
)

_LENS = 0.75  # px: blur there is without motion
_AROUND = 0.8  # cells that are white beyond the black border, at least
_LONGEST = 2.4  # cells that motion smears by
_LIKENESS = 0.7  # least correlation from which to start,
_RARER = 0.02  # by so much likelier it must be that it is out of focus
_ALIKE = 0.95  # and of the fit
_MIN_CONTRAST = 10.0  # grey levels
_PASSES = 12
_DAMPED = 3  # of them with steps of the smear halved
_SMALL = 0.02  # rad, and ten times as many cells: a shorter step is the last, but for the first
_LONGEST_TURN = 1.0  # rad, or cells more of smear: a longer step leads nowhere,
_LONGEST_STEP = 0.5  # and so does one by this share of the distance
_MIN_INSIDE = 0.8  # share of the samples that must be in the image
_BLURRED = 0.05  # cells: how well it is known how sharp the lens and the print are
_FLOOR = 1.0  # grey levels: least standard deviation of a sample
_ALIKE_SAMPLES = 1.5  # as many count as one: within a cell they err alike
#: Of the pose (6), the response (6) and the smear (2); a smear of 0 leaves the last open.
_PRIOR = np.diag([0.0] * 12 + [1.0, 1.0])
#: By so much of the contrast (1 sigma) the response is bent further, and light falls unevenly.
_UNEVEN = 0.1
#: By more of the contrast light does not fall off across a marker: the most measured is 0.15.
_STEEPEST = 0.4
_REGULAR = np.diag([0.0] * 9 + [_UNEVEN**-2] * 3 + [0.0, 0.0])


class SmearStart(NamedTuple):
    """Pose, smear and blur to descend from, as in :class:`SmearFit`."""

    pose: Transform
    smear: Array
    lens: int


class SmearFit(NamedTuple):
    """
    A pose that explains a smeared marker.

    ``pose`` is ``T_camera_body``; ``covariance`` (6, 6) is of the position of the marker's middle
    in the camera's optical frame, m, and of the rotation vector r in R_true = exp(r) R. ``rms``
    is the difference between image and print, as a share of the contrast. ``smear`` (2,), cells,
    and ``lens``, an index of :data:`LENS_BLURS`, are the blur found.
    """

    pose: Transform
    covariance: Array
    rms: float
    smear: Array
    lens: int

    @property
    def blur(self) -> float:
        """Return the standard deviation of the blur along the smear, cells."""
        by_lens = float(LENS_BLURS[self.lens])
        return math.sqrt(float(self.smear.dot(self.smear)) / 12.0 + by_lens**2)


def fit_smeared(image: GrayImage, camera: CameraModel, model: SmearModel,
                start: Transform) -> SmearFit | None:
    """
    Return the pose of a marker near ``start``, ``T_camera_body``, or None if it is not there.

    ``start`` may be off by two cells and a half, and a little in all else.
    """
    begin = seek(image, camera, model, start)
    return None if begin is None else descend(image, camera, model, begin)


def seek(image: GrayImage, camera: CameraModel, model: SmearModel,
         start: Transform) -> SmearStart | None:
    """
    Return the pose, shifted, smear and blur with which the print is likest to the image.

    ``start`` may be off by two cells and a half. None if the image resembles the print nowhere.
    """
    seen = _look(image, camera, start.apply(
        model.origin + model.around @ model.axes)) if within_reason(start) else None
    if seen is None:
        return None
    brightness, _ = seen
    size = math.isqrt(len(brightness))
    shown = brightness.reshape(size, size).astype(np.float32)
    likeness = np.stack([cv2.matchTemplate(shown, smeared, cv2.TM_CCOEFF_NORMED)
                         for smeared in model.smeared])
    likeness[~np.isfinite(likeness)] = 0.0
    likeness[[lens >= N_FOCUSED for lens in model.lenses]] -= _RARER
    which, row, column = np.unravel_index(int(likeness.argmax()), likeness.shape)
    if not likeness[which, row, column] > _LIKENESS:
        return None
    shift = (np.array([column, row]) - SEARCH_REACH) / SAMPLES_PER_CELL
    offset = start.rotation @ (shift @ model.axes)
    pose = Transform(start.rotation, start.translation + offset)
    return SmearStart(pose, model.smears[which], model.lenses[which])


def _look(image: GrayImage, camera: CameraModel, points: Array) -> tuple[Array, Any] | None:
    """Return the brightness (s,) at points (s, 3), m, and which are in the image; None if few."""
    if not points[:, 2].min() > 0.05:
        return None
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        return None
    brightness = cv2.remap(image, pixels.astype(np.float32)[:, None], None, cv2.INTER_LINEAR,
                           borderMode=cv2.BORDER_REPLICATE).ravel()
    inside: Any = ((pixels >= 0.0) & (pixels <= (camera.width - 1, camera.height - 1))).all(axis=1)
    if np.count_nonzero(inside) < _MIN_INSIDE * len(inside):
        return None
    return brightness.astype(float), inside


class _Linear(NamedTuple):
    """
    The print at a pose and a smear, and by how much its samples, (s,), change with each unknown.

    ``design`` (s, 14), grey levels per unit of the pose (6), the response (6) and the smear (2);
    ``steep`` (s,), grey levels squared, of how well blur is known. ``usable`` (s,), bool: samples
    in the image that show the marker; ``center`` (3,), m, is about which it turns. ``light``:
    difference between white and black, grey levels.
    """

    brightness: Array
    usable: Any
    design: Array
    steep: Array
    center: Array
    light: float


class _Descent(NamedTuple):
    """
    Residuals, (s,), grey levels, after a step, and the inputs of the step.

    ``light``: difference between white and black; ``response`` (s, 6) to whiteness.
    """

    residual: Array
    fitted: Array
    weights: Array
    information: Array
    light: float
    response: Array


def descend(image: GrayImage, camera: CameraModel, model: SmearModel,
            start: SmearStart) -> SmearFit | None:
    """Return the fit at the least weighted squares near a pose and a smear."""
    pose, smear, lens = start
    weights, variance, response = np.ones(len(model.places)), _FLOOR**2, None
    for count in range(_PASSES):
        lens = _lens_of(camera, model, pose, lens)
        at = _linearize(image, camera, model, SmearStart(pose, smear, lens), response)
        if at is None:
            return None
        # The steeper it is, the more the true blur of lens and cells matters.
        weights = weights * at.usable / (variance + at.steep)
        weighted = at.design * weights[:, None]
        information = weighted.T.dot(at.design) + _PRIOR + (
            _REGULAR / max(at.light, _MIN_CONTRAST)**2)
        # Smears to either side of an axis look alike: a whole step from one leads to the other.
        held = information + information * _PRIOR if count < _DAMPED else information
        step = solve_normal(held, weighted.T.dot(at.brightness))
        if step is None:
            return None
        response = step[6:9].tolist()
        turn, offset = float(np.abs(step[3:6]).max()), float(np.abs(step[:3]).max())
        smear, smeared = smear + step[-2:], float(np.abs(step[-2:]).max())
        if (not max(turn, smeared) < _LONGEST_TURN or response[0] <= 0.0
                or offset > _LONGEST_STEP * at.center[2] or math.hypot(*smear) > _LONGEST):
            return None
        pose = moved(pose, at.center, step)
        residual = at.brightness - at.design.dot(step)
        if count > 2 and turn < _SMALL and max(offset / model.cell, smeared) < 10.0 * _SMALL:
            break
        squares = residual * residual
        variance = max(1.4826**2 * median(squares), _FLOOR**2)
        weights = np.maximum(1.0 - squares / (25.0 * (variance + at.steep)), 0.0)**2
    else:
        return None
    if math.hypot(*step[10:12].tolist()) > _STEEPEST * response[0]:
        return None
    columns = at.design[:, 6:12]
    return _checked(model, SmearStart(pose, smear, lens), _Descent(
        residual, columns.dot(step[6:12]), weights, information, response[0], columns))


def _lens_of(camera: CameraModel, model: SmearModel, pose: Transform, lens: int) -> int:
    """Return the index of the blur of a lens in focus at a pose; one out of focus stays."""
    if lens >= N_FOCUSED:
        return lens
    depth = float(pose.apply(model.middle[None])[0, 2])
    blur = _LENS * depth / (camera.matrix[0, 0] * model.cell)
    return int(np.abs(LENS_BLURS[:N_FOCUSED] - blur).argmin())


def _linearize(image: GrayImage, camera: CameraModel, model: SmearModel, start: SmearStart,
                response: list[float] | None) -> _Linear | None:
    """
    Return the print near ``start``; None if the image does not show it.

    :param response: difference between white and black, black, and bend, grey levels; None: they
        are fitted to the image.
    """
    pose, smear, lens = start
    points, center = pose.apply(model.on_body), pose.apply(model.middle[None])[0]
    seen = _look(image, camera, points)
    if seen is None:
        return None
    brightness, inside = seen
    # What lies beyond the white around the marker is smeared into its rim.
    usable = inside & (model.from_middle + 0.5 * np.abs(smear) < 0.5 * model.cells + _AROUND
                       ).all(axis=1)
    white, by_place, by_smear = smear_print(
        model.printed[lens], model.places, smear, LENS_BLURS[lens])
    design = np.empty((len(white), 14))
    # Gamma and over-exposure bend what would be straight; light falls unevenly.
    bent = white * (1.0 - white)
    design[:, 6], design[:, 7], design[:, 8] = white, 1.0, bent
    design[:, 9] = bent * (1.0 - 2.0 * white)
    design[:, 10:12] = white[:, None] * model.across
    if response is None:
        columns = design[:, 6:12]
        first = solve_normal(columns.T.dot(columns), columns.T.dot(brightness))
        if first is None:
            return None
        response = first[:3].tolist()
    slope = (response[0] + response[2] * (1.0 - 2.0 * white))[:, None]
    by_place = slope * by_place
    design[:, :3] = _by_point(pose, model, points, by_place)
    design[:, 3:6] = cross(points - center, design[:, :3])
    design[:, 12:] = slope * by_smear
    steep = _BLURRED**2 * (by_place * by_place).sum(axis=1)
    return _Linear(brightness, usable, design, steep, center, response[0])


def _by_point(pose: Transform, model: SmearModel, points: Array, by_place: Array) -> Array:
    """Return by how much brightness grows as points (s, 3) move, per m, from that per cell."""
    right, down = (skew(axis) for axis in model.axes @ pose.rotation.T)
    # As the marker moves by v, at a pixel is the place r, d before: v = r right + d down + ray.
    across = points.dot(right.dot(down[[2, 0, 1], [1, 2, 0]]))
    moved_by: Array = (by_place[:, 1:] * points.dot(right.T)
                       - by_place[:, :1] * points.dot(down.T)) / across[:, None]
    return moved_by


def _checked(model: SmearModel, end: SmearStart, last: _Descent) -> SmearFit | None:
    """Return a fit, None if it does not show the marker's code."""
    weights, contrast = last.weights, float(np.ptp(last.fitted))
    shown = last.fitted + last.residual
    spread = float(weights.dot((shown - weights.dot(shown) / max(weights.sum(), 1e-9))**2))
    left = float(weights.dot(last.residual**2))
    if (contrast < _MIN_CONTRAST or not left < (1.0 - _ALIKE**2) * spread
            or not _shows_code(model, end, last)):
        return None
    chi2 = max(left / max(np.count_nonzero(weights) - len(_PRIOR), 1), 1.0)
    covariance = normal_covariance(last.information / (chi2 * _ALIKE_SAMPLES))
    if covariance is None:
        return None
    return SmearFit(end.pose, covariance[:6, :6], math.sqrt(
        left / max(float(weights.sum()), 1e-9)) / contrast, end.smear, end.lens)


def _shows_code(model: SmearModel, end: SmearStart, last: _Descent) -> bool:
    """Return whether no word suits the image better, and few cells were better turned."""
    instants = instants_of(end.smear, LENS_BLURS[end.lens])
    at = np.rint(model.places + instants[:, None, None] * end.smear).astype(int)
    inner, count = model.cells - 2, len(model.places)
    within = ((at >= 1) & (at <= inner)).all(axis=2)
    cell = (at[..., 1] - 1) * inner + at[..., 0] - 1
    index = cell * count + np.arange(count)
    share = np.bincount(index[within], minlength=inner * inner * count).reshape(
        inner * inner, count) / len(instants)  # of each sample, how much is of each cell
    own = model.codes[0]
    turned = (1.0 - 2.0 * own)[:, None] * share * last.light
    # What turning cells adds to the squares left, once the response is fitted anew.
    basis = np.linalg.qr(last.response)[0]
    turned = turned - turned.dot(basis).dot(basis.T)
    by_residual, together = turned.dot(last.residual), turned.dot(turned.T)
    if np.count_nonzero(together.diagonal() <= 2.0 * by_residual) > model.errors:
        return False
    flips = np.abs(model.codes[1:] - own)
    added = (flips.dot(together) * flips).sum(axis=1) - 2.0 * flips.dot(by_residual)
    return bool((added > 0.0).all())
