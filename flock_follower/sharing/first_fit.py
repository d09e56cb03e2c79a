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
How two frames lie to each other, from nothing: whom both knew of at one time, fitted at once.

The best yaw between two sets of points is the direction of a sum, linear in its cosine and sine,
so that no first guess is needed; attitudes of a vehicle known in both frames add to the same sum.
How long the sum would be were all exact is what is known of the yaw: of points at one place,
nothing.
"""

from __future__ import annotations

from collections import deque
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, wrap_angle
from flock_follower.messages import NANOSECONDS
from flock_follower.sharing.frame_alignment import FirstFit, turned
from flock_follower.sharing.sharing_params import SharingParams
from flock_follower.sharing.told_tracks import Moment

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

    def __init__(self, params: SharingParams) -> None:
        self._params = params
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
        return np.array([p.variance for p in pairs]) + 2.0 * self._params.position_drift ** 2 * age

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
            share = min(1.0, WARINESS / self._params.attitude_noise ** 2 / sure)
            along += share * sum(weight * math.cos(turn) for turn, weight in turns)
            across += share * sum(weight * math.sin(turn) for turn, weight in turns)
            known += share * sure
        covariance = np.zeros((4, 4))
        covariance[0, 0] = WARINESS / max(known, 1e-6)
        covariance[1:, 1:] = np.eye(3) * (
            WARINESS / total + self._params.sighting_noise ** 2)
        return FirstFit(math.atan2(across, along), place, anchor, covariance)

    def _misfit(self, pairs: list[_Pair], fit: FirstFit) -> Array:
        """Return chi^2 (n,) of each pair's distance, and of its attitudes, from a fit."""
        one, other = np.array([p.one for p in pairs]), np.array([p.other for p in pairs])
        gap = one - fit.place - (other - fit.anchor) @ turned(fit.yaw).T
        chi2: Array = (gap * gap).sum(axis=1) / self._variances(pairs)
        turns = np.array([wrap_angle(p.turn - fit.yaw) ** 2 / p.turn_variance for p in pairs])
        return np.maximum(chi2, turns)
