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
Fits a neighbour's pose to the edges of its markers, from a roughly known pose.

The fit minimises the squared distances between edges and model, across the edges: Gauss-Newton
with Tukey's weights, so that covered or dirty edges do not count. Gamma and over-exposure make
white areas swell ("bloom"): all edges shift from white to black. The fit estimates this shift with
the pose, one for edges across the marker's x axis and one for those across y, because motion blurs
them unequally.

``ippe`` and ``refine`` give the pose of a square from its four corners. A square has two poses
that explain its corners almost equally well, mirrored about the line of sight (Collins & Bartoli,
"Infinitesimal plane-based pose estimation", IJCV 2014; IPPE).
"""

from __future__ import annotations

import math
from operator import truediv
from typing import NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import Array, rotation_vector_to_matrix, skew, Transform
from flock_follower.perception import edges
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edges import Found, Lines, normal_covariance, solve_normal
from flock_follower.perception.images import GrayImage
from flock_follower.perception.print_model import EdgeModel, median

#: An edge is in place if the fit explains it to within this, px, or three times the RMS.
INLIER = 0.4
_SIGMA_BLOOM = 0.35  # px, of either shift
_FLOOR = 0.03  # px: least standard deviation of an edge's place
#: What a step leaves out goes with its square, and against the marker's size: where the square is
#: more than this times the narrowest cell, px, edges are looked for again;
_AGAIN = 0.2
_ANEW = 1.5  # px: where the pose moved an edge by more, they are projected anew
_TURNED = 0.04  # rad: seen from the front, a turn hardly moves edges, and not in proportion
_PASSES = 5
_LONGEST_TURN = 1.0  # rad: after a longer step the edges must be found again
_SETTLED = 2.0  # times as far as a step may go that nothing is looked for again after
_EITHER = 0.1  # share of the edges of either axis, by weight, that a pose must rest on
_CLEAR = 0.75  # share of edges, by weight: with fewer, edges are found again
_BLURRED = 1.6  # a kernel this much too narrow or too wide is matched, and edges found again
_UNKNOWN = np.full(2, _FLOOR**2)
_PRIOR = np.diag([0.0] * 6 + [_SIGMA_BLOOM**-2] * 2)


class EdgeFit(NamedTuple):
    """
    A pose that explains the edges.

    ``pose`` is ``T_camera_body``; ``center`` (3,) is in the middle of the edges, in the camera's
    optical frame, m. ``covariance`` (6, 6) is of the position of that point and of the rotation
    vector r in R_true = exp(r) R. ``rms`` is what the edges miss it by, px, ``chi2`` the mean of
    their squares over their variances, ``degrees`` the degrees of freedom left; ``inliers`` the
    share of edges in place. ``spacing``, px, is that of the profiles which suits the blur found,
    ``smear`` the blur, as a share of the narrowest cell.
    """

    pose: Transform
    center: Array
    covariance: Array
    rms: float
    chi2: float
    degrees: float
    inliers: float
    spacing: tuple[float, float]
    smear: float
    lines: Lines
    residual: Array
    """(n,), px: where edges are across the lines at ``pose``, bloom removed."""
    weights: Array
    """(n,), 1/px^2: 0 if an edge was not found."""


def fit(image: GrayImage, camera: CameraModel, model: EdgeModel, start: Transform,
        spacing: tuple[float, float] | None = None) -> EdgeFit | None:
    """
    Return the pose near ``start``, ``T_camera_body``, or None if its edges are not found.

    ``start`` may be off by half a cell of the marker in the image.

    :param spacing: of the profiles, px, that suited the image before; then ``start`` may be off
        by four times as much.
    """
    lines = edges.project(camera, model, start)
    if lines is None:
        return None
    pose = start
    now = edges.searching(lines) if spacing is None else spacing
    last: _Step | None = None
    count = 0
    while True:
        count += 1
        found = edges.find(image, lines, now)
        if found is None:
            return None
        found, widths = edges.apart(lines, found)
        step = _solve(lines, found, last)
        if step is None:
            return None
        turn = max(map(abs, step.step[3:6].tolist()))
        if not turn < _LONGEST_TURN:
            return None
        pose = moved(pose, lines.center, step.step)
        lines = lines.moved(step.step, step.explained)
        blur = edges.blurs(widths, now)
        suited = edges.matched(lines, blur)
        farthest = float(np.abs(step.explained).max())
        turned = turn > _TURNED
        clear = float(step.weights.sum()) > _CLEAR * len(model)
        alike = all(1.0 / _BLURRED < a / b < _BLURRED for a, b in zip(suited, now))
        cell = min(lines.narrowest)
        near = farthest * farthest < _AGAIN * cell
        settled = near and alike and clear and not turned
        if settled or count == _PASSES:
            if not settled and farthest * farthest > _SETTLED**2 * _AGAIN * cell:
                return None
            smear = max(map(truediv, blur, lines.narrowest))
            return _fitted(pose, lines, found, step, suited, smear)
        now = suited
        # A fit to a part of the edges must not exclude the others.
        last = step if clear else None
        if farthest > _ANEW or turned:
            fresh = edges.project(camera, model, pose)
            if fresh is None:
                return None
            lines = fresh


def refit(camera: CameraModel, fitted: EdgeFit,
          start: Transform) -> tuple[Transform, float] | None:
    """
    Return another pose near ``start`` that fits the edges found already, and its chi^2.

    chi^2 is the weighted sum of their squared residuals. None if no pose fits.
    """
    pose = start
    at = fitted.lines.pixels + fitted.residual[:, None] * fitted.lines.normals
    for _ in range(2):
        lines = edges.project(camera, fitted.lines.model, pose)
        if lines is None:
            return None
        offsets = ((at - lines.pixels) * lines.normals).sum(axis=1)
        design = lines.design[:, :6]
        moment = (design * fitted.weights[:, None]).T
        step = solve_normal(moment.dot(design), moment.dot(offsets))
        if step is None or not float(np.abs(step[3:]).max()) < _LONGEST_TURN:
            return None
        pose = moved(pose, lines.center, step)
        explained = design.dot(step)
        if float(np.abs(explained).max()) < _ANEW:
            break
    residual = offsets - explained
    return pose, float(fitted.weights.dot(residual * residual))


def _fitted(pose: Transform, lines: Lines, found: Found, last: _Step,
            spacing: tuple[float, float], smear: float) -> EdgeFit | None:
    """Return the fit that ends with a step, None if that leaves a direction open."""
    if not (last.weights.dot(lines.model.bloom) < -_EITHER * lines.model.counts).all():
        return None
    covariance = normal_covariance(last.information)
    if covariance is None:
        return None
    degrees = max(float(last.weights.sum()) - 8.0, 1.0)
    weights = last.weights / last.variance[lines.model.axis]
    square = float(last.weights.dot(last.squares)) / degrees
    in_place = np.count_nonzero(found.found & (last.squares < max(INLIER**2, 9.0 * square)))
    return EdgeFit(
        pose, lines.center, covariance[:6, :6], math.sqrt(square),
        float(weights.dot(last.squares)) / degrees, degrees, in_place / len(lines.model),
        spacing, smear, lines, last.residual, weights)


class _Step(NamedTuple):
    """
    A least-squares step (8,), the motion of the edges, (n,), px, and their residuals, px^2.

    ``weights`` (n,): how much each edge counts, 0..1, 0 if it was not found; ``variance``
    (2,): of where an edge of either axis is, px^2. ``information`` (8, 8) of the step.
    """

    step: Array
    explained: Array
    residual: Array
    squares: Array
    weights: Array
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
    variance = _UNKNOWN if last is None else last.variance
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
        variance = np.maximum(variance, _FLOOR**2)
        weights = 1.0 - squares / np.maximum(16.0 * variance, INLIER**2)[axis]
        weights = np.maximum(weights, 0.0)**2 * found.found
    explained = design[:, :6].dot(step[:6])
    return _Step(step, explained, residual, squares, weights, variance, information)


def _robust(squares: Array) -> float:
    """Return the variance of which most of the squares (n,) are, by their median."""
    return 1.4826**2 * median(squares) if len(squares) else 1.0


def moved(pose: Transform, center: Array, step: Array) -> Transform:
    """Return a pose after a step (6,) or more of a point: its translation, and a turn about it."""
    turn = rotation_vector_to_matrix(step[3:6])
    return Transform(turn.dot(pose.rotation),
                     center + step[:3] + turn.dot(pose.translation - center))


def marker_corners(side_length: float) -> Array:
    """Return a marker's corners (4, 3) in its own frame, m: top-left, then clockwise."""
    return 0.5 * side_length * np.array(
        [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def ippe(corners: Array, camera: CameraModel, side_length: float) -> list[Transform]:
    """Return the two closed-form poses ``T_camera_marker`` of corners (4, 2), px, if any."""
    normalised = camera.undistort(corners)
    if not np.all(np.isfinite(normalised)):
        return []
    # OpenCV's IPPE returns rotation vectors that are wrong near half a turn, and a marker that
    # faces the camera upright is half a turn away from it. So it is given the square as if it
    # lay in the image, x right and y down, whichever of its corners is on top.
    quarters = int(np.argmin(normalised.sum(axis=1)))
    in_image = np.roll(normalised, -quarters, axis=0)[::-1]
    # Undistorted coordinates and an identity matrix serve every lens model alike.
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        marker_corners(side_length), np.ascontiguousarray(in_image).reshape(4, 1, 2), np.eye(3),
        None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    turned = rotation_vector_to_matrix([0.0, 0.0, quarters * np.pi / 2.0])
    as_marker = np.diag([1.0, -1.0, -1.0]) @ turned
    return [Transform(rotation_vector_to_matrix(np.ravel(r)) @ as_marker, np.ravel(t))
            for r, t in zip(rotations, translations)
            if np.all(np.isfinite(r)) and np.all(np.isfinite(t))]


def refine(corners: Array, camera: CameraModel, points: Array, center: Array,
           pose: Transform) -> tuple[Transform, Array] | None:
    """
    Return the pose of least reprojection error near ``pose``, by Gauss-Newton, None if it fails.

    The second value is the Jacobian (8, 6), px per m and rad. Of ``points`` (4, 3) on a body, m,
    ``corners`` (4, 2) are seen, px; a step turns the body about ``center`` (3,), m.
    """
    for _ in range(20):
        seen = pose.apply(points)
        pixels, by_point = camera.linearize(seen)
        residual = (corners - pixels).ravel()
        middle = pose.apply(center[None])[0]
        turns = np.stack([row @ -skew(arm) for row, arm in zip(by_point, seen - middle)])
        jacobian = np.concatenate([by_point, turns], axis=2).reshape(-1, 6)
        step = solve_normal(jacobian.T @ jacobian, jacobian.T @ residual)
        if step is None or not np.all(np.isfinite(step)):
            return None
        if np.max(np.abs(step)) < 1e-7:
            break
        pose = moved(pose, middle, step)
    return pose, jacobian
