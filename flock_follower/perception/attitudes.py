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
Which of the attitudes that explain a marker's image to believe.

Mirrored about the line of sight, a square looks almost the same, and the edges do not always tell.
What else speaks for an attitude is that history expects it, and that a neighbour flies about
upright.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, Transform
from flock_follower.perception.edge_fit import EdgeFit

#: How far an expected attitude may be off, and how far a neighbour leans, rad (1 sigma).
SIGMA_HISTORY = 0.1
SIGMA_UPRIGHT = 0.25
#: History may not outweigh the image for ever: its say in chi^2 is capped.
MAX_HISTORY = 9.0
#: Two attitudes closer than this, rad, are one.
SAME = 0.02


class PosePrior(NamedTuple):
    """
    What is known before the image.

    ``pose``: the expected ``T_camera_body``, or None; ``up``: unit vector opposite to gravity in
    the camera's optical frame, (3,), or None.
    """

    pose: Transform | None = None
    up: Array | None = None


class Hypothesis(NamedTuple):
    """A pose, the chi^2 of its residuals, and the fit it comes from, if any."""

    pose: Transform
    chi2: float
    fitted: EdgeFit | None = None


class Choice(NamedTuple):
    """The likeliest pose; the others with their probabilities; its lead in chi^2."""

    chosen: Hypothesis
    others: list[tuple[float, Hypothesis]]
    margin: float


def choose(poses: list[Hypothesis], expected: PosePrior) -> Choice:
    """Return the likeliest of at least one pose, given its residuals and what is expected."""
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


def distinct(poses: list[Hypothesis]) -> list[Hypothesis]:
    """Return the poses, or the better one where two are the same."""
    if len(poses) == 2 and angle(poses[0].pose, poses[1].pose) < SAME:
        return [min(poses, key=lambda p: p.chi2)]
    return poses
