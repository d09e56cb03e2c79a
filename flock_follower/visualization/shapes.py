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
Shapes in space: what ``visualization_msgs/Marker`` can show, as plain values.

All are in one frame, that of the odometry (ENU); lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array, IDENTITY_QUATERNION, matrix_to_quaternion

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each in [0, 1]."""

ARROW, CUBE, SPHERE, LINE_STRIP, LINE_LIST, TEXT = (
    'ARROW', 'CUBE', 'SPHERE', 'LINE_STRIP', 'LINE_LIST', 'TEXT_VIEW_FACING')
CIRCLE_POINTS = 48
DEGENERATE = 1e-3  # m: nothing is drawn shorter than this, viewers refuse sizes of zero


class Shape(NamedTuple):
    """One shape; ``name`` tells it from others, and replaces the one drawn before."""

    name: str
    kind: str
    """The name of a constant of ``visualization_msgs/Marker``."""
    color: Color
    size: tuple[float, float, float]
    """Lengths along the axes; of lines the width first, of text the height last."""
    position: Array = np.zeros(3)
    quaternion: Array = IDENTITY_QUATERNION
    points: Array = np.zeros((0, 3))
    """Of lines and arrows (n, 3); then position and quaternion are left alone."""
    text: str = ''


def arrow(name: str, start: Array, along: Array, color: Color, width: float = 0.04) -> Shape:
    """Return an arrow from a place (3,) along a vector (3,)."""
    return Shape(name, ARROW, color, (width, 2.0 * width, 2.5 * width),
                 points=np.stack([start, start + along]))


def lines(name: str, points: ArrayLike, color: Color, width: float = 0.02) -> Shape:
    """Return lines between points (n, 3): first and second, third and fourth, and so on."""
    return Shape(name, LINE_LIST, color, (width, 0.0, 0.0),
                 points=np.asarray(points, dtype=float).reshape(-1, 3))


def circle(name: str, centre: Array, radius: float, color: Color, width: float) -> Shape:
    """Return a level circle about a place (3,)."""
    angle = np.linspace(0.0, math.tau, CIRCLE_POINTS + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return Shape(name, LINE_STRIP, color, (width, 0.0, 0.0), points=centre + radius * ring)


def ellipsoid(name: str, centre: Array, covariance: Array, deviations: float,
              color: Color) -> Shape:
    """Return the ellipsoid of so many standard deviations of a finite covariance (3, 3), m^2."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:  # a mirror is no rotation
        axes[:, 0] = -axes[:, 0]
    x, y, z = np.maximum(
        2.0 * deviations * np.sqrt(np.maximum(variances, 0.0)), DEGENERATE).tolist()
    return Shape(name, SPHERE, color, (x, y, z), centre, matrix_to_quaternion(axes))


def text(name: str, position: Array, told: str, color: Color, height: float = 0.15) -> Shape:
    """Return text that faces whoever looks."""
    return Shape(name, TEXT, color, (0.0, 0.0, height), position, text=told)


def frustum(name: str, apex: Array, corners: Sequence[Array] | Array, color: Color) -> Shape:
    """Return the edges of a pyramid whose base has four corners (4, 3) in order."""
    ends = []
    for k in range(4):
        ends += [apex, corners[k], corners[k], corners[(k + 1) % 4]]
    return lines(name, np.stack(ends), color, 0.01)
