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

"""Data association: which of those who carry one marker is believed to be the neighbor."""

from __future__ import annotations

from marker_images import known
import numpy as np
import pytest

from flock_follower.geometry import Array, Transform
from flock_follower.perception.hypotheses import (
    Candidate,
    Hypotheses,
    PATIENCE,
    RESTART_TOLERANCE,
    Taken,
)
from flock_follower.perception.neighbor_filter import Estimate, NeighborFilter, UpdateOutcome
from flock_follower.perception.neighbor_motion import FilterParams

PARAMS = FilterParams()
NOISE = np.diag([0.005, 0.005, 0.01, 0.02, 0.02, 0.01])**2
START, VELOCITY = np.array([2.0, 0.0, 1.0]), np.array([0.4, 0.1, 0.0])
WALL = np.array([3.2, 1.4, 1.2])
DT = 1.0 / 30.0


class Course:
    """What a camera sees, measurement by measurement."""

    def __init__(self, velocity: Array = VELOCITY, params: FilterParams = PARAMS) -> None:
        self.tracks, self.velocity = Hypotheses(params), velocity
        self.time = 0.0
        self.rng = np.random.default_rng(4)

    @property
    def leader(self) -> Array:
        return START + self.time * self.velocity

    def see(self, *places: Array) -> list[Taken]:
        """Take an image of bodies at places (3,), m, the believed first, as Tracker does."""
        self.time += DT
        taken: list[Taken] = []
        now = self.tracks.primary.newest
        for place in places if now is None else sorted(
                places, key=lambda place: float(np.linalg.norm(place - now.position))):
            noisy = place + np.sqrt(np.diag(NOISE)[:3]) * self.rng.standard_normal(3)
            used = any(each.candidate is None for each in taken)
            taken.append(self.tracks.take(self.time, Transform(np.eye(3), noisy), np.zeros(3),
                                          NOISE, used))
        return taken

    def watch(self, seconds: float, *also: Array) -> list[Taken]:
        """See the leader, and prints, for a while."""
        return [taken for _ in range(round(seconds / DT)) for taken in self.see(
            self.leader, *also)]

    def only(self, seconds: float, place: Array, velocity: Array | None = None) -> list[Taken]:
        """See nobody but one who begins at a place (3,), m."""
        rate, begin = np.zeros(3) if velocity is None else velocity, self.time
        return [taken for _ in range(round(seconds / DT))
                for taken in self.see(place + (self.time - begin) * rate)]

    @property
    def estimate(self) -> Estimate:
        return known(self.tracks.primary.newest)

    @property
    def candidate(self) -> Candidate:
        (candidate,) = self.tracks.candidates
        return candidate


def outcomes(taken: list[Taken]) -> set[UpdateOutcome]:
    return {each.outcome for each in taken}


def near(track: NeighborFilter, place: Array) -> bool:
    """Return whether a track is at a place (3,), m."""
    return track.newest is not None and float(
        np.linalg.norm(track.newest.position - place)) < 0.06


def test_first_of_two_is_trusted_and_both_are_tracked() -> None:
    course = Course(np.zeros(3))
    course.watch(1.0, WALL)
    assert course.candidate.beside and course.candidate.confirmed
    assert near(course.candidate.track, WALL) and near(course.tracks.primary, START)
    assert course.candidate.number == 1


def test_a_false_detection_is_not_a_duplicate_and_forgotten() -> None:
    course = Course()
    course.watch(1.0)
    course.see(course.leader, WALL)
    assert not course.candidate.confirmed
    course.watch(PARAMS.max_gap + 0.1)
    course.see(course.leader, WALL + 1.0)
    assert course.candidate.measured == 1


@pytest.mark.parametrize('velocity', [VELOCITY, np.zeros(3)], ids=['moving', 'hovering'])
@pytest.mark.parametrize('known', [True, False])
def test_print_is_never_the_leader_beside_it_rarely_one_far_off(
        velocity: Array, known: bool) -> None:
    course = Course(velocity)
    course.watch(3.0, *[WALL] * known)
    taken = course.only(PATIENCE - 1.0, WALL)
    assert outcomes(taken) == {UpdateOutcome.OUTLIER}
    back = course.see(course.leader)
    assert back[0].outcome is UpdateOutcome.STARTED
    assert near(course.tracks.primary, course.leader)


def test_print_beside_leader_is_never_taken_for_it() -> None:
    course = Course()
    course.watch(2.0, WALL)
    assert UpdateOutcome.STARTED not in outcomes(course.only(3.0 * PATIENCE, WALL))


def test_one_elsewhere_is_trusted_after_time_or_motion() -> None:
    still, moving = Course(), Course()
    for course in still, moving:
        course.watch(2.0)
    gone = still.time
    while UpdateOutcome.STARTED not in outcomes(still.see(WALL)):
        assert still.time < gone + PATIENCE + 1.0
    assert still.time - gone > PATIENCE
    gone = moving.time
    assert UpdateOutcome.STARTED in outcomes(moving.only(2.0, WALL, np.array([0.0, 0.6, 0.0])))


@pytest.mark.parametrize('speed', [0.5, 3.0])
def test_a_restart_that_needs_more_than_its_speed_is_refused(speed: float) -> None:
    course = Course(params=FilterParams(leader_speed_max=speed))
    course.watch(2.0)
    gone = course.time
    course.time += PARAMS.max_gap + 0.5
    reach = speed * (course.time + DT - gone) + RESTART_TOLERANCE
    far = course.estimate.position + np.array([0.0, 1.05 * reach, 0.0])
    assert outcomes(course.only(2.0, far)) == {UpdateOutcome.OUTLIER}


def test_refused_track_takes_over_after_six_with_velocity() -> None:
    course = Course()
    course.watch(2.0)
    fast = VELOCITY + np.array([0.0, 1.5, 0.0])
    taken = course.only(6 * DT, course.leader + np.array([0.0, 0.33, 0.0]), fast)
    assert [each.outcome for each in taken] == [UpdateOutcome.OUTLIER] * 5 + [
        UpdateOutcome.STARTED]
    assert course.tracks.candidates == []
    assert np.linalg.norm(course.estimate.velocity - fast) < 0.4
    assert np.sqrt(course.estimate.covariance[4, 4]) < 0.3


def test_one_that_moves_takes_the_place_of_one_that_never_did() -> None:
    course, wall = Course(np.zeros(3)), WALL
    course.watch(1.0)  # the print was seen first
    flying = np.array([0.3, 0.2, 0.0])
    begin = course.time
    for _ in range(120):
        course.see(START, wall + (course.time - begin) * flying)
    assert near(course.tracks.primary, wall + 4.0 * flying)
    assert near(course.candidate.track, START)


@pytest.mark.parametrize('unseen', [1.2, 2.5])
def test_print_seen_within_reach_yields_to_returning_leader(
        unseen: float) -> None:
    course = Course(np.zeros(3))
    course.watch(2.0)
    course.time += unseen
    course.only(1.0, WALL)  # nothing tells that it is not the leader
    assert near(course.tracks.primary, WALL)
    back = course.watch(0.5, WALL)
    assert UpdateOutcome.STARTED in outcomes(back)
    assert near(course.tracks.primary, START)
    course.watch(2.0, WALL)
    assert near(course.tracks.primary, START)


def test_two_that_move_do_not_change_places() -> None:
    course = Course()
    course.watch(2.0, WALL)
    begin = course.time
    for _ in range(120):
        course.see(course.leader, WALL - (course.time - begin) * np.array([0.0, 0.0, 0.4]))
        assert near(course.tracks.primary, course.leader)


def test_print_seen_in_turns_with_leader_does_not_replace_it() -> None:
    course = Course(np.zeros(3))
    course.watch(2.0)
    for _ in range(30):
        course.see(START + np.array([0.0, 0.34, 0.0]))  # within reach
        course.see(START)
        assert near(course.tracks.primary, START)


def test_a_jump_back_in_time_forgets_all() -> None:
    course = Course()
    course.watch(2.0, WALL)
    course.time = 0.0
    course.see(course.leader)
    assert course.tracks.candidates == []
    assert course.estimate.stamp == DT


def pose_outcomes(marked: bool, speed: float, outlier: Array, at: int) -> list[UpdateOutcome]:
    """Return the outcomes of poses at 10 Hz, of which one is off by ``outlier`` (3,), m."""
    tracks, random = Hypotheses(PARAMS, marked), np.random.default_rng(1)
    noise: Array = np.diag([0.03] * 3 + [0.1] * 3)**2
    found = []
    for k in range(40):
        place = START + random.normal([0.1 * k * speed, 0.0, 0.0], 0.03)
        found.append(tracks.take(
            0.1 * k, Transform(translation=place + outlier if k == at else place), np.zeros(3),
            noise).outcome)
    return found


def test_a_track_that_began_with_an_outlier_begins_anew() -> None:
    begun = pose_outcomes(False, 0.0, np.array([0.0, 1.0, 0.0]), 0)
    assert begun[:4] == [UpdateOutcome.STARTED, *[UpdateOutcome.OUTLIER] * 2,
                         UpdateOutcome.STARTED]
    assert UpdateOutcome.OUTLIER not in begun[4:]
    # A marker may be one on a wall: one that has not moved has to wait.
    marked = pose_outcomes(True, 0.0, np.array([0.0, 1.0, 0.0]), 0)
    assert marked[1:] == [UpdateOutcome.OUTLIER] * 39


@pytest.mark.parametrize('length', [0.3, 1.2, 3.0])
@pytest.mark.parametrize('towards', [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.7, 0.7)])
def test_the_place_of_an_outlier_takes_no_later_pose(
        length: float, towards: tuple[float, float]) -> None:
    outlier = length * np.array([*towards, 0.0])
    found = pose_outcomes(False, 1.2, outlier, 15)
    assert UpdateOutcome.OUTLIER not in found[:15] + found[16:]


def test_the_place_of_a_marker_elsewhere_takes_those_near_it() -> None:
    assert UpdateOutcome.OUTLIER in pose_outcomes(
        True, 1.2, np.array([1.2, 0.0, 0.0]), 15)[16:]
