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
Data association: selects the neighbor's track among all markers with its id.

An id may appear twice: on the neighbor, and on a print on a wall. The primary track is used as the
neighbor. Every other print with the id has a separate track, a candidate, which replaces the
primary track only if it can be the neighbor:

===============================  ================================================================
the primary track is             the candidate takes its place
===============================  ================================================================
in view, and has never moved     once it has moved: a print does not; or at once, if the primary
                                 track restarted farther from where it was lost
not seen since the candidate     after ``max_rejections`` measurements, if from the newest place
is, nor ever beside it           of the primary track ``leader_speed_max`` reaches the candidate's
                                 first place, or if it has moved, or after PATIENCE
out of view                      after PATIENCE, if it has moved; never, if it stands still
===============================  ================================================================

Poses of another detector have no second print, but single poses are outliers:

- A primary track with fewer than three measurements may have begun with an outlier: a candidate
  with three later measurements takes its place.
- A candidate that is not confirmed gets no measurement near the primary track: otherwise an
  outlier on a neighbor's path would take the measurements of this neighbor as it passes.

Positions are in the smooth frame of ``OdometryBuffer``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import NamedTuple

from flock_follower.geometry import Array, Transform
from flock_follower.messages import MAX_JUMP
from flock_follower.perception.neighbor_filter import NeighborFilter, UpdateOutcome
from flock_follower.perception.neighbor_motion import FilterParams

#: A measurement nearer than this to a candidate's expected place is of that candidate, m.
SAME_PLACE = 0.3
#: Tolerance of the distance of a restart, m: errors of both places.
RESTART_TOLERANCE = 0.3
#: A candidate has moved if it covers this distance, m, within WINDOW.
MOVED = 0.5
#: Time in which a moving candidate covers MOVED, s.
WINDOW = 5.0
#: A candidate with fewer measurements may be a false detection.
N_CONFIRMED = 3
#: The primary track must be unseen for this long, s, before a candidate can replace it.
PATIENCE = 10.0
#: A candidate at rest is kept for this long, s, after its last measurement.
MEMORY = 30.0
#: Largest number of candidates.
MOST = 3
#: If the primary track was not measured for longer than this, s, every measurement outside its
#: gate becomes a candidate.
GAP = 0.5
#: Measurements not farther apart than this, s, are from the same time: both bodies were in view.
BESIDE = 1e-3


class _Motion:
    """Whether a body has moved."""

    def __init__(self) -> None:
        self.has_moved = False
        self._since, self._place = -math.inf, (0.0, 0.0, 0.0)

    def take(self, time: float, place: Array) -> None:
        """Take its position (3,), m."""
        x, y, z = place.tolist()
        if not 0.0 <= time - self._since <= WINDOW:
            self._since, self._place = time, (x, y, z)
        self.has_moved = self.has_moved or math.dist(self._place, (x, y, z)) > MOVED


@dataclass(eq=False)
class Candidate:
    """A track that is not the primary track; candidates are numbered from 1 on."""

    number: int
    track: NeighborFilter
    reachable: bool
    """Whether the primary track could have reached the candidate's first place."""
    motion: _Motion = field(default_factory=_Motion)
    measured: int = 0
    """Number of accepted measurements."""
    alone: int = 0
    """Number of measurements since the last measurement of the primary track."""
    beside: bool = False
    """Whether the primary track was ever measured in the same image."""

    @property
    def confirmed(self) -> bool:
        """Return whether the candidate is more than a false detection."""
        return self.measured >= N_CONFIRMED

    @property
    def seen(self) -> float:
        """Return the time of the last measurement, s."""
        return -math.inf if self.track.newest is None else self.track.newest.stamp

    def distance(self, time: float, place: Array) -> float:
        """Return the distance of a place (3,), m, from the candidate's expected place, m."""
        expected = self.track.place(time) or (self.track.newest and self.track.newest.pose)
        return math.inf if expected is None else math.dist(place, expected.translation)

    def take(self, time: float, measured: Transform, reference: Array,
             covariance: Array) -> None:
        """Update the track with a measurement; if the track refuses it, the track restarts."""
        arguments = time, measured, reference, covariance
        if self.track.update(*arguments) is UpdateOutcome.OUTLIER:
            self.track.reset()
            self.track.update(*arguments)
        self.motion.take(time, measured.translation)
        self.measured += 1
        self.alone += 1


class Taken(NamedTuple):
    """The outcome of a measurement; ``candidate`` is None if it belongs to the primary track."""

    outcome: UpdateOutcome
    candidate: Candidate | None = None


class Hypotheses:
    """
    The primary track of one neighbor, and the candidates with the same marker.

    :param marked: whether the neighbor carries markers; else another detector measures its poses.
    """

    def __init__(self, params: FilterParams, marked: bool = True) -> None:
        self.params, self._marked = params, marked
        self.primary = NeighborFilter(params)
        self.reset()

    def reset(self) -> None:
        """Forget all of them."""
        self.primary.reset()
        self._motion = _Motion()
        self._measured = 0  # measurements of the primary track since it started
        self._lost: Array | None = None
        """Position (3,), m, of the primary track before its restart; None without a restart."""
        self.candidates: list[Candidate] = []

    @property
    def tracks(self) -> list[NeighborFilter]:
        """Return the filters of all of them."""
        return [self.primary, *(each.track for each in self.candidates)]

    def candidate_at(self, time: float, place: Array) -> Candidate | None:
        """Return the candidate that a measurement at a place (3,), m, belongs to, or None."""
        if not self.candidates:
            return None
        nearest = self._find_nearest(time, place)
        expected = self.primary.place(time)
        least = SAME_PLACE if expected is None else min(
            SAME_PLACE, math.dist(place, expected.translation))
        if not self._marked and least < SAME_PLACE and not nearest.confirmed:
            return None
        return nearest if nearest.distance(time, place) < least else None

    def _find_nearest(self, time: float, place: Array) -> Candidate:
        return min(self.candidates, key=lambda each: each.distance(time, place))

    def take(self, time: float, measured: Transform, reference: Array, covariance: Array,
             another: bool = False, alike: Array | None = None) -> Taken:
        """
        Take in a body's pose; see ``NeighborFilter.update``.

        :param another: whether the primary track is elsewhere in the same image.
        """
        newest = self.primary.newest
        if newest is not None and time < newest.stamp - MAX_JUMP:
            self.reset()
        self.candidates = [each for each in self.candidates if time - each.seen <= (
            MEMORY if each.confirmed and not each.motion.has_moved else self.params.max_gap)]
        candidate = self.candidate_at(time, measured.translation)
        arguments = time, measured, reference, covariance
        if candidate is None:
            outcome = UpdateOutcome.OUTLIER if another else self._update_primary(
                *arguments, alike)
            if outcome is not UpdateOutcome.OUTLIER:
                return Taken(outcome)
            candidate = self._choose_candidate(time, measured.translation)
        if time <= candidate.seen:
            return Taken(UpdateOutcome.OLDER, candidate)
        candidate.take(*arguments)
        last = self.primary.newest
        if another or (last is not None and abs(time - last.stamp) < BESIDE):
            candidate.beside, candidate.alone = True, 0
        if self._is_neighbor(candidate, time):
            self._exchange(candidate)
            return Taken(UpdateOutcome.STARTED)
        return Taken(UpdateOutcome.OUTLIER, candidate)

    def _choose_candidate(self, time: float, place: Array) -> Candidate:
        """Return the candidate of a measurement (3,), m, that the primary track refused."""
        if not self._marked and self.candidates:
            nearest = self._find_nearest(time, place)
            if nearest.distance(time, place) < SAME_PLACE:
                return nearest
        return self._add(time, place)

    def _update_primary(self, time: float, measured: Transform, reference: Array,
                        covariance: Array, alike: Array | None) -> UpdateOutcome:
        """Update the primary track with a measurement, if both can be of one body."""
        last, reach = self.primary.newest, self._reach(time)
        if last is not None and time - last.stamp > self.params.max_gap and (
                math.dist(measured.translation, last.position) > reach):
            return UpdateOutcome.OUTLIER
        surprised = last is None or time - last.stamp <= GAP
        outcome = self.primary.update(time, measured, reference, covariance,
                                      reach if surprised else 0.0, alike)
        if outcome is UpdateOutcome.STARTED:
            self._motion, self._lost = _Motion(), None if last is None else last.position
            self._measured = 0
        if outcome not in (UpdateOutcome.OUTLIER, UpdateOutcome.OLDER):
            self._measured += 1
            self._motion.take(time, measured.translation)
            for each in self.candidates:
                each.alone = 0
        return outcome

    def _reach(self, time: float) -> float:
        """Return the largest possible distance of the primary track from its last place, m."""
        last = self.primary.newest
        return RESTART_TOLERANCE if last is None else (
            RESTART_TOLERANCE + self.params.leader_speed_max * max(time - last.stamp, 0.0))

    def _is_neighbor(self, candidate: Candidate, time: float) -> bool:
        """Return whether a candidate replaces the primary track; see the module."""
        moved, last = candidate.motion.has_moved, self.primary.newest
        if not self._marked and self._measured < N_CONFIRMED <= candidate.alone:
            return True
        if candidate.measured < self.params.max_rejections:
            return False
        if not self._motion.has_moved and (moved or self._nearer_to_loss(candidate)):
            return True
        if last is None or candidate.alone < self.params.max_rejections:
            return False
        patient = time - last.stamp > PATIENCE
        if candidate.beside:
            return moved and patient
        return candidate.reachable or moved or patient

    def _nearer_to_loss(self, candidate: Candidate) -> bool:
        """Return whether a candidate is nearer than the primary track to the place of its loss."""
        now, other = self.primary.newest, candidate.track.newest
        return self._lost is not None and now is not None and other is not None and (
            math.dist(other.position, self._lost) < math.dist(now.position, self._lost))

    def _exchange(self, candidate: Candidate) -> None:
        """Make a candidate primary; the old primary track stays if both were seen at once."""
        last = self.primary.newest
        self._lost = None if candidate.beside or last is None else last.position
        before = self.primary.continued(self.params.max_gap)
        self.primary.reset()
        self.primary.newest = candidate.track.newest
        self._motion, candidate.motion = candidate.motion, self._motion
        self._measured = candidate.measured
        candidate.track, candidate.alone = before, 0
        if not candidate.beside:
            self.candidates.remove(candidate)

    def _add(self, time: float, place: Array) -> Candidate:
        """Return a new candidate at a place (3,), m."""
        if len(self.candidates) == MOST:
            self.candidates.remove(min(self.candidates, key=lambda c: (c.confirmed, c.seen)))
        number = min({*range(1, MOST + 1)} - {each.number for each in self.candidates})
        last = self.primary.newest
        candidate = Candidate(number, NeighborFilter(self.params), (
            last is not None and math.dist(place, last.position) <= self._reach(time)))
        candidate.track.walk = self.primary.walk
        self.candidates.append(candidate)
        return candidate
