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
The recent own odometry, interpolated to the stamp of an image.

The position of visual-inertial odometry is noisy, and jumps with every correction; a measured
velocity does not jump. So the buffer also keeps ``travel``, the integral of the velocity. Relative
to ``travel`` detections move smoothly; adding ``position - travel`` converts them to odom.

Attitude noise moves distant detections sideways. So the attitudes of the last few samples are
extrapolated to the stamp by the angular velocities, and averaged.
"""

from __future__ import annotations

from enum import Enum
from typing import Literal, NamedTuple

import numpy as np

from flock_follower.geometry import (
    Array,
    normalize_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
    Transform,
)
from flock_follower.geometry.rotation_vectors import slerp
from flock_follower.messages import FASTEST, MAX_JUMP, OdometryState

#: Columns of a row, after the stamp.
_POSITION, _VELOCITY, _RATE, _TRAVEL = (slice(k, k + 3) for k in range(1, 13, 3))
_ATTITUDE = slice(13, 17)
CUBIC_BEYOND = 0.012  # s between two samples, beyond which the interpolation is cubic
MAX_RATE_MISMATCH = 0.3  # rad/s, of measured rates and the turn, for a cubic


_NO_TRAVEL: Array = np.zeros(3)
_ONES_3 = np.ones(3)


class OdometrySample(NamedTuple):
    """
    The ego state at a stamp, s.

    ``position`` (3,), m, and ``velocity`` (3,), m/s, in odom; ``quaternion`` (x, y, z, w) takes
    the body (FLU) to odom; ``angular_velocity`` (3,), rad/s, is in the body. ``travel`` (3,), m,
    is the integral of the velocity since the beginning of the buffer; the buffer sets it.
    ``derived``: whether the velocity was derived from the positions, so that it has no new
    information.
    """

    stamp: float
    position: Array
    quaternion: Array
    velocity: Array
    angular_velocity: Array
    travel: Array = _NO_TRAVEL
    derived: bool = False

    def row(self, travel: Array) -> Array:
        """Return stamp, position, velocity, angular velocity, ``travel`` and quaternion (17,)."""
        return np.array((
            self.stamp, *self.position.tolist(), *self.velocity.tolist(),
            *self.angular_velocity.tolist(), *travel.tolist(), *self.quaternion.tolist()))

    @classmethod
    def from_state(cls, state: OdometryState, stamp: float) -> OdometrySample:
        """Return the sample of a state, at a stamp, s."""
        return cls(stamp, state.position, state.quaternion, state.velocity,
                   state.angular_velocity, derived=state.derived)

    @classmethod
    def of_row(cls, row: Array) -> OdometrySample:
        """Return the sample of a row (17,)."""
        return cls(float(row[0]), row[_POSITION], row[_ATTITUDE], row[_VELOCITY], row[_RATE],
                   row[_TRAVEL])

    @property
    def smooth_pose(self) -> Transform:
        """Return the body's pose in the smooth frame: attitude as in odom, at ``travel``."""
        return Transform(quaternion_to_matrix(self.quaternion), self.travel)

    @property
    def correction(self) -> Array:
        """Return the offset (3,), m, from the smooth frame to odom."""
        correction: Array = self.position - self.travel
        return correction


class Missing(Enum):
    """Why there is no odometry for a stamp."""

    EMPTY = 'no odometry yet'
    TOO_NEW = 'odometry has not reached the image stamp'
    TOO_OLD = 'odometry does not reach back to the image stamp'
    GAP = 'odometry has a gap at the image stamp'


class OdometryBuffer:
    """The recent samples, in the order of their stamps."""

    #: Samples kept at most, whatever their stamps: 2 s at 1 kHz.
    CAPACITY = 2000
    HORIZON = 2.0  # s for which samples are kept
    MAX_GAP = 0.25  # s between two samples, beyond which they are not interpolated
    MAX_EXTRAPOLATION = 0.03  # s past the newest sample
    #: An attitude is averaged over so long, s, and so many samples at most.
    STEADY = 0.1
    AVERAGED = 20
    #: Samples that disagree by more, rad, do not count.
    AGREEMENT = 0.005
    #: Comparisons over which squared distances of attitudes are averaged.
    COMPARISONS = 30
    #: Attitudes are averaged while drift^2 < this * (step of successive attitudes)^2, which is 2
    #: noise^2: the average errs by drift / 2 and noise / sqrt(AVERAGED), one attitude by noise.
    MAX_DRIFT_RATIO = 2.5
    #: If the velocity is derived, a position farther from where it led, m, is a correction. A
    #: tenth of ``POSITION_JUMP``: no jump, but a neighbor would seem to move by it.
    STEP = 0.03

    def __init__(self) -> None:
        self._storage: Array = np.empty((2 * self.CAPACITY, 17))
        self._end = 0
        self._rows: Array = self._storage[:0]
        """The rows of ``_storage`` that are in use, up to ``_end``: adding one copies no other."""
        self._near = self._far = self._rough = 0.0
        self._comparisons = 0

    def __len__(self) -> int:
        """Return how many samples are held."""
        return len(self._rows)

    @property
    def newest(self) -> float | None:
        """Return the newest stamp, s, or None while empty."""
        return float(self._rows[-1, 0]) if len(self) else None

    def clear(self) -> None:
        """Forget all samples."""
        self._rows = self._storage[self._end:self._end]

    def add(self, sample: OdometrySample) -> bool:
        """
        Add a sample; return whether time jumped back, so that all other samples were forgotten.

        A late sample, and a repetition, are ignored.
        """
        newest = self.newest
        jumped = newest is not None and sample.stamp <= newest
        if newest is not None and jumped:
            if newest - sample.stamp <= MAX_JUMP:
                return False
            self.clear()
        row = sample.row(self._travel(sample))
        old = max(0, len(self) + 1 - self.CAPACITY)
        while old < len(self) and sample.stamp - self._rows[old, 0] > self.HORIZON:
            old += 1
        held = len(self) - old
        if self._end == len(self._storage):
            self._storage[:held] = self._rows[old:]
            self._end = held
        self._storage[self._end] = row
        self._end += 1
        self._rows = self._storage[self._end - held - 1:self._end]
        return jumped

    def _travel(self, sample: OdometrySample) -> Array:
        if not len(self):
            return np.array(sample.position, dtype=float)
        last = self._rows[-1]
        dt = sample.stamp - float(last[0])
        mean = 0.5 * (last[_VELOCITY] + sample.velocity)
        displacement: Array = sample.position - last[_POSITION]
        # Velocities so far apart are of little use, and an absurd one would stay in the sum.
        # The norm is the faster test, and enough for most.
        if dt > self.MAX_GAP or not (mean.dot(mean) <= FASTEST**2 or (
                float(np.abs(mean).max()) <= FASTEST)):
            return last[_TRAVEL] + displacement
        if sample.derived and float(np.abs(displacement - dt * mean).max()) < self.STEP:
            return last[_TRAVEL] + displacement
        return last[_TRAVEL] + dt * mean

    def at(self, stamp: float, extrapolate: bool = True) -> OdometrySample | Missing:
        """
        Return the state at a stamp, s, or the reason why it is missing.

        Between two samples velocities are interpolated linearly, and position and attitude follow
        from them. After the newest sample its velocities are kept, for at most
        ``MAX_EXTRAPOLATION``.
        """
        after = self._find_sample(stamp, extrapolate)
        if isinstance(after, Missing):
            return after
        if after == len(self):
            return _extrapolate(OdometrySample.of_row(self._rows[-1].copy()), stamp)
        if self._rows[after, 0] == stamp:
            return OdometrySample.of_row(self._rows[after].copy())
        return _interpolate(self._rows[after - 1], self._rows[after], stamp)

    def places(self, stamps: Array, points: Array) -> Array | None:
        """
        Return points (n, 3) on the body in the smooth frame, (k, n, 3), for stamps (k, n), s.

        Position and attitude are interpolated linearly. None if there is no odometry for a stamp.
        """
        held = self._rows[:, 0]
        if not len(held) or not held[0] <= stamps.min() <= stamps.max() <= held[-1]:
            return None
        after = held.searchsorted(stamps).clip(1)
        span = held[after] - held[after - 1]
        if span.max() > self.MAX_GAP:
            return None
        part = (stamps - held[after - 1]) / span
        poses = self._rows[:, 10:].T  # travel and attitude
        before = poses[:, after - 1]
        px, py, pz, x, y, z, w = before + part * (poses[:, after] - before)
        u, v, t = points.T
        # Of the quaternion (r, w), of any length: p + 2 r x (r x p + w p) / (r.r + w w).
        a, b, c = y * t - z * v + w * u, z * u - x * t + w * v, x * v - y * u + w * t
        twice = 2.0 / (x * x + y * y + z * z + w * w)
        return np.stack([px + u + twice * (y * c - z * b), py + v + twice * (z * a - x * c),
                         pz + t + twice * (x * b - y * a)], axis=-1)

    def missing(self, stamp: float, extrapolate: bool = True) -> Missing | None:
        """Return why :meth:`at` would return no state, or None."""
        after = self._find_sample(stamp, extrapolate)
        return after if isinstance(after, Missing) else None

    def _find_sample(self, stamp: float, extrapolate: bool) -> int | Missing:
        """Return the index of the first sample at or after a stamp; the end if there is none."""
        if not len(self):
            return Missing.EMPTY
        after = self._index_after(stamp, 'left')
        if after == len(self):
            ahead = stamp - float(self._rows[-1, 0])
            return after if extrapolate and ahead <= self.MAX_EXTRAPOLATION else (
                Missing.TOO_NEW)
        if self._rows[after, 0] == stamp:
            return after
        if after == 0:
            return Missing.TOO_OLD
        wide = self._rows[after, 0] - self._rows[after - 1, 0] > self.MAX_GAP
        return Missing.GAP if wide else after

    def _index_after(self, stamp: float, side: Literal['left', 'right']) -> int:
        return int(self._rows[:, 0].searchsorted(stamp, side))

    def steadied(self, state: OdometrySample) -> OdometrySample:
        """
        Return a state of :meth:`at` with the attitude averaged over the last ``STEADY`` seconds.

        The attitude is averaged only if the angular velocities explain the change from each
        attitude to the next, see :meth:`_agree`. An attitude that differs from the others by more
        than the noise is not used.
        """
        end = self._index_after(state.stamp, 'right')
        first = max(self._index_after(state.stamp - self.STEADY, 'left'), end - self.AVERAGED)
        if end - first < 3:
            return state
        recent = self._rows[first:end][::-1]
        # Newest first. Rates are in the body's axes of the moment; these turn too little
        # meanwhile to matter.
        rates = recent[:, _RATE]
        turns = np.empty((len(recent), 3))
        turns[0] = (0.5 * (state.stamp - recent[0, 0])) * (rates[0] + state.angular_velocity)
        turns[1:] = (0.5 * (recent[:-1, :1] - recent[1:, :1])) * (rates[:-1] + rates[1:])
        x, y, z, w = state.quaternion.tolist()
        # Quaternions times this are the state's inverse times them: by how much they are off.
        off = recent[:, _ATTITUDE].dot(np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z],
                                                 [-x, -y, -z, w]]))
        apart = np.copysign(2.0, off[:, 3:]) * off[:, :3] + np.add.accumulate(turns)
        if not self._agree(apart, recent[:, _VELOCITY]):
            return state
        agreeing = (apart * apart).dot(_ONES_3) < max(self.AGREEMENT**2, 9.0 * self._near)
        count = np.count_nonzero(agreeing)
        if count < 2:
            return state
        turn = rotation_vector_to_quaternion(agreeing.dot(apart) / count)
        return state._replace(quaternion=quaternion_multiply(state.quaternion, turn))

    @property
    def white_noise(self) -> tuple[float, float]:
        """Return the variances of white noise, per axis: attitude, rad^2; velocity, (m/s)^2."""
        # Of differences of two, in three axes, and of third differences: 1, 3, 3, 1.
        return self._near / 6.0, self._rough / 60.0

    def _agree(self, apart: Array, velocities: Array) -> bool:
        """
        Return whether attitudes and angular velocities agree within the attitudes' white noise.

        The noise of the velocities (n, 3) is updated on the way.

        ``apart`` holds attitudes (n, 3), rad, newest first, propagated to one stamp. By noise
        alone the first and the last differ as much as neighbors do. If angular velocities are
        missing or late, the first and the last differ more: then averaging would lose.
        """
        self._comparisons += 1
        if self._comparisons > self.COMPARISONS and self._comparisons % 3:  # it changes slowly
            return self._far < self.MAX_DRIFT_RATIO * self._near
        step = apart[1:] - apart[:-1]
        some = max(1, len(apart) // 4)
        way = apart[-some:] - apart[:some]
        near, far = float(np.vdot(step, step)) / len(step), float(np.vdot(way, way)) / some
        over = min(self._comparisons, self.COMPARISONS)
        if len(velocities) > 3:
            third = velocities[3:] - velocities[:-3] - 3.0 * (velocities[2:-1] - velocities[1:-2])
            self._rough += (float(np.vdot(third, third)) / len(third) - self._rough) / over
        self._near += (near - self._near) / over
        self._far += (far - self._far) / over
        return self._far < self.MAX_DRIFT_RATIO * self._near


def interpolate(a: OdometrySample, b: OdometrySample, stamp: float) -> OdometrySample:
    """Return the state at a stamp, s, between two samples, as in :class:`OdometryBuffer`."""
    return _interpolate(a.row(a.position), b.row(b.position), stamp)


def _interpolate(a: Array, b: Array, stamp: float) -> OdometrySample:
    """Return the sample between two rows."""
    span = float(b[0] - a[0])
    part = float((stamp - a[0]) / span)
    row = (1.0 - part) * a + part * b
    row[0] = stamp
    if span > CUBIC_BEYOND:
        # The velocity changes evenly: the way between is a parabola, not a line.
        bend = 0.5 * span * part * (part - 1.0) * (b[_VELOCITY] - a[_VELOCITY])
        row[_POSITION] += bend
        row[_TRAVEL] += bend
        row[_ATTITUDE] = _cubic_attitude(a, b, span, part)
    elif float(a[_ATTITUDE].dot(b[_ATTITUDE])) > 0.999999:
        # Closer than 3 mrad the chord, mixed already, is the arc, but for 1e-9 rad and its length.
        row[_ATTITUDE] = normalize_quaternion(row[_ATTITUDE])
    else:
        row[_ATTITUDE] = slerp(a[_ATTITUDE], b[_ATTITUDE], part)
    return OdometrySample.of_row(row)


def _cubic_attitude(a: Array, b: Array, span: float, part: float) -> Array:
    """Return the attitude a part of the way between two rows, a cubic if the rates suit it."""
    turn = quaternion_to_rotation_vector(
        quaternion_multiply(quaternion_conjugate(a[_ATTITUDE]), b[_ATTITUDE]))
    start, end = span * a[_RATE] - turn, span * b[_RATE] - turn
    way = part * turn
    if float(np.abs(start + end).max()) < MAX_RATE_MISMATCH * span:
        # Hermite's cubic with the rates as slopes, as what it adds to the even turn.
        way = way + part * (1.0 - part) * ((1.0 - part) * start - part * end)
    return quaternion_multiply(a[_ATTITUDE], rotation_vector_to_quaternion(way))


def _extrapolate(a: OdometrySample, stamp: float) -> OdometrySample:
    ahead = stamp - a.stamp
    turn = rotation_vector_to_quaternion(a.angular_velocity * ahead)
    step = ahead * a.velocity
    return a._replace(stamp=a.stamp + ahead, position=a.position + step,
                      quaternion=quaternion_multiply(a.quaternion, turn), travel=a.travel + step)
