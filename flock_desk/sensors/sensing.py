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
How simulated followers see their leader in lock step: what is in view, noise, the filter.

Each object serves n runs at once, one row each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from flock_follower.geometry import Array
from flock_follower.perception.neighbor_filter import GATE, NEAREST, RangeGate, WILD
from flock_follower.perception.neighbor_motion import (
    bounded_across,
    FilterParams,
    motion,
    turned_along,
)

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
    """Across the line of sight, rad times the distance: one's own attitude, image by image."""
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
    Return which vehicles (n, 3, 3) show a marker to whoever looks, not too oblique (n,).

    :param offsets: of the vehicles from there (n, 3), m.
    :param angle: from a marker's normal up to which it is found, rad.
    :param faces: their sides that have one, keys of ``DIRECTIONS``.
    """
    on_body = np.einsum('nji,nj->ni', rotations, offsets)
    least = math.cos(angle) * np.linalg.norm(offsets, axis=1)
    return np.any([-on_body @ np.array(DIRECTIONS[f]) >= least for f in faces], axis=0)


def hidden(offsets: Array, present: Any, radius: float) -> Any:
    """
    Return behind which of m vehicles (..., m) another one stands in the way.

    :param offsets: of all of them from whoever looks (..., m, 3), m.
    :param present: which are there (..., m).
    :param radius: of a vehicle, m.
    """
    distance = np.linalg.norm(offsets, axis=-1)
    # [..., b, j]: how far b is along the way to j, and how far beside it.
    along = offsets @ np.swapaxes(offsets, -1, -2) / distance[..., None, :]
    beside = distance[..., :, None] ** 2 - along ** 2
    between = (along > 0.0) & (along < distance[..., None, :]) & (beside < radius ** 2)
    between &= ~np.eye(offsets.shape[-2], dtype=bool) & np.asarray(present)[..., :, None]
    return between.any(axis=-2)


class Filters:
    """
    The neighbour filters of n runs.

    The same estimator of position, velocity and acceleration as ``perception.neighbor_filter``:
    on a marker at the centre of its body the two give the same numbers.
    """

    def __init__(self, count: int, params: FilterParams | None = None) -> None:
        self.params = params or FilterParams()
        self.stamp: Array = np.full(count, -np.inf)
        self._state: Array = np.zeros((count, 9))
        self._covariance: Array = np.zeros((count, 9, 9))
        self._surprises: Array = np.zeros((count, 3))
        self._range_gate = RangeGate(count, self.params.max_rejections)
        self._line: Array = np.zeros((count, 3))  # on which the last distance was measured
        self._begin: Array = np.zeros((9, 9))
        self._begin[3:6, 3:6] = self.params.initial_speed ** 2 * np.eye(3)
        self._begin[6:, 6:] = self.params.acceleration ** 2 * np.eye(3)

    @property
    def position(self) -> Array:
        """Return positions (n, 3), m, at the stamps."""
        return self._state[:, :3]

    @property
    def velocity(self) -> Array:
        """Return velocities (n, 3), m/s."""
        return self._state[:, 3:6]

    @property
    def acceleration(self) -> Array:
        """Return accelerations (n, 3), m/s^2."""
        return self._state[:, 6:]

    @property
    def position_covariance(self) -> Array:
        """Return the covariances (n, 3, 3) of the positions, m^2."""
        return self._covariance[:, :3, :3]

    @property
    def velocity_covariance(self) -> Array:
        """Return the covariances (n, 3, 3) of the velocities, m^2/s^2."""
        return self._covariance[:, 3:6, 3:6]

    def update(self, stamp: float, measured: Array, covariance: Array, seen: Any) -> Any:
        """Take in positions (n, 3), covariances (n, 3, 3), where ``seen``; return where used."""
        state, spread, running = self._predicted(stamp)
        innovation = measured - state[:, :3]
        expected = np.linalg.inv(spread[:, :3, :3] + covariance)
        doubt = np.einsum('ni,nij,nj->n', innovation, expected, innovation) / GATE
        used = seen & running & (doubt <= WILD)
        surprising = used & (doubt > 1.0)
        again = surprising & (np.einsum('ni,ni->n', innovation, self._surprises) > 0.0)
        self._surprises[used] = np.where(surprising[:, None], innovation, 0.0)[used]
        spread = spread * np.where(again, doubt, 1.0)[:, None, None]
        inverse = np.linalg.inv(spread[:, :3, :3] + covariance) / np.where(
            surprising & ~again, doubt, 1.0)[:, None, None]

        restart = seen & ~running
        self._surprises[restart] = 0.0

        gain = spread[:, :, :3] @ inverse
        corrected = spread - gain @ spread[:, :3]
        self._state[used] = (state + (gain @ innovation[:, :, None])[:, :, 0])[used]
        self._covariance[used] = (0.5 * (corrected + corrected.transpose(0, 2, 1)))[used]
        self._state[restart] = 0.0
        self._state[restart, :3] = measured[restart]
        self._covariance[restart] = self._begin
        self._covariance[restart, :3, :3] = covariance[restart]
        self.stamp = np.where(used | restart, stamp, self.stamp)
        self._line[used | restart] = 0.0
        return used | restart

    def _predicted(self, stamp: float) -> tuple[Array, Array, Any]:
        """Return states (n, 9) and covariances (n, 9, 9) at a stamp, s, and which reach there."""
        dt = stamp - self.stamp
        running = dt <= self.params.max_gap
        steps, which = np.unique(np.where(running, dt, 0.0).round(6), return_inverse=True)
        moves = [motion(float(step), self.params) for step in steps]
        linear = np.stack([np.kron(move, np.eye(3)) for move, _ in moves])[which]
        noise = np.stack([np.kron(jerk, np.eye(3)) for _, jerk in moves])[which]
        state = (linear @ self._state[:, :, None])[:, :, 0]
        spread = linear @ self._covariance @ linear.transpose(0, 2, 1) + noise
        return state, spread, running

    def along(self, stamp: float, places: Array) -> tuple[Array, Array, Array]:
        """Return distances (n,), m, from places (n, 3), directions (n, 3), variances (n,), m^2."""
        state, spread, _ = self._predicted(stamp)
        sight = state[:, :3] - places
        distance = np.linalg.norm(sight, axis=1)
        along = sight / np.maximum(distance, NEAREST)[:, None]
        return distance, along, np.einsum('ni,nij,nj->n', along, spread[:, :3, :3], along)

    def go_on_from(self, others: Filters, which: Any) -> None:
        """Take over, where ``which``, what other filters know."""
        self.stamp = np.where(which, others.stamp, self.stamp)
        self._state[which] = others._state[which]
        self._covariance[which] = others._covariance[which]
        self._range_gate.restart(which)
        self._line[which] = 0.0

    def update_range(self, stamp: float, distances: Array, own_positions: Array, variances: Array,
                     given: Any) -> Any:
        """
        Take in distances (n,), m, from (n, 3), m, where ``given``; return where they were used.

        :param variances: of the distances (n,), m^2.
        """
        state, prior, running = self._predicted(stamp)
        sight = state[:, :3] - own_positions
        length = np.linalg.norm(sight, axis=1)
        given = given & running & (stamp > self.stamp) & (length > NEAREST)
        along = sight / np.maximum(length, NEAREST)[:, None]
        prior = turned_along(prior, self._line, along)
        radial = np.einsum('ni,nij,nj->n', along, prior[:, :3, :3], along)
        innovation = distances - length
        used, widened, careful = self._range_gate.judge(innovation, radial + variances, given)
        prior, radial = prior * widened[:, None, None], radial * widened
        whole = careful * (radial + variances)
        across = np.einsum('nij,nj->ni', prior[:, :, :3], along).reshape(-1, 3, 3)
        shares = np.einsum('nbi,ni->nb', across, along) / whole[:, None]
        gain = (shares[:, :, None] * along[:, None, :]).reshape(-1, 9)
        remain = np.tile(np.eye(9), (len(gain), 1, 1))
        remain[:, :, :3] -= gain[:, :, None] * along[:, None, :]
        corrected = remain @ prior @ remain.transpose(0, 2, 1) + (whole - radial)[
            :, None, None] * gain[:, :, None] * gain[:, None, :]
        self._state[used] = (state + gain * innovation[:, None])[used]
        self._covariance[used] = bounded_across(
            corrected, along, length, self.params.initial_speed)[used]
        self._line[used] = along[used]
        self.stamp = np.where(used, stamp, self.stamp)
        return used
