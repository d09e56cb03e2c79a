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
How neighbours move: what their filter takes for likely.

The acceleration is Singer's ("Estimating optimal tracking filter performance for manned
maneuvering targets", IEEE Trans. AES, 1970): of standard deviation s, forgotten with a time
constant T, driven by white jerk of spectral density 2 s^2 / T. The angular velocity is driven by
white angular acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np

from flock_follower.geometry import Array
from flock_follower.perception.neighbor_state import (
    ACCELERATION,
    ATTITUDE,
    POSITION,
    RATE,
    SIZE,
    VELOCITY,
)
from flock_follower.ranges import Checked, Range

_EYE = np.eye(3)


@dataclass(frozen=True)
class FilterParams(Checked):
    """
    How neighbours move, and when to doubt a measurement.

    ``acceleration`` is the standard deviation of a neighbour's acceleration, m/s^2 per axis, and
    ``acceleration_time`` the time in which it changes, s. ``angular_noise`` is the root of the
    spectral density of its angular acceleration, rad/s^2/sqrt(Hz).
    ``odometry_noise`` is how the error of one's own velocity wanders, in which all is seen,
    m/s^2/sqrt(Hz).
    ``odometry_walk`` is how one's own position wanders, m/sqrt(s), where no velocity is measured.
    ``initial_speed``, m/s, and ``initial_rate``, rad/s, are the deviations before any motion has
    been seen. ``attitude_noise``, rad, is how much one's own attitude errs differently from one
    image to the next; at a distance it moves a neighbour sideways.
    ``max_rejections`` measurements in a row outside the gate restart the filter, as does a gap
    above ``max_gap`` s or a stamp more than ``max_jump`` s back. A restart that needs more than
    ``leader_speed_max``, m/s, since the newest estimate is refused: see ``hypotheses``.
    """

    acceleration: float = 0.5
    acceleration_time: float = 1.0
    angular_noise: float = 2.0
    odometry_noise: float = 0.03
    odometry_walk: float = 0.02
    initial_speed: float = 1.0
    initial_rate: float = 0.5
    attitude_noise: float = 0.0005
    max_rejections: int = 6
    max_gap: float = 2.0
    max_jump: float = 0.5
    leader_speed_max: float = 2.0

    RANGES: ClassVar[dict[str, Range]] = {
        'acceleration': Range(0.01, 100.0, 'm/s^2'),
        'acceleration_time': Range(0.01, 100.0, 's'),
        'angular_noise': Range(0.01, 100.0, 'rad/s^2/sqrt(Hz)'),
        'odometry_noise': Range(0.0, 100.0, 'm/s^2/sqrt(Hz)', above=True),
        'odometry_walk': Range(0.0, 1.0, 'm/sqrt(s)'),
        'initial_speed': Range(0.0, 100.0, 'm/s', above=True),
        'initial_rate': Range(0.0, 100.0, 'rad/s', above=True),
        'attitude_noise': Range(0.0, 1.0, 'rad'),
        'max_rejections': Range(1, 1000, whole=True),
        'max_gap': Range(0.0, 60.0, 's', above=True),
        'max_jump': Range(0.0, 60.0, 's', above=True),
        'leader_speed_max': Range(0.0, 50.0, 'm/s'),
    }


def motion(dt: float, params: FilterParams) -> tuple[Array, Array]:
    """
    Return what dt, s, does to (p, v, a) along an axis, (3, 3), and the noise it adds, (3, 3).

    Singer's transition is exact. Its noise is that of white jerk of the same density, which it
    tends to for a time constant much longer than dt.
    A negative dt goes back, and adds as much.
    """
    T, x = params.acceleration_time, dt / params.acceleration_time
    decay = math.exp(-x)
    linear = np.array([[1.0, dt, T * T * (x - 1.0 + decay)],
                       [0.0, 1.0, T * (1.0 - decay)],
                       [0.0, 0.0, decay]])
    density, dt = 2.0 * params.acceleration**2 / T, abs(dt)
    noise = density * np.array([[dt**5 / 20.0, dt**4 / 8.0, dt**3 / 6.0],
                                [dt**4 / 8.0, dt**3 / 3.0, dt**2 / 2.0],
                                [dt**3 / 6.0, dt**2 / 2.0, dt]])
    noise[:2, :2] += params.odometry_noise**2 * _walk(dt)
    return linear, noise


def _walk(dt: float) -> Array:
    """Return the covariance of a rate and its integral, driven for dt by white noise."""
    return np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])


def transition(dt: float, params: FilterParams) -> tuple[Array, Array, Array]:
    """
    Return what dt, s, does: to (p, v, a), (3, 3), to the error state, (15, 15), and its noise.

    See :func:`motion`.
    """
    linear, jerk = motion(dt, params)
    whole, noise = np.eye(SIZE), np.zeros((SIZE, SIZE))
    order = (POSITION, VELOCITY, ACCELERATION)
    for i, row in enumerate(order):
        for k, column in enumerate(order):
            whole[row, column] = linear[i, k] * _EYE
            noise[row, column] = jerk[i, k] * _EYE
    whole[ATTITUDE, RATE] = dt * _EYE
    noise[6:12, 6:12] = np.kron(params.angular_noise**2 * _walk(abs(dt)), _EYE)
    return linear, whole, noise


def turned_along(covariances: Array, before: Array, now: Array) -> Array:
    """
    Return covariances (n, k, k), of position, velocity and more, turned from one line to another.

    Of whom no more than the distance is known may be anywhere on a sphere: where the line to the
    likeliest place turns, from ``before`` to ``now``, unit vectors (n, 3), what is known along it
    turns along. ``before`` of zeros turns nothing.
    """
    w = np.cross(before, now)
    cross = np.zeros((len(w), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = w
    cross[:, [1, 2, 0], [2, 0, 1]] = -w
    cosine = np.einsum('ni,ni->n', before, now)
    turn = _EYE + cross + cross @ cross / np.maximum(1.0 + cosine, 0.1)[:, None, None]
    whole = np.tile(np.eye(covariances.shape[-1]), (len(w), 1, 1))
    for part in (POSITION, VELOCITY):
        whole[:, part, part] = turn
    whole[:, -3:, -3:] = turn  # the acceleration
    return whole @ covariances @ whole.transpose(0, 2, 1)


def bounded_across(covariances: Array, along: Array, distance: Array, speed: float) -> Array:
    """
    Return covariances (n, k, k), of position, velocity and more, with what is absurd taken off.

    Seen from where the distances (n,), m, were measured, along (n, 3), a neighbour is no farther
    to the side than it is away, and no faster there than ``speed``, m/s. Were it more, turning
    the line a little would make the distance uncertain, too.
    """
    scale = np.tile(np.eye(covariances.shape[-1]), (len(covariances), 1, 1))
    line = along[:, :, None] * along[:, None, :]
    for part, most in ((POSITION, distance), (VELOCITY, np.full(len(along), speed))):
        block = covariances[:, part, part]
        across = np.einsum('nii->n', block) - np.einsum('nij,nij->n', line, block)
        share = np.minimum(most / np.sqrt(np.maximum(0.5 * across, 1e-12)), 1.0)[:, None, None]
        scale[:, part, part] = line + share * (_EYE - line)
    return scale @ covariances @ scale.transpose(0, 2, 1)
