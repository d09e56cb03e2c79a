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

"""What one image tells of one neighbour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, matrix_to_rotation_vector, Transform
from flock_follower.perception.attitudes import Choice
from flock_follower.perception.edge_fit import moved

#: Deviations are widened by this, because neighbouring edges share pixels, and what calibration
#: and blur do is the same for all.
WIDENING = 1.5


class Measurement(NamedTuple):
    """
    One neighbour in one image.

    ``T_camera_body`` is its body's pose in the optical frame, m. ``covariance`` (6, 6) is of the
    position of ``reference`` (3,), a point on the body, m, then of the rotation vector r in
    R_true = exp(r) R, both along the camera's axes. ``rms`` is how far the edges, or corners,
    are from where the pose has them, px, of a smeared marker what its image differs by from the
    pose's, as a share of contrast; ``stage`` how it was found: 'track', 'roi' or 'full'.
    ``spacing``, px, of brightness profiles suited the image, None where there were none.
    ``margin`` is by how much chi^2 favours this attitude over the mirrored one; 0 where both are
    one, infinite where several markers leave no doubt, None where that was not looked at.
    """

    name: str
    T_camera_body: Transform
    reference: Array
    covariance: Array
    rms: float
    spacing: tuple[float, float] | None
    stage: str = 'track'
    margin: float | None = None


def widened(measurement: Measurement, best: Choice) -> Measurement:
    """Return a measurement with mean and covariance of all poses, by their probability."""
    pose, reference = measurement.T_camera_body, measurement.reference
    at = pose.apply(reference)
    mean, square = np.zeros(6), np.zeros((6, 6))
    for weight, other in best.others:
        if weight > 1e-6:
            d = np.concatenate([
                other.pose.apply(reference) - at,
                matrix_to_rotation_vector(other.pose.rotation @ pose.rotation.T)])
            mean += weight * d
            square += weight * np.outer(d, d)
    if not mean.any():
        return measurement
    return measurement._replace(
        T_camera_body=moved(pose, at, mean),
        covariance=measurement.covariance + square - np.outer(mean, mean))


def likeliest(several: Sequence[Measurement], expected: Transform | None) -> Measurement:
    """Return which measurement of one neighbour to believe: prints and reflections happen."""
    # A print on the wall behind is farther away.
    place = np.zeros(3) if expected is None else expected.translation
    return min(several, key=lambda m: float(np.linalg.norm(m.T_camera_body.translation - place)))
