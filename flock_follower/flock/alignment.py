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
Alignment of the odometry frames of other vehicles with the own frame, in one Kalman filter.

All frames share the vertical, by gravity: a frame has a yaw and a translation, 4 unknowns. The
state of each frame is the yaw, which turns its coordinates to the own ones, and the place of an
anchor point in the own frame. The anchor moves with the sending vehicle, because the drift of its
odometry turns the frame about the vehicle. So yaw and place are nearly independent, and the lever
is short. The drift of the own odometry moves all frames together; their joint covariance includes
that. So two other frames can be related to each other without counting information twice.

The first estimate is a least-squares fit of the positions of common vehicles in two frames. The
best yaw between two sets of points is the direction of a sum that is linear in cosine and sine,
so that no first guess is needed; attitudes of a vehicle known in both frames add to the same sum.
The length of this sum of vectors is the information about the yaw; zero if all points coincide.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math

import numpy as np

from flock_follower.flock.peers import (
    ATTITUDE_NOISE,
    is_covariance,
    position_covariance,
    POSITION_DRIFT,
    SIGHTING_NOISE,
    TrackPoint,
    YAW_DRIFT,
)
from flock_follower.geometry import (
    Array,
    canonical_quaternion,
    quaternion_from_yaw,
    quaternion_multiply,
    quaternion_to_matrix,
    wrap_angle,
)
from flock_follower.messages import NANOSECONDS, OdometryState

#: chi^2 with 3 degrees of freedom, and with 1, at a probability of 0.999.
GATE, YAW_GATE = 16.27, 10.83
#: Drift is taken in by steps of this, ns, at least.
DRIFT_STEP = 50_000_000
_SIZE = 4


def turned(yaw: float) -> Array:
    """Return the rotation (3, 3) about the vertical by a yaw, rad."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def sideways(vector: Array) -> Array:
    """Return the derivative of a vector (3,) by a rotation about the vertical, per rad."""
    return np.array([-vector[1], vector[0], 0.0])


@dataclass
class Frame:
    """
    Estimate of one frame; a covariance of it (4, 4) is of yaw and place.

    ``yaw``, rad, turns its coordinates to those of the other frame; ``anchor`` (3,), m, in it is
    at ``place`` (3,), m, in the other.
    """

    yaw: float
    place: Array
    anchor: Array

    @property
    def rotation(self) -> Array:
        """Return the rotation (3, 3) of its coordinates to those of the other frame."""
        return turned(self.yaw)

    def lever(self, position: Array) -> Array:
        """Return the vector (3,), m, in the other frame from the anchor to a position."""
        return self.rotation.dot(position - self.anchor)


class FrameAlignment:
    """
    The filter; a frame has the name of its vehicle. Times are stamps, ns.

    :param own: name of the own frame, which is known exactly.
    """

    def __init__(self, own: str) -> None:
        self.frames = {own: Frame(0.0, np.zeros(3), np.zeros(3))}
        """The estimates of all frames in the own one, which is the first."""
        self._covariance: Array = np.zeros((_SIZE, _SIZE))
        self._stamp: int | None = None

    def __contains__(self, name: str) -> bool:
        """Return whether a frame is known."""
        return name in self.frames

    def covariance(self, name: str) -> Array:
        """Return the covariance (4, 4) of the yaw and place of a frame."""
        part = self._part(name)
        return self._covariance[part, part]

    def stds(self, name: str) -> tuple[float, float]:
        """Return the standard deviations of a frame's place, sqrt(trace), m, and yaw, rad."""
        if name not in self:
            return math.inf, math.inf
        variances = self.covariance(name).diagonal()
        return math.sqrt(max(variances[1:].sum(), 0.0)), math.sqrt(max(variances[0], 0.0))

    def located(self, name: str, position: Array) -> tuple[Array, Array]:
        """Return the own-frame position (3,) of a position, and the frame's share (3, 3) in it."""
        frame = self.frames[name]
        lever = frame.lever(position)
        H = _lever_matrix(lever)[:3]
        return frame.place + lever, H.dot(self.covariance(name)).dot(H.T)

    def drop(self, name: str) -> None:
        """Forget a frame."""
        if name in self:
            kept = np.delete(np.arange(len(self._covariance)), self._part(name))
            self._covariance = self._covariance[np.ix_(kept, kept)]
            del self.frames[name]

    def start(self, name: str, found: Frame, covariance: Array, reference: str) -> None:
        """
        Begin the estimate of a frame.

        :param found: its estimate in the known frame ``reference``, and the covariance (4, 4).
        """
        size = len(self._covariance)
        known, part = self.frames[reference], self._part(reference)
        lever = known.lever(found.place)
        # yaw = yaw_r + yaw', place = place_r + R_r (place' - anchor_r), and their errors.
        A, B = np.eye(_SIZE), np.eye(_SIZE)
        A[1:, 0], B[1:, 1:] = sideways(lever), known.rotation
        across = A.dot(self._covariance[part])
        grown = np.zeros((size + _SIZE, size + _SIZE))
        grown[:size, :size] = self._covariance
        grown[size:, :size], grown[:size, size:] = across, across.T
        grown[size:, size:] = A.dot(self._covariance[part, part]).dot(A.T) + (
            B.dot(covariance).dot(B.T))
        self._covariance = grown
        self.frames[name] = Frame(
            wrap_angle(known.yaw + found.yaw), known.place + lever, found.anchor)

    def set_anchor(self, name: str, position: Array) -> None:
        """Move the anchor of a frame to the position (3,) of its vehicle, if it is known."""
        if name not in self:
            return
        frame, row = self.frames[name], self._part(name).start
        lever = frame.lever(position)
        frame.anchor, frame.place = position, frame.place + lever
        P, aside = self._covariance, sideways(lever)
        P[row + 1:row + _SIZE] += np.outer(aside, P[row])
        P[:, row + 1:row + _SIZE] += np.outer(P[:, row], aside)

    def drift(self, stamp: int, own_position: Array) -> None:
        """Let the frames drift until a stamp, ns; the own frame turns about a position (3,)."""
        if self._stamp is None or len(self.frames) == 1:
            self._stamp = stamp
        if stamp - self._stamp < DRIFT_STEP:
            return
        elapsed = (stamp - self._stamp) / NANOSECONDS
        self._stamp = stamp
        position = POSITION_DRIFT ** 2 * elapsed
        yaw = YAW_DRIFT ** 2 * elapsed
        others = list(self.frames.values())[1:]
        turning = np.concatenate([np.concatenate([[1.0], sideways(frame.place - own_position)])
                                  for frame in others])
        own = yaw * np.outer(turning, turning) + position * np.kron(
            np.ones((len(others), len(others))), np.diag([0.0, 1.0, 1.0, 1.0]))
        theirs = np.tile([yaw, position, position, position], len(others))
        known = self._covariance[_SIZE:, _SIZE:]
        known[:] = known + own + np.diag(theirs)

    def relate(self, first: tuple[str, TrackPoint], second: tuple[str, TrackPoint]) -> float:
        """
        Update with the track points of one vehicle in two known frames, at one stamp.

        Return the squared Mahalanobis distance of the two over the gate's: above 1 it was refused.

        :param first: the frame and the track point in it.
        """
        H = np.zeros((_SIZE, len(self._covariance)))
        gap, noise = np.zeros(_SIZE), np.zeros((_SIZE, _SIZE))  # of position and yaw
        for sign, (name, there) in ((1.0, first), (-1.0, second)):
            frame, rotation = self.frames[name], self.frames[name].rotation
            lever = frame.lever(there.position)
            H[:, self._part(name)] = sign * _lever_matrix(lever)
            gap += sign * np.append(frame.place + lever, there.yaw + frame.yaw)
            noise[:3, :3] += rotation.dot(there.covariance).dot(rotation.T)
            noise[3, 3] += there.yaw_variance
        gap[3] = wrap_angle(float(gap[3]))
        across = self._covariance.dot(H.T)
        variance = float(H[3].dot(across[:, 3]))
        S = H.dot(across) + noise
        doubt = float(gap[:3].dot(np.linalg.solve(S[:3, :3], gap[:3]))) / GATE
        if not doubt <= 1.0:  # NaN is refused
            return doubt
        # Attitudes err by how markers are mounted, always alike: no average is better than that.
        turned_alike = (math.isfinite(S[3, 3]) and variance > ATTITUDE_NOISE ** 2
                        and gap[3] ** 2 <= YAW_GATE * S[3, 3])
        rows = slice(4 if turned_alike else 3)
        gain = np.linalg.solve(S[rows, rows], across[:, rows].T)  # (rows, 4 n), symmetric S
        for frame, (yaw, *place) in zip(self.frames.values(),
                                        -gap[rows].dot(gain).reshape(-1, _SIZE)):
            frame.yaw = wrap_angle(frame.yaw + float(yaw))
            frame.place = frame.place + place
        P = self._covariance - across[:, rows].dot(gain)
        self._covariance = 0.5 * (P + P.T)
        return doubt

    def _part(self, name: str) -> slice:
        row = _SIZE * list(self.frames).index(name)
        return slice(row, row + _SIZE)


def _lever_matrix(lever: Array) -> Array:
    """Return the Jacobian (4, 4) of position and yaw at a lever (3,), m, to yaw and place."""
    H = np.zeros((_SIZE, _SIZE))
    H[:3, 0], H[:3, 1:], H[3, 0] = sideways(lever), np.eye(3), 1.0
    return H


#: Pairs kept, and for how long, s: drift makes older ones worthless.
MOST, LONGEST = 100, 20.0
FEWEST = 5
#: Errors of sightings are correlated in time: factor on the variances of a fit.
WARINESS = 4.0
#: A yaw less certain than this, rad, is no start for a linear filter.
START_YAW = 0.35
#: Pairs with a larger chi^2 (3 degrees of freedom) are excluded; share of the pairs that must fit.
OUTLIER, AGREEING = 25.0, 0.7


class PairedFrames:
    """
    Collects the common vehicles of two frames until the first fit.

    A row (10,) holds a stamp, s; the positions in both frames (3, 3), m, and their variance, m^2;
    the difference of the yaws, rad, and its variance, infinite if a yaw is unknown.
    """

    def __init__(self) -> None:
        self._rows: deque[Array] = deque(maxlen=MOST)
        self.yaw_std = math.pi
        """Standard deviation of the yaw between the frames, rad, at the last fit."""

    def add(self, one: TrackPoint, other: TrackPoint) -> None:
        """Add the track points of one vehicle in both frames, at one stamp."""
        stamp = one.stamp / NANOSECONDS
        while self._rows and stamp - self._rows[0][0] > LONGEST:
            self._rows.popleft()
        self._rows.append(np.array([
            stamp, *one.position, *other.position,
            (one.covariance + other.covariance).trace() / 3.0, one.yaw - other.yaw,
            one.yaw_variance + other.yaw_variance]))

    def first_fit(self, swapped: bool = False) -> tuple[Frame, Array] | None:
        """
        Return the second frame in the first, with its covariance; None while that is unknown.

        :param swapped: the first in the second.
        """
        if len(self._rows) < FEWEST:
            return None
        rows = np.array(self._rows)
        if swapped:
            rows[:, 1:7], rows[:, 8] = rows[:, [4, 5, 6, 1, 2, 3]], -rows[:, 8]
        found, covariance = _fit(rows)
        agreeing = rows[_misfit(rows, found) < OUTLIER]
        if len(agreeing) < max(FEWEST, AGREEING * len(rows)):
            if len(rows) > 4 * FEWEST:  # the older ones may be wrong
                for _ in range(len(rows) // 2):
                    self._rows.popleft()
            return None
        if len(agreeing) < len(rows):
            found, covariance = _fit(agreeing)
        self.yaw_std = math.sqrt(min(covariance[0, 0], math.pi ** 2))
        return (found, covariance) if self.yaw_std <= START_YAW else None


def _variances(rows: Array) -> Array:
    """Return the variance of each pair (n,), m^2, with the drift of both frames since."""
    variances: Array = rows[:, 7] + 2.0 * POSITION_DRIFT ** 2 * (rows[-1, 0] - rows[:, 0])
    return variances


def _fit(rows: Array) -> tuple[Frame, Array]:
    one, other, turns = rows[:, 1:4], rows[:, 4:7], rows[:, 8]
    weights, sure = 1.0 / _variances(rows), 1.0 / rows[:, 9]
    total = float(weights.sum())
    place, anchor = weights @ one / total, weights @ other / total
    x, y = (one - place)[:, :2], (other - anchor)[:, :2]
    # A marker is always mounted alike: no number of attitudes is worth more than one.
    sure *= min(1.0, WARINESS / ATTITUDE_NOISE ** 2 / max(float(sure.sum()), 1e-9))
    along = weights @ (y * x).sum(axis=1) + sure @ np.cos(turns)
    across = weights @ (y[:, 0] * x[:, 1] - y[:, 1] * x[:, 0]) + sure @ np.sin(turns)
    # Noise alone spreads points by their variance on two axes.
    known = sure.sum() + max(0.0, weights @ (y * y).sum(axis=1) - 2.0 * (len(rows) - 1))
    covariance = np.diag([WARINESS / max(known, 1e-6),
                          *[WARINESS / total + SIGHTING_NOISE ** 2] * 3])
    return Frame(math.atan2(across, along), place, anchor), covariance


def _misfit(rows: Array, fit: Frame) -> Array:
    """Return chi^2 (n,) of the distance and attitudes of each pair from a fit."""
    gap = rows[:, 1:4] - fit.place - (rows[:, 4:7] - fit.anchor) @ fit.rotation.T
    turns = (rows[:, 8] - fit.yaw + math.pi) % (2.0 * math.pi) - math.pi
    return np.maximum((gap * gap).sum(axis=1) / _variances(rows), turns ** 2 / rows[:, 9])


#: Of a received velocity without covariance, m/s.
VELOCITY_STD = 0.1


def in_own_frame(state: OdometryState, sender: str, frame: str,
                 frames: FrameAlignment) -> OdometryState:
    """Return a state in an aligned sender's frame as a state in the own frame, at its stamp."""
    theirs, yaw_variance = frames.frames[sender], float(frames.covariance(sender)[0, 0])
    rotation = theirs.rotation
    position, share = frames.located(sender, state.position)
    velocity, spread = rotation.dot(state.velocity), state.velocity_covariance
    if not is_covariance(spread):
        spread = VELOCITY_STD ** 2 * np.eye(3)
    swung = sideways(velocity)
    spread = rotation.dot(spread).dot(rotation.T) + yaw_variance * np.outer(swung, swung)
    quaternion = canonical_quaternion(quaternion_multiply(
        quaternion_from_yaw(theirs.yaw), state.quaternion))
    to_own = quaternion_to_matrix(quaternion)
    pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
    pose[:3, :3] = share + rotation.dot(
        position_covariance(state, state.child == sender)).dot(rotation.T)
    if is_covariance(state.pose_covariance[3:, 3:]):
        pose[3:, 3:] = rotation.dot(state.pose_covariance[3:, 3:]).dot(rotation.T)
        pose[5, 5] += yaw_variance
    twist[:3, :3] = to_own.T.dot(spread).dot(to_own)
    return OdometryState(state.stamp, frame, state.child, position, quaternion, velocity,
                         state.angular_velocity, pose, twist, to_own, state.derived)
