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
The measurement of one neighbor in one image, and the choice between its possible attitudes.

A square that is mirrored about the line of sight looks almost the same, and the edges do not
always show which attitude is right. ``choose`` adds two priors: the expected attitude, and an
approximately upright neighbor.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import matrix_to_rotation_vector
from flock_follower.perception.edges import apply_step

#: Error of an expected attitude, rad (1 sigma).
SIGMA_HISTORY = 0.1
#: Lean of a neighbor, rad (1 sigma).
SIGMA_UPRIGHT = 0.25
#: History may not outweigh the image for ever: its contribution to chi^2 is capped.
MAX_HISTORY = 9.0
#: Two attitudes closer than this, rad, are one.
SAME_ATTITUDE = 0.02
#: An attitude that differs by more, rad, is another one.
MAX_TURN = 0.3


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
    """The most likely pose, and how much better its chi^2 is; the other pose, its probability."""

    chosen: Hypothesis
    margin: float
    other: Hypothesis | None = None
    share: float = 0.0


def choose(poses: list[Hypothesis], expected: PosePrior) -> Choice:
    """Return the likeliest of one or two poses, given their residuals and the prediction."""
    if len(poses) == 1 or angle(poses[0].pose, poses[1].pose) < SAME_ATTITUDE:
        return Choice(min(poses, key=lambda p: p.chi2), 0.0)  # both in one: soon they may part
    first, second = (p.chi2 + _attitude_chi2(p.pose, expected) for p in poses)
    chosen, other = poses if first <= second else reversed(poses)
    margin = abs(second - first)
    odds = math.exp(-0.5 * margin)
    return Choice(chosen, margin, other, odds / (1.0 + odds))


def _attitude_chi2(pose: Transform, expected: PosePrior) -> float:
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
    return math.acos(min(max(0.5 * float(np.vdot(a.rotation, b.rotation)) - 0.5, -1.0), 1.0))


#: Deviations are widened by this, because neighboring edges share pixels, and the errors by
#: calibration and blur are the same for all.
DEVIATION_FACTOR = 1.5


class Measurement(NamedTuple):
    """
    One neighbor in one image.

    ``T_camera_body`` is the body's pose in the optical frame, m. ``covariance`` (6, 6) is the
    covariance of the position of ``reference`` (3,), a point on the body, m, then of the rotation
    vector r in R_true = exp(r) R, both along the camera's axes. ``rms`` is the distance of the
    edges from their projections, px; for a smeared marker, the difference between its image and
    the rendered image, as a share of the contrast. ``stage`` is how the neighbor was found:
    'track', 'roi' or 'full'. ``spacing``, px, is that of the brightness profiles; None for a
    smeared print. ``margin`` is by how much chi^2 favors this attitude over the mirrored one: 0 if
    both are equal, infinite if several markers decide, None if not checked. ``doubt`` is the
    probability of the mirrored attitude at the last check. ``alike`` is the share of the
    covariance by errors that are correlated between images. ``smear`` and ``lens`` are those of a
    smeared print, as in ``SmearFit``.
    """

    name: str
    T_camera_body: Transform
    reference: Array
    covariance: Array
    rms: float
    spacing: tuple[float, float] | None
    stage: str = 'track'
    margin: float | None = None
    doubt: float = 0.0
    alike: float = 0.0
    smear: Array | None = None
    lens: int = 0


def mix_poses(measurement: Measurement, best: Choice) -> Measurement:
    """Return a measurement with mean and covariance of both poses, and the better one's margin."""
    measurement = measurement._replace(margin=best.margin, doubt=min(best.share, 1.0 - best.share))
    if best.other is None or not best.share > 1e-6:
        return measurement
    pose, other = measurement.T_camera_body, best.other.pose
    at = pose.apply(measurement.reference)
    apart = np.concatenate([
        other.apply(measurement.reference) - at,
        matrix_to_rotation_vector(other.rotation @ pose.rotation.T)])
    return measurement._replace(
        T_camera_body=apply_step(pose, at, best.share * apart),
        covariance=measurement.covariance
        + best.share * (1.0 - best.share) * np.outer(apart, apart))


#: The mirrored attitude is fitted in every image while its chi^2 is within this of the other's.
SETTLED_MARGIN = 100.0
#: Images from one fit of the mirrored attitude to the next, otherwise.
MIRRORED_EVERY = 30
#: Images from one fit of the mirrored attitude of a smeared print to the next.
SMEARED_EVERY = 3
#: Probability of the mirrored attitude below which the other one is settled.
SETTLED_DOUBT = 0.05


def images_unchecked(found: Measurement, expected: PosePrior) -> int:
    """Return the number of images until the mirrored attitude is checked again."""
    assert found.margin is not None
    if found.spacing is not None:
        return MIRRORED_EVERY - 1 if found.margin > SETTLED_MARGIN else 0
    # Both attitudes in one, with a margin of 0, may part soon.
    settled = found.margin > 0.0 and found.doubt < SETTLED_DOUBT and (
        expected.pose is not None
        and angle(found.T_camera_body, expected.pose) < 0.5 * MAX_TURN)
    return SMEARED_EVERY - 1 if settled else 0
