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

"""Ranges in perception: what is dropped and why, what is learned, and reports out of sight."""

from __future__ import annotations

from dataclasses import dataclass
import math

from marker_images import known
import numpy as np
import pytest

from flock_follower.geometry import quaternion_from_yaw, Transform
from flock_follower.messages.poses import RangeState
from flock_follower.odometry.buffer import OdometryBuffer, OdometrySample
from flock_follower.parameters.neighbors_file import MarkedNeighbor
from flock_follower.perception import range_tracking
from flock_follower.perception.neighbor_filter import FilterParams, NeighborFilter, UpdateOutcome
from flock_follower.perception.range_tracking import Ranged, Ranging, RangingParams, UNSEEN

NOISE = np.diag([0.002, 0.002, 0.002, 0.02, 0.02, 0.02]) ** 2
TAG = np.array([0.0, 0.0, 0.1])
OWN_TAG = (0.05, 0.0, 0.08)


@dataclass
class Rig:
    """Odometry at 100 Hz, sightings at 30 Hz, ranges at 20 Hz, of a leader that chance moves."""

    seed: int = 0
    bias: float = 0.1
    outliers: float = 0.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.odometry, self.filter = OdometryBuffer(), NeighborFilter()
        self.ranging = Ranging([MarkedNeighbor('leader', (), tuple(TAG))],
                               {'leader': self.filter}, self.odometry,
                               RangingParams(OWN_TAG))
        self.time = 0
        self.own, self.leader = np.zeros(3), np.array([2.0, 0.3, 0.2])
        self.velocity = np.zeros(3)
        self.found: list[tuple[float, float, float]] = []  # time, error of distance, its deviation

    def fly(self, seconds: float, seen: bool, acceleration: tuple[float, ...] = (0.0, 0.0, 0.0)
            ) -> None:
        """Go on, in steps of 10 ms."""
        for _ in range(round(100 * seconds)):
            self.time += 1
            t = self.time / 100
            self.velocity = self.velocity + 0.01 * np.array(acceleration)
            self.leader = self.leader + 0.01 * self.velocity
            self.odometry.add(OdometrySample(
                t, self.own, quaternion_from_yaw(0.0), np.zeros(3), np.zeros(3)))
            if seen and self.time % 3 == 0:
                place = self.leader + self.rng.normal(0.0, 0.002, 3)
                self.filter.update(t, Transform(np.eye(3), place), np.zeros(3), NOISE)
            if self.time % 5 == 0:
                self.range(t)

    def range(self, t: float) -> None:
        distance = math.dist(self.leader + TAG, self.own + np.array(OWN_TAG))
        detour = self.rng.uniform(0.0, 1.0) if self.rng.random() < self.outliers else 0.0
        measured = distance + self.bias + self.rng.normal(0.0, 0.1) + detour
        assert self.ranging.take(RangeState(round(t * 1e9), 'leader', measured), t) is None
        for outcome in self.ranging.due():
            assert isinstance(outcome, Ranged)
            found = outcome.estimate
            sight = found.position - self.own
            along = sight / np.linalg.norm(sight)
            self.found.append((t, float(np.linalg.norm(sight) - math.dist(self.leader, self.own)),
                              math.sqrt(along @ found.covariance[:3, :3] @ along)))
            self.last = found


def test_in_sight_the_bias_is_learned_and_nothing_is_reported() -> None:
    rig = Rig(bias=0.25)
    rig.fly(10.0, seen=True)
    assert rig.found == []
    assert rig.ranging.biases['leader'].value == pytest.approx(0.25, abs=0.06)


@pytest.mark.parametrize('seed', range(5))
def test_through_5_s_out_of_sight_the_distance_stays_known(seed: int) -> None:
    rig = Rig(seed, bias=0.15, outliers=0.05)
    rig.fly(10.0, True)
    rig.fly(1.0, True, (0.3, 0.1, 0.0))
    rig.fly(2.0, False, (-0.4, 0.2, 0.0))  # turns back unseen
    rig.fly(3.0, False)
    times, errors, deviations = np.transpose(rig.found)
    assert times[0] == pytest.approx(11.0 + UNSEEN, abs=0.1)
    assert len(errors) > 75  # most of 20 Hz over 4.5 s
    assert np.abs(errors[-1]) < 0.2 and np.abs(errors).max() < 0.3
    assert np.mean((errors / deviations) ** 2) < 4.0


def test_distance_grows_uncertain_only_across_line_of_sight() -> None:
    rig = Rig()
    rig.fly(5.0, True)
    deviations = []
    for _ in range(5):
        rig.fly(1.0, False)
        p = rig.last.covariance[:3, :3]
        sight = rig.last.position - rig.own
        along = sight / np.linalg.norm(sight)
        deviations.append((math.sqrt(along @ p @ along), math.sqrt(np.trace(p))))
    along, whole = np.transpose(deviations)
    assert along.max() < 0.15
    assert np.all(np.diff(whole)[:3] > 0.3)
    assert whole[-1] == pytest.approx(math.sqrt(2.0) * math.dist(rig.leader, rig.own), rel=0.02)
    # It is somewhere on a sphere.
    assert np.linalg.eigvalsh(rig.last.covariance).min() > 0.0


def state(stamp: float, distance: float = 2.0, name: str = 'leader',
          limits: tuple[float, float] = (0.0, 0.0)) -> RangeState:
    return RangeState(round(stamp * 1e9), name, distance, limits)


@pytest.mark.parametrize(('measured', 'stamp', 'reason'), [
    (state(1.0, name='lead'), 1.0, range_tracking.UNKNOWN),
    (state(1.0, math.nan), 1.0, range_tracking.INVALID),
    (state(1.0, math.inf), 1.0, range_tracking.INVALID),
    (state(1.0, -0.1), 1.0, range_tracking.INVALID),
    (state(1.0, -0.1, limits=(-1.0, 50.0)), 1.0, range_tracking.INVALID),
    (state(1.0, 0.2, limits=(0.3, 50.0)), 1.0, range_tracking.INVALID),
    (state(1.0, 51.0, limits=(0.3, 50.0)), 1.0, range_tracking.INVALID),
    (state(1.0, 2.0, limits=(math.nan, 50.0)), 1.0, ''),
    (state(0.4), 0.4, range_tracking.UNTIMELY),
    (state(1.4), 1.4, range_tracking.UNTIMELY),
    (state(0.7), 0.7, range_tracking.UNTIMELY),  # as one before
    (state(1.2), 1.2, ''),
    (state(0.9), 0.9, '')])
def test_what_cannot_be_used_is_dropped_with_its_reason(measured: RangeState, stamp: float,
                                                        reason: str) -> None:
    rig = Rig()
    rig.fly(1.0, True)
    rig.ranging.restart()
    assert rig.ranging.take(state(0.8), 0.8) is None
    rejection = rig.ranging.take(measured, stamp)
    assert ('' if rejection is None else rejection[0]) == reason


def test_a_range_before_odometry_is_dropped() -> None:
    ranges = Ranging(
        [MarkedNeighbor('leader', ())], {'leader': NeighborFilter()}, OdometryBuffer())
    assert known(ranges.take(state(0.0), 0.0))[0] == range_tracking.UNPLACED


def test_a_range_waits_for_its_odometry() -> None:
    rig = Rig()
    rig.fly(1.0, True)
    rig.fly(1.0, False)
    assert rig.ranging.take(state(2.03), 2.03) is None
    assert list(rig.ranging.due()) == []
    for t in (2.02, 2.04):
        rig.odometry.add(OdometrySample(t, rig.own, quaternion_from_yaw(0.0), np.zeros(3),
                                        np.zeros(3)))
    found = list(rig.ranging.due())
    assert [outcome.stamp for outcome in found if isinstance(outcome, Ranged)] == [2_030_000_000]


def test_a_distance_corrects_what_is_along_the_line_only() -> None:
    tracker = NeighborFilter()
    tracker.update(0.0, Transform(np.eye(3), np.array([2.0, 0.0, 0.0])), np.zeros(3), NOISE)
    plain = tracker.continued(2.0)
    assert tracker.update_range(0.5, 2.4, np.zeros(3), 0.01) is UpdateOutcome.USED
    before, after = known(plain.predict(0.5)), known(tracker.newest)
    assert after.position[0] > 2.2
    np.testing.assert_array_equal(after.position[1:], before.position[1:])
    np.testing.assert_array_equal(after.velocity[1:], before.velocity[1:])
    for k in (1, 2, 4, 5):
        assert after.covariance[k, k] == pytest.approx(before.covariance[k, k], rel=0.06)
    assert after.covariance[0, 0] < 0.01
    assert tracker.update_range(0.5, 2.4, np.zeros(3), 0.01) is UpdateOutcome.OLDER
    assert tracker.update_range(9.0, 2.4, np.zeros(3), 0.01) is UpdateOutcome.LOST
    assert NeighborFilter().update_range(0.0, 2.0, np.zeros(3), 0.01) is UpdateOutcome.LOST


def test_antenna_beside_body_counts_if_attitude_is_known() -> None:
    tracker, tag = NeighborFilter(FilterParams()), np.array([-0.5, 0.0, 0.0])
    for k in range(60):
        tracker.update(k / 30, Transform(np.eye(3), np.array([2.0, 0.0, 0.0])), np.zeros(3), NOISE)
    apart = tracker.continued(2.0)
    assert apart.update_range(2.1, 1.5, np.zeros(3), 0.01, tag) is UpdateOutcome.USED
    assert known(apart.newest).position[0] == pytest.approx(2.0, abs=0.01)
