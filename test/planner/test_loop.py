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

"""The planner's loop: stamps, clocks and frames; its activation is in test_activation."""

from __future__ import annotations

import numpy as np
import pytest

from flock_follower.geometry import IDENTITY_QUATERNION, quaternion_from_yaw
from flock_follower.messages import OdometryState
from flock_follower.messages.commands import Command
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.step import Decision

PARAMS = PlannerParams()
START = 1_700_000_000 * 10**9  # ns
MS = 10**6  # ns
TICK = 100 * MS
HOUR = 3600 * 10**9  # ns
SURE = np.eye(6) * 1e-4


def own(stamp: int, frame: str = 'odom') -> OdometryState:
    return OdometryState(stamp, frame, 'base_link', np.array([0.0, 0.0, 2.0]),
                         quaternion_from_yaw(0.3), np.zeros(3), np.zeros(3), SURE,
                         SURE, np.eye(3))


def leader(stamp: int, frame: str = 'odom', covariance: np.ndarray = SURE) -> OdometryState:
    return OdometryState(stamp, frame, 'leader', np.array([2.5, 0.0, 2.0]), IDENTITY_QUATERNION,
                         np.zeros(3), np.zeros(3), covariance, SURE, np.eye(3))


def engaged() -> PlannerLoop:
    loop = PlannerLoop(require_bridge=False)
    loop.engage(True)
    return loop


def fly(loop: PlannerLoop, now: int, seen: int | None = None) -> tuple[Decision, Command]:
    """Tick at a time, ns, with odometry of 10 ms before and, if any, a leader seen at another."""
    loop.take_odometry(own(now - 10 * MS), now)
    if seen is not None:
        loop.take_neighbor(leader(seen))
    decision, command = loop.tick(now, PARAMS)
    assert command is not None
    return decision, command


@pytest.mark.parametrize('start', [START, TICK], ids=['wall time', 'simulated time'])
@pytest.mark.parametrize('age', [0, 1, 40 * MS, 70 * MS + 1])
def test_command_bears_stamp_of_its_image_to_the_nanosecond(
        age: int, start: int) -> None:
    loop = engaged()
    for now in (start, start + TICK, start + TICK + 1, start + HOUR, start + HOUR + TICK):
        if now == start + HOUR:  # no neighbor for so long that it follows again only on request
            loop.engage(False)
            loop.engage(True)
        command = fly(loop, now, seen=now - age)[1]
        assert (command.stamp, command.ahead) == (now - age, age)
        assert command.ages(now + 20 * MS) == pytest.approx((0.02, 0.02 + age * 1e-9), abs=1e-9)


def test_a_command_is_never_stamped_ahead_of_its_tick() -> None:
    # By another clock than one's own: so it would look fresh for longer than it is.
    command = fly(engaged(), START, seen=START + 50 * MS)[1]
    assert (command.stamp, command.ahead) == (START, 0)


@pytest.mark.parametrize('other', ['earth', 'world', ''])
@pytest.mark.parametrize('frame', ['odom', 'map'])
def test_neighbors_count_only_in_the_frame_of_the_odometry(frame: str, other: str) -> None:
    loop = engaged()
    loop.take_neighbor(leader(START, other))  # with no odometry there is no frame to compare
    loop.take_odometry(own(START, frame), START)
    with pytest.raises(ValueError, match=f"^leader is in frame '{other}': must .* '{frame}'$"):
        loop.take_neighbor(leader(START, other))
    assert loop.tick(START, PARAMS)[0].state is State.SEARCH
    loop.take_odometry(own(START + TICK, frame), START + TICK)
    # As a message brings it: another string object of the same letters.
    loop.take_neighbor(leader(START + TICK, ''.join(list(frame))))
    decision, command = loop.tick(START + TICK, PARAMS)
    assert decision.state is State.TRACK
    assert command is not None and command.frame == frame


def test_what_came_is_handed_on_once() -> None:
    loop = engaged()
    fly(loop, START)
    loop.take_odometry(own(START - HOUR), START)
    loop.take_neighbor(leader(START - HOUR))
    rejected = loop.tick(START + TICK, PARAMS)[0].rejected
    assert [why.reason for why in rejected] == ['odometry too old', 'estimate too old']
    assert loop.tick(START + TICK + 1, PARAMS)[0].rejected == ()


@pytest.mark.parametrize(('axis', 'state'), [
    (0, State.SEARCH), (2, State.SEARCH), (3, State.TRACK), (5, State.TRACK)])
def test_uncertain_place_is_not_followed_uncertain_attitude_is(
        axis: int, state: State) -> None:
    loop, covariance = engaged(), SURE.copy()
    covariance[axis, axis] = 100.0
    loop.take_odometry(own(START), START)
    loop.take_neighbor(leader(START, covariance=covariance))
    assert loop.tick(START, PARAMS)[0].state is state
    if state is State.TRACK:
        np.testing.assert_array_equal(
            loop.memory.neighbors['leader'].position_covariance, SURE[:3, :3])


@pytest.mark.parametrize(('std', 'known'), [(0.49, True), (0.51, False), (np.nan, False)])
def test_the_yaw_of_a_neighbor_is_known_up_to_a_deviation(std: float, known: bool) -> None:
    loop, covariance = engaged(), SURE.copy()
    covariance[5, 5] = std**2
    loop.take_odometry(own(START), START)
    loop.take_neighbor(leader(START, covariance=covariance))
    loop.tick(START, PARAMS)
    assert (loop.memory.neighbors['leader'].yaw is not None) == known


def test_only_seen_neighbor_has_acceleration_faced_one_distance() -> None:
    loop = engaged()
    assert loop.distance() is None
    accelerates = leader(START)._replace(acceleration=np.array([0.3, 0.0, 0.0]))
    reported = accelerates._replace(child='peer', position=np.array([0.0, 1.6, 2.0]))
    loop.take_odometry(own(START), START)
    loop.take_neighbor(accelerates)
    loop.take_neighbor(reported, received=True)
    loop.tick(START, PARAMS)
    known = loop.memory.neighbors
    np.testing.assert_array_equal(known['leader'].acceleration, accelerates.acceleration)
    assert known['peer'].acceleration is None or not np.any(known['peer'].acceleration)
    assert loop.memory.faced == 'leader'
    assert loop.distance() == ('leader', pytest.approx(2.5, abs=0.01))  # though the peer is nearer


def watched(loop: PlannerLoop, now: int) -> Decision:
    return fly(loop, now, seen=now)[0]


def test_a_frozen_camera_is_braked_on_as_if_there_were_none() -> None:
    loop = engaged()
    for tick in range(5):
        now = START + tick * TICK
        assert loop.take_frame(now, now - 30 * MS)
        assert watched(loop, now).state is State.TRACK
    assert not loop.take_frame(now + 1, now - 30 * MS)
    late = now + round(PARAMS.perception_timeout * 1e9)
    assert not loop.take_frame(late, now - 30 * MS)
    assert watched(loop, late - MS).state is State.TRACK
    decision = watched(loop, late)
    assert decision.state is State.HOLD and decision.reason.startswith('no image processed for')
    # Another image is one whether its stamp is later or, after a clock's jump, earlier.
    assert loop.take_frame(late, now - TICK)
    assert watched(loop, late + 1).state is State.TRACK


def test_images_that_stop_after_clock_jump_are_missed_in_time() -> None:
    loop = engaged()
    loop.take_frame(START + HOUR, START + HOUR)
    assert watched(loop, START + HOUR).state is State.TRACK
    assert watched(loop, START).state is State.TRACK
    late = START + round(PARAMS.perception_timeout * 1e9)
    assert watched(loop, late - MS).state is State.TRACK
    assert watched(loop, late).state is State.HOLD


def test_repeated_odometry_shows_no_rhythm_jump_back_ends_it() -> None:
    loop, second = engaged(), 10**9
    arrived = [(1, 0), (1, 1), (1, 2), (2, 4), (2, 5), (3, 5), (0, 6)]  # stamp and arrival, s
    for (stamp, arrival), ages in zip(arrived, ([], [], [], [3], [3], [3, 3], [])):
        loop.take_odometry(own(stamp * second), arrival * second)
        assert list(loop._ages) == ages


def test_odometry_at_10_hz_is_not_late_between_its_messages() -> None:
    loop = engaged()
    for stamp in range(START, START + 10 * TICK, TICK):
        loop.take_odometry(own(stamp), stamp + 60 * MS)
        loop.take_neighbor(leader(stamp))
        decision = loop.tick(stamp + 155 * MS, PARAMS)[0]
        assert stamp == START or decision.state is State.TRACK


def test_height_at_arming_is_unknown_after_odometry_jump() -> None:
    loop = engaged()
    loop.ground = 0.4
    for now, height, ground in ((START, 2.0, 0.4), (START + TICK, 3.0, None)):
        loop.take_odometry(own(now)._replace(position=np.array([0.0, 0.0, height])), now)
        loop.tick(now, PARAMS)
        assert loop.ground == ground
    loop.ground = 3.4
    fly(loop, START - HOUR)  # the simulation began again
    assert loop.ground is None
