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
A marker at rest, seen while the camera moves: it tells its size, and how the camera is mounted.

By odometry and image it has to stay where it is. Where it comes nearer by more, or less, than the
camera moved towards it, its size (or the focal length) is another one; where it swings as the
camera turns, the camera looks elsewhere than told. With y, from the camera to the marker as seen,
q the camera's place by odometry, both along odom's axes, and s how many times too far all is seen,

    y = c - s q - turn x y - ...    (least squares; c is s times where the marker is)

A leader that moves can look just so: one that goes ahead by half of what the follower does is like
a marker told too small. From relative positions alone this cannot be known. So it is told only
where a single s explains nearly all that y changes by, and the marker keeps its attitude, as it
does where it stands on the ground and the camera is carried before it.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from flock_follower.geometry import (
    Array,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    skew,
)

#: Sightings, at least.
FEW: Final = 12
#: Deviations of what is estimated besides, so that it is not taken for the former two: creeping
#: of marker or odometry, m/s; the camera's place on the body, m; offset of its stamps, s.
CREEP, PLACE, LATE = 0.02, 0.05, 0.02
#: Deviations before anything was seen, of s and of the turn, rad.
SCALE, TURN = 1.0, 0.5
#: Deviations of odometry, m, and of what is seen, share of the distance, at least.
ODOMETRY, SHARE = 0.005, 0.003
#: Errors of odometry that last are partly fitted as if they were motion: deviations were half.
WIDENED: Final = 2.0
_PASSES = 6
_HUBER = 2.0  # deviations
_CORRELATED = 0.9  # of neighbouring residuals, at most


class OwnPath(NamedTuple):
    """
    One's own motion at the n images.

    ``times`` (n,), s; of base_link in odom ``positions`` (n, 3), m, ``velocities`` (n, 3), m/s,
    ``rotations`` (n, 3, 3), and ``rates`` (n, 3), rad/s, along its own axes.
    """

    times: Array
    positions: Array
    velocities: Array
    rotations: Array
    rates: Array


class Sightings(NamedTuple):
    """
    The marker as seen in n images, along base_link's axes as the camera is told to be mounted.

    ``arms`` (n, 3), m, from the camera to it, ``deviations`` (n,) of these, m; ``attitudes``
    (n, 3, 3). ``camera`` (3,), m: where the camera is on base_link.
    """

    arms: Array
    deviations: Array
    attitudes: Array
    camera: Array


class RestFit(NamedTuple):
    """
    What explains the sightings as those of a marker at rest.

    ``scale``: how many times too far it is seen; ``turn`` (3,), rad, along base_link's axes: the
    camera is mounted by exp(turn) otherwise than told; ``deviation`` and ``turn_deviations`` (3,)
    of them. ``moved``: RMS of the camera's way from its middle, m; ``left``: RMS, m, of what is
    left unexplained; ``swayed``: how far, rad, the marker's attitude is from its mean, half the
    time.
    """

    scale: float
    deviation: float
    turn: Array
    turn_deviations: Array
    moved: float
    left: float
    swayed: float


def fit_rest(seen: Sightings, own: OwnPath) -> RestFit | None:
    """Return what explains the sightings best, None where they are too few."""
    count = len(seen.arms)
    if count < FEW:
        return None
    R, w = own.rotations, own.rates
    q = own.positions + R @ seen.camera
    away = q - q.mean(axis=0)
    moving = own.velocities + _turned(R, np.cross(w, seen.camera))
    times = own.times - own.times.mean()
    variance = (seen.deviations**2 + ODOMETRY**2
                + (SHARE * np.linalg.norm(seen.arms, axis=1))**2)
    prior = np.diag([0.0] * 3 + [CREEP**-2] * 3 + [SCALE**-2] + [TURN**-2] * 3
                    + [PLACE**-2] * 3 + [LATE**-2])
    turn: Array = np.zeros(3)
    scale, robust = 1.0, np.ones(count)
    eye = np.broadcast_to(np.eye(3), (count, 3, 3))
    for _ in range(_PASSES):
        arms = seen.arms @ rotation_vector_to_matrix(turn).T
        y = _turned(R, arms)
        late = -(_turned(R, np.cross(w, arms)) + scale * moving)
        design = np.concatenate([
            eye, times[:, None, None] * eye, -away[:, :, None],
            R @ np.array([skew(arm) for arm in arms]), -R, late[:, :, None]], axis=2)
        weights = (robust / variance)[:, None, None]
        information = np.sum(np.swapaxes(design, 1, 2) @ (weights * design), axis=0) + prior
        moment = np.sum(np.swapaxes(design, 1, 2) @ (weights * y[:, :, None]), axis=0)[:, 0]
        # The prior is of the whole turn, not of what is added to it, and of s - 1.
        moment[6] += prior[6, 6]
        moment[7:10] -= prior[7:10, 7:10] @ turn
        solution = np.linalg.solve(information, moment)
        residual = y - (design @ solution)
        scale, turn = float(solution[6]), _composed(turn, solution[7:10])
        off = np.linalg.norm(residual, axis=1) / np.sqrt(variance)
        typical = max(float(np.median(off)), 1.0)
        robust = np.minimum(1.0, _HUBER * typical / np.maximum(off, 1e-9))
    spread = _spread(residual, robust / variance)
    deviations = WIDENED * np.sqrt(spread * np.linalg.inv(information).diagonal())
    return RestFit(
        scale, float(deviations[6]), turn, deviations[7:10],
        float(np.sqrt(np.mean(np.sum(away**2, axis=1)))),
        float(np.sqrt(np.average(np.sum(residual**2, axis=1), weights=robust))),
        _sway(R @ (rotation_vector_to_matrix(turn) @ seen.attitudes)))


def _turned(R: Array, vectors: Array) -> Array:
    """Return rotations (n, 3, 3) of vectors (n, 3)."""
    turned: Array = (R @ vectors[:, :, None])[:, :, 0]
    return turned


def _composed(turn: Array, more: Array) -> Array:
    return matrix_to_rotation_vector(
        rotation_vector_to_matrix(more) @ rotation_vector_to_matrix(turn))


def _spread(residual: Array, weights: Array) -> float:
    """
    Return by how much residuals (n, 3) are larger than their variances, and alike in time.

    Errors of odometry last: as neighbours err alike, there are fewer that are independent.
    """
    squares = np.sum(residual**2, axis=1)
    chi2 = float(np.sum(weights * squares)) / (3 * len(residual) - 14)
    together = float(np.sum(residual[1:] * residual[:-1])) / max(float(np.sum(squares)), 1e-12)
    together = min(max(together, 0.0), _CORRELATED)
    return max(chi2 * (1.0 + together) / (1.0 - together), 1.0)


def _sway(attitudes: Array) -> float:
    """Return how far attitudes (n, 3, 3) are from their mean half the time, rad."""
    u, _, v = np.linalg.svd(attitudes.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    cosines = 0.5 * (np.einsum('nij,ij->n', attitudes, mean) - 1.0)
    return float(np.median(np.arccos(np.clip(cosines, -1.0, 1.0))))
