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

"""The planner's loop from the ground to the end of a flight: active only while it is flown."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.geometry import Array, IDENTITY_QUATERNION, quaternion_from_yaw
from flock_follower.messages import OdometryState
from flock_follower.messages.bridge_reading import BridgeState, effective_state, parse, SILENCE_MAX
from flock_follower.messages.bridge_state import ACTIVE, BRIDGE_STATES, INACTIVE, NO_AUTOPILOT
from flock_follower.messages.commands import Command
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import odometry
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.memory import Memory, NONE
from flock_follower.planner.modes import State
from flock_follower.planner.params import PlannerParams
from flock_follower.planner.step import Decision

PARAMS = PlannerParams()
START = 1_700_000_000 * 10**9  # ns
TICK = 100_000_000  # ns


@pytest.mark.parametrize(('text', 'name', 'reason'), [
    ('ACTIVE', 'ACTIVE', ''),
    ('ACTIVE: ', 'ACTIVE', ''),
    ('ACTIVE:flying', 'ACTIVE', 'flying'),
    ('READY: waiting for OFFBOARD', 'READY', 'waiting for OFFBOARD'),
    ('TAKEN_OVER the pilot: switched', 'TAKEN_OVER', 'the pilot: switched'),
    ('NO_AUTOPILOT\n: none\theard\n', 'NO_AUTOPILOT', 'none heard'),
    ('INACTIVE: ' + 'x' * 999, 'INACTIVE', 'x' * 200),
])
def test_a_word_and_its_reason_are_read(text: str, name: str, reason: str) -> None:
    assert parse(text) == BridgeState(name, reason)


@pytest.mark.parametrize('text', [
    '', ' ', ':', ': ACTIVE', 'active', 'Active', 'ACTIVE!', 'ACTIVE_', 'INACTIVE,', 'FLYING: yes',
    'NOT ACTIVE', '\0ACTIVE', 'ÀCTIVE'])
def test_what_it_does_not_know_counts_as_inactive_and_is_shown(text: str) -> None:
    state = parse(text)
    assert state.name == INACTIVE
    assert repr(text) in state.reason


@given(st.text())
def test_any_text_is_read_as_one_of_the_words(text: str) -> None:
    state = parse(text)
    assert state.name in BRIDGE_STATES
    assert len(str(state).splitlines()) == 1
    assert (state.name != ACTIVE) or text.split(':')[0].split()[0] == 'ACTIVE'


@pytest.mark.parametrize(('reported', 'age', 'name'), [
    (None, 0.0, NO_AUTOPILOT), (None, math.inf, NO_AUTOPILOT),
    (BridgeState(ACTIVE), 0.0, ACTIVE), (BridgeState(ACTIVE), SILENCE_MAX, ACTIVE),
    (BridgeState(ACTIVE), 1.001, NO_AUTOPILOT), (BridgeState(ACTIVE), math.inf, NO_AUTOPILOT),
    (BridgeState(ACTIVE), math.nan, NO_AUTOPILOT),
    (BridgeState('READY', 'x'), 0.5, 'READY'), (BridgeState('READY', 'x'), 1.5, NO_AUTOPILOT)])
def test_a_bridge_that_is_silent_is_none(reported: BridgeState | None, age: float,
                                         name: str) -> None:
    assert effective_state(reported, age).name == name


class Flight:
    """A loop that ticks at 10 Hz, with odometry and a leader 2 m ahead at every tick."""

    def __init__(self, require_bridge: bool = True) -> None:
        self.loop = PlannerLoop(require_bridge)
        self.now = START
        self.height, self.yaw = 0.0, 0.0
        self.velocity: Array = np.zeros(3)
        self.silent = math.inf
        # Distance, m, and speed, m/s: no bound of the guard acts.
        self.leader: tuple[float, float] | None = (2.0, 0.2)

    @property
    def held(self) -> float | None:
        """Return the altitude that it holds, m."""
        altitude = self.loop.memory.altitude
        return None if altitude is None else altitude.held

    def bridge(self, text: str) -> None:
        self.loop.take_bridge_state(text, self.silent)
        self.silent = 0.0

    def sense(self) -> None:
        self.loop.take_odometry(OdometryState(
            self.now, 'odom', 'base_link', np.array([0.0, 0.0, self.height]),
            quaternion_from_yaw(self.yaw), self.velocity, np.zeros(3), np.zeros((6, 6)),
            np.zeros((6, 6)), np.eye(3)), self.now)
        if self.leader is not None:
            distance, speed = self.leader
            self.loop.take_neighbor(from_odometry(odometry(
                empty, self.now, 'odom', 'leader', (distance, 0.0, self.height),
                IDENTITY_QUATERNION, (speed, 0.0, 0.0))))

    def tick(self, receives: bool = True) -> tuple[Decision, Command | None]:
        """Pass a tenth of a second, in which the bridge repeats itself, or falls silent."""
        self.now += TICK
        self.silent = 0.0 if receives and math.isfinite(self.silent) else self.silent + 0.1
        self.sense()
        return self.loop.tick(self.now, PARAMS, self.silent)

    def climb(self, height: float, rate: float = 0.5) -> list[Decision]:
        self.velocity = np.array([0.0, 0.0, math.copysign(rate, height - self.height)])
        decisions = []
        while abs(height - self.height) > 1e-9:
            self.height += math.copysign(min(0.1 * rate, abs(height - self.height)),
                                         height - self.height)
            decisions.append(self.tick()[0])
        self.velocity = np.zeros(3)
        return decisions

    def commanded(self) -> Command:
        _, command = self.tick()
        assert command is not None
        return command


def taken_off() -> Flight:
    """Return a flight engaged on the ground, flown to 2.5 m by the pilot."""
    flight = Flight()
    flight.bridge('INACTIVE: offboard not requested')
    flight.tick()
    flight.loop.engage(True)
    decisions = flight.climb(2.5)
    assert {(d.state, d.reason) for d in decisions} == {
        (State.IDLE, 'engaged, waiting for the bridge: INACTIVE: offboard not requested')}
    assert all(d.acceleration is None for d in decisions)
    return flight


def test_nothing_of_an_earlier_flight_survives() -> None:
    """After an interruption it decides as one that was never in the air before."""
    first, fresh = taken_off(), taken_off()
    first.bridge('ACTIVE')
    for _ in range(20):
        first.commanded()
        assert fresh.tick()[1] is None
    for flight in (first, fresh):
        flight.bridge('INACTIVE')
        flight.yaw = 1.0
        flight.tick()
    one, other = first.loop.memory, fresh.loop.memory
    assert repr(one) == repr(other)
    assert repr(one._replace(own=None, neighbors=NONE)) == repr(Memory(now=one.now))
    for flight in (first, fresh):
        flight.bridge('ACTIVE')
    for _ in range(10):
        assert repr(first.commanded()) == repr(fresh.commanded())


@pytest.mark.parametrize('interrupt', ['bridge', 'engage'])
def test_an_interruption_between_two_ticks_counts_too(interrupt: str) -> None:
    flight = taken_off()
    flight.bridge('ACTIVE')
    for _ in range(10):
        whole = flight.commanded()
    flight.height += 0.2
    if interrupt == 'bridge':
        flight.bridge('READY')
        flight.bridge('ACTIVE')
    else:
        flight.loop.engage(False)
        flight.loop.engage(True)
    command = flight.commanded()
    assert flight.held == pytest.approx(2.7, abs=0.01)
    assert command.acceleration[:2] == pytest.approx(0.2 * whole.acceleration[:2], rel=0.01)


def test_repeated_engage_and_active_reports_change_nothing() -> None:
    flight, other = taken_off(), taken_off()
    for each in (flight, other):
        each.bridge('ACTIVE')
        each.commanded()
    for _ in range(10):
        flight.loop.engage(True)
        flight.bridge('ACTIVE: flying')
        assert repr(flight.commanded()) == repr(other.commanded())


@pytest.mark.parametrize('text', ['READY', 'INACTIVE', 'TAKEN_OVER: x', 'NO_AUTOPILOT', 'ACTIV'])
def test_any_other_word_stops_the_commands_at_the_next_tick(text: str) -> None:
    flight = taken_off()
    flight.bridge('ACTIVE')
    flight.commanded()
    flight.bridge(text)
    decision, command = flight.tick()
    assert (decision.state, command) == (State.IDLE, None)
    flight.bridge('ACTIVE')
    if text.startswith('TAKEN_OVER'):
        assert flight.tick()[1] is None
        flight.loop.engage(True)
    flight.commanded()


@pytest.mark.parametrize('early', [False, True], ids=['after', 'before'])
def test_after_a_takeover_it_has_to_be_engaged_once(early: bool) -> None:
    """Before or after the bridge is ACTIVE again; what the bridge repeats disengages nothing."""
    flight = taken_off()
    flight.bridge('ACTIVE')
    flight.commanded()
    flight.bridge('TAKEN_OVER: x')
    flight.tick()
    if early:
        flight.loop.engage(True)
    for text in ('TAKEN_OVER: x', 'TAKEN_OVER: y', 'READY', 'ACTIVE'):
        flight.bridge(text)
        decision, command = flight.tick()
        assert (command is None) == (text != 'ACTIVE' or not early)
        if text.startswith('TAKEN_OVER') and not early:  # the bridge may name the cause later
            assert f'taken over ({text[-1]})' in decision.reason
    flight.loop.engage(True)
    flight.commanded()


def test_after_giving_up_only_engaging_makes_it_command_again() -> None:
    flight = taken_off()
    flight.bridge('ACTIVE')
    flight.commanded()
    flight.loop.memory = flight.loop.memory._replace(given_up=True)
    for text in ('ACTIVE', 'INACTIVE: hold was requested', 'ACTIVE'):
        flight.bridge(text)
        decision, command = flight.tick()
        assert command is None and 'call planner/engage' in decision.reason
    flight.loop.engage(True)
    flight.commanded()


EVENTS = st.one_of(
    st.just('tick'), st.just('silence'), st.booleans(),
    st.sampled_from([*BRIDGE_STATES, 'ACTIVE: x', 'READY: x', '', 'active']).map(
        lambda name: (name,)),
    st.sampled_from([*['ACTIVE'] * 3, 'READY']).map(lambda name: (name,)))


@settings(max_examples=200)
@given(st.lists(EVENTS, max_size=40))
def test_no_command_comes_unless_engaged_and_active_and_fresh(
        events: list[str | bool | tuple[str]]) -> None:
    flight, engaged, name, silent = Flight(), False, '', math.inf
    anew = True
    for event in [*events, 'tick']:
        if isinstance(event, bool):
            flight.loop.engage(event)
            engaged = event
        elif isinstance(event, tuple):
            flight.bridge(*event)
            before, name, silent = name, event[0].split(':')[0], 0.0
            engaged &= name != 'TAKEN_OVER' or before == 'TAKEN_OVER'
        elif event == 'silence':
            flight.silent += 0.7
            silent += 0.7
        else:
            silent += 0.1
            decision, command = flight.tick(receives=False)
            active = engaged and name == 'ACTIVE' and silent <= SILENCE_MAX
            assert (command is not None) == active == (decision.state is not State.IDLE)
            if active and anew:
                assert flight.held == flight.height
            anew = False
        if not (engaged and name == 'ACTIVE' and silent <= SILENCE_MAX):
            anew = True
            flight.height += 0.01
