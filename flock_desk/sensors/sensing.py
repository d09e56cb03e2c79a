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

"""Sensors in lock step: the field of view of a camera, its noise, radio messages and ranges."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from flock_desk.scenarios.scenario import RangeErrors
from flock_follower.geometry import Array

#: Where cameras look, and markers, on the body (FLU).
DIRECTIONS = {'front': (1, 0, 0), 'left': (0, 1, 0), 'right': (0, -1, 0), 'back': (-1, 0, 0),
              'up': (0, 0, 1), 'down': (0, 0, -1)}


def _camera_axes(direction: tuple[int, int, int]) -> tuple[Array, Array, Array]:
    """Return the forward, left and up axes of a camera on the body, (3,) each."""
    axis = np.array(direction, dtype=float)
    up = np.array([-axis[2], 0.0, 1.0 - abs(axis[2])])
    return axis, np.cross(up, axis), up


_CAMERA_AXES = {name: _camera_axes(direction) for name, direction in DIRECTIONS.items()}
_IDENTITY = np.eye(3)


@dataclass(frozen=True)
class PerceptionNoise:
    """
    Standard deviations of a marker's measured position, and the camera's field of view.

    As measured on rendered flights, marker 0.16 m and focal length 611 px: along the line of
    sight 0.4 mm at 1.2 m, 1.2 mm at 2.2 m, 2 to 6 mm at 3 to 4 m with motion blur.
    """

    lateral: float = 0.0005
    """Across the line of sight, rad times the distance: the ego attitude, image by image."""
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
    """Farthest distance at which the marker is detected, m."""


def relative_noise(offsets: Array, noise: PerceptionNoise, turning: ArrayLike = 0.0) -> Array:
    """
    Return the covariances (n, 3, 3), m^2, of leaders measured at offsets (n, 3), m.

    :param turning: how fast each moves across the image (n,), rad/s.
    """
    r2 = np.add.reduce(offsets * offsets, axis=1)[:, None, None]
    blur = 1.0 + noise.blur * np.asarray(turning)[..., None, None]
    along = ((noise.range_constant + noise.range_growth * r2) * blur) ** 2
    across = noise.lateral ** 2 * r2
    outer = offsets[:, :, None] * offsets[:, None, :] / r2
    return across * _IDENTITY + (along - across) * outer


def in_view(offsets: Array, rotations: Array, noise: PerceptionNoise,
            cameras: Sequence[str] = ('front',)) -> Any:
    """
    Return which vehicles at offsets (n, 3), ENU, the cameras of bodies (n, 3, 3) see.

    :param cameras: where they look, keys of ``DIRECTIONS``.
    """
    on_body = np.einsum('nji,nj->ni', rotations, offsets)
    seen = np.zeros(len(offsets), dtype=bool)
    for camera in cameras:
        ahead, aside, above = (on_body @ axis for axis in _CAMERA_AXES[camera])
        seen |= ((ahead > noise.nearest) & (np.abs(aside) < noise.half_width * ahead)
                 & (np.abs(above) < noise.half_height * ahead))
    return seen & (np.add.reduce(offsets * offsets, axis=1) <= noise.farthest ** 2)


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
    shown = np.zeros(len(offsets), dtype=bool)
    for face in faces:
        shown |= -on_body @ _CAMERA_AXES[face][0] >= least
    return shown


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


Message = TypeVar('Message')


class Radio(Generic[Message]):
    """
    Messages within flocks of m vehicles; no flock receives messages of another.

    :param company: m, the number of vehicles in each flock.
    :param delay: time from sending to arrival, s.
    :param loss: share of messages that do not arrive at one of the receivers.
    :param generators: random generators, one for each follower, flock by flock.
    """

    def __init__(self, company: int, delay: float, loss: float,
                 generators: Sequence[np.random.Generator]) -> None:
        self._company, self._delay, self._loss = company, delay, loss
        self._generators = generators
        self._coming: deque[tuple[float, int, Message]] = deque()

    def send(self, now: float, sender: int, messages: Sequence[Message]) -> None:
        """Take messages that a follower, counted through all flocks, sends at a time, s."""
        first = sender - sender % self._company
        draws = self._generators[sender].random((len(messages), self._company))
        for message, luck in zip(messages, draws.tolist()):
            self._coming += [
                (now + self._delay, first + k, message) for k, p in enumerate(luck)
                if first + k != sender and p >= self._loss]

    def arrived(self, now: float) -> list[tuple[int, Message]]:
        """Return the messages that have arrived since the last call, each with its receiver."""
        received = []
        while self._coming and self._coming[0][0] <= now + 1e-9:
            _, receiver, message = self._coming.popleft()
            received.append((receiver, message))
        return received


class Radios:
    """
    Measure distances with the errors of a scenario.

    :param generators: of the random numbers, one for each row.
    """

    def __init__(self, errors: RangeErrors, generators: Sequence[np.random.Generator]) -> None:
        self._errors, self._generators = errors, generators
        self._bias = errors.bias * np.array([g.standard_normal() for g in generators])
        self._walk = errors.bias_walk * errors.rate ** -0.5

    def measure(self, distance: Array) -> Array:
        """Return measurements of true distances (n,), m, one period after the last."""
        errors = self._errors
        drawn = np.stack([g.standard_normal(2) for g in self._generators])
        chance = np.stack([g.random(2) for g in self._generators])
        self._bias = self._bias + self._walk * drawn[:, 0]
        detour = np.where(chance[:, 0] < errors.outliers, errors.outlier * chance[:, 1], 0.0)
        measured: Array = np.maximum(
            distance + self._bias + errors.noise * drawn[:, 1] + detour, 0.0)
        return measured
