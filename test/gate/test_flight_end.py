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

"""The end of a flight: which causes hand the vehicle over, and when a landing follows."""

import math

from bridge_flight import BOTH, Flight
from faulty_autopilot import Fault
from hypothesis import given
from hypothesis import strategies as st
import pytest

from flock_follower.gate.flight_end import (
    BATTERY_TIME,
    BATTERY_TIMEOUT,
    COMMAND_TIMEOUT,
    CommandSources,
    EndParams,
    FELL_SILENT_AFTER,
    FlightEnd,
    Handover,
    HOLD,
    LAND,
    LANDING_DELAY,
    RETRY_PERIOD,
)
from flock_follower.gate.vehicle_status import VehicleStatus

OURS = VehicleStatus(True, 'OFFBOARD', True)
HELD = VehicleStatus(True, 'AUTO.LOITER', False)
NEVER = -math.inf


def reason(end=None, active_since=10.0, command_time=NEVER, handover='', now=20.0):
    return (end or FlightEnd()).reason(active_since, command_time, handover, now)


@pytest.mark.parametrize(('options', 'at', 'why'), [
    ({}, {'now': 70.0}, ''), ({}, {'now': 70.1}, 'no command within engage_timeout = 60 s'),
    ({'engage_timeout': 5.0}, {'now': 15.1}, 'no command within engage_timeout = 5 s'),
    ({}, {'command_time': 9.9, 'now': 69.0}, ''),  # of the phase before
    ({}, {'command_time': 20.0, 'now': 20.0 + COMMAND_TIMEOUT}, ''),
    ({}, {'command_time': 20.0, 'now': 20.01 + COMMAND_TIMEOUT}, 'no command for 3 s'),
    ({}, {'active_since': math.inf, 'now': 999.0}, '')])
@pytest.mark.parametrize('action', [HOLD, LAND])
def test_engage_timeout_before_first_command_then_3_s(
        options, at, why, action):
    end = FlightEnd(EndParams(leader_lost_action=action, **options))
    assert reason(end, **at)[:2] == (why, action if why else HOLD)
    # What the gate finds goes first and is held.
    assert reason(end, handover='height 0.2 m', **at)[:2] == ('height 0.2 m', HOLD)


def test_a_battery_has_to_be_low_for_a_while_and_known():
    end = FlightEnd(EndParams(battery_action=LAND))
    assert end.battery_unknown(0.0)
    for now in range(10):
        end.take_battery(0.19 if now != 4 else 0.21, float(now))  # a climb ends
    assert not end.battery_low(9.9) and end.battery_low(5.0 + BATTERY_TIME)
    assert reason(end, now=10.0)[:2] == ('battery at 19 %: below battery_low = 20 %', LAND)
    assert not end.battery_unknown(10.0) and end.battery_unknown(10.0 + BATTERY_TIMEOUT)
    end.take_battery(math.nan, 11.0)
    assert end.battery_unknown(11.0) and not end.battery_low(99.0)
    off = FlightEnd(EndParams(battery_low=0.0))
    off.take_battery(0.0, 0.0)
    assert not off.battery_unknown(99.0) and not off.battery_low(99.0)


def step(end, now, flies=True, pending=False, why='', action=HOLD, held='', status=OURS):
    return end.step(flies, pending, Handover(why, action), held, status, now)


def test_hold_is_requested_once_and_again_if_it_failed():
    end, lost = FlightEnd(), 'no command for 3 s'
    assert step(end, 1.0, pending=True, why=lost) == ''  # a request under way goes on
    assert step(end, 1.1, why=lost) == HOLD and end.why == lost
    assert step(end, 1.2, pending=True) == ''
    assert step(end, 1.3) == ''  # it failed: again after a while, though the cause is gone
    assert step(end, 1.2 + RETRY_PERIOD) == HOLD
    assert step(end, 3.3, flies=False, held='AUTO.LOITER', status=HELD) == ''
    end.begin()
    assert end.why == '' and step(end, 3.4) == ''
    assert step(end, 3.5, why=lost) == HOLD  # a new flight waits for no earlier request


def handed_over(status=HELD):
    end = FlightEnd()
    step(end, 1.0, why='lost', action=LAND)
    assert step(end, 2.0, flies=False, held='AUTO.LOITER', status=status) == ''
    return end


def test_a_landing_follows_only_in_the_mode_that_was_requested():
    end = handed_over()
    assert step(end, 1.9 + LANDING_DELAY, False, held='AUTO.LOITER', status=HELD) == ''
    assert step(end, 2.0 + LANDING_DELAY, False, held='AUTO.LOITER', status=HELD) == LAND
    assert step(end, 9.0, False, held='AUTO.LOITER', status=HELD) == ''  # once


@pytest.mark.parametrize('status', [
    HELD._replace(mode='POSCTL'), OURS, HELD._replace(armed=False)])
def test_other_mode_once_or_new_request_cancels_landing(status):
    later, asked = handed_over(), handed_over()
    assert step(later, 2.5, False, held='AUTO.LOITER', status=status) == ''
    asked.begin()
    for end in (later, asked, handed_over(status)):
        assert step(end, 99.0, False, held='AUTO.LOITER', status=HELD) == ''


# Whole flights against the embedded autopilots.


@pytest.mark.slow
@BOTH
def test_dead_planner_leads_to_hold_mode_within_4_s(personality):
    flight = Flight(personality, bridge={'report_to_gcs': True}).follow(2.0)
    flight.planner, killed = None, flight.vehicle.position[2]
    took = flight.fly_until(lambda: flight.mode != flight.modes.offboard, 6.0)
    assert flight.mode == flight.modes.hold and 3.0 < took < 4.0
    assert abs(flight.vehicle.position[2] - killed) < 0.3
    flight.fly(1.0)
    assert flight.bridge.state(flight.now) == 'INACTIVE: given back (no command for 3 s)'
    assert [m.text.rstrip('\0') for _, m in flight.received if m.get_type() == 'STATUSTEXT'] == [
        'flock: hands over: no command for 3 s']


@pytest.mark.slow
def test_no_mode_is_requested_while_autopilot_is_silent():
    # The pilot may have switched: a request for hold would take the vehicle back.
    flight = Flight(faults=[Fault('drop', 5.0, 6.0, 'sent')]).follow(2.5)
    flight.planner = None
    flight.controller.pilot_switches('POSCTL')
    flight.fly(11.5 - flight.now)
    assert flight.mode == 'POSCTL'
    assert flight.bridge.state(flight.now).startswith('TAKEN_OVER')
    assert flight.bridge.handover is None


@pytest.mark.slow
def test_requested_hold_is_not_repeated_without_telemetry():
    flight = Flight(faults=[Fault('drop', 6.8, 5.0, 'sent'), Fault(
        'drop', 6.8, 1.3, 'received', message='COMMAND_LONG')]).follow(1.0)
    flight.planner = None
    flight.fly_until(lambda: flight.bridge.handover is not None, 6.0)
    assert 6.8 < flight.now < 7.8 and flight.mode == 'OFFBOARD'  # the first command is lost
    flight.fly(1.5)
    flight.controller.pilot_switches('POSCTL')
    flight.fly(6.0)
    assert flight.mode == 'POSCTL' and flight.bridge.handover.outcome is not None


@pytest.mark.slow
@pytest.mark.parametrize(('personality', 'action'), [('px4', LAND), ('arducopter', HOLD)])
def test_a_low_battery_ends_the_flight_and_bars_the_next(personality, action):
    flight = Flight(personality, bridge={'end': EndParams(battery_action=action)}, faults=[
        Fault('battery', 3.0, remaining=0.15)]).follow(1.0)
    wanted = flight.modes.hold if action == HOLD else flight.modes.land
    flight.fly_until(lambda: flight.mode == wanted, 20.0)
    assert flight.mode == wanted and 'battery_low' in flight.ask('offboard', True).message


# One node that commands, one that takes its place, and two at once.

PERIOD = 0.1  # s, the planner's
FIRST = st.one_of(st.integers(1, 40), st.integers(1, 10**6))
"""The sequence number of the first command that is received of a publisher."""


def noticed(commands):
    """Return the times at which a second publisher was detected."""
    sources = CommandSources()
    return [time for time, number in sorted(commands) if sources.another(number, time)]


def publisher(first, begin, late, lost=frozenset(), period=PERIOD):
    """Return times, s, and numbers of commands with delays, without the lost ones."""
    return [(begin + k * period + delay, first + k) for k, delay in enumerate(late)
            if k not in lost]


JITTER = st.lists(st.floats(0.0, 0.08), min_size=16, max_size=24)


@given(first=FIRST, late=JITTER, lost=st.sets(st.integers(0, 40), max_size=20))
def test_one_publisher_counts_as_one_whatever_is_lost(first, late, lost):
    assert not noticed(publisher(first, 0.0, late, lost))


@given(lives=st.lists(st.tuples(FIRST, JITTER, st.floats(FELL_SILENT_AFTER, 20.0)), min_size=2,
                      max_size=4))
def test_a_planner_that_starts_again_is_no_second_one(lives):
    commands = []
    for first, late, pause in lives:
        begin = commands[-1][0] + pause + 1e-6 if commands else 0.0
        commands += publisher(first, begin, late)
    assert not noticed(commands)


@given(number=FIRST, own=FIRST, late=JITTER, at=st.floats(0.1, 1.5))
def test_a_single_command_of_a_second_node_is_noticed(number, own, late, at):
    found = noticed([*publisher(own, 0.0, late), (at, number)])
    assert found and at <= found[0] < at + 2 * PERIOD


def test_middleware_without_numbers_reports_no_loss():
    sources = CommandSources()
    assert not any(sources.another(None, 0.01 * k) for k in range(10))
