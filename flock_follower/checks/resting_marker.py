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
A marker at rest, seen by a moving camera: it shows its size, and how the camera is mounted.

By odometry and image the marker must stay in place. If it approaches by more, or less, than the
camera moves towards it, its size (or the focal length) is wrong. If it swings as the camera turns,
the mounting is wrong. With y from the camera to the marker as seen, q the position of the camera
by odometry, both along odom's axes, and s the ratio of the distance seen to the true one,

    y = c - s q - turn x y - ...    (least squares; c is s times the position of the marker)

A leader that moves can look the same: if it goes ahead by half of the follower's way, it looks
like a marker whose configured size is too small. Relative positions alone cannot distinguish the
two cases. So a result is given only if a single s explains nearly all changes of y, and the marker
keeps its attitude, as it does if it stands on the ground and the camera is carried before it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from flock_follower.checks.findings import Finding, judged, unmeasured
from flock_follower.checks.image_motion import AxesFit, interpolated
from flock_follower.checks.mounting import check_mounting, SURE
from flock_follower.checks.observations import Observations
from flock_follower.geometry import (
    Array,
    matrix_to_rotation_vector,
    quaternion_from_rpy,
    quaternion_to_matrix,
    R_FLU_OPTICAL,
    rotation_vector_to_matrix,
    skew,
)
from flock_follower.messages import NANOSECONDS, OdometryState

#: Least number of sightings.
FEW: Final = 12
#: Prior deviations of nuisance parameters: creep of marker or odometry, m/s; position of the
#: camera on the body, m; offset of its stamps, s.
CREEP, PLACE, LATE = 0.02, 0.05, 0.02
#: Prior deviations of s and of the turn, rad.
SCALE, TURN = 1.0, 0.5
#: Least deviations of odometry, m, and of a sighting, share of the distance.
ODOMETRY, SHARE = 0.005, 0.003
#: Lasting errors of odometry are partly fitted as motion, so deviations came out half as large.
WIDENED: Final = 2.0
_PASSES = 6
_HUBER = 2.0  # deviations
_CORRELATED = 0.9  # of neighbouring residuals, at most

#: m RMS: least motion of the camera.
MOVED: Final = 0.1
#: A marker is at rest if the residual is at most this share of the camera's motion, and it sways
#: by less, rad, half the time: a leader on its course does not keep to a multiple of the
#: follower's motion.
LEFT, SWAYED = 0.15, 0.1
SCALES: Final = (0.4, 2.5)
#: Relative errors of the size: of a warning, of an error; it must be known to 3 deviations.
SIZE, BAD_SIZE = 0.05, 0.1
#: rad: a larger error of the mounting is another order of axes, which has a row of its own.
OTHER_AXES: Final = 0.7
HOW: Final = 'stand the leader on the ground, and carry the camera before it by 1 m, to and fro'
_FAR: Final = 'as far as odometry moves'


class OwnPath(NamedTuple):
    """
    The own motion at the n images.

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
    The marker as seen in n images, along base_link's axes with the camera mounted as configured.

    ``arms`` (n, 3), m, from the camera to it, ``deviations`` (n,) of these, m; ``attitudes``
    (n, 3, 3). ``camera`` (3,), m: position of the camera on base_link.
    """

    arms: Array
    deviations: Array
    attitudes: Array
    camera: Array


class RestFit(NamedTuple):
    """
    The fit of a marker at rest to the sightings.

    ``scale``: ratio of the distance seen to the true one; ``turn`` (3,), rad, along base_link's
    axes: the camera is mounted by exp(turn) otherwise than configured; ``deviation`` and
    ``turn_deviations`` (3,) of them. ``moved``: RMS distance of the camera from its mean position,
    m; ``left``: RMS residual, m; ``swayed``: median angle of the marker from its mean attitude,
    rad.
    """

    scale: float
    deviation: float
    turn: Array
    turn_deviations: Array
    moved: float
    left: float
    swayed: float

    @property
    def at_rest(self) -> bool:
        """Return whether the marker was at rest, and the camera moved."""
        return (self.moved >= MOVED and SCALES[0] <= self.scale <= SCALES[1]
                and self.left <= LEFT * min(self.scale, 1.0) * self.moved
                and self.swayed <= SWAYED and float(np.abs(self.turn).max()) < OTHER_AXES)


def check_resting_marker(seen: Observations, states: list[OdometryState], axes: AxesFit | None
                         ) -> Iterator[Finding]:
    """
    Check the size of the marker and the mounting of the camera.

    :param states: the odometry, as our nodes read it. :param axes: the fit to the image motion,
        None if it is not conclusive.
    """
    estimates = [] if axes is None else [(axes.mounting, axes.mounting_deviations)]
    rpy, why = seen.value('relative_pose', 'camera_rpy', [0.0, 0.0, 0.0]), HOW
    if seen.sightings:
        number, _ = Counter(int(row[1]) for row in seen.sightings).most_common(1)[0]
        fit = _fit(seen, states, number, quaternion_to_matrix(quaternion_from_rpy(*rpy)))
        if fit is not None and fit.at_rest:
            yield _size(fit, number, seen.marker_sides.get(number, 0.0))
            estimates.append((fit.turn, fit.turn_deviations))
        else:
            why = 'the leader moves' if fit is not None and fit.moved >= MOVED else HOW
            yield unmeasured('marker size', why, _FAR)
    if estimates or seen.sightings:
        yield check_mounting(estimates, rpy, why)


def _size(fit: RestFit, number: int, side: float) -> Finding:
    """Check the size of a marker whose configured side is ``side``, m."""
    if SURE * fit.deviation > 3.0 * SIZE:
        return unmeasured('marker size', HOW, _FAR)
    off = abs(fit.scale - 1.0)
    wrong = off > max(SIZE, SURE * fit.deviation)
    return judged(
        wrong and off > BAD_SIZE, wrong, 'marker size',
        f'moves {fit.scale:.2f} ± {fit.deviation:.2f} times as far', _FAR,
        f'measure marker {number}, its black square from edge to edge: {side / fit.scale:.3f} m '
        f'would fit, config/neighbors.yaml says {side:g}. If that is right: is the calibration '
        'of this lens, and the scale of the odometry right?')


def _fit(seen: Observations, states: list[OdometryState], number: int,
         camera_rotation: Array) -> RestFit | None:
    """Return the fit to the sightings of a marker."""
    rows = np.array(sorted(row for row in seen.sightings if row[1] == number))
    start = states[0].stamp
    stamps = np.array([(state.stamp - start) / NANOSECONDS for state in states])
    # Near zero, floats resolve a nanosecond.
    times = rows[:, 0] - start / NANOSECONDS
    quaternions, known = interpolated(
        stamps, np.array([state.quaternion for state in states]))(times)
    rows, times = rows[known], times[known]
    motion = np.array([[*s.position, *s.velocity, *s.angular_velocity] for s in states])
    own = np.column_stack([np.interp(times, stamps, column) for column in motion.T])
    R_base_optical = camera_rotation @ R_FLU_OPTICAL
    return fit_rest(Sightings(
        rows[:, 2:5] @ R_base_optical.T, rows[:, 5],
        np.array([R_base_optical @ quaternion_to_matrix(q) for q in rows[:, 6:10]]),
        np.array(seen.value('relative_pose', 'camera_position', [0.0, 0.0, 0.0]))),
        OwnPath(times, own[:, :3], own[:, 3:6],
                np.array([quaternion_to_matrix(q) for q in quaternions[known]]), own[:, 6:]))


def fit_rest(seen: Sightings, own: OwnPath) -> RestFit | None:
    """Return the least-squares fit to the sightings, None if they are too few."""
    count = len(seen.arms)
    if count < FEW:
        return None
    R, w = own.rotations, own.rates
    q = own.positions + R @ seen.camera
    offsets = q - q.mean(axis=0)
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
            eye, times[:, None, None] * eye, -offsets[:, :, None],
            R @ np.array([skew(arm) for arm in arms]), -R, late[:, :, None]], axis=2)
        weights = (robust / variance)[:, None, None]
        information = np.sum(np.swapaxes(design, 1, 2) @ (weights * design), axis=0) + prior
        moment = np.sum(np.swapaxes(design, 1, 2) @ (weights * y[:, :, None]), axis=0)[:, 0]
        # The prior is of the whole turn, not of its increment, and of s - 1.
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
        float(np.sqrt(np.mean(np.sum(offsets**2, axis=1)))),
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
    Return the factor on the variance: residuals (n, 3) may exceed it, and be correlated in time.

    Errors of odometry last, so fewer residuals are independent.
    """
    squares = np.sum(residual**2, axis=1)
    chi2 = float(np.sum(weights * squares)) / (3 * len(residual) - 14)
    together = float(np.sum(residual[1:] * residual[:-1])) / max(float(np.sum(squares)), 1e-12)
    together = min(max(together, 0.0), _CORRELATED)
    return max(chi2 * (1.0 + together) / (1.0 - together), 1.0)


def _sway(attitudes: Array) -> float:
    """Return the median angle of attitudes (n, 3, 3) from their mean, rad."""
    u, _, v = np.linalg.svd(attitudes.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    cosines = 0.5 * (np.einsum('nij,ij->n', attitudes, mean) - 1.0)
    return float(np.median(np.arccos(np.clip(cosines, -1.0, 1.0))))
