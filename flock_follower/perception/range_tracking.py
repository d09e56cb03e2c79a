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
Tracks a neighbor that is out of sight by distances that a radio measures.

One sensor measures the distances to a neighbor: they have one bias, one place of the ego antenna,
and increasing stamps. A second sensor would need a second series.

In sight, the marker measures the distance a hundred times better than the radio, so only the error
of the ranges is learned. Out of sight, a second filter continues from the state of the first
filter. It is separate, so that ranges do not influence the first filter when the neighbor is seen
again. Ranges limit the error of the state along the line of sight. Across this line the
uncertainty grows with the neighbor's possible motion; once it exceeds the distance, the direction
is unknown.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from flock_follower.geometry import Array, SHORTEST
from flock_follower.messages import FARTHEST
from flock_follower.messages.poses import RangeState
from flock_follower.odometry.buffer import Missing, OdometryBuffer, OdometrySample
from flock_follower.parameters.neighbors_file import MarkedNeighbor
from flock_follower.perception.neighbor_filter import NeighborFilter, UpdateOutcome
from flock_follower.perception.neighbor_motion import Estimate, POSITION
from flock_follower.perception.range_gate import RangeBias
from flock_follower.ranges import Checked, parameter, Range

#: If a neighbor is unseen for this long, s, its state is estimated from its ranges ...
UNSEEN = 0.5
#: ... and for so long at most.
LONGEST = 60.0
#: A range is used to estimate the bias if the neighbor is seen within this time after it, s.
LEARNED = 0.1
#: A range stamped up to this far ahead of the newest odometry, s, waits for it; beyond, clocks
#: differ.
AHEAD_OF_ODOMETRY = 0.3
#: A range older than the newest odometry by more, s, is of no use.
OLDEST_RANGE = 0.5
MOST_WAITING = 100  # ranges: 2 s at 50 Hz, and a bound on memory
UNKNOWN = 'range of an unknown neighbor'
INVALID = 'range outside its limits'
UNTIMELY = 'range stamp repeated, too old or ahead of the odometry'
UNPLACED = 'range without odometry'
Rejection = tuple[str, str]


@dataclass(frozen=True)
class RangingParams(Checked):
    """Place of the ego antenna on the body, FLU, m; noise, m, of ranges without a variance."""

    tag_position: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0), Range(-5.0, 5.0, 'm'),
        'position of the antenna that measures the ranges, on the body, FLU', live=False)
    range_noise: float = parameter(
        0.1, Range(0.001, 10.0, 'm'),
        'standard deviation of ranges without a variance', live=False)


class Ranged(NamedTuple):
    """A neighbor's state as estimated from its ranges, at the stamp of the newest, ns."""

    name: str
    stamp: int
    estimate: Estimate


class PlacedRange(NamedTuple):
    """A range, its time on the filters' clock, s, and the ego antenna (3,), m, in their frame."""

    stamp: float
    distance: float
    variance: float
    antenna: Array


class Ranging:
    """
    Takes the ranges of all neighbors, and estimates the states of those out of sight.

    :param filters: of the neighbors seen, by name; not changed here.
    :param odometry: the ego odometry.
    """

    def __init__(self, neighbors: Iterable[MarkedNeighbor], filters: Mapping[str, NeighborFilter],
                 odometry: OdometryBuffer, params: RangingParams | None = None) -> None:
        self.params = params or RangingParams()
        self._odometry = odometry
        self._tag = np.array(self.params.tag_position)
        self._series = {n.name: RangeSeries(filters[n.name], np.array(n.tag_position))
                        for n in neighbors}
        self._waiting: list[tuple[float, RangeState]] = []

    def restart(self) -> None:
        """Forget everything."""
        self._waiting.clear()
        for series in self._series.values():
            series.restart()

    @property
    def biases(self) -> dict[str, RangeBias]:
        """Return the bias of the ranges to each neighbor."""
        return {name: series.bias for name, series in self._series.items()
                if series.newest > -math.inf}

    @property
    def waiting(self) -> bool:
        """Return whether a range waits for odometry."""
        return bool(self._waiting)

    def take(self, measured: RangeState, stamp: float) -> Rejection | None:
        """
        Take a range for :meth:`due`; return why it is dropped, or None.

        :param stamp: its stamp, s, by the clock of the odometry.
        """
        series, newest = self._series.get(measured.name), self._odometry.newest
        if series is None:
            return UNKNOWN, f'frame_id {measured.name!r}: must be one of {", ".join(self._series)}'
        low, high = measured.limits if measured.limits[0] < measured.limits[1] else (0.0, math.inf)
        high = min(high, FARTHEST)
        # Radios send 0 for none; NaN fails.
        if not (low <= measured.distance <= high and measured.distance > 0.0):
            return INVALID, (f'{measured.name}, {measured.distance:.3g} m: must be in '
                             f'[{low:g}, {high:g}] m, and not 0')
        if newest is None:
            return UNPLACED, measured.name
        if not max(newest - OLDEST_RANGE, series.newest) < stamp <= newest + AHEAD_OF_ODOMETRY:
            return UNTIMELY, f'{measured.name}: {stamp - newest:.2f} s after the odometry'
        series.newest = stamp
        insort(self._waiting, (stamp, measured), key=lambda waiting: waiting[0])
        return None

    def due(self) -> Iterator[Ranged | Rejection]:
        """Use every range that the odometry has reached; yield the result."""
        while self._waiting:
            stamp, measured = self._waiting[0]
            own = self._odometry.at(stamp, extrapolate=False)
            if own is Missing.TOO_NEW and len(self._waiting) <= MOST_WAITING:
                return
            self._waiting.pop(0)
            if isinstance(own, Missing):
                yield UNPLACED, f'{measured.name}: {own.value}'
                continue
            body = own.smooth_pose
            variance = measured.variance or self.params.range_noise ** 2
            placed = PlacedRange(stamp, measured.distance, variance, body.apply(self._tag))
            estimate = self._series[measured.name].take(placed, own)
            if estimate is not None:
                yield Ranged(measured.name, measured.stamp, estimate)


class RangeSeries:
    """The ranges to an antenna at ``tag`` (3,), m, on the body of a neighbor."""

    def __init__(self, seen: NeighborFilter, tag: Array) -> None:
        self._seen, self._tag = seen, tag
        self.restart()

    def restart(self) -> None:
        self.bias = RangeBias()
        self.newest = -math.inf  # stamp, s
        self._unused: deque[PlacedRange] = deque(maxlen=MOST_WAITING)
        self._apart: NeighborFilter | None = None
        self._since: float | None = None

    def take(self, measured: PlacedRange, own: OdometrySample) -> Estimate | None:
        """Take a range; return the state, on the odometry's clock, of a neighbor out of sight."""
        seen = self._seen.newest
        if seen is None:
            return None
        self._unused.append(measured)
        while self._unused and self._unused[0].stamp <= seen.stamp:
            self._learn(self._unused.popleft(), seen)
        if self._since != seen.stamp:  # it was seen meanwhile
            self._apart = None
        unseen = measured.stamp - seen.stamp
        if not UNSEEN < unseen <= LONGEST:
            return None
        if self._apart is None:
            self._apart, self._since = self._seen.continued(LONGEST), seen.stamp
        outcome = UpdateOutcome.LOST
        while self._unused:
            each = self._unused.popleft()
            outcome = self._apart.update_range(
                each.stamp, each.distance - self.bias.value, each.antenna,
                each.variance + self.bias.variance(each.stamp), self._tag)
        now = self._apart.newest
        if now is None or outcome not in (UpdateOutcome.USED, UpdateOutcome.SURPRISING):
            return None
        return self._reported(now, own)

    def _learn(self, measured: PlacedRange, seen: Estimate) -> None:
        then = self._seen.near(measured.stamp)
        if then is None or seen.stamp - measured.stamp > LEARNED:
            return
        distance, along = _measured(
            then.position + then.rotation.dot(self._tag) - measured.antenna)
        spread = float(along.dot(then.covariance[POSITION, POSITION]).dot(along))
        self.bias.learn(measured.stamp, measured.distance - distance, measured.variance + spread)

    def _reported(self, now: Estimate, own: OdometrySample) -> Estimate:
        """Return a state in odom; the variance of the bias adds to that of the distance."""
        _, along = _measured(now.position - own.travel)
        covariance = now.covariance.copy()
        covariance[POSITION, POSITION] += self.bias.variance(now.stamp) * np.outer(along, along)
        return now._replace(stamp=own.stamp, position=now.position + own.correction,
                            covariance=covariance)


def _measured(sight: Array) -> tuple[float, Array]:
    """Return length, m, and direction (3,) of a line of sight (3,), m; no direction at 0."""
    distance = math.hypot(*sight.tolist())
    return distance, sight / max(distance, SHORTEST)
