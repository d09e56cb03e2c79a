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
The poses of a square from its corners, and the other pose that looks almost the same.

A square has two poses that explain its corners almost equally well, mirrored about the line of
sight (Collins & Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014; IPPE).
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from flock_follower.geometry import Array, skew, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.edges import apply_step, cross, solve_normal
from flock_follower.perception.markers import marker_corners
from flock_follower.perception.measurement import SAME_ATTITUDE


def ippe(corners: Array, camera: CameraModel, side_length: float) -> list[Transform]:
    """Return the two closed-form poses ``T_camera_marker`` from corners (4, 2), px, if any."""
    normalized = camera.undistort(corners)
    if not np.all(np.isfinite(normalized)):
        return []
    # OpenCV's IPPE returns rotation vectors that are wrong near half a turn, and a marker that
    # faces the camera upright is half a turn away from it. So it is given the square as if it
    # lay in the image, x right and y down, whichever of its corners is on top.
    quarters = int(np.argmin(normalized.sum(axis=1)))
    in_image = np.roll(normalized, -quarters, axis=0)[::-1]
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

    The second value is the Jacobian (8, 6), px per m and rad. ``corners`` (4, 2), px, are the
    images of ``points`` (4, 3) on a body, m. A step rotates the body about ``center`` (3,), m.
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
        pose = apply_step(pose, middle, step)
    return pose, jacobian


def mirror(pose: Transform, center: Array, facing_along: Array) -> Transform | None:
    """
    Return a pose mirrored about the line of sight; None if it is the same.

    :param center: of the marker (3,), in the camera's optical frame, m; it does not move.
    :param facing_along: the marker's normal (3,) on the body.
    """
    normal, sight = pose.rotation.dot(facing_along), center / math.sqrt(center.dot(center))
    other = 2.0 * normal.dot(sight) * sight - normal
    axis = cross(normal[None], other[None])[0]
    sine = math.sqrt(axis.dot(axis))
    if sine < SAME_ATTITUDE:
        return None
    step = np.zeros(6)
    step[3:] = math.atan2(sine, normal.dot(other)) / sine * axis
    return apply_step(pose, center, step)
