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
Errors of the estimates against the truth: one row per image and neighbor.

Errors are those of the neighbor's state relative to the follower, in the follower's body frame
(FLU): (estimate - ego odometry) - (true neighbor - true follower). Drift of the odometry, which
leader and follower have in common, does not count. The covariances of the errors follow from the
published ones.

- Position: z = R' (p_L - p_F). The filter measures p_L relative to p_F, so p_L contains the error
  of p_F, which cancels in z. The filter's covariance P_p is that of the relative position: P = R'
  P_p R.
- Velocity: z = R' (v_L - v_F). The filter derives v_L from positions relative to a point that
  moves with the integral of v_F. So v_L converges to the true velocity plus the error of v_F,
  which cancels in z after this convergence. The lag is in P_v, because the filter's noise contains
  the random walk of that error (``odometry_noise``), and P_v contains the measured white noise of
  v_F. So P = R' P_v R; adding the covariance of the odometry's velocity would count it twice.

P_v is the filter's covariance of the velocity in odom. The covariance in the message is that of
the twist in the leader's body frame: it also contains the error of the leader's attitude, and is
not used here.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, quaternion_to_matrix, Transform
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.odometry.buffer import interpolate, OdometrySample
from flock_follower.parameters.neighbors_file import MarkedNeighbor, Marker
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.neighbor_filter import Estimate

STAGES = ('none', 'track', 'roi', 'full')

#: The columns of n images by name, (n,) or (n, 3), see :meth:`FrameErrors.table`.
Table = Mapping[str, Array]
#: States farther apart than this are not interpolated, ns.
MAX_GAP = NANOSECONDS // 2
#: A marker seen at a larger angle from its normal is not in view, cosine.
GRAZING = float(np.cos(np.radians(80.0)))
#: Numbers of a state: time [ns], position, quaternion, velocity, angular velocity.
_STATE_LENGTH = 14
#: Numbers of an image's result: stage, position, velocity, rotation matrix, covariance (6, 6).
_SIGHTING_LENGTH = 52


class _States(NamedTuple):
    """States at n stamps, in odom; NaN if unknown."""

    position: Array
    velocity: Array
    rotation: Array


class FrameErrors:
    """
    Collects images, odometry and truth as they arrive; :meth:`table` compares them.

    An hour takes about 130 MB: 112 bytes for each state, 0.4 kB for each image and neighbor.

    :param cameras: where the camera is on the follower's body; of several, each by its name.
    :param start: the time of zero in the table, ns.
    """

    def __init__(self, neighbors: Sequence[MarkedNeighbor],
                 cameras: Transform | Mapping[str, Transform], start: int) -> None:
        self.models: dict[str, CameraModel | None] = {}
        """The calibration of each camera, '' of the only one, if known."""
        self.strangers: set[str] = set()
        """Names in the truth that are no neighbor's."""
        self._neighbors = {n.name: n for n in neighbors}
        mounted = {'': cameras} if isinstance(cameras, Transform) else cameras
        self._T_camera_body = {name: place.inverse() for name, place in mounted.items()}
        self._start = start
        self._own = array('d')
        self._true = {name: array('d') for name in ('', *self._neighbors)}  # '': the ego state
        self._stamps = array('d')
        self._cameras: list[str] = []
        self._seen = {name: array('d') for name in self._neighbors}

    def odometry(self, state: OdometryState) -> None:
        """Take the ego odometry."""
        self._take(self._own, state)

    def truth(self, state: OdometryState, own: bool = False) -> None:
        """Take the ego true state, or that of the neighbor that the child frame names."""
        name = '' if own else state.child
        if name in self._true:
            self._take(self._true[name], state)
        else:
            self.strangers.add(name)

    def frame(self, stamp: int, estimates: Mapping[str, Estimate],
              stages: Mapping[str, str], camera: str = '') -> None:
        """Take the estimates of the image of a stamp, ns, and the stage that measured each."""
        self._stamps.append(stamp - self._start)
        self._cameras.append(camera)
        for name, seen in self._seen.items():
            estimate = estimates.get(name)
            seen.extend((0.0, *[np.nan] * (_SIGHTING_LENGTH - 1)) if estimate is None else (
                STAGES.index(stages.get(name, 'full')), *estimate.position.tolist(),
                *estimate.velocity.tolist(), *estimate.rotation.ravel().tolist(),
                *estimate.covariance[:6, :6].ravel().tolist()))

    def _take(self, states: array[float], state: OdometryState) -> None:
        states.extend((state.stamp - self._start, *state.position.tolist(),
                       *state.quaternion.tolist(), *state.velocity.tolist(),
                       *state.angular_velocity.tolist()))

    def table(self, name: str) -> dict[str, Array]:
        """
        Return the columns of a neighbor by name, a row for each of n images; NaN is unknown.

        (n,): ``time``, s; ``stage``, an index into STAGES; ``visible``, 1 if by the truth a marker
        is in view; ``distance`` and ``true_distance``, m; ``nees_position``, ``nees_velocity``;
        ``turned``, the angle between estimated and true attitude relative to the follower, rad.
        (n, 3): ``own`` and ``neighbor``, m in odom; the errors ``position``, m, and ``velocity``,
        m/s, along the follower's x, y, z (forward, left, up), and their standard deviations
        ``position_sigma`` and ``velocity_sigma``.
        """
        stamps = np.array(self._stamps)
        own, true_own, true = (
            _interpolate(states, stamps)
            for states in (self._own, self._true[''], self._true[name]))
        seen = np.array(self._seen[name]).reshape(-1, _SIGHTING_LENGTH)
        position, velocity, rotation = seen[:, 1:4], seen[:, 4:7], seen[:, 7:16]
        covariance = seen[:, 16:].reshape(-1, 6, 6)
        estimated = _relative(_States(position, velocity, rotation.reshape(-1, 3, 3)), own)
        truth = _relative(true, true_own)
        # The trace of R' R_true.
        trace = np.einsum('nij,nij->n', estimated.rotation, truth.rotation)
        table = {
            'time': stamps / NANOSECONDS, 'stage': seen[:, 0],
            'visible': self._visible(self._neighbors[name], truth),
            'own': own.position, 'neighbor': position,
            'distance': np.linalg.norm(estimated.position, axis=1),
            'true_distance': np.linalg.norm(truth.position, axis=1),
            'turned': np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)),
            'position': estimated.position - truth.position,
            'velocity': estimated.velocity - truth.velocity}
        for kind, k in (('position', slice(0, 3)), ('velocity', slice(3, 6))):
            in_body = own.rotation.transpose(0, 2, 1) @ covariance[:, k, k] @ own.rotation
            table[f'{kind}_sigma'] = np.sqrt(np.diagonal(in_body, axis1=1, axis2=2))
            table[f'nees_{kind}'] = _nees(table[kind], in_body)
        return table

    def _visible(self, neighbor: MarkedNeighbor, truth: _States) -> Array:
        """Return for every image whether a marker, if any, is in view, NaN without truth."""
        visible, cameras = np.zeros(len(truth.position), dtype=bool), np.array(self._cameras)
        calibrated = {name: model for name, model in self.models.items() if model is not None}
        for name, model in calibrated.items():
            for marker in neighbor.markers:
                visible |= (cameras == name) & _marker_visible(
                    marker, model, self._T_camera_body[name], truth.position, truth.rotation)
        if not neighbor.markers:  # whatever another detector reports, it saw
            visible[:] = True
        return np.where(np.isfinite(truth.position[:, 0]), visible, np.nan)


def _marker_visible(marker: Marker, camera: CameraModel, T_camera_body: Transform,
                    position: Array, rotation: Array) -> NDArray[np.bool_]:
    half = marker.side_length / 2.0
    corners = marker.T_body_marker.apply(
        half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=float))
    in_camera = T_camera_body.apply(
        np.einsum('nij,kj->nki', rotation, corners) + position[:, None])
    pixels = camera.project(in_camera.reshape(-1, 3)).reshape(-1, 4, 2)
    with np.errstate(invalid='ignore'):
        inside = ((pixels >= 0.0) & (pixels <= [camera.width - 1.0, camera.height - 1.0])
                  ).all(axis=(1, 2))
        center = in_camera.mean(axis=1)
        normal = np.cross(in_camera[:, 2] - in_camera[:, 3], in_camera[:, 0] - in_camera[:, 3])
        facing = -np.einsum('ni,ni->n', normal, center) > (
            GRAZING * np.linalg.norm(normal, axis=1) * np.linalg.norm(center, axis=1))
    return np.asarray(inside & facing)


def _interpolate(states: array[float], stamps: Array) -> _States:
    """
    Return the states at stamps (n,), ns, between two states at most half a second apart.

    The states are interpolated as in perception, so that interpolation adds no error of its own.
    """
    result = _States(*(np.full((len(stamps), *shape), np.nan) for shape in ((3,), (3,), (3, 3))))
    read = np.array(states).reshape(-1, _STATE_LENGTH)
    if not len(read):
        return result
    # By their stamps, of equal ones the first: a stamp far ahead must not hide the later ones.
    times, first = np.unique(read[:, 0], return_index=True)
    rows = read[first]
    after = np.minimum(np.searchsorted(times, stamps), len(rows) - 1)
    before = np.where(times[after] == stamps, after, np.maximum(after - 1, 0))
    known = ((times[before] <= stamps) & (stamps <= times[after])
             & (times[after] - times[before] <= MAX_GAP))
    for k in np.flatnonzero(known):
        begin = times[before[k]]
        state = _sample(rows[before[k]], begin)
        if before[k] != after[k]:
            state = interpolate(state, _sample(rows[after[k]], begin),
                                float(stamps[k] - begin) / NANOSECONDS)
        result.position[k], result.velocity[k] = state.position, state.velocity
        result.rotation[k] = quaternion_to_matrix(state.quaternion)
    return result


def _sample(row: Array, since: float) -> OdometrySample:
    return OdometrySample((row[0] - since) / NANOSECONDS, row[1:4], row[4:8], row[8:11], row[11:])


def _relative(neighbor: _States, own: _States) -> _States:
    """Return a neighbor's states relative to the ego ones, in the follower's body."""
    to_body = own.rotation.transpose(0, 2, 1)
    return _States(np.einsum('nij,nj->ni', to_body, neighbor.position - own.position),
                   np.einsum('nij,nj->ni', to_body, neighbor.velocity - own.velocity),
                   to_body @ neighbor.rotation)


def _nees(errors: Array, covariances: Array) -> Array:
    """
    Return e' P^-1 e (n,) of errors (n, 3) and covariances (n, 3, 3).

    NaN if there is no estimate, infinite if its covariance is invalid.
    """
    estimated = np.isfinite(errors).all(axis=1)
    known = estimated & (np.linalg.det(np.nan_to_num(covariances)) > 0.0)
    nees = np.where(estimated, np.inf, np.nan)
    solved = np.linalg.solve(covariances[known], errors[known][:, :, None])[:, :, 0]
    nees[known] = np.einsum('ni,ni->n', errors[known], solved)
    return nees
