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
Fits the pose of a marker that motion has blurred so much that its edges overlap.

If a camera or a marker moves by one to three cells during the exposure, the image has no sharp
edges. But the effect of motion is known: each point of the image is the mean over a line in
the print. So the print, blurred along a vector, is compared with the image: first at several
places and for several vectors; then, from the best of them, Gauss-Newton refines the pose, the
vector and the camera's response to light.

Lengths on a marker are in cells: (0, 0) is the middle of its first black cell, x right, y down.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edges import (
    apply_step,
    has_converged,
    normal_covariance,
    solve_normal,
)
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import median
from flock_follower.perception.smear_print import (
    instants_of,
    LENS_BLURS,
    N_FOCUSED,
    NEAR_REACH,
    SAMPLES_PER_CELL,
    SEARCH_REACH,
    smear_print,
    SmearModel,
)

#: Blur without motion, px (1 sigma).
_LENS_BLUR = 0.75
#: White beyond the black border, at least, cells.
_WHITE_AROUND = 0.8
#: Longest smear by motion, cells.
_MAX_SMEAR = 3.2
#: Least correlation of image and print from which to descend.
_MIN_LIKENESS = 0.7
#: Correlation by which a defocused print must win.
_DEFOCUS_PENALTY = 0.02
#: Least correlation of image and print at the end.
_MIN_FIT_LIKENESS = 0.95
#: Least difference of white and black, gray levels.
_MIN_CONTRAST = 10.0
#: Most steps of a descent.
MOST_STEPS = 10
#: First steps, in which that of the smear is halved: from a smear that is only roughly known.
_DAMPED_PASSES = 2
#: First steps of a descent from the smear of another fit, whose weights are not yet those of it.
_KNOWN_PASSES = 1
#: With the third step, the most of the image's variance that the print may leave unexplained. Of
#: descents that end in a fit 99 % have less than 0.04 there, of others 90 % more than 0.26.
_MAX_UNEXPLAINED = 0.2
#: After a step that turns by less, rad, the slopes of the print serve for the next one, too.
_SAME_SLOPES_TURN = 0.06
#: The same for a step of the pose, cells.
_SAME_SLOPES_SHIFT = 0.2
#: The same for a step of the smear, cells: the print is not rendered again with the smear found.
_SAME_SLOPES_SMEAR = 0.02
#: With the slopes of the step before, and from the smear of another fit, whose first step is not
#: halved, the last step must be this many times shorter.
_CLOSER_FACTOR = 2.0
#: A step that turns by less, rad, may be the last.
_LAST_TURN = 0.02
#: A step of pose and smear that is shorter, cells, may be the last.
_LAST_SHIFT = 0.2
#: A step that turns by more, rad, or smears by more, cells, is refused.
_MAX_TURN = 1.0
#: A step that is longer than this share of the distance is refused.
_MAX_STEP_SHARE = 0.5
#: Least depth of a sample, m.
_MIN_DEPTH = 0.05
#: Least share of the samples that are in the image.
_MIN_INSIDE = 0.8
#: Error of the blur of lens and print, cells (1 sigma).
_BLUR_ERROR = 0.05
#: Least variance of a sample, squared gray levels.
_MIN_VARIANCE = 1.0
#: Samples whose errors count as one: within a cell they err alike.
_ALIKE_SAMPLES = 1.5
#: Added to normal equations of the response, samples: they stay definite.
_RIDGE = 1e-9 * np.eye(6)
#: Prior of the pose (6), the response (6) and the smear (2): a smear of 0 leaves the last open.
_PRIOR_INFORMATION = np.diag([0.0] * 12 + [1.0, 1.0])
#: Further bend of the response and uneven light, share of the contrast (1 sigma).
_UNEVEN_LIGHT = 0.1
#: Most fall-off of light across a marker, share of the contrast: the most measured is 0.15.
_MAX_FALL_OFF = 0.4
#: Prior of the bend of the response and of the fall-off of light, times the squared contrast.
_REGULAR_INFORMATION = np.diag([0.0] * 9 + [_UNEVEN_LIGHT**-2] * 3 + [0.0, 0.0])


class SmearStart(NamedTuple):
    """Pose, smear and blur at which the descent begins, as in :class:`SmearFit`."""

    pose: Transform
    smear: Array
    lens: int


class SmearFit(NamedTuple):
    """
    A pose that explains a smeared marker.

    ``pose`` is ``T_camera_body``; ``covariance`` (6, 6) is of the position of the marker's middle
    in the camera's optical frame, m, and of the rotation vector r in R_true = exp(r) R. ``rms``
    is the difference between image and print, as a share of the contrast. ``smear`` (2,), cells,
    and ``lens``, an index of :data:`LENS_BLURS`, are the blur found, after ``steps`` steps.
    """

    pose: Transform
    covariance: Array
    rms: float
    smear: Array
    lens: int
    steps: int

    @property
    def blur(self) -> float:
        """Return the standard deviation of the blur along the smear, cells."""
        by_lens = float(LENS_BLURS[self.lens])
        return math.sqrt(float(self.smear.dot(self.smear)) / 12.0 + by_lens**2)


def fit_smeared(image: GrayImage, camera: CameraModel, model: SmearModel,
                start: Transform) -> SmearFit | None:
    """
    Return the pose of a marker near ``start``, ``T_camera_body``, or None if it is not there.

    ``start`` may be off by two cells and a half in the image plane, and by a little otherwise.
    """
    begin = seek(image, camera, model, start)
    return None if begin is None else descend(image, camera, model, begin)


def seek(image: GrayImage, camera: CameraModel, model: SmearModel,
         start: Transform, near: bool = False) -> SmearStart | None:
    """
    Return the shifted pose, smear and blur with which the print correlates best.

    ``start`` may be off by two cells and a half. None if no part of the image resembles the print.

    :param near: whether ``start`` is probably off by less than a cell: a search there is cheaper.
    """
    if not has_converged(start):
        return None
    found = _seek_within(image, camera, model, start, NEAR_REACH) if near else None
    return found or _seek_within(image, camera, model, start, SEARCH_REACH)


def _seek_within(image: GrayImage, camera: CameraModel, model: SmearModel, start: Transform,
                 reach: int) -> SmearStart | None:
    """Return what :func:`seek` does; of a shorter reach than the longest none at its rim."""
    seen = _look(image, camera, _basis(start, model), model.around[reach])
    if seen is None:
        return None
    likeness = _likeness(seen.brightness, model)
    likeness[:, [lens >= N_FOCUSED for lens in model.lenses]] -= _DEFOCUS_PENALTY
    place, which = divmod(int(likeness.argmax()), len(model.lenses))
    if not likeness[place, which] > _MIN_LIKENESS:
        return None
    row, column = divmod(place, 2 * reach + 1)
    steps = np.array([column, row]) - reach
    if reach < SEARCH_REACH and np.abs(steps).max() == reach:
        return None
    offset = start.rotation @ (steps / SAMPLES_PER_CELL @ model.axes)
    pose = Transform(start.rotation, start.translation + offset)
    return SmearStart(pose, model.smears[which], model.lenses[which])


def _likeness(brightness: Array, model: SmearModel) -> Array:
    """Return the correlation of each place, row by row, with each smeared print, (p, t)."""
    size = math.isqrt(len(brightness))
    shown = (brightness - brightness.mean()).astype(np.float32).reshape(size, size)
    side = math.isqrt(model.smeared.shape[1])
    patches = sliding_window_view(shown, (side, side)).reshape(-1, side * side)
    mean = patches.mean(axis=1)
    spread = np.einsum('ps,ps->p', patches, patches) - side * side * mean * mean
    # A smeared print has mean 0 and norm 1.
    return np.asarray(patches.dot(model.smeared.T) / np.sqrt(np.maximum(spread, 1.0))[:, None])


class _Seen(NamedTuple):
    """
    The brightness of samples in an image, (s,), gray levels.

    ``inside`` (s,), bool: which are in the image; None if all are.
    """

    brightness: Array
    inside: Any


def _basis(pose: Transform, model: SmearModel) -> Array:
    """Return a step to the right, one down, and the place (0, 0), (3, 3), m, as columns."""
    basis = np.empty((3, 3))
    basis[:, :2] = pose.rotation.dot(model.axes.T)
    basis[:, 2] = pose.rotation.dot(model.origin) + pose.translation
    return basis


def _look(image: GrayImage, camera: CameraModel, basis: Array, places: Array) -> _Seen | None:
    """Return the brightness at places (3, s) on a marker; None if too few are in the image."""
    points = basis.dot(places)
    if not np.minimum.reduce(points[2]) > _MIN_DEPTH:
        return None
    pixels = camera.distort((points[:2] / points[2]).T)
    (left, top), (right, bottom) = (
        end.reduce(pixels).tolist() for end in (np.minimum, np.maximum))
    inside: Any = None
    # Written so that NaN is outside.
    if not (left >= 0.0 and top >= 0.0 and right <= camera.width - 1
            and bottom <= camera.height - 1):
        if not np.isfinite(pixels).all():
            return None
        inside = ((pixels >= 0.0) & (pixels <= (camera.width - 1, camera.height - 1))).all(axis=1)
        if np.count_nonzero(inside) < _MIN_INSIDE * len(inside):
            return None
    x, y = pixels.T.astype(np.float32)
    brightness = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
    return _Seen(brightness.astype(float), inside)


class _Linear(NamedTuple):
    """
    The print at a pose and a smear, and by how much its samples, (s,), change with each unknown.

    ``design`` (14, s), gray levels per unit of the pose (6), the response (6) and the smear (2);
    ``steep`` (s,), gray levels squared, of how well blur is known. ``usable`` (s,), bool: samples
    in the image that show the marker; ``center`` (3,), m, is about which it turns. ``light``:
    difference between white and black, gray levels.
    """

    brightness: Array
    usable: Any
    design: Array
    steep: Array
    center: Array
    light: float


class _Descent(NamedTuple):
    """
    Residuals, (s,), gray levels, after a step, and the inputs of the step.

    ``light``: difference between white and black; ``response`` (6, s) to whiteness; ``steps``
    were done.
    """

    residual: Array
    fitted: Array
    weights: Array
    information: Array
    light: float
    response: Array
    steps: int


def descend(image: GrayImage, camera: CameraModel, model: SmearModel, start: SmearStart,
            known: bool = False, most_steps: int = MOST_STEPS) -> SmearFit | None:
    """
    Return the fit with the least weighted squares near a pose and a smear.

    :param known: whether smear and lens come from a fit to this image or to the previous image.
    """
    pose, smear, lens = start
    weights, variance, response = np.ones(model.places.shape[1]), _MIN_VARIANCE, None
    first = _KNOWN_PASSES if known else _DAMPED_PASSES
    before: _Linear | None = None
    for count in range(most_steps):
        fresh = before is None
        if before is None:
            lens, linearized_at = _lens_of(camera, model, pose, lens), smear
            at = _linearize(image, camera, model, SmearStart(pose, smear, lens), response)
        else:
            at = _look_again(image, camera, model, SmearStart(pose, smear, lens), before)
        if at is None:
            return None
        # The steeper it is, the more the true blur of lens and cells matters.
        weights = weights * at.usable / (variance + at.steep)
        weighted = at.design * weights
        information = weighted.dot(at.design.T) + _PRIOR_INFORMATION + (
            _REGULAR_INFORMATION / max(at.light, _MIN_CONTRAST)**2)
        # Smears to either side of an axis look alike: a whole step from one leads to the other.
        held = information if known or count >= _DAMPED_PASSES else (
            information + information * _PRIOR_INFORMATION)
        step = solve_normal(held, weighted.dot(at.brightness))
        if step is None:
            return None
        response = step[6:9].tolist()
        turn, offset = max(map(abs, step[3:6].tolist())), max(map(abs, step[:3].tolist()))
        smear, last = linearized_at + step[-2:], smear
        smeared = max(map(abs, (smear - last).tolist()))
        if (not max(turn, smeared) < _MAX_TURN or response[0] <= 0.0
                or offset > _MAX_STEP_SHARE * at.center[2]
                or math.hypot(*smear.tolist()) > _MAX_SMEAR):
            return None
        pose = apply_step(pose, at.center, step)
        residual = at.brightness - step.dot(at.design)
        shift = max(offset / model.cell, smeared)
        factor = 1.0 if fresh and not known else _CLOSER_FACTOR
        if count >= first and factor * turn < _LAST_TURN and factor * shift < _LAST_SHIFT:
            break
        squares = residual * residual
        if count == _DAMPED_PASSES and _unexplained_share(at, squares) > _MAX_UNEXPLAINED:
            return None
        variance = max(1.4826**2 * median(squares), _MIN_VARIANCE)
        weights = np.maximum(1.0 - squares / (25.0 * (variance + at.steep)), 0.0)**2
        near = (turn < _SAME_SLOPES_TURN and shift < _SAME_SLOPES_SHIFT
                and smeared < _SAME_SLOPES_SMEAR)
        before = at if fresh and near and count + 1 >= first else None
    else:
        return None
    if math.hypot(*step[10:12].tolist()) > _MAX_FALL_OFF * response[0]:
        return None
    rows = at.design[6:12]
    return _check_fit(model, SmearStart(pose, smear, lens), _Descent(
        residual, step[6:12].dot(rows), weights, information, response[0], rows, count + 1))


def _look_again(image: GrayImage, camera: CameraModel, model: SmearModel, start: SmearStart,
                before: _Linear) -> _Linear | None:
    """Return what the image shows after a short step, with the slopes of the print before."""
    seen = _look(image, camera, _basis(start.pose, model), model.places)
    return None if seen is None else before._replace(
        brightness=seen.brightness, usable=_usable(model, seen, start.smear),
        center=start.pose.apply(model.middle[None])[0])


def _unexplained_share(at: _Linear, squares: Array) -> float:
    """Return the share of the image's variance that is left, given the squared residuals."""
    brightness = at.brightness[at.usable]
    brightness -= brightness.mean()
    return float(squares.dot(at.usable)) / max(float(brightness.dot(brightness)), 1e-9)


def _lens_of(camera: CameraModel, model: SmearModel, pose: Transform, lens: int) -> int:
    """Return the index of the blur of a lens in focus at a pose; one out of focus stays."""
    if lens >= N_FOCUSED:
        return lens
    blur = _LENS_BLUR * pose.apply(model.middle)[2] / (camera.matrix[0, 0] * model.cell)
    return min(range(N_FOCUSED), key=lambda each: abs(float(LENS_BLURS[each]) - blur))


def _linearize(image: GrayImage, camera: CameraModel, model: SmearModel, start: SmearStart,
               response: list[float] | None) -> _Linear | None:
    """
    Return the print near ``start``; None if the image does not show it.

    :param response: difference between white and black, black, and bend, gray levels; None: they
        are fitted to the image.
    """
    pose, smear, lens = start
    basis = _basis(pose, model)
    seen = _look(image, camera, basis, model.places)
    if seen is None:
        return None
    (white, right, down), by_smear = smear_print(
        model.printed[lens], model.texels, smear, LENS_BLURS[lens])
    design = np.empty((14, len(white)))
    # Gamma and over-exposure bend what would be straight; light falls unevenly.
    steepness = 1.0 - 2.0 * white
    design[6], design[7], design[8] = white, 1.0, white * (1.0 - white)
    np.multiply(design[8], steepness, out=design[9])
    np.multiply(model.across, white, out=design[10:12])
    if response is None:
        rows = design[6:12]
        first = solve_normal(rows.dot(rows.T), rows.dot(seen.brightness))
        if first is None:
            return None
        response = first[:3].tolist()
    slope = response[0] + response[2] * steepness
    right, down = slope * right, slope * down
    center = pose.apply(model.middle[None])[0]
    _by_pose(basis, model.places, center, right, down, design)
    np.multiply(slope, by_smear, out=design[12:])
    return _Linear(seen.brightness, _usable(model, seen, smear), design,
                   _BLUR_ERROR**2 * (right * right + down * down), center, response[0])


def _usable(model: SmearModel, seen: _Seen, smear: Array) -> Any:
    """Return which samples show the marker: what is beyond its white is smeared into the rim."""
    across, along = (0.5 * model.cells + _WHITE_AROUND - 0.5 * np.abs(smear)).tolist()
    usable = (model.from_middle[0] < across) & (model.from_middle[1] < along)
    return usable if seen.inside is None else usable & seen.inside


def _by_pose(basis: Array, places: Array, center: Array, right: Array, down: Array,
             design: Array) -> None:
    """
    Set by how much brightness grows as the marker moves, per m, and turns, per rad, ``design``.

    :param right, down: by how much it grows per cell, (s,).
    """
    # The place u r + v d + o is seen at a pixel. As the marker moves by m, that shows the place
    # before by u (c . m) - a . m, v (c . m) - b . m; a, b, c are the rows of the inverse.
    along = np.empty((3, len(right)))
    np.negative(right, out=along[0])
    np.negative(down, out=along[1])
    np.multiply(places[0], right, out=along[2])
    along[2] += places[1] * down
    x, y, z = np.dot(cv2.invert(basis)[1].T, along, out=design[:3])
    middle = basis.copy()
    middle[:, 2] -= center
    arm_x, arm_y, arm_z = middle.dot(places)
    np.subtract(arm_y * z, arm_z * y, out=design[3])
    np.subtract(arm_z * x, arm_x * z, out=design[4])
    np.subtract(arm_x * y, arm_y * x, out=design[5])


def _check_fit(model: SmearModel, end: SmearStart, last: _Descent) -> SmearFit | None:
    """Return a fit, None if it does not show the marker's code."""
    weights, contrast = last.weights, float(np.ptp(last.fitted))
    shown = last.fitted + last.residual
    spread = float(weights.dot((shown - weights.dot(shown) / max(weights.sum(), 1e-9))**2))
    left = float(weights.dot(last.residual**2))
    if (contrast < _MIN_CONTRAST or not left < (1.0 - _MIN_FIT_LIKENESS**2) * spread
            or not _shows_code(model, end, last)):
        return None
    chi2 = max(left / max(np.count_nonzero(weights) - len(_PRIOR_INFORMATION), 1), 1.0)
    covariance = normal_covariance(last.information / (chi2 * _ALIKE_SAMPLES))
    if covariance is None:
        return None
    return SmearFit(end.pose, covariance[:6, :6], math.sqrt(
        left / max(float(weights.sum()), 1e-9)) / contrast, end.smear, end.lens, last.steps)


def _shows_code(model: SmearModel, end: SmearStart, last: _Descent) -> bool:
    """Return whether no other code fits the image better, and few cells fit better inverted."""
    instants = instants_of(end.smear, LENS_BLURS[end.lens])[:, None]
    inner, count = model.cells - 2, model.places.shape[1]
    column, row = (np.rint(place + instants * along).astype(np.intp)
                   for place, along in zip(model.places, end.smear.tolist()))
    within = (column >= 1) & (column <= inner) & (row >= 1) & (row <= inner)
    index = ((row - 1) * inner + column - 1) * count + np.arange(count)
    share = np.bincount(index[within], minlength=inner * inner * count).reshape(
        inner * inner, count)  # of each sample, in how many instants it is of each cell
    turned = share * ((1.0 - 2.0 * model.bits) * (last.light / len(instants)))[:, None]
    # What turning cells adds to the squares left, once the response is fitted anew.
    response, residual = last.response, last.residual
    by_response = turned.dot(response.T)
    refit = cv2.solve(response.dot(response.T) + _RIDGE, by_response.T)[1].T
    by_residual = turned.dot(residual) - refit.dot(response.dot(residual))
    together = turned.dot(turned.T) - refit.dot(by_response.T)
    if np.count_nonzero(together.diagonal() <= 2.0 * by_residual) > model.errors:
        return False
    added = (model.flips.dot(together) * model.flips).sum(axis=1) - (
        2.0 * model.flips.dot(by_residual))
    return bool((added > 0.0).all())
