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
From an image to the poses of the neighbours' markers, with covariance: :func:`measure`.

A square seen by one camera has two poses that explain its four corners almost equally well,
mirrored about the line of sight (Collins & Bartoli, "Infinitesimal plane-based pose estimation",
IJCV 2014; IPPE). Both are computed, both refined to the least reprojection error in real pixels,
and the more probable is kept, given the corners, the pose expected from history, and that a
neighbour flies about upright.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from flock_follower.geometry import (
    Array,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    Transform,
)
from flock_follower.perception import aruco
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.corners import moved_outward
from flock_follower.perception.images import GrayImage
from flock_follower.perception.neighbors import Neighbor, NeighborConfig

#: A pose whose corners miss the image's by more than this, px RMS, is none.
MAX_RMS = 1.5
#: Corner noise is never believed to be below this, px; and the deviations are widened by 1.5
#: because lens calibration and rolling shutter err much the same from frame to frame.
SIGMA_FLOOR = 0.05
WIDENING = 1.5
#: The expected corner noise weighs as much as this many residuals: four corners leave only
#: 8 - 6 = 2 degrees of freedom, too few to believe what they say about the noise.
PRIOR_WEIGHT = 4.0
#: How far an expected orientation may be off, and how far a neighbour leans, rad (1 sigma).
SIGMA_HISTORY = 0.3
SIGMA_UPRIGHT = 0.25
#: History may not outweigh the image for ever: its say in chi^2 is capped.
MAX_HISTORY = 9.0
#: Two solutions closer than this, rad, are one.
_SAME_ROTATION = 0.02


@dataclass(frozen=True)
class Prediction:
    """
    What is known before the image: of use in choosing between the two poses, and in searching.

    ``up`` is the unit vector opposite to gravity in the camera's optical frame, (3,), or None;
    ``markers`` the expected ``T_camera_marker`` by neighbour's name.
    """

    up: Array | None = None
    markers: Mapping[str, Transform] = field(default_factory=dict)


@dataclass(frozen=True)
class Measurement:
    """
    One neighbour's marker in one image.

    ``T_camera_marker`` is the marker's pose in the optical frame, m; ``covariance`` (6, 6) is of
    its position, then of the rotation vector r in R_true = exp(r) R, both along the camera's
    axes; ``systematic`` (3,), m, is one deviation more of the position, which does not average
    out over frames and so is no part of ``covariance``; ``rms`` is the reprojection error, px;
    ``solutions`` how many distinct poses were weighed. ``rejected`` is empty, or the reason not
    to use it.
    """

    name: str
    T_camera_marker: Transform
    covariance: Array
    systematic: Array
    rms: float
    solutions: int
    rejected: str = ''


class Measured(NamedTuple):
    """The measurements of one image, and the ids of markers that are no neighbour's."""

    measurements: list[Measurement]
    other_ids: list[int]


class _Fit(NamedTuple):
    """A pose at the least reprojection error: sum of squares, px^2, and Jacobian (8, 6)."""

    pose: Transform
    squares: float
    jacobian: Array


def measure(image: GrayImage, camera: CameraModel, config: NeighborConfig,
            prediction: Prediction) -> Measured:
    """
    Return the measurements of the neighbours' markers in a grey image (H, W) uint8.

    Where every neighbour is expected and found near its expected place, only there is searched.

    :raises ValueError: where the image is not of the camera's size.
    """
    camera.check_image(image.shape[1], image.shape[0])
    best: dict[str, Measurement] = {}
    other_ids: list[int] = []
    by_marker = config.by_marker()
    for detections in _searches(image, camera, config, prediction, found=best):
        for marker_id, corners, sigma, sigma_bloom in zip(*detections):
            neighbor = by_marker.get(int(marker_id))
            if neighbor is None:
                other_ids.append(int(marker_id))
                continue
            found = solve(corners, float(sigma), float(sigma_bloom), camera, neighbor, prediction)
            if found is not None:
                rival = best.get(neighbor.name)
                best[neighbor.name] = found if rival is None else _likelier(
                    found, rival, prediction.markers.get(neighbor.name))
    return Measured(list(best.values()), sorted(set(other_ids)))


def solve(corners: Array, sigma: float, sigma_bloom: float, camera: CameraModel,
          neighbor: Neighbor, prediction: Prediction) -> Measurement | None:
    """
    Return the pose of a marker seen at corners (4, 2), px, or None where no pose fits at all.

    :param sigma: expected noise of a corner coordinate, px.
    :param sigma_bloom: deviation of a shift that all four edges share, px.
    """
    square = marker_corners(neighbor.side_length)
    fits = _distinct([fit for start in _ippe(corners, camera, neighbor.side_length)
                      if (fit := _refine(corners, camera, square, start)) is not None])
    if not fits:
        return None
    noise = _variance(min(fit.squares for fit in fits), sigma)
    surprise = np.array([fit.squares / noise + _surprise(fit.pose, neighbor, prediction)
                         for fit in fits])
    weights = np.exp(-0.5 * (surprise - np.min(surprise)))
    weights /= weights.sum()
    pose, squares, jacobian = fits[int(np.argmax(weights))]

    by_noise = np.linalg.inv(jacobian.T @ jacobian)
    covariance = _variance(squares, sigma) * by_noise
    # What the other pose would mean, by its probability: E[d d^T] about the chosen one.
    for weight, fit in zip(weights, fits):
        d = np.concatenate([fit.pose.translation - pose.translation,
                            matrix_to_rotation_vector(fit.pose.rotation @ pose.rotation.T)])
        covariance += weight * np.outer(d, d)
    swollen = moved_outward(corners, np.full(4, sigma_bloom)) - corners
    systematic = (by_noise @ jacobian.T @ swollen.ravel())[:3]
    rms = float(np.sqrt(squares / 4.0))
    rejected = f'reprojection above {MAX_RMS} px' if rms > MAX_RMS else ''
    return Measurement(neighbor.name, pose, covariance, systematic, rms, len(fits),
                       rejected)


def _variance(squares: float, sigma: float) -> float:
    """Return the variance of a corner coordinate, px^2, from what was expected and what is."""
    variance = (PRIOR_WEIGHT * sigma**2 + squares) / (PRIOR_WEIGHT + 2.0)
    return max(variance, SIGMA_FLOOR**2) * WIDENING**2


def marker_corners(side_length: float) -> Array:
    """Return a marker's corners (4, 3) in its own frame, m: top-left, then clockwise."""
    return 0.5 * side_length * np.array(
        [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def _searches(image: GrayImage, camera: CameraModel, config: NeighborConfig,
              prediction: Prediction, found: Mapping[str, Measurement],
              ) -> Iterator[aruco.Detections]:
    """
    Yield detections near where neighbours are expected, then everywhere if some are missing.

    ``found`` is filled by the caller in between.
    """
    for neighbor in config.neighbors:
        expected = prediction.markers.get(neighbor.name)
        region = expected and _region(camera, expected, neighbor.side_length)
        if region:
            yield aruco.detect(image, config.dictionary, camera=camera, region=region)
    if any(neighbor.name not in found for neighbor in config.neighbors):
        yield aruco.detect(image, config.dictionary, camera=camera)


def _region(camera: CameraModel, expected: Transform,
            side_length: float) -> aruco.Region | None:
    """Return where in the image a marker is expected, generously, or None where outside."""
    pixels = camera.project(expected.apply(marker_corners(side_length)))
    if not np.all(np.isfinite(pixels)):
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = max(32.0, 0.75 * float(np.max(high - low)))
    x0, y0 = np.maximum(np.floor(low - margin), 0.0).astype(int).tolist()
    x1, y1 = np.minimum(np.ceil(high + margin) + 1.0,
                        (camera.width, camera.height)).astype(int).tolist()
    return (x0, y0, x1, y1) if x1 - x0 > margin and y1 - y0 > margin else None


def _ippe(corners: Array, camera: CameraModel, side_length: float) -> list[Transform]:
    """Return the two closed-form poses of a square, unrefined."""
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


def _refine(corners: Array, camera: CameraModel, square: Array, pose: Transform) -> _Fit | None:
    """Return the pose of least reprojection error near ``pose``, by Gauss-Newton."""
    for _ in range(20):
        points = pose.apply(square)
        pixels, by_point = camera.linearize(points)
        residual = (corners - pixels).ravel()
        # A small rotation r about the marker's centre moves a point by r x arm, and
        # row . (r x arm) = (arm x row) . r.
        arms = (points - pose.translation)[:, None]
        jacobian = np.concatenate([by_point, np.cross(arms, by_point)], axis=2).reshape(-1, 6)
        try:
            step = np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
        except np.linalg.LinAlgError:
            return None
        if not np.all(np.isfinite(step)):
            return None
        if np.max(np.abs(step)) < 1e-7:
            break
        pose = Transform(rotation_vector_to_matrix(step[3:]) @ pose.rotation,
                         pose.translation + step[:3])
    facing = float(pose.rotation[:, 2] @ pose.translation) < 0.0
    return _Fit(pose, float(residual @ residual), jacobian) if facing else None


def _distinct(fits: list[_Fit]) -> list[_Fit]:
    if len(fits) == 2:
        apart = matrix_to_rotation_vector(fits[0].pose.rotation @ fits[1].pose.rotation.T)
        if np.linalg.norm(apart) < _SAME_ROTATION:
            return [min(fits, key=lambda fit: fit.squares)]
    return fits


def _surprise(pose: Transform, neighbor: Neighbor, prediction: Prediction) -> float:
    """Return how improbable an orientation is, as chi^2, from history and uprightness."""
    surprise = 0.0
    expected = prediction.markers.get(neighbor.name)
    if expected is not None:
        off = np.linalg.norm(matrix_to_rotation_vector(pose.rotation @ expected.rotation.T))
        surprise += min(float(off / SIGMA_HISTORY)**2, MAX_HISTORY)
    if prediction.up is not None:
        body_up = pose.rotation @ neighbor.T_body_marker.rotation.T[:, 2]
        tilt = np.arccos(np.clip(body_up @ prediction.up, -1.0, 1.0))
        surprise += float(tilt / SIGMA_UPRIGHT)**2
    return surprise


def _likelier(a: Measurement, b: Measurement, expected: Transform | None) -> Measurement:
    """Return which of two measurements of one marker to believe; false detections happen."""
    if bool(a.rejected) != bool(b.rejected):
        return b if a.rejected else a
    if expected is None:  # a print on the wall behind is further away
        return min(a, b, key=lambda m: float(np.linalg.norm(m.T_camera_marker.translation)))
    return min(a, b, key=lambda m: float(
        np.linalg.norm(m.T_camera_marker.translation - expected.translation)))
