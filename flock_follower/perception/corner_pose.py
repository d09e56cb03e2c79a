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

"""The pose of a marker from its four corners alone."""

from __future__ import annotations

import math

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception import aruco, normal_equations
from flock_follower.perception.attitudes import choose, distinct, Hypothesis, PosePrior
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.corners import marker_corners, refine
from flock_follower.perception.measurement import Measurement, widened, WIDENING
from flock_follower.perception.neighbors import Marker

#: Deviation of a detected corner's coordinate, px, and how far the pose may miss the corners, px
#: RMS.
SIGMA_CORNER = 0.6
MAX_CORNER_RMS = 1.5
#: Deviation of all four from the middle together, px: the darker a blurred
#: outline must be to count, the further inside it is, by up to 1 px at a blur of 2.5 px.
SIGMA_OUTLINE = 0.8


def from_corners(camera: CameraModel, name: str, marker: Marker, corners: Array,
                 starts: list[Transform], expected: PosePrior) -> Measurement | None:
    """
    Return the neighbour ``name`` by four corners of its marker, or None where no pose suits them.

    :param corners: (4, 2), px, from top-left on, clockwise.
    :param starts: poses ``T_camera_body`` to start from, at least one.
    """
    points = marker.T_body_marker.apply(marker_corners(marker.side_length))
    center = marker.T_body_marker.translation
    fits = [refined for start in starts
            if (refined := refine(corners, camera, points, center, start)) is not None]
    if not fits:
        return None
    best = choose(distinct([Hypothesis(f.pose, f.squares / SIGMA_CORNER**2) for f in fits]),
                  expected)
    chosen = next(f for f in fits if f.pose is best.chosen.pose)
    rms = math.sqrt(chosen.squares / 4.0)
    if rms > MAX_CORNER_RMS:
        return None
    covariance = _covariance(corners, chosen.jacobian)
    if covariance is None:
        return None
    return widened(Measurement(name, chosen.pose, center, covariance, rms, None,
                               margin=best.margin), best)


def _covariance(corners: Array, jacobian: Array) -> Array | None:
    """Return the covariance (6, 6) of least squares of corners (4, 2), px, by their Jacobian."""
    alone = normal_equations.covariance(jacobian.T @ jacobian)
    if alone is None:
        return None
    swollen = aruco.outwards(corners[None], SIGMA_OUTLINE)[0] - corners
    together = alone @ (jacobian.T @ swollen.ravel())
    covariance: Array = WIDENING**2 * SIGMA_CORNER**2 * alone + np.outer(together, together)
    return covariance
