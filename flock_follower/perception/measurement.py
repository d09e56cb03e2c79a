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
The measurement of one neighbour in one image, and the choice between its possible attitudes.

A square looks almost the same mirrored about the line of sight, and its edges do not always
decide. ``choose`` adds two priors: the expected attitude, and that a neighbour flies about
upright.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from flock_follower.geometry import Array, matrix_to_rotation_vector, Transform
from flock_follower.perception.edges import moved

#: How far an expected attitude may be off, and how far a neighbour leans, rad (1 sigma).
SIGMA_HISTORY = 0.1
SIGMA_UPRIGHT = 0.25
#: History may not outweigh the image for ever: its say in chi^2 is capped.
MAX_HISTORY = 9.0
#: Two attitudes closer than this, rad, are one.
SAME = 0.02


class PosePrior(NamedTuple):
    """
    The prediction before an image.

    ``pose``: the expected ``T_camera_body``, or None; ``up``: unit vector opposite to gravity in
    the camera's optical frame, (3,), or None.
    """

    pose: Transform | None = None
    up: Array | None = None


class Hypothesis(NamedTuple):
    """A pose, the chi^2 of its residuals, and its fit, if any."""

    pose: Transform
    chi2: float
    fit: Any = None


class Choice(NamedTuple):
    """The likeliest pose; the others with their probabilities; its lead in chi^2."""

    chosen: Hypothesis
    others: list[tuple[float, Hypothesis]]
    margin: float


def choose(poses: list[Hypothesis], expected: PosePrior) -> Choice:
    """Return the likeliest of one or two poses, given their residuals and the prediction."""
    if len(poses) == 2 and angle(poses[0].pose, poses[1].pose) < SAME:
        poses = [min(poses, key=lambda p: p.chi2)]
    if len(poses) == 1:
        return Choice(poses[0], [], 0.0)  # both in one: soon they may part
    surprise = np.array([p.chi2 + _surprise(p.pose, expected) for p in poses])
    best = int(np.argmin(surprise))
    weights = np.exp(-0.5 * (surprise - surprise[best]))
    weights /= weights.sum()
    others = [(float(w), p) for k, (w, p) in enumerate(zip(weights, poses)) if k != best]
    margin = min(float(s - surprise[best]) for k, s in enumerate(surprise) if k != best)
    return Choice(poses[best], others, margin)


def _surprise(pose: Transform, expected: PosePrior) -> float:
    """Return how improbable an attitude is, as chi^2, from history and uprightness."""
    surprise = 0.0
    if expected.pose is not None:
        surprise += min((angle(pose, expected.pose) / SIGMA_HISTORY)**2, MAX_HISTORY)
    if expected.up is not None:
        lean = math.acos(min(max(float(pose.rotation[:, 2] @ expected.up), -1.0), 1.0))
        surprise += (lean / SIGMA_UPRIGHT)**2
    return surprise


def angle(a: Transform, b: Transform) -> float:
    """Return the angle between two attitudes, rad."""
    trace = float(np.sum(a.rotation * b.rotation))
    return math.acos(min(max(0.5 * (trace - 1.0), -1.0), 1.0))


#: Deviations are widened by this, because neighbouring edges share pixels, and what calibration
#: and blur do is the same for all.
WIDENING = 1.5


class Measurement(NamedTuple):
    """
    One neighbour in one image.

    ``T_camera_body`` is its body's pose in the optical frame, m. ``covariance`` (6, 6) is of the
    position of ``reference`` (3,), a point on the body, m, then of the rotation vector r in
    R_true = exp(r) R, both along the camera's axes. ``rms`` is how far the edges are
    from their projections, px; of a smeared marker the difference of its image from the
    rendered one, as a share of contrast; ``stage`` how it was found: 'track', 'roi' or 'full'.
    ``spacing``, px, of the brightness profiles, None without profiles.
    ``margin`` is by how much chi^2 favours this attitude over the mirrored one; 0 if both are
    equal, infinite if several markers decide it, None if it was not checked.
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
    """Return a measurement with mean and covariance of all poses, and the margin of the best."""
    measurement = measurement._replace(margin=best.margin)
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
