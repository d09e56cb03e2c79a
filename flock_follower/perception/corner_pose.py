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
from flock_follower.perception.attitudes import choose, distinct, Hypothesis, PosePrior
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.corners import marker_corners, refine
from flock_follower.perception.measurement import Measurement, widened, WIDENING
from flock_follower.perception.neighbors import Marker

#: Deviation of a detected corner's coordinate, px, and how far the pose may miss the corners, px
#: RMS.
SIGMA_CORNER = 0.6
MAX_CORNER_RMS = 1.5


def from_corners(camera: CameraModel, name: str, marker: Marker, corners: Array,
                  starts: list[Transform], expected: PosePrior) -> Measurement | None:
    """Return the pose of four corners, where blur or darkness leaves no edges to fit."""
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
    covariance = np.linalg.inv(chosen.jacobian.T @ chosen.jacobian) * (
        SIGMA_CORNER * WIDENING)**2
    return widened(Measurement(name, chosen.pose, center, covariance, rms, None,
                                margin=best.margin), best)
