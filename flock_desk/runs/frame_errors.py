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
What every image told of every neighbour, beside the truth where there is one: a table that grows.

Errors are those of the leader's state relative to the follower, each in its own follower's body
frame (FLU): estimate minus own odometry against truth minus truth, so that drift, which is common
to leader and follower in odom, does not count. Their covariances follow from what was published.

- Position: z = R' (p_L - p_F). The filter measures p_L from the own place, and its covariance P_p
  is of the leader as seen from there: the error of p_F is in p_L too and cancels. P = R' P_p R.
- Velocity: z = R' (v_L - v_F). The filter takes v_L from positions seen from a place that moves
  with the integral of v_F, so it follows the true velocity plus the error of v_F, which cancels as
  far as v_L has followed it. How far it lags behind is in P_v, because that error's wandering is
  part of the filter's noise (``odometry_noise``). P = R' P_v R; the covariance of the odometry's
  velocity, added, would count it twice.

P_v is the filter's covariance of the velocity in odom. The covariance in the message is that of
the twist in the leader's body, so it also holds the error of the leader's attitude, of which the
velocity in odom is free.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flock_follower.geometry import Array, quaternion_to_matrix, Transform
from flock_follower.messages import NANOSECONDS, OdometryState
from flock_follower.odometry.buffer import between, OdometrySample
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.markers import MarkedNeighbor, Marker
from flock_follower.perception.neighbor_filter import Estimate

STAGES = ('none', 'track', 'roi', 'full')

#: The columns of the table; three of a kind are along the follower's x, y, z (forward, left, up).
#: ``stage`` is an index into STAGES; ``visible`` is 1 where the truth says a marker is in view;
#: positions are in odom, m; sigmas are deviations of the errors; ``turned`` is the angle between
#: estimated and true attitude of the neighbour relative to the follower, rad. NaN is unknown.
COLUMNS = (
    'time', 'stage', 'visible', 'own_x', 'own_y', 'neighbor_x', 'neighbor_y',
    'distance', 'true_distance', 'position_x', 'position_y', 'position_z',
    'velocity_x', 'velocity_y', 'velocity_z', 'position_sigma_x', 'position_sigma_y',
    'position_sigma_z', 'velocity_sigma_x', 'velocity_sigma_y', 'velocity_sigma_z',
    'nees_position', 'nees_velocity', 'turned')
#: The columns, (n,) each, by name.
Table = Mapping[str, Array]
#: States further apart than this are not interpolated, ns.
MAX_GAP = NANOSECONDS // 2
#: How long an image waits for odometry and truth of its stamp, ns.
PATIENCE = NANOSECONDS
#: A marker seen at a larger angle from its normal is not in view, cosine.
GRAZING = float(np.cos(np.radians(80.0)))
_SPAN = 15 * NANOSECONDS  # odometry and truth kept at most
_BATCH = 256  # images worked out at once: numpy is slow on single ones

_P, _V = slice(0, 3), slice(3, 6)


class _Seen(NamedTuple):
    """An image of a stamp, ns, what it told: estimate and stage by neighbour; and its camera."""

    stamp: int
    estimates: Mapping[str, Estimate]
    stages: Mapping[str, str]
    camera: str


class _At(NamedTuple):
    """States at n stamps, in odom; covariances of estimates only; NaN where unknown."""

    position: Array
    rotation: Array
    velocity: Array
    covariance: Array


class FrameErrors:
    """
    Collects images, odometry and truth as they come, and works them out a batch at a time.

    Memory grows by one row of ``COLUMNS`` per image and neighbour, 192 bytes, and nothing else.

    :param cameras: where the camera is on the follower's body; of several, each by its name.
    :param start: the time of zero in the table, ns.
    """

    def __init__(self, neighbors: Sequence[MarkedNeighbor],
                 cameras: Transform | Mapping[str, Transform], start: int) -> None:
        self.models: dict[str, CameraModel | None] = {}
        """The calibration of each camera, '' of the only one, where known."""
        self._neighbors = {n.name: n for n in neighbors}
        mounted = {'': cameras} if isinstance(cameras, Transform) else cameras
        self._T_camera_body = {name: place.inverse() for name, place in mounted.items()}
        self._start = start
        self._rows = {name: array('d') for name in self._neighbors}
        self._pending: list[_Seen] = []
        self._own: deque[OdometryState] = deque()
        self._true_own: deque[OdometryState] = deque()
        self._true_neighbors: dict[str, deque[OdometryState]] = {
            name: deque() for name in self._neighbors}
        self.strangers: set[str] = set()
        """Names in the truth that are no neighbour's."""

    def table(self, name: str) -> dict[str, Array]:
        """Return the columns, (n,) each, of a neighbour, after :meth:`finish`."""
        rows = np.frombuffer(self._rows[name]).reshape(-1, len(COLUMNS))
        return dict(zip(COLUMNS, rows.T))

    def odometry(self, state: OdometryState) -> None:
        """Take one's own odometry."""
        self._take(self._own, state)

    def true_odometry(self, state: OdometryState) -> None:
        """Take one's own true state."""
        self._take(self._true_own, state)

    def true_neighbor(self, state: OdometryState) -> None:
        """Take a neighbour's true state; its name is the child frame."""
        if state.child in self._true_neighbors:
            self._take(self._true_neighbors[state.child], state)
        else:
            self.strangers.add(state.child)

    def frame(self, stamp: int, estimates: Mapping[str, Estimate],
              stages: Mapping[str, str], camera: str = '') -> None:
        """Take what the image of a stamp, ns, told."""
        self._pending.append(_Seen(stamp, estimates, stages, camera))
        if len(self._pending) >= _BATCH:
            self._work_out(self._pending[-1].stamp - PATIENCE)

    def finish(self) -> None:
        """Work out all that is left."""
        if self._pending:
            self._work_out(max(seen.stamp for seen in self._pending))

    def _take(self, states: deque[OdometryState], state: OdometryState) -> None:
        _append(states, state)
        if state.stamp - states[0].stamp > _SPAN:  # images are rare, or have stopped
            self._work_out(state.stamp - PATIENCE)

    def _work_out(self, newest: int) -> None:
        batch = [seen for seen in self._pending if seen.stamp <= newest]
        self._pending = [seen for seen in self._pending if seen.stamp > newest]
        if batch:
            self._add_rows(batch)
        for states in (self._own, self._true_own, *self._true_neighbors.values()):
            while len(states) > 1 and states[1].stamp <= newest:
                states.popleft()

    def _add_rows(self, batch: Sequence[_Seen]) -> None:
        stamps = np.array([seen.stamp for seen in batch])
        own, true_own = _at(self._own, stamps), _at(self._true_own, stamps)
        for name, neighbor in self._neighbors.items():
            true = _at(self._true_neighbors[name], stamps)
            rows = np.full((len(batch), len(COLUMNS)), np.nan)
            columns = dict(zip(COLUMNS, rows.T))
            columns['time'][:] = (stamps - self._start) / NANOSECONDS
            columns['stage'][:] = [
                STAGES.index(seen.stages.get(name, 'full')) if name in seen.estimates else 0
                for seen in batch]
            columns['own_x'][:], columns['own_y'][:] = own.position[:, 0], own.position[:, 1]
            self._compare(columns, _estimated(batch, name), own, true, true_own)
            columns['visible'][:] = self._visible(
                [seen.camera for seen in batch], neighbor, true, true_own)
            self._rows[name].frombytes(rows.tobytes())

    def _compare(self, columns: dict[str, Array], estimated: _At, own: _At, true: _At,
                 true_own: _At) -> None:
        position, velocity, rotation = _relative(estimated, own)
        true_position, true_velocity, true_rotation = _relative(true, true_own)
        columns['neighbor_x'][:] = estimated.position[:, 0]
        columns['neighbor_y'][:] = estimated.position[:, 1]
        columns['distance'][:] = np.linalg.norm(position, axis=1)
        columns['true_distance'][:] = np.linalg.norm(true_position, axis=1)
        turned = np.einsum('nij,nij->n', rotation, true_rotation)  # the trace of R' R_true
        columns['turned'][:] = np.arccos(np.clip((turned - 1.0) / 2.0, -1.0, 1.0))
        for kind, error, covariance in (
                ('position', position - true_position, estimated.covariance[:, _P, _P]),
                ('velocity', velocity - true_velocity, estimated.covariance[:, _V, _V])):
            in_body = own.rotation.transpose(0, 2, 1) @ covariance @ own.rotation
            columns[f'nees_{kind}'][:] = _nees(error, in_body)
            for i, axis in enumerate('xyz'):
                columns[f'{kind}_{axis}'][:] = error[:, i]
                columns[f'{kind}_sigma_{axis}'][:] = np.sqrt(in_body[:, i, i])

    def _visible(self, images: Sequence[str], neighbor: MarkedNeighbor, true: _At,
                 true_own: _At) -> Array:
        """Return for every image whether a marker is in view, NaN where there is no truth."""
        position, _, rotation = _relative(true, true_own)
        known = np.isfinite(position[:, 0])
        visible = np.zeros(len(known), dtype=bool)
        for name, T_camera_body in self._T_camera_body.items():
            model, taken = self.models.get(name), np.array([name == image for image in images])
            if model is None:
                continue
            for marker in neighbor.markers:
                visible |= taken & _marker_visible(
                    marker, model, T_camera_body, position, rotation)
        return np.where(known, visible, np.nan)


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
        centre = in_camera.mean(axis=1)
        normal = np.cross(in_camera[:, 2] - in_camera[:, 3], in_camera[:, 0] - in_camera[:, 3])
        facing = -np.einsum('ni,ni->n', normal, centre) > (
            GRAZING * np.linalg.norm(normal, axis=1) * np.linalg.norm(centre, axis=1))
    result: NDArray[np.bool_] = inside & facing
    return result


def _append(states: deque[OdometryState], state: OdometryState) -> None:
    """Keep states in the order of their stamps; where time jumps back, begin anew."""
    if states and state.stamp <= states[-1].stamp:
        if states[-1].stamp - state.stamp <= MAX_GAP:
            return
        states.clear()
    states.append(state)


def _unknown(count: int) -> _At:
    return _At(np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan),
               np.full((count, 3), np.nan), np.full((count, 6, 6), np.nan))


def _at(states: deque[OdometryState], stamps: NDArray[np.int64]) -> _At:
    """
    Return the states at stamps (n,), between two of them, for half a second at most.

    They are interpolated as perception does it: what a line is off at 10 Hz is no error of its.
    """
    result = _unknown(len(stamps))
    if not states:
        return result
    have = list(states)
    times = np.array([s.stamp for s in have])
    after = np.minimum(np.searchsorted(times, stamps), len(have) - 1)
    before = np.where(times[after] == stamps, after, np.maximum(after - 1, 0))
    gap = times[after] - times[before]
    known = (times[before] <= stamps) & (stamps <= times[after]) & (gap <= MAX_GAP)
    for n in np.flatnonzero(known):
        a, b = have[before[n]], have[after[n]]
        state = a if a is b else between(
            _sample(a, a.stamp), _sample(b, a.stamp), float(stamps[n] - a.stamp) / NANOSECONDS)
        result.position[n], result.velocity[n] = state.position, state.velocity
        result.rotation[n] = quaternion_to_matrix(state.quaternion)
    return result


def _sample(state: OdometryState, since: int) -> OdometrySample:
    return OdometrySample((state.stamp - since) / NANOSECONDS, state.position, state.quaternion,
                          state.velocity, state.angular_velocity)


def _estimated(batch: Sequence[_Seen], name: str) -> _At:
    result = _unknown(len(batch))
    for n, seen in enumerate(batch):
        estimate = seen.estimates.get(name)
        if estimate is not None:
            result.position[n], result.velocity[n] = estimate.position, estimate.velocity
            result.rotation[n] = estimate.rotation
            result.covariance[n] = estimate.covariance[:6, :6]
    return result


def _relative(neighbor: _At, own: _At) -> tuple[Array, Array, Array]:
    """Return positions (n, 3), velocities (n, 3), rotations (n, 3, 3) in the follower's body."""
    to_body = own.rotation.transpose(0, 2, 1)
    return (np.einsum('nij,nj->ni', to_body, neighbor.position - own.position),
            np.einsum('nij,nj->ni', to_body, neighbor.velocity - own.velocity),
            to_body @ neighbor.rotation)


def _nees(errors: Array, covariances: Array) -> Array:
    """
    Return e' P^-1 e (n,) of errors (n, 3) and covariances (n, 3, 3).

    NaN where there is no estimate, infinite where its covariance is none.
    """
    estimated = np.isfinite(errors).all(axis=1)
    known = estimated & (np.linalg.det(np.nan_to_num(covariances)) > 0.0)
    nees = np.where(estimated, np.inf, np.nan)
    solved = np.linalg.solve(covariances[known], errors[known][:, :, None])[:, :, 0]
    nees[known] = np.einsum('ni,ni->n', errors[known], solved)
    return nees
