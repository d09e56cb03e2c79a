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
Fits a neighbor's pose to the edges of its markers, from a roughly known pose.

Brightness is sampled across the known edges between black and white. The derivative of such a
profile, smoothed by the blur of the image, has its peak at the edge. The half-way level between
black and white is not used, because it moves if blur darkens a narrow white cell; the peak hardly
moves.

The fit minimizes the squared distances between edges and model, across the edges: Gauss-Newton
with Tukey's weights, so that covered or dirty edges do not count. Gamma and over-exposure enlarge
white areas ("bloom"): all edges shift from white to black. The fit estimates this shift together
with the pose, separately for edges across the marker's x axis and y axis, because motion blurs
them differently.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edges import (
    apply_step,
    Lines,
    normal_covariance,
    profiles_across,
    project,
    solve_normal,
)
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import EdgeModel, median, N_DERIVATIVES

#: Least distance between samples of a profile, px.
MIN_SPACING = 0.3
#: Most distance between samples of a profile, px, unless MAX_SPACING_SHARE is more.
MAX_SPACING = 1.2
#: The same as a share of the narrowest cell.
MAX_SPACING_SHARE = 0.1
#: Samples on either side of the middle, of the smoothed derivative and of the kernel.
_HALF_WIDTH = N_DERIVATIVES // 2
#: Samples on either side of the middle of a profile.
_PROFILE_HALF_LENGTH = 2 * _HALF_WIDTH
#: Standard deviation of the kernel, samples.
_KERNEL_SIGMA = 2.0
#: A point and a step, (1, 2), times this: the places along a profile.
_STEPS = np.stack([
    np.ones(2 * _PROFILE_HALF_LENGTH + 1),
    np.arange(-_PROFILE_HALF_LENGTH, _PROFILE_HALF_LENGTH + 1.0)]).astype(np.float32)
#: Least slope of an edge, gray levels per px.
_MIN_SLOPE = 1.0
#: Least slope of an edge, as a share of the median: in a shadow it is 0.2.
_MIN_SLOPE_SHARE = 0.15
#: The same for narrow cells, whose edges blur into one another.
_MIN_SLOPE_SHARE_NARROW = 0.3
#: Cells up to this width are narrow, px.
_NARROW_CELL = 4.0
#: Least share of the edges that are found.
_MIN_SHARE = 0.5
#: Distance between samples for sharp images of large markers, px.
_SHARP_SPACING = 0.5
#: Squared distance from which on an edge does not disturb the next one, in variances of the blur.
_UNDISTURBED_BEYOND = 25.0
#: Least half of the squared distance that is corrected for, in variances of the blur.
_MIN_CORRECTED = 2.5
#: Least variance of the blur to divide by, px^2.
_MIN_BLUR_VARIANCE = 1e-9
#: Indices one inside the range: a maximum at its rim is no peak, and has only one neighbor.
_INNER_INDEX = np.array([1, *range(1, 2 * _HALF_WIDTH), 2 * _HALF_WIDTH - 1])
#: Added to indices (n,): those of the sample before each, of each and of the one after.
_ADJACENT = np.array([[-1], [0], [1]])
#: Sums both columns of (n, 2).
_ONES = np.ones(2)
#: Subtracts the second column of (n, 2) from the first.
_DIFFERENCE = np.array([1.0, -1.0])


def _correlation() -> Any:
    """Return the matrix from a profile (17,) to its smoothed derivative in the middle (9,)."""
    k = np.arange(-_HALF_WIDTH, _HALF_WIDTH + 1.0)
    kernel = k * np.exp(-0.5 * (k / _KERNEL_SIGMA)**2)
    kernel /= kernel @ k  # one gray level per sample gives 1
    matrix = np.zeros((2 * _PROFILE_HALF_LENGTH + 1, 2 * _HALF_WIDTH + 1), dtype=np.float32)
    for i in range(2 * _HALF_WIDTH + 1):
        matrix[i:i + 2 * _HALF_WIDTH + 1, i] = kernel
    return matrix


_CORRELATION = _correlation()


class Found(NamedTuple):
    """
    Positions of edges in the image.

    ``offsets`` (n,), px: from the predicted lines, along the normals. ``found`` (n,), bool.
    ``variance`` (n,), px^2: squared width (sigma^2) of each peak, from the blur and the kernel
    together. ``known``: the indices of the edges found across either axis.
    """

    offsets: Array
    found: Any
    variance: Array
    known: tuple[Any, Any]


def _find(image: GrayImage, lines: Lines, spacing: tuple[float, float],
          bloom: Array) -> Found | None:
    """
    Return where brightness rises most steeply along each line's normal.

    None if too few edges are found, or too faint edges. ``spacing``, px, between samples
    across edges of either axis; ``bloom`` (2,), px, as far as it is known.
    """
    model, pixels, swollen = lines.model, lines.pixels, None
    step = np.array(spacing, dtype=np.float32)[model.axis]
    along = lines.normals * step[:, None]
    if max(map(abs, bloom.tolist())) > MAX_PLAIN_BLOOM:
        swollen = model.bloom.dot(bloom)
        pixels = pixels + swollen[:, None] * lines.normals
    profiles = profiles_across(image, pixels, along, _STEPS, max(spacing))
    if profiles is None:
        return None
    slope = profiles.dot(_CORRELATION)

    peak = slope.argmax(axis=1)
    within = _INNER_INDEX[peak]
    index = model.begins + within
    before, top, after = slope.ravel().take(_ADJACENT + index)
    bend = np.minimum(before - 2.0 * top + after, -1e-3)
    typical = median(top)
    faint = _MIN_SLOPE_SHARE if min(lines.narrowest) > _NARROW_CELL else _MIN_SLOPE_SHARE_NARROW
    found = (peak == within) & (top > faint * typical)
    if (typical < _MIN_SLOPE * max(spacing)
            or np.count_nonzero(found) < max(_MIN_SHARE * len(found), 12)):
        return None
    offsets = (within - _HALF_WIDTH + 0.5 * (before - after) / bend) * step
    if swollen is not None:
        offsets += swollen
    first, second = ((found & one).nonzero()[0] for one in model.across)
    return Found(offsets, found, (-top / bend) * (step * step), (first, second))


def _separate_edges(lines: Lines, found: Found) -> tuple[float, float]:
    """
    Subtract the shifts by adjacent edges from ``found``, and return the blur of each axis, px.

    Blurred by s in all, an edge at 0 and its opposite at d give the smoothed derivative
    C = exp(-x^2 / 2 s^2) - exp(-(x - d)^2 / 2 s^2). With e = exp(-d^2 / 2 s^2), its peak is at
    about -d e / (1 + (d^2 / s^2 - 1) e), and -C / C'' is s^2 (1 - e) / (1 + (d^2 / s^2 - 1) e).
    """
    model, offsets = lines.model, found.offsets
    known = found.known
    variance = _typical(found.variance, known)
    (cell_x, cell_y), (blur_x, blur_y) = lines.narrowest, variance
    if cell_x**2 < _UNDISTURBED_BEYOND * blur_x or cell_y**2 < _UNDISTURBED_BEYOND * blur_y:
        room = model.room * np.array(lines.scale)[model.axis][:, None]
        square = room * room
        for again in (True, True, False):
            blurred = np.maximum(variance, _MIN_BLUR_VARIANCE)[model.axis]
            normalized = square / blurred[:, None]
            e = np.exp(np.minimum(-0.5 * normalized, -_MIN_CORRECTED))
            bend = 1.0 + ((normalized - 1.0) * e).dot(_ONES)
            if again:
                variance = _typical(found.variance * bend / (1.0 - e.dot(_ONES)), known)
        offsets -= (room * e).dot(_DIFFERENCE) / bend
    return math.sqrt(variance[0]), math.sqrt(variance[1])


def _typical(variance: Array, known: tuple[Any, Any]) -> tuple[float, float]:
    """Return the median variance of the known edges of either axis, px^2; 0 without one."""
    first, second = known
    return (median(variance[first]) if len(first) else 0.0,
            median(variance[second]) if len(second) else 0.0)


def _match_spacing(lines: Lines, blur: list[float]) -> tuple[float, float]:
    """Return the spacing at which the kernel is about as wide as the image is blurred, px."""
    # Wider than the blur averages more noise, as long as the next edge stays out of it.
    first, second = (
        min(max(sigma / _KERNEL_SIGMA, min(_SHARP_SPACING, 0.12 * cell), MIN_SPACING),
            max(MAX_SPACING, MAX_SPACING_SHARE * cell))
        for sigma, cell in zip(blur, lines.narrowest))
    return first, second


def _widen_for_bloom(spacing: tuple[float, float], bloom: Array) -> tuple[float, float]:
    """Return the spacing, px, with which profiles reach edges that bloom has shifted."""
    first, second = (each + shift / _HALF_WIDTH if shift > MAX_PLAIN_BLOOM else each
                     for each, shift in zip(spacing, map(abs, bloom.tolist())))
    return first, second


def _search_spacing(lines: Lines) -> tuple[float, float]:
    """
    Return the sample spacing of the profiles for both axes, px.

    With it, a profile reaches an edge that is half a cell from its predicted place.
    """
    first, second = (max(cell / (2 * _HALF_WIDTH), MIN_SPACING) for cell in lines.narrowest)
    return first, second


#: Least share of the edges that agree with an accepted pose.
MIN_INLIER_SHARE = 0.5
#: Largest RMS of the residuals of an accepted pose, px.
MAX_RMS = 0.4
#: The same as a share of the narrowest cell, if that is more: the halo of a reflex grows with it.
_MAX_RMS_SHARE = 0.03
#: Largest residual of an edge in place, px, or three times the RMS if that is more.
MAX_INLIER_ERROR = 0.4
#: Prior of either shift of bloom, px (1 sigma).
_SIGMA_BLOOM = 0.35
#: Edges that bloom shifts by more, px, are looked for where it shifts them.
MAX_PLAIN_BLOOM = 0.7
#: Least standard deviation of an edge's place, px.
_MIN_SIGMA = 0.03
#: Edges are found again after a step whose square exceeds this times the narrowest cell, px: the
#: error of a step grows with its square, and falls with the marker's size.
_REFIND_BEYOND = 0.2
#: Edges are projected again if the pose moved one by more, px.
REPROJECT_BEYOND = 1.5
#: The same for a turn, rad: seen from the front, it hardly moves edges, and not in proportion.
_REPROJECT_TURN = 0.04
#: Most steps of a fit.
_MAX_PASSES = 5
#: A step that turns by more, rad, leads nowhere.
MAX_TURN_STEP = 1.0
#: The last step may be this much longer than one after which edges are found again.
_FINAL_STEP_FACTOR = 2.0
#: Least share of the edges of either axis, by weight, that a pose rests on.
_MIN_AXIS_SHARE = 0.1
#: Edges are found again while a smaller share of them, by weight, agrees.
_REFIND_BELOW = 0.75
#: Least growth of this share by a step: with less, the other edges are hidden.
_LEAST_GAIN = 0.02
#: Edges are found again if the kernel is wider or narrower than the blur by this factor.
_MAX_MISMATCH = 1.6
#: Variances of an edge's place of either axis before any is known, px^2.
_INITIAL_VARIANCE = np.full(2, _MIN_SIGMA**2)
#: Bloom before any is known, px.
_NO_BLOOM = np.zeros(2)
#: Prior of the pose (6) and of both shifts of bloom.
_PRIOR = np.diag([0.0] * 6 + [_SIGMA_BLOOM**-2] * 2)


class EdgeFit(NamedTuple):
    """
    A pose that explains the edges.

    ``pose`` is ``T_camera_body``; ``center`` (3,) is the middle of the edges, in the camera's
    optical frame, m. ``covariance`` (6, 6) is the covariance of the position of ``center`` and of
    the rotation vector r in R_true = exp(r) R. ``rms`` is the RMS of the residuals, px; ``chi2``
    the mean of the squared residuals over their variances; ``degrees`` the remaining degrees of
    freedom; ``inlier_share`` the share of edges in place. ``spacing``, px, is the best spacing of
    the profiles for the blur found. ``blur``, a share of the narrowest cell, and ``bloom``, the
    shift in px, are those of the axis with the larger value.
    """

    pose: Transform
    center: Array
    covariance: Array
    rms: float
    chi2: float
    degrees: float
    inlier_share: float
    spacing: tuple[float, float]
    blur: float
    bloom: float
    lines: Lines
    residual: Array
    """Distance (n,), px, of the edges from the lines at ``pose``, without bloom."""
    weights: Array
    """Weight (n,), 1/px^2; 0 if an edge was not found."""


def fit(image: GrayImage, camera: CameraModel, model: EdgeModel, start: Transform,
        spacing: tuple[float, float] | None = None) -> EdgeFit | None:
    """
    Return the pose near ``start``, ``T_camera_body``, or None if the image does not show it.

    More than MIN_INLIER_SHARE of the edges must be in place, within MAX_RMS. ``start`` may be off
    by half a cell of the marker in the image.

    :param spacing: the best spacing of the profiles, px, in the image before; with it, ``start``
        may be off by four times as much.
    """
    pose, last, share = start, None, 0.0
    bloom: Array = _NO_BLOOM
    lines = project(camera, model, start)
    if lines is not None and spacing is None:
        spacing = _search_spacing(lines)
    for count in range(_MAX_PASSES):
        found = None if lines is None or spacing is None else _find(image, lines, spacing, bloom)
        if lines is None or spacing is None or found is None:
            return None
        widths = _separate_edges(lines, found)
        step = _solve(lines, found, last)
        turn = math.inf if step is None else max(map(abs, step.step[3:6].tolist()))
        if step is None or not turn < MAX_TURN_STEP:
            return None
        pose = apply_step(pose, lines.center, step.step)
        lines, bloom = lines.after_step(step.step, step.explained), step.step[6:]
        blur = [math.sqrt(max(width**2 - (_KERNEL_SIGMA * each)**2, 0.0))
                for width, each in zip(widths, spacing)]
        suited = _match_spacing(lines, blur)
        alike = all(1.0 / _MAX_MISMATCH < a / b < _MAX_MISMATCH for a, b in zip(suited, spacing))
        before, share = share, step.weight / len(model)
        clear = share > _REFIND_BELOW or (count > 0 and share < before + _LEAST_GAIN)
        farthest, turned = cv2.norm(step.explained, cv2.NORM_INF), turn > _REPROJECT_TURN
        near = _REFIND_BEYOND * min(lines.narrowest)
        settled = farthest * farthest < near and alike and clear and not turned
        if settled or count == _MAX_PASSES - 1:
            if not settled and farthest * farthest > _FINAL_STEP_FACTOR**2 * near:
                return None
            return _build_fit(pose, lines, found, step, suited, blur)
        spacing = suited
        # A fit to a part of the edges must not exclude the others.
        last = step if clear else None
        if farthest > REPROJECT_BEYOND or turned:
            lines = project(camera, model, pose)
    return None


def _build_fit(pose: Transform, lines: Lines, found: Found, last: _Step,
               spacing: tuple[float, float], blur: list[float]) -> EdgeFit | None:
    """Return the fit after the last step; None if it is poor or a direction is undetermined."""
    for weight, count in zip(last.weights.dot(lines.model.bloom).tolist(), lines.model.counts):
        if not -weight > _MIN_AXIS_SHARE * count:
            return None
    degrees = max(last.weight - 8.0, 1.0)
    square = float(last.weights.dot(last.squares)) / degrees
    in_place = found.found & (last.squares < max(MAX_INLIER_ERROR**2, 9.0 * square))
    inlier_share, rms = np.count_nonzero(in_place) / len(lines.model), math.sqrt(square)
    covariance = normal_covariance(last.information)
    if covariance is None or not (inlier_share > MIN_INLIER_SHARE and (
            rms < max(MAX_RMS, _MAX_RMS_SHARE * min(lines.narrowest)))):
        return None
    weights = last.weights / last.variance[lines.model.axis]
    return EdgeFit(
        pose, lines.center, covariance[:6, :6], rms, float(weights.dot(last.squares)) / degrees,
        degrees, inlier_share, _widen_for_bloom(spacing, last.step[6:]),
        max(width / cell for width, cell in zip(blur, lines.narrowest)),
        max(map(abs, last.step[6:].tolist())), lines, last.residual, weights)


class _Step(NamedTuple):
    """
    A least-squares step (8,), the motion of the edges, (n,), px, and their residuals, px^2.

    ``weights`` (n,): how much each edge counts, 0..1, 0 if it was not found; ``weight``: their
    sum; ``variance`` (2,): of where an edge of either axis is, px^2. ``information`` (8, 8) of the
    step.
    """

    step: Array
    explained: Array
    residual: Array
    squares: Array
    weights: Array
    weight: float
    variance: Array
    information: Array


def _solve(lines: Lines, found: Found, last: _Step | None) -> _Step | None:
    """
    Return the step that explains where edges were found, starting from the last weights.

    None if the edges determine no step: the normal equations are not definite.
    """
    axis, design, offsets = lines.model.axis, lines.design, found.offsets
    groups = lines.model.bloom  # (n, 2): -1 for the edges of an axis, else 0
    weights = found.found if last is None else last.weights * found.found
    variance = _INITIAL_VARIANCE if last is None else last.variance
    for again in range(2):
        weighted = design * (weights / variance[axis])[:, None]
        information = weighted.T.dot(design) + _PRIOR
        solution = solve_normal(information, offsets.dot(weighted))
        if solution is None:
            return None
        step = solution
        residual = offsets - design.dot(step)
        squares = residual * residual
        # Motion smears edges of one direction more: each has a scale of its own.
        if again == 0 and last is None:
            first, second = found.known
            variance = np.array([_robust(squares[first]), _robust(squares[second])])
        else:
            variance = ((weights * squares).dot(groups)
                        / np.minimum(weights.dot(groups) + 4.0, -1.0))
        variance = np.maximum(variance, _MIN_SIGMA**2)
        weights = 1.0 - squares / np.maximum(16.0 * variance, MAX_INLIER_ERROR**2)[axis]
        weights = np.maximum(weights, 0.0)**2 * found.found
    explained = design[:, :6].dot(step[:6])
    return _Step(step, explained, residual, squares, weights, float(np.add.reduce(weights)),
                 variance, information)


def _robust(squares: Array) -> float:
    """Return the variance of most residuals, from the median of their squares (n,)."""
    return 1.4826**2 * median(squares) if len(squares) else 1.0
