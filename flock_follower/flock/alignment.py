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
Alignment of the odometry frame of another vehicle with the ego frame, by a Kalman filter.

All frames have the same vertical axis, so a frame has 4 unknowns: yaw and translation. The state
is the yaw, which rotates coordinates of the other frame to the ego frame, and the place of an
anchor point in the ego frame. The anchor moves with the sending vehicle, because the drift of its
odometry rotates the frame about the vehicle. So the errors of yaw and place are nearly
independent, and the lever arm is short.

The first estimate is a least-squares fit to the positions of vehicles that are known in both
frames. The best yaw between two sets of points is the direction of a sum of vectors, so the fit
needs no initial value; known attitudes of a vehicle in both frames add to this sum. The length of
the sum is the information about the yaw, and zero if all points coincide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from flock_follower.flock.peers import (
    ATTITUDE_NOISE,
    is_covariance,
    position_covariance,
    SIGHTING_NOISE,
    TrackPoint,
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

POSITION_DRIFT = 0.025  # m/sqrt(s): random walk of the odometry of each vehicle
YAW_DRIFT = 0.0025  # rad/sqrt(s): likewise of its yaw
VELOCITY_STD = 0.1  # m/s: of a received velocity without covariance
POSITION_GATE = 16.27  # chi^2 with 3 degrees of freedom at a probability of 0.999
YAW_GATE = 10.83  # chi^2 with 1 degree of freedom at a probability of 0.999


def yaw_rotation(yaw: float) -> Array:
    """Return the rotation (3, 3) about the vertical by a yaw, rad."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_derivative(vector: Array) -> Array:
    """Return the derivative of a vector (3,) by a rotation about the vertical, per rad."""
    return np.array([-vector[1], vector[0], 0.0])


@dataclass
class Frame:
    """
    Estimate of another vehicle's frame; ``covariance`` (4, 4) of yaw and place.

    ``yaw``, rad, rotates coordinates of the other frame to the ego frame. The point ``anchor``
    (3,), m, of the other frame is at ``place`` (3,), m, in the ego frame. ``stamp``, ns, is the
    time up to which drift was added.
    """

    yaw: float
    place: Array
    anchor: Array
    covariance: Array
    stamp: int

    @property
    def stds(self) -> tuple[float, float]:
        """Return the standard deviations of the place, sqrt(trace), m, and of the yaw, rad."""
        variances = self.covariance.diagonal()
        return math.sqrt(max(variances[1:].sum(), 0.0)), math.sqrt(max(variances[0], 0.0))

    def lever(self, position: Array) -> Array:
        """Return the vector (3,), m, from the anchor to a position, along the ego frame's axes."""
        return yaw_rotation(self.yaw).dot(position - self.anchor)

    def locate(self, position: Array) -> tuple[Array, Array]:
        """Return a position in the ego frame (3,), and the covariance (3, 3) by this frame."""
        lever = self.lever(position)
        H = _jacobian(lever)[:3]
        return self.place + lever, H.dot(self.covariance).dot(H.T)

    def point(self, point: TrackPoint) -> TrackPoint:
        """Return a track point of this frame in the ego frame."""
        rotation, (position, share) = yaw_rotation(self.yaw), self.locate(point.position)
        return point._replace(
            position=position, velocity=rotation.dot(point.velocity),
            covariance=rotation.dot(point.covariance).dot(rotation.T) + share,
            yaw=point.yaw + self.yaw,
            yaw_variance=point.yaw_variance + float(self.covariance[0, 0]))

    def move_anchor(self, position: Array) -> None:
        """Move the anchor to the position (3,) of the vehicle in its frame."""
        lever = self.lever(position)
        J = np.eye(4)
        J[1:, 0] = yaw_derivative(lever)
        self.anchor, self.place = position, self.place + lever
        self.covariance = J.dot(self.covariance).dot(J.T)

    def drift(self, stamp: int, own_position: Array) -> None:
        """
        Add the drift of both frames until a stamp, ns.

        The ego frame rotates about a position (3,).
        """
        elapsed = max(stamp - self.stamp, 0) / NANOSECONDS
        self.stamp = max(stamp, self.stamp)
        about = np.array([1.0, *yaw_derivative(self.place - own_position)])
        walk = np.array([0.0, 1.0, 1.0, 1.0])
        self.covariance = self.covariance + elapsed * (
            2.0 * POSITION_DRIFT ** 2 * np.diag(walk)
            + YAW_DRIFT ** 2 * (np.outer(about, about) + np.diag(1.0 - walk)))

    def relate(self, theirs: TrackPoint, ours: TrackPoint) -> float:
        """
        Update with the track points of one vehicle in this frame and the ego frame, at one stamp.

        Return their squared Mahalanobis distance divided by that of the gate; above 1 the points
        are refused.
        """
        rotation, lever = yaw_rotation(self.yaw), self.lever(theirs.position)
        H, noise = _jacobian(lever), np.zeros((4, 4))
        gap = np.append(self.place + lever - ours.position,
                        wrap_angle(self.yaw + theirs.yaw - ours.yaw))
        noise[:3, :3] = rotation.dot(theirs.covariance).dot(rotation.T) + ours.covariance
        noise[3, 3] = theirs.yaw_variance + ours.yaw_variance
        across = self.covariance.dot(H.T)
        S = H.dot(across) + noise
        doubt = float(gap[:3].dot(np.linalg.solve(S[:3, :3], gap[:3]))) / POSITION_GATE
        if not doubt <= 1.0:  # NaN is refused
            return doubt
        # The error of attitudes is that of a marker's mounting: constant, no average reduces it.
        by_attitude = (math.isfinite(S[3, 3]) and self.covariance[0, 0] > ATTITUDE_NOISE ** 2
                       and gap[3] ** 2 <= YAW_GATE * S[3, 3])
        rows = slice(4 if by_attitude else 3)
        gain = np.linalg.solve(S[rows, rows], across[:, rows].T)  # (rows, 4), symmetric S
        correction = -gap[rows].dot(gain)
        self.yaw = wrap_angle(self.yaw + float(correction[0]))
        self.place = self.place + correction[1:]
        P = self.covariance - across[:, rows].dot(gain)
        self.covariance = 0.5 * (P + P.T)
        return doubt


def _jacobian(lever: Array) -> Array:
    """Return the Jacobian (4, 4) of position and yaw at a lever (3,), m, by yaw and place."""
    H = np.zeros((4, 4))
    H[:3, 0], H[:3, 1:], H[3, 0] = yaw_derivative(lever), np.eye(3), 1.0
    return H


MIN_PAIRS = 5  # pairs of a fit at least
MAX_PAIRS = 100  # pairs of a fit at most
PAIR_AGE_MAX = 20 * NANOSECONDS  # ns: drift makes older pairs useless
VARIANCE_FACTOR = 4.0  # on the variances of a fit: errors of sightings are correlated in time
OUTLIER_CHI2 = 25.0  # chi^2 (3 degrees of freedom) above which a pair is excluded from a fit
MIN_AGREEING_SHARE = 0.7  # share of the pairs that must fit
Pair = tuple[TrackPoint, TrackPoint]
"""Track points of one vehicle in another frame and in the ego frame, at one stamp."""


def first_fit(pairs: Sequence[Pair]) -> Frame | None:
    """Return the estimate of a frame by at least ``MIN_PAIRS`` pairs, or None if they disagree."""
    # A row (9,): the positions in both frames, m; their variance, m^2, with the drift since; the
    # difference of the yaws, rad, and its variance, infinite if a yaw is unknown.
    newest = pairs[-1][0].stamp
    rows = np.array([[
        *theirs.position, *ours.position,
        (theirs.covariance + ours.covariance).trace() / 3.0
        + 2.0 * POSITION_DRIFT ** 2 * (newest - theirs.stamp) / NANOSECONDS,
        ours.yaw - theirs.yaw, theirs.yaw_variance + ours.yaw_variance]
        for theirs, ours in pairs])
    found = _fit(rows, newest)
    off = rows[:, 3:6] - found.place - (rows[:, :3] - found.anchor) @ yaw_rotation(found.yaw).T
    turns = (rows[:, 7] - found.yaw + math.pi) % (2.0 * math.pi) - math.pi
    misfit = np.maximum((off * off).sum(axis=1) / rows[:, 6], turns ** 2 / rows[:, 8])
    agreeing = rows[misfit < OUTLIER_CHI2]
    enough = len(agreeing) >= max(MIN_PAIRS, MIN_AGREEING_SHARE * len(rows))
    return _fit(agreeing, newest) if enough else None


def _fit(rows: Array, stamp: int) -> Frame:
    theirs, ours, turns = rows[:, :3], rows[:, 3:6], rows[:, 7]
    weights, sure = 1.0 / rows[:, 6], 1.0 / rows[:, 8]
    total = float(weights.sum())
    anchor, place = weights @ theirs / total, weights @ ours / total
    x, y = (theirs - anchor)[:, :2], (ours - place)[:, :2]
    # The mounting of a marker is constant: many attitudes are no better than one.
    sure *= min(1.0, VARIANCE_FACTOR / ATTITUDE_NOISE ** 2 / max(float(sure.sum()), 1e-9))
    along = weights @ (x * y).sum(axis=1) + sure @ np.cos(turns)
    across = weights @ (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]) + sure @ np.sin(turns)
    # Noise alone spreads points by their variance on two axes.
    known = sure.sum() + max(0.0, weights @ (x * x).sum(axis=1) - 2.0 * (len(rows) - 1))
    covariance = np.diag([min(VARIANCE_FACTOR / max(known, 1e-6), math.pi ** 2),
                          *[VARIANCE_FACTOR / total + SIGHTING_NOISE ** 2] * 3])
    return Frame(math.atan2(across, along), place, anchor, covariance, stamp)


def in_own_frame(state: OdometryState, of_itself: bool, frame: Frame,
                 name: str) -> OdometryState:
    """
    Return a state in an aligned frame as a state in the ego frame, at its stamp.

    :param of_itself: whether the sender is the vehicle itself; :param name: of the ego frame.
    """
    rotation, yaw_variance = yaw_rotation(frame.yaw), float(frame.covariance[0, 0])
    position, share = frame.locate(state.position)
    velocity, spread = rotation.dot(state.velocity), state.velocity_covariance
    if not is_covariance(spread):
        spread = VELOCITY_STD ** 2 * np.eye(3)
    swung = yaw_derivative(velocity)
    spread = rotation.dot(spread).dot(rotation.T) + yaw_variance * np.outer(swung, swung)
    quaternion = canonical_quaternion(quaternion_multiply(
        quaternion_from_yaw(frame.yaw), state.quaternion))
    to_own = quaternion_to_matrix(quaternion)
    pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
    pose[:3, :3] = share + rotation.dot(position_covariance(state, of_itself)).dot(rotation.T)
    if is_covariance(state.pose_covariance[3:, 3:]):
        pose[3:, 3:] = rotation.dot(state.pose_covariance[3:, 3:]).dot(rotation.T)
        pose[5, 5] += yaw_variance
    twist[:3, :3] = to_own.T.dot(spread).dot(to_own)
    return state._replace(
        frame=name, position=position, quaternion=quaternion, velocity=velocity,
        pose_covariance=pose, twist_covariance=twist, twist_rotation=to_own)
