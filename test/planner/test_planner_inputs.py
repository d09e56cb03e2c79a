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

"""Which odometry and which estimates the planner takes, and what it does without them."""

from __future__ import annotations

import math

from flown import commanded, step
from flown import seen as leader
import numpy as np
from one_step import decide, FREE, own, PARAMS, tracking
import pytest

from flock_follower.planner.inputs import Neighbor, OwnState
from flock_follower.planner.memory import Memory
from flock_follower.planner.modes import odometry_delay, odometry_fault, State
from flock_follower.planner.params import PlannerParams


@pytest.mark.parametrize(('me', 'rejected'), [
    (None, []),
    (own(0.69), ['odometry too old']),
    (own(1.11), ['odometry ahead of the clock']),
    (own(1.0, (math.nan, 0.0, 0.0)), ['odometry not finite']),
    (own(1.0, velocity=(0.0, 60.0, 0.0)), ['odometry too fast']),
    (own(1.0, yaw=math.inf), ['odometry not finite']),
])
def test_without_usable_odometry_there_is_no_command(me: OwnState | None,
                                                     rejected: list[str]) -> None:
    memory, decision = step(Memory(), 1.0, True, me, [leader(1.0)], PARAMS)
    assert (decision.state, decision.acceleration, decision.yaw) == (State.SEARCH, None, None)
    assert decision.reason == 'no odometry'
    assert [r.reason for r in decision.rejected] == rejected
    assert memory.own is None


def test_odometry_stopped_in_flight_stops_commands_with_reason() -> None:
    memory, decision = step(tracking(), 0.15, True, None, [leader(0.15)], PARAMS)
    assert decision.state is State.TRACK
    memory, decision = step(memory, 0.25, True, None, [leader(0.25)], PARAMS)
    assert (decision.state, decision.reason) == (State.HOLD, 'odometry late (0.25 s)')
    assert decision.acceleration is not None  # it brakes while it still knows how fast it is
    memory, decision = step(memory, 0.4, True, None, [leader(0.4)], PARAMS)
    assert (decision.state, decision.acceleration) == (State.HOLD, None)
    assert decision.reason == 'odometry too old (0.40 s)'
    assert odometry_fault(memory.own, 0.2, PARAMS) == ''


def test_odometry_jump_takes_new_altitude_forgets_neighbors() -> None:
    memory, jumped = tracking(), (0.0, 0.0, 2.35)
    memory, decision = step(memory, 0.1, True, own(0.1, jumped), [], PARAMS)
    assert [r.reason for r in decision.rejected] == ['odometry jumped']
    assert memory.leader is None  # its place was in the frame before
    assert commanded(decision)[2] == pytest.approx(0.0)
    assert not memory.neighbors
    assert memory.altitude is not None and memory.altitude.held == 2.35
    late = leader(0.05)  # seen before, in the frame that was
    memory, decision = step(memory, 0.2, True, own(0.2, jumped), [late], PARAMS)
    assert [r.reason for r in decision.rejected] == ['estimate older than the jump of odometry']
    assert not memory.neighbors


def test_braking_in_a_pause_of_odometry_is_no_jump() -> None:
    memory, _ = step(Memory(), 1.0, True, own(1.0, velocity=(1.5, 0.0, 0.0)), [], PARAMS)
    for x, jumps in ((0.375, 0), (0.7, 1)):  # from 1.5 m/s to a stop within 0.5 s; 0.32 m beyond
        after = own(1.5, (x, 0.0, 2.0))
        decision = step(memory, 1.5, True, after, [], PARAMS)[1]
        assert [r.reason for r in decision.rejected] == ['odometry jumped'] * jumps


def test_odometry_that_comes_late_does_not_replace_newer() -> None:
    memory, _ = step(Memory(), 1.0, True, own(1.0), [leader(1.0)], PARAMS)
    memory, _ = step(memory, 1.1, True, own(0.9, velocity=(0.5, 0.0, 0.0)), [], PARAMS)
    assert memory.own is not None
    assert memory.own.stamp == 1.0


@pytest.mark.parametrize(('bad', 'reason', 'detail'), [
    (leader(1.0, (math.nan, 0.0, 0.0)), 'not finite', 'holds NaN or infinity'),
    (leader(math.inf), 'not finite', 'holds NaN or infinity'),
    (leader(1.0, velocity=(math.inf, 0.0, 0.0)), 'not finite', 'holds NaN or infinity'),
    (leader(1.0, velocity=(0.0, 51.0, 0.0)), 'too fast', '51 m/s'),
    (leader(1.0, (0.0, 101.0, 2.0)), 'too far', '101 m'),
    (leader(1.0, (1e308, -1e308, 0.0)), 'too far', '1.41e+308 m'),
    (leader(0.4), 'too old', '0.60 s'),
    (leader(1.2), 'ahead of the clock', 'by 0.20 s'),
    (leader(1.0, position_covariance=np.eye(3)), 'too uncertain', 'variance of its position 3'),
    (leader(1.0, velocity_covariance=np.eye(3)), 'too uncertain', 'variance of its velocity 3'),
    *((leader(1.0, position_covariance=np.array([
        [1e-4, number, 0.0], [number, 1e-4, 0.0], [0.0, 0.0, 1e-4]])), 'too uncertain',
       'invalid covariance of its position') for number in (math.nan, math.inf, 1.0, -1.0)),
    (leader(1.0, velocity_covariance=np.full((3, 3), np.nan)), 'too uncertain',
     'variance of its velocity nan'),
])
def test_bad_estimate_is_refused_with_reason_prediction_goes_on(
        bad: Neighbor, reason: str, detail: str) -> None:
    decision = decide(1.0, bad)
    assert decision.state is State.SEARCH
    assert decision.rejected == ((f'estimate {reason}', f'leader: {detail}'),)
    good, with_bad = (decide(1.0, *estimates, memory=tracking(0.7)) for estimates in ([], [bad]))
    assert with_bad.state is State.TRACK
    assert np.array_equal(commanded(with_bad), commanded(good))


def test_newest_estimate_of_a_name_counts_in_any_order() -> None:
    old, new = leader(0.1, (1.5, 0.0, 2.0)), leader(0.2, (2.5, 0.0, 2.0))
    me = own(0.2, velocity=(0.0, 0.1, 0.0))
    forward, backward, alone = (
        commanded(decide(0.2, *order, me=me)) for order in ((old, new), (new, old), (new,)))
    assert np.array_equal(forward, backward)
    assert np.array_equal(forward, alone)


def test_neighbors_drop_out_one_by_one_as_they_grow_old() -> None:
    near, far = leader(0.0, name='near'), leader(0.3, (0.0, 2.5, 2.0), name='far')
    me = own(0.4, velocity=(0.1, 0.1, 0.0))
    memory, both = step(Memory(), 0.4, True, me, [near, far], FREE)
    later = own(0.7, velocity=(0.1, 0.1, 0.0))
    memory, one = step(memory, 0.7, True, later, [], FREE)
    assert (both.state, both.stamp, one.state, one.stamp) == (State.TRACK, 0.3, State.TRACK, 0.3)
    assert np.array_equal(commanded(one), commanded(decide(0.7, far, me=later, params=FREE)))
    assert not np.allclose(commanded(one), commanded(both))
    assert both.yaw == pytest.approx(0.0, abs=0.1)  # the nearer one
    assert one.yaw == pytest.approx(math.pi / 2, abs=0.1)


def test_a_jump_back_in_time_forgets_the_inputs_of_before() -> None:
    memory, decision = step(tracking(12.0), 0.5, True, own(0.5, (0.0, 0.0, 5.0)), [], PARAMS)
    assert decision.state is State.SEARCH
    assert decision.rejected[0].reason == 'time jumped back'
    assert memory.altitude is not None and memory.altitude.held == 5.0
    for now in (6.0, 11.9, 12.0, 12.1):  # the clock reaches the old estimate's stamp again
        memory, decision = step(memory, now, True, own(now), [], PARAMS)
        assert decision.state is State.SEARCH


def test_leader_suddenly_elsewhere_is_unused_until_old_expires() -> None:
    memory = tracking()
    for tick in range(1, 4):
        memory, _ = step(memory, 0.1 * tick, True, own(0.1 * tick),
                         [leader(0.1 * tick, (2.0 - 0.2 * tick, 0.0, 2.0))], PARAMS)
    far = (5.0, 0.0, 2.0)
    memory, decision = step(memory, 0.4, True, own(0.4), [leader(0.4, far)], PARAMS)
    assert [r.reason for r in decision.rejected] == ['estimate jumped']
    for tick in range(5, 12):  # the old one ages out, the new one is followed
        now = 0.1 * tick
        memory, decision = step(memory, now, True, own(now), [leader(now, far)], PARAMS)
    assert memory.neighbors['leader'].position == pytest.approx(far)


def test_guessed_acceleration_of_hidden_leader_is_not_flown() -> None:
    params, memory = PlannerParams(v_max=2.0), Memory()
    for tick in range(12):  # hovering; its velocity seems to grow, then it is not seen any more
        now = 0.1 * tick
        speed = max(0.0, min(now - 0.4, 0.3))
        seen = [leader(now, (2.5, 0.0, 2.0), (speed, 0.0, 0.0))] if tick <= 7 else []
        memory, decision = step(memory, now, True, own(now), seen, params)
        if now > 0.7 + 0.26:
            assert commanded(decision)[0] < 1.5  # what its velocity alone asks for; else 2.5


FAST, SLOW, TOO_SLOW = (0.03,) * 20, (0.16,) * 20, (0.26,) * 20


@pytest.mark.parametrize(('age', 'ages', 'reason'), [
    (0.15, (), ''), (0.16, (), 'odometry late (0.16 s)'),
    (0.15, FAST, ''), (0.16, FAST, 'odometry late (0.16 s)'),
    (0.19, SLOW, ''), (0.20, SLOW, 'odometry late (0.20 s)'),  # 1.2 times what is usual
    (0.19, (*FAST[1:], 0.16), ''), (0.24, (*FAST[1:], 0.5), ''),  # after one hiccup
    (0.25, (*FAST[1:], 0.5), 'odometry late (0.25 s)'),
    (0.02, TOO_SLOW, 'odometry too slow (0.26 s old when the next message arrives)')])
def test_odometry_is_late_by_age_its_messages_usually_reach(
        age: float, ages: tuple[float, ...], reason: str) -> None:
    assert odometry_delay(own(1.0)._replace(ages=ages), 1.0 + age, PARAMS) == reason
