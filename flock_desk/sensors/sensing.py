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

"""Simulated detection in lock step: the field of view of a camera, and measurement noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array

#: Where cameras look, and markers, on the body (FLU).
DIRECTIONS = {'front': (1, 0, 0), 'left': (0, 1, 0), 'right': (0, -1, 0), 'back': (-1, 0, 0),
              'up': (0, 0, 1), 'down': (0, 0, -1)}


@dataclass(frozen=True)
class PerceptionNoise:
    """
    Standard deviations of a marker's measured position, and what the camera sees.

    As measured on rendered flights, marker 0.16 m and focal length 611 px: along the line of
    sight 0.4 mm at 1.2 m, 1.2 mm at 2.2 m, 2 to 6 mm at 3 to 4 m with motion blur.
    """

    lateral: float = 0.0005
    """Across the line of sight, rad times the distance: the own attitude, image by image."""
    range_constant: float = 0.0003
    """Along the line of sight, m ..."""
    range_growth: float = 0.0003
    """... plus this times the squared distance, 1/m ..."""
    blur: float = 1.6
    """... and larger by this share for every rad/s at which it moves across the image, s."""
    half_width: float = 0.50
    """Tangent of the horizontal half angle of view that holds a whole marker."""
    half_height: float = 0.37
    """Likewise vertically."""
    nearest: float = 0.3
    """Nearest distance at which a marker fits the image, m."""
    farthest: float = math.inf
    """Farthest at which it is found, m."""


def relative_noise(offsets: Array, noise: PerceptionNoise, turning: ArrayLike = 0.0) -> Array:
    """
    Return the covariances (n, 3, 3), m^2, of leaders measured at offsets (n, 3), m.

    :param turning: how fast each moves across the image (n,), rad/s.
    """
    r2 = np.sum(offsets * offsets, axis=1)[:, None, None]
    blur = 1.0 + noise.blur * np.asarray(turning)[..., None, None]
    along = ((noise.range_constant + noise.range_growth * r2) * blur) ** 2
    across = noise.lateral ** 2 * r2
    outer = offsets[:, :, None] * offsets[:, None, :] / r2
    return across * np.eye(3) + (along - across) * outer


def in_view(offsets: Array, rotations: Array, noise: PerceptionNoise,
            cameras: Sequence[str] = ('front',)) -> Any:
    """
    Return which vehicles at offsets (n, 3), ENU, the cameras of bodies (n, 3, 3) see.

    :param cameras: where they look, keys of ``DIRECTIONS``.
    """
    on_body = np.einsum('nji,nj->ni', rotations, offsets)
    seen = np.zeros(len(offsets), dtype=bool)
    for axis in (np.array(DIRECTIONS[camera], dtype=float) for camera in cameras):
        up = np.array([-axis[2], 0.0, 1.0 - abs(axis[2])])
        ahead, aside, above = (on_body @ each for each in (axis, np.cross(up, axis), up))
        seen |= ((ahead > noise.nearest) & (np.abs(aside) < noise.half_width * ahead)
                 & (np.abs(above) < noise.half_height * ahead))
    return seen & (np.sum(offsets * offsets, axis=1) <= noise.farthest ** 2)


def facing(offsets: Array, rotations: Array, angle: float,
           faces: Sequence[str] = ('back',)) -> Any:
    """
    Return which vehicles (n, 3, 3) show a marker to the observer, not too oblique (n,).

    :param offsets: positions of the vehicles relative to it (n, 3), m.
    :param angle: largest angle to a marker's normal at which it is found, rad.
    :param faces: sides of a vehicle with a marker, keys of ``DIRECTIONS``.
    """
    on_body = np.einsum('nji,nj->ni', rotations, offsets)
    least = math.cos(angle) * np.linalg.norm(offsets, axis=1)
    return np.any([-on_body @ np.array(DIRECTIONS[f]) >= least for f in faces], axis=0)


def hidden(offsets: Array, present: Any, radius: float) -> Any:
    """
    Return which of m vehicles are hidden by another one (..., m).

    :param offsets: positions of the vehicles relative to the observer (..., m, 3), m.
    :param present: which vehicles exist (..., m).
    :param radius: radius of a vehicle, m.
    """
    distance = np.linalg.norm(offsets, axis=-1)
    # [..., b, j]: how far b is along the way to j, and how far beside it.
    along = offsets @ np.swapaxes(offsets, -1, -2) / distance[..., None, :]
    beside = distance[..., :, None] ** 2 - along ** 2
    between = (along > 0.0) & (along < distance[..., None, :]) & (beside < radius ** 2)
    between &= ~np.eye(offsets.shape[-2], dtype=bool) & np.asarray(present)[..., :, None]
    return between.any(axis=-2)
