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
What simulated followers know: odometry of their own, and the leader's filtered motion.

Each object serves n runs at once, one row each; every row has a generator of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flock_follower.geometry import Array
from flock_follower.perception.neighbor_filter import FilterParams, GATE, motion
from flock_follower.simulation.sensors.vio import VioNoise

Generators = list[np.random.Generator]


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
    """... plus this times the squared distance, 1/m."""
    half_width: float = 0.50
    """Tangent of the horizontal half angle of view that holds a whole marker."""
    half_height: float = 0.37
    """Likewise vertically."""
    nearest: float = 0.3
    """Nearest distance at which a marker fits the image, m."""


def relative_noise(offsets: Array, noise: PerceptionNoise) -> Array:
    """Return the covariances (n, 3, 3), m^2, of leaders measured at offsets (n, 3), m."""
    r2 = np.sum(offsets * offsets, axis=1)[:, None, None]
    along = (noise.range_constant + noise.range_growth * r2) ** 2
    across = noise.lateral ** 2 * r2
    outer = offsets[:, :, None] * offsets[:, None, :] / r2
    return across * np.eye(3) + (along - across) * outer


def in_view(offsets: Array, rotations: Array, noise: PerceptionNoise) -> Any:
    """Return which leaders at offsets (n, 3), ENU, the cameras of bodies (n, 3, 3) see."""
    x, y, z = np.moveaxis(np.einsum('nji,nj->ni', rotations, offsets), 1, 0)
    return ((x > noise.nearest) & (np.abs(y) < noise.half_width * x)
            & (np.abs(z) < noise.half_height * x))


class Vio:
    """
    Visual-inertial odometry: the true motion, with drift and noise, step by step.

    Yaw and position walk at random, and the walk of the yaw turns every further step.
    """

    def __init__(self, position: Array, generators: Generators, noise: VioNoise,
                 period: float) -> None:
        self.noise = noise
        self.position = position.copy()
        self.velocity = np.zeros_like(position)
        self.travel = position.copy()
        """The integral of the velocity (n, 3), m, as ``perception.odometry`` keeps it."""
        self.yaw_error = np.zeros(len(position))
        self._period = period
        self._true = position.copy()
        self._walked = position.copy()
        self._correction = np.zeros_like(position)
        self._velocity_error = np.zeros_like(position)
        self._generators = generators
        self._drawn: Array = np.zeros((len(generators), 0, 13))
        self._used = 0
        self._root = period ** 0.5
        self._keep_correction = float(np.exp(-period / 0.5))
        self._keep_velocity = float(np.exp(-period / 0.3))

    def step(self, position: Array, velocity: Array) -> None:
        """Take the true position and velocity (n, 3) one period later."""
        draw = self._draw()
        noise = self.noise
        self.yaw_error = self.yaw_error + noise.yaw_walk * self._root * draw[:, 0]
        self._walked = (self._walked + turned(position - self._true, self.yaw_error)
                        + noise.position_walk * self._root * draw[:, 1:4])
        self._true = position
        self._correction = _renewed(self._correction, self._keep_correction,
                                    noise.position * draw[:, 4:7])
        self._velocity_error = _renewed(self._velocity_error, self._keep_velocity,
                                        noise.velocity * draw[:, 7:10])
        self.position = self._walked + self._correction
        before = self.velocity
        self.velocity = (turned(velocity, self.yaw_error) + self._velocity_error
                         + noise.velocity_white * draw[:, 10:13])
        self.travel = self.travel + 0.5 * self._period * (before + self.velocity)

    def _draw(self) -> Array:
        if self._used == self._drawn.shape[1]:  # drawn in blocks: it is faster
            self._drawn = np.stack([g.standard_normal((256, 13)) for g in self._generators])
            self._used = 0
        self._used += 1
        return self._drawn[:, self._used - 1]


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
        self._outliers: Any = np.zeros(count, dtype=int)
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
    def position_covariance(self) -> Array:
        """Return the covariances (n, 3, 3) of the positions, m^2."""
        return self._covariance[:, :3, :3]

    @property
    def velocity_covariance(self) -> Array:
        """Return the covariances (n, 3, 3) of the velocities, m^2/s^2."""
        return self._covariance[:, 3:6, 3:6]

    def update(self, stamp: float, measured: Array, covariance: Array, seen: Any) -> Any:
        """Take in positions (n, 3), covariances (n, 3, 3), where ``seen``; return where used."""
        dt = stamp - self.stamp
        running = dt <= self.params.max_gap
        steps, which = np.unique(np.where(running, dt, 0.0).round(6), return_inverse=True)
        moves = [motion(float(step), self.params) for step in steps]
        linear = np.stack([np.kron(move, np.eye(3)) for move, _ in moves])[which]
        noise = np.stack([np.kron(jerk, np.eye(3)) for _, jerk in moves])[which]
        state = (linear @ self._state[:, :, None])[:, :, 0]
        spread = linear @ self._covariance @ linear.transpose(0, 2, 1) + noise

        innovation = measured - state[:, :3]
        inverse = np.linalg.inv(spread[:, :3, :3] + covariance)
        outlier = np.einsum('ni,nij,nj->n', innovation, inverse, innovation) > GATE
        self._outliers = np.where(seen & running, np.where(outlier, self._outliers + 1, 0),
                                  self._outliers)
        restart = seen & (~running | (self._outliers >= self.params.max_rejections))
        used = seen & running & ~outlier & ~restart
        self._outliers[restart] = 0

        gain = spread[:, :, :3] @ inverse
        corrected = spread - gain @ spread[:, :3]
        self._state[used] = (state + (gain @ innovation[:, :, None])[:, :, 0])[used]
        self._covariance[used] = (0.5 * (corrected + corrected.transpose(0, 2, 1)))[used]
        self._state[restart] = 0.0
        self._state[restart, :3] = measured[restart]
        self._covariance[restart] = self._begin
        self._covariance[restart, :3, :3] = covariance[restart]
        self.stamp = np.where(used | restart, stamp, self.stamp)
        return used | restart


def turned(vectors: Array, angle: Array) -> Array:
    """Return vectors (n, 3) turned about z by angles (n,), rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vectors[:, 0] - s * vectors[:, 1],
                     s * vectors[:, 0] + c * vectors[:, 1], vectors[:, 2]], axis=1)


def _renewed(values: Array, keep: float, fresh: Array) -> Array:
    """Return a first-order Gauss-Markov process one step later."""
    return keep * values + (1.0 - keep ** 2) ** 0.5 * fresh
