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
Innovations of a filter: covariance, size, and errors that are correlated between images.

A smear, a reflex or over-exposure lasts for several images, and causes similar errors of the
measured poses: the mean of ten such poses is hardly better than one pose. The filter considers
these errors without estimating them (Schmidt, "Application of state-space methods to navigation
problems", 1966): it stores the covariance between its state and the errors. The errors are those
of a measured point and of the attitude, scaled to unit variance; they decay with a time constant.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from flock_follower.geometry import Array, skew

ALIKE_TIME = 0.25  # s, time constant of the errors
FORGET_AFTER = 6.0  # time constants without such a measurement until the errors are forgotten
_IDENTITY = np.eye(6)  # np.eye takes several times as long as a copy


class AlikeErrors:
    """``cross`` (15, 6): covariance of a filter's error state with the errors; None if zero."""

    def __init__(self) -> None:
        self.cross: Array | None = None
        self._age = 0.0  # since the last measurement that has such errors, s

    def pass_on(self, dt: float, transition: Array) -> None:
        """Predict over dt, s, with the transition (15, 15) of the error state."""
        self._age += dt
        if self.cross is not None:
            self.cross = math.exp(-dt / ALIKE_TIME) * transition.dot(self.cross)
            if self._age > FORGET_AFTER * ALIKE_TIME:
                self.cross = None

    def take(self, remain: Array, gain: Array, root: Array | None) -> None:
        """
        Take an update of the state.

        :param remain: the factor (15, 15) by which the update reduces the error state; :param
            gain: (15, n).
        :param root: :func:`root_of` the errors in the measurement, (n, 6); None without errors.
        """
        if self.cross is not None:
            self.cross = remain.dot(self.cross)
        if root is not None:
            self._age = 0.0
            self.cross = (0.0 if self.cross is None else self.cross) - gain.dot(root)

    def together(self, root: Array | None) -> Array | None:
        """Return the covariance (15, n) of the state with the measurement; None if it is 0."""
        return None if root is None or self.cross is None else self.cross.dot(root.T)


def root_of(covariance: Array) -> Array:
    """Return the symmetric root (n, n) of a covariance (n, n); it changes continuously."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).dot(vectors.T))


def scale_variances(covariance: Array, part: slice | Array, factor: float) -> Array:
    """Return a covariance with the variances of a part multiplied."""
    scale = np.ones(len(covariance))
    scale[part] = math.sqrt(factor)
    return covariance * np.outer(scale, scale)


def expected_innovation(prior: Array, jacobian: Array, noise: Array,
                        shared: Array | None) -> tuple[Array, Array]:
    """
    Return the covariances of an innovation with the state, (n, 15), and of itself, (n, n).

    :param shared: the covariance of the state with the noise, (15, n), if any.
    """
    across = jacobian.dot(prior)
    if shared is None:
        return across, across.dot(jacobian.T) + noise
    across = across + shared.T
    return across, across.dot(jacobian.T) + jacobian.dot(shared) + noise


def to_body(lever: Array) -> Array:
    """
    Return the matrix (6, 6) from the errors of a point and of the attitude to those of the body.

    ``lever`` (3,) is the vector from the body's origin to the point, in odom: p = p_point - R l,
    so dp = dp_point + [R l]x dr.
    """
    matrix = _IDENTITY.copy()
    matrix[:3, 3:] = skew(lever)
    return matrix


def squared_distance(innovation: Array, spread: Array) -> float:
    """Return the squared Mahalanobis distance; infinity if the spread (n, n) is singular."""
    solved, solution = cv2.solve(spread, innovation[:, None])
    return float(innovation.dot(solution[:, 0])) if solved else math.inf
