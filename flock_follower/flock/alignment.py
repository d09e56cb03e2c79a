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
How the frames of others lie to one's own: all of them in one Kalman filter.

Gravity makes vertical what is vertical for all: a frame is turned by a yaw and moved, 4 unknowns.
Of each frame are kept the yaw, which turns its coordinates to one's own, and the place in one's
own frame of an anchor in it. The anchor moves with its vehicle, about which the drift of its
odometry turns it: yaw and place are then nearly independent, and the lever between is short.
One's own odometry drifts, too, and moves all frames at once, which their covariance knows: so a
frame may be tied to another instead of one's own, and nothing counts twice.

How two frames lie to each other, from nothing: whom both knew of at one time, fitted at once.

The best yaw between two sets of points is the direction of a sum, linear in its cosine and sine,
so that no first guess is needed; attitudes of a vehicle known in both frames add to the same sum.
How long the sum would be were all exact is what is known of the yaw: of points at one place,
nothing.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from flock_follower.flock.peers import (
    ATTITUDE_NOISE,
    Moment,
    POSITION_DRIFT,
    SIGHTING_NOISE,
    YAW_DRIFT,
)
from flock_follower.geometry import Array, wrap_angle
from flock_follower.messages import NANOSECONDS

#: chi^2 with 3 degrees of freedom, and with 1, at a probability of 0.999.
GATE, YAW_GATE = 16.27, 10.83
#: Drift is taken in by steps of this, ns, at least.
DRIFT_STEP = 50_000_000
_SIZE = 4


class FirstFit(NamedTuple):
    """
    How a frame lies to another at first: see ``first_fit``.

    ``yaw``, rad, turns its coordinates to the other's; ``anchor`` (3,), m, in it is at ``place``
    (3,), m, in the other; ``covariance`` (4, 4) is of yaw and place.
    """

    yaw: float
    place: Array
    anchor: Array
    covariance: Array


def turned(yaw: float) -> Array:
    """Return the rotation (3, 3) about the vertical by a yaw, rad."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def sideways(vector: Array) -> Array:
    """Return by what a vector (3,) moves where it is turned about the vertical, per rad."""
    return np.array([-vector[1], vector[0], 0.0])


@dataclass
class _Frame:
    """Estimate of one frame; the covariance has 4 rows of it, in the order of the frames."""

    yaw: float
    """Turns its coordinates to the own ones, rad."""
    rotation: Array
    """(3, 3), the same."""
    place: Array
    """Of its anchor in the own frame (3,), m."""
    anchor: Array
    """In the frame itself (3,), m."""

    def lever(self, position: Array) -> Array:
        """Return the way (3,), m, in the own frame from the anchor to a position in the frame."""
        return self.rotation.dot(position - self.anchor)


class FrameAlignment:
    """The filter; a frame has the name of its vehicle. Times are stamps, ns."""

    def __init__(self) -> None:
        self._frames: dict[str, _Frame] = {}
        self._covariance: Array = np.zeros((0, 0))
        self._stamp: int | None = None

    def __contains__(self, name: str) -> bool:
        """Return whether anything is known of a frame."""
        return name in self._frames

    def rotation(self, name: str) -> Array:
        """Return what turns a frame's coordinates to one's own, (3, 3)."""
        return self._frames[name].rotation

    def yaw(self, name: str) -> float:
        """Return the yaw that does it, rad."""
        return self._frames[name].yaw

    def block(self, name: str) -> Array:
        """Return the covariance (4, 4) of a frame's yaw and place."""
        part = self._part(name)
        return self._covariance[part, part]

    def stds(self, name: str) -> tuple[float, float]:
        """Return the standard deviations of a frame's place, sqrt(trace), m, and yaw, rad."""
        variances = self.block(name).diagonal()
        return math.sqrt(max(variances[1:].sum(), 0.0)), math.sqrt(max(variances[0], 0.0))

    def located(self, name: str, position: Array) -> tuple[Array, Array]:
        """Return a position (3,) of a frame in one's own, and the frame's share (3, 3) in it."""
        frame = self._frames[name]
        lever = frame.lever(position)
        H = _lever_matrix(lever)
        return frame.place + lever, H.dot(self.block(name)).dot(H.T)

    def variance(self, name: str, position: Array) -> float:
        """Return the trace of the frame's share in a position (3,) of it, m^2, quickly."""
        x, y, _ = self._frames[name].lever(position).tolist()
        block = self.block(name)
        yaw, across_x, across_y, _ = block[0].tolist()
        place = float(block.diagonal()[1:].sum())
        return place + 2.0 * (x * across_y - y * across_x) + (x * x + y * y) * yaw

    def drop(self, name: str) -> None:
        """Forget a frame."""
        kept = np.delete(np.arange(len(self._covariance)), self._part(name))
        self._covariance = self._covariance[np.ix_(kept, kept)]
        del self._frames[name]

    def clear(self) -> None:
        """Forget all frames."""
        self._frames.clear()
        self._covariance = np.zeros((0, 0))

    def start(self, name: str, fit: FirstFit, reference: str | None = None) -> None:
        """
        Take in a frame that nothing was known of.

        :param reference: the frame that ``fit`` relates it to, already known; None: one's own.
        """
        size = len(self._covariance)
        grown = np.zeros((size + _SIZE, size + _SIZE))
        grown[:size, :size] = self._covariance
        yaw, place, covariance = fit.yaw, fit.place, fit.covariance
        if reference is not None:
            # yaw = yaw_r + yaw', place = place_r + R_r (place' - anchor_r), and their errors.
            known, part = self._frames[reference], self._part(reference)
            lever = known.lever(fit.place)
            yaw, place = known.yaw + fit.yaw, known.place + lever
            A, B = np.eye(_SIZE), np.eye(_SIZE)
            A[1:, 0], B[1:, 1:] = sideways(lever), known.rotation
            across = A.dot(self._covariance[part])
            grown[size:, :size], grown[:size, size:] = across, across.T
            covariance = A.dot(self._covariance[part, part]).dot(A.T) + (
                B.dot(fit.covariance).dot(B.T))
        grown[size:, size:] = covariance
        self._covariance = grown
        self._frames[name] = _Frame(wrap_angle(yaw), turned(yaw), place, fit.anchor)

    def anchored(self, name: str, position: Array) -> None:
        """Move a frame's anchor to where its vehicle is in it, (3,)."""
        frame, row = self._frames[name], self._part(name).start
        lever = frame.lever(position)
        frame.anchor, frame.place = position, frame.place + lever
        P, aside = self._covariance, sideways(lever)
        P[row + 1:row + _SIZE] += np.outer(aside, P[row])
        P[:, row + 1:row + _SIZE] += np.outer(P[:, row], aside)

    def drift(self, stamp: int, own_position: Array) -> None:
        """Let the frames drift until a stamp, ns; one's own turns about one's position (3,)."""
        if self._stamp is None or not self._frames:
            self._stamp = stamp
        if stamp - self._stamp < DRIFT_STEP:
            return
        elapsed = (stamp - self._stamp) / NANOSECONDS
        self._stamp = stamp
        position = POSITION_DRIFT ** 2 * elapsed
        yaw = YAW_DRIFT ** 2 * elapsed
        count = len(self._frames)
        turning = np.concatenate([np.concatenate([[1.0], sideways(frame.place - own_position)])
                                  for frame in self._frames.values()])
        own = yaw * np.outer(turning, turning) + position * np.kron(
            np.ones((count, count)), np.diag([0.0, 1.0, 1.0, 1.0]))
        theirs = np.tile([yaw, position, position, position], count)
        self._covariance = self._covariance + own + np.diag(theirs)

    def relate(self, first: tuple[str | None, Moment], second: tuple[str | None, Moment]) -> float:
        """
        Take in that one vehicle was at two places in two frames, at one stamp.

        Return the squared Mahalanobis distance of the two over the gate's: above 1 it was refused.

        :param first: the frame, known, or None for one's own, and the vehicle's moment in it.
        """
        columns: list[int] = []
        parts: list[Array] = []
        gap: Array = np.zeros(3)
        noise: Array = np.zeros((3, 3))
        yaw_gap, yaw_noise = 0.0, 0.0
        for sign, (name, there) in ((1.0, first), (-1.0, second)):
            place, covariance, yaw = there.position, there.covariance, there.yaw
            if name is not None:
                frame, part = self._frames[name], self._part(name)
                lever = frame.lever(place)
                place, yaw = frame.place + lever, yaw + frame.yaw
                covariance = frame.rotation.dot(covariance).dot(frame.rotation.T)
                columns += range(part.start, part.stop)
                parts.append(sign * np.vstack([_lever_matrix(lever), [1.0, 0.0, 0.0, 0.0]]))
            gap, noise = gap + sign * place, noise + covariance
            yaw_gap, yaw_noise = yaw_gap + sign * yaw, yaw_noise + there.yaw_variance
        H = np.hstack(parts)
        known = self._covariance[np.ix_(columns, columns)]
        spread = H.dot(known).dot(H.T)
        S = spread[:3, :3] + noise
        doubt = float(gap.dot(np.linalg.solve(S, gap))) / GATE
        if not doubt <= 1.0:  # NaN is refused
            return doubt
        innovation: Array = gap
        rows = 3
        if self._yaw_counts(float(spread[3, 3]), yaw_noise, yaw_gap):
            innovation, rows = np.append(gap, wrap_angle(yaw_gap)), 4
            S = spread.copy()
            S[:3, :3] += noise
            S[3, 3] += yaw_noise
        across = self._covariance[:, columns].dot(H[:rows].T)
        gain = np.linalg.solve(S, across.T)  # (rows, 4 n), symmetric S
        self._add(-innovation.dot(gain))
        P = self._covariance - across.dot(gain)
        self._covariance = 0.5 * (P + P.T)
        return doubt

    def _yaw_counts(self, variance: float, noise: float, gap: float) -> bool:
        """
        Return whether attitudes are to be used for the yaw between two frames.

        They err by how markers hang, time after time: never averaged below that.
        """
        return (math.isfinite(noise) and variance > ATTITUDE_NOISE ** 2
                and wrap_angle(gap) ** 2 <= YAW_GATE * (variance + noise))

    def _add(self, error: Array) -> None:
        """Add an error state (4 n,)."""
        for frame, (yaw, *place) in zip(self._frames.values(),
                                        error.reshape(-1, _SIZE).tolist()):
            frame.yaw = wrap_angle(frame.yaw + yaw)
            frame.rotation = turned(frame.yaw)
            frame.place = frame.place + place

    def _part(self, name: str) -> slice:
        row = _SIZE * list(self._frames).index(name)
        return slice(row, row + _SIZE)


def _lever_matrix(lever: Array) -> Array:
    """Return what takes the errors of yaw and place (4,) to those of a point (3,) off them."""
    H = np.zeros((3, _SIZE))
    H[:, 0], H[:, 1:] = sideways(lever), np.eye(3)
    return H


#: Pairs kept, and for how long, ns: drift makes older ones worthless.
MOST, LONGEST = 100, 20 * NANOSECONDS
FEWEST = 5
#: Errors of sightings last: the variances of a fit that takes them for independent, times this.
WARINESS = 4.0
#: A yaw less certain than this, rad, is no start for a linear filter.
START_YAW = 0.35
#: chi^2 of 3 beyond which a pair is left out; all are where it is not that of most.
OUTLIER, AGREEING = 25.0, 0.7


class _Pair(NamedTuple):
    """One vehicle in the two frames, at one stamp."""

    stamp: int
    one: Array
    other: Array
    variance: float
    """Of each axis, m^2."""
    turn: float
    """By how much its yaw is greater in the first frame than in the other, rad ..."""
    turn_variance: float
    """... infinite where it is not known."""


class PairedFrames:
    """Two frames that have not been related yet."""

    def __init__(self) -> None:
        self._pairs: deque[_Pair] = deque(maxlen=MOST)
        self.yaw_std = math.pi
        """Of the yaw between them, rad, at the last fit."""

    def add(self, one: Moment, other: Moment) -> None:
        """Take in where one vehicle was in both, at one stamp."""
        while self._pairs and one.stamp - self._pairs[0].stamp > LONGEST:
            self._pairs.popleft()
        variance = float((one.covariance + other.covariance).trace()) / 3.0
        self._pairs.append(_Pair(one.stamp, one.position, other.position, variance,
                                 one.yaw - other.yaw, one.yaw_variance + other.yaw_variance))

    def first_fit(self, swapped: bool = False) -> FirstFit | None:
        """
        Return how the second frame lies to the first, or None while that is not known.

        :param swapped: how the first lies to the second.
        """
        if len(self._pairs) < FEWEST:
            return None
        pairs = list(self._pairs)
        if swapped:
            pairs = [p._replace(one=p.other, other=p.one, turn=-p.turn) for p in pairs]
        found = self._fit(pairs)
        agreeing = [p for p, chi2 in zip(pairs, self._misfit(pairs, found)) if chi2 < OUTLIER]
        if len(agreeing) < len(pairs):
            if len(agreeing) < max(FEWEST, AGREEING * len(pairs)):
                if len(pairs) > 4 * FEWEST:  # it may be the older ones that are wrong
                    for _ in range(len(pairs) // 2):
                        self._pairs.popleft()
                return None
            found = self._fit(agreeing)
        self.yaw_std = math.sqrt(min(found.covariance[0, 0], math.pi ** 2))
        return found if self.yaw_std <= START_YAW else None

    def _variances(self, pairs: list[_Pair]) -> Array:
        """Return the variance of each pair (n,), m^2, with the drift of both frames since."""
        age = (pairs[-1].stamp - np.array([p.stamp for p in pairs])) / NANOSECONDS
        return np.array([p.variance for p in pairs]) + 2.0 * POSITION_DRIFT ** 2 * age

    def _fit(self, pairs: list[_Pair]) -> FirstFit:
        weights = 1.0 / self._variances(pairs)
        total = float(weights.sum())
        one, other = np.array([p.one for p in pairs]), np.array([p.other for p in pairs])
        place, anchor = weights @ one / total, weights @ other / total
        x, y = (one - place)[:, :2], (other - anchor)[:, :2]
        along = float(weights @ (y * x).sum(axis=1))
        across = float(weights @ (y[:, 0] * x[:, 1] - y[:, 1] * x[:, 0]))
        # Noise alone spreads points by their variance on two axes.
        known = max(0.0, float(weights @ (y * y).sum(axis=1)) - 2.0 * (len(pairs) - 1))
        turns = [(p.turn, 1.0 / p.turn_variance) for p in pairs if p.turn_variance < math.inf]
        if turns:
            # How markers hang is the same all the time: no number of attitudes is worth more.
            sure = sum(weight for _, weight in turns)
            share = min(1.0, WARINESS / ATTITUDE_NOISE ** 2 / sure)
            along += share * sum(weight * math.cos(turn) for turn, weight in turns)
            across += share * sum(weight * math.sin(turn) for turn, weight in turns)
            known += share * sure
        covariance = np.zeros((4, 4))
        covariance[0, 0] = WARINESS / max(known, 1e-6)
        covariance[1:, 1:] = np.eye(3) * (
            WARINESS / total + SIGHTING_NOISE ** 2)
        return FirstFit(math.atan2(across, along), place, anchor, covariance)

    def _misfit(self, pairs: list[_Pair], fit: FirstFit) -> Array:
        """Return chi^2 (n,) of each pair's distance, and of its attitudes, from a fit."""
        one, other = np.array([p.one for p in pairs]), np.array([p.other for p in pairs])
        gap = one - fit.place - (other - fit.anchor) @ turned(fit.yaw).T
        chi2: Array = (gap * gap).sum(axis=1) / self._variances(pairs)
        turns = np.array([wrap_angle(p.turn - fit.yaw) ** 2 / p.turn_variance for p in pairs])
        return np.maximum(chi2, turns)
