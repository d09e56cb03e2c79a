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

from bridge_flight import Flight
from faulty_autopilot import Fault
import numpy as np
import pytest

from flock_follower.mavlink.dialects import VehicleStatus
from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.flight_end import (
    BATTERY_TIME,
    BATTERY_TIMEOUT,
    COMMAND_TIMEOUT,
    EndParams,
    FlightEnd,
    HOLD,
    LAND,
    LANDING_DELAY,
    RETRY_PERIOD,
)

OURS = VehicleStatus(True, 'OFFBOARD', 'active', True)
HELD = VehicleStatus(True, 'AUTO.LOITER', 'active', False)
NEVER = -math.inf


def reason(end=None, active_since=10.0, command_time=NEVER, handover='', now=20.0):
    return (end or FlightEnd()).reason(active_since, command_time, handover, now)


def test_before_the_first_command_the_engage_timeout_counts_and_after_it_three_seconds():
    assert reason(now=70.0) == ('', HOLD)
    assert reason(now=70.1) == ('no command within engage_timeout = 60 s', HOLD)
    assert reason(command_time=9.9, now=69.0) == ('', HOLD)  # of the phase before
    assert reason(command_time=20.0, now=20.0 + COMMAND_TIMEOUT) == ('', HOLD)
    assert reason(command_time=20.0, now=20.01 + COMMAND_TIMEOUT) == ('no command for 3 s', HOLD)
    assert reason(active_since=math.inf, now=999.0) == ('', HOLD)
    lands = FlightEnd(EndParams(leader_lost_action=LAND, engage_timeout=5.0))
    assert reason(lands, now=15.1) == ('no command within engage_timeout = 5 s', LAND)


def test_what_the_gate_finds_goes_first_and_is_held():
    lands = FlightEnd(EndParams(leader_lost_action=LAND))
    assert reason(lands, handover='height 0.2 m', now=99.0) == ('height 0.2 m', HOLD)


def test_a_battery_has_to_be_low_for_a_while_and_known():
    end = FlightEnd(EndParams(battery_action=LAND))
    assert end.battery_unknown(0.0)
    for now in range(10):
        end.take_battery(0.19 if now != 4 else 0.21, float(now))  # a climb ends
    assert not end.battery_low(9.9) and end.battery_low(5.0 + BATTERY_TIME)
    assert reason(end, now=10.0) == ('battery at 19 %: below battery_low = 20 %', LAND)
    assert not end.battery_unknown(10.0) and end.battery_unknown(10.0 + BATTERY_TIMEOUT)
    end.take_battery(math.nan, 11.0)
    assert end.battery_unknown(11.0) and not end.battery_low(99.0)
    off = FlightEnd(EndParams(battery_low=0.0))
    off.take_battery(0.0, 0.0)
    assert not off.battery_unknown(99.0) and not off.battery_low(99.0)


def step(end, now, flies=True, pending=False, why='', action=HOLD, held='', status=OURS):
    return end.step(flies, pending, why, action, held, status, now)


def test_hold_is_requested_once_and_again_if_it_failed():
    end = FlightEnd()
    assert step(end, 1.0) is None
    assert step(end, 1.1, why='no command for 3 s') == (HOLD, 'no command for 3 s')
    assert step(end, 1.2, pending=True) is None
    assert step(end, 1.3) is None  # it failed: again after a while, though the cause is gone
    assert step(end, 1.2 + RETRY_PERIOD) == (HOLD, 'no command for 3 s')
    assert step(end, 5.0, flies=False, held='AUTO.LOITER', status=HELD) is None
    end.begin()
    assert end.why == '' and step(end, 99.0) is None


def test_a_request_to_hold_or_land_under_way_is_not_superseded():
    assert step(FlightEnd(), 1.0, pending=True, why='no command for 3 s') is None


def handed_over(status=HELD):
    end = FlightEnd()
    step(end, 1.0, why='lost', action=LAND)
    assert step(end, 2.0, flies=False, held='AUTO.LOITER', status=status) is None
    return end


def test_a_landing_follows_only_in_the_mode_that_was_requested():
    end = handed_over()
    assert step(end, 1.9 + LANDING_DELAY, False, held='AUTO.LOITER', status=HELD) is None
    assert step(end, 2.0 + LANDING_DELAY, False, held='AUTO.LOITER', status=HELD) == (LAND, 'lost')
    assert step(end, 9.0, False, held='AUTO.LOITER', status=HELD) is None  # once


@pytest.mark.parametrize('status', [
    HELD._replace(mode='POSCTL'), OURS, HELD._replace(armed=False)])
def test_any_other_mode_once_cancels_the_landing(status):
    end = handed_over()
    assert step(end, 2.5, False, held='AUTO.LOITER', status=status) is None
    assert step(end, 99.0, False, held='AUTO.LOITER', status=HELD) is None
    end = handed_over(status)  # at once
    assert step(end, 99.0, False, held='AUTO.LOITER', status=HELD) is None
    end = handed_over()
    end.begin()  # somebody has requested something
    assert step(end, 99.0, False, held='AUTO.LOITER', status=HELD) is None


@pytest.mark.parametrize(('name', 'value', 'valid'), [
    ('battery_low', 1.1, r'a number in \[0, 1\]'), ('engage_timeout', 0.5, r'\[1, 3600\] s'),
    ('battery_action', 'rtl', 'one of hold, land'), ('leader_lost_action', '', 'one of hold')])
def test_a_wrong_parameter_is_named_with_its_value_and_range(name, value, valid):
    with pytest.raises(ValueError, match=f'{name} = .*{valid}'):
        EndParams(**{name: value})


# Whole flights against both embedded autopilots.

BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])
OFFBOARD = {'px4': 'OFFBOARD', 'arducopter': 'GUIDED'}
HOLD_MODE = {'px4': 'AUTO.LOITER', 'arducopter': 'BRAKE'}
LAND_MODE = {'px4': 'AUTO.LAND', 'arducopter': 'LAND'}
MANUAL = {'px4': 'POSCTL', 'arducopter': 'STABILIZE'}
EAST = np.array([0.3, 0.0, 0.0])


def flown(personality, seconds=3.0, **options):
    """Return a flight that has followed commands for a while."""
    flight = Flight(personality, **options)
    flight.engage()
    flight.planner = EAST
    flight.fly(seconds)
    return flight


def until(flight, condition, seconds):
    """Fly until a condition holds; return how long that took, s."""
    begun = flight.now
    while not condition() and flight.now < begun + seconds:
        flight.fly(0.05)
    return flight.now - begun


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize('thrust_error', [0.0, -1.0, 1.0])
def test_a_planner_that_dies_is_followed_by_hold_mode_within_four_seconds(personality,
                                                                          thrust_error):
    flight = flown(personality)
    flight.controller.wind = np.zeros(3)
    height = flight.vehicle.position[2]
    control, pushed = flight.vehicle.step, np.array([0.0, 0.0, thrust_error])

    def step(acceleration, *arguments, **changes):  # the hover thrust is wrong
        offboard = flight.controller.mode == OFFBOARD[personality]
        control(acceleration + pushed * offboard, *arguments, **changes)
    flight.vehicle.step = step
    gate = flight.bridge.gate

    def follow():  # a planner that closes the height
        gate_height, climb = gate.heights.height(flight.now), flight.vehicle.velocity[2]
        return np.array([0.2, 0.0, 2.25 * (height - gate_height) - 3.0 * climb - thrust_error])
    for _ in range(100):
        flight.planner = follow()
        flight.fly(0.1)
    flight.planner, killed = None, flight.vehicle.position[2]
    took = until(flight, lambda: flight.controller.mode != OFFBOARD[personality], 6.0)
    assert flight.controller.mode == HOLD_MODE[personality] and 3.0 < took < 4.0
    assert abs(flight.vehicle.position[2] - killed) < 0.3
    flight.fly(2.0)
    assert flight.bridge.state(flight.now) == 'INACTIVE: given back (no command for 3 s)'


@pytest.mark.slow
@BOTH
def test_without_a_first_command_the_engage_timeout_ends_the_flight(personality):
    flight = Flight(personality, bridge={'end': EndParams(engage_timeout=5.0)})
    flight.engage()
    took = until(flight, lambda: flight.controller.mode != OFFBOARD[personality], 9.0)
    assert 4.0 < took < 6.5 and flight.controller.mode == HOLD_MODE[personality]


@pytest.mark.slow
@BOTH
def test_no_mode_is_requested_while_the_autopilot_is_not_received(personality):
    # The pilot may have switched: a request for hold would take the vehicle back.
    flight = Flight(personality, faults=[Fault('drop', 6.0, 8.0, 'sent')])
    flight.engage()
    flight.planner = EAST
    while flight.now < 6.5:
        flight.fly(0.1)
    flight.planner = None
    flight.controller.pilot_switches(MANUAL[personality])
    while flight.now < 13.9:
        flight.fly(0.1)
        assert flight.controller.mode == MANUAL[personality]
    flight.fly(2.0)
    assert flight.controller.mode == MANUAL[personality]
    assert flight.bridge.state(flight.now).startswith('TAKEN_OVER')


@BOTH
def test_a_hold_that_the_bridge_requested_is_not_repeated_once_nothing_is_received(personality):
    flight = flown(personality, 1.0)
    flight.planner = None
    carry, arriving = flight.wire.write, flight.wire.read
    # The first COMMAND_LONG is lost.
    flight.wire.write = lambda data: data[7:10] == b'\x4c\x00\x00' or carry(data)
    until(flight, lambda: flight.bridge.handover is not None, 6.0)
    flight.wire.read = lambda: iter(list(arriving())[:0])  # lost
    until(flight, lambda: not flight.bridge.alive(flight.now), 4.0)
    flight.wire.write = carry
    flight.controller.pilot_switches(MANUAL[personality])
    flight.fly(4.0)
    assert flight.controller.mode == MANUAL[personality]
    flight.wire.read = arriving
    flight.fly(3.0)
    assert flight.controller.mode == MANUAL[personality]
    assert flight.bridge.handover.outcome is not None


@BOTH
def test_a_landing_follows_if_it_was_asked_for_and_nobody_interferes(personality):
    end = EndParams(leader_lost_action=LAND)
    flight = flown(personality, bridge={'end': end})
    flight.planner = None
    until(flight, lambda: flight.controller.mode == LAND_MODE[personality], 12.0)
    assert flight.controller.mode == LAND_MODE[personality]
    flight = flown(personality, bridge={'end': end})
    flight.planner = None
    until(flight, lambda: flight.controller.mode == HOLD_MODE[personality], 6.0)
    flight.fly(0.5)
    flight.controller.pilot_switches(MANUAL[personality])
    flight.fly(1.5)
    flight.controller.pilot_switches(HOLD_MODE[personality])
    flight.fly(10.0)
    assert flight.controller.mode == HOLD_MODE[personality]


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize(('action', 'modes'), [(HOLD, HOLD_MODE), (LAND, LAND_MODE)])
def test_a_low_battery_ends_the_flight_and_bars_the_next(personality, action, modes):
    flight = flown(personality, bridge={'end': EndParams(battery_action=action)}, faults=[
        Fault('battery', 3.0, remaining=0.15)])
    until(flight, lambda: flight.controller.mode == modes[personality], 20.0)
    assert flight.controller.mode == modes[personality]
    if action == HOLD:
        assert 'battery_low' in flight.ask('offboard', True).message


@pytest.mark.slow
@BOTH
def test_a_barometer_that_jumps_or_falls_silent_brakes(personality):
    flight = flown(personality, faults=[Fault('barometer', 8.0, duration=2.0, offset=2.0)])
    reasons = set()
    while flight.now < 12.0:
        flight.fly(0.05)
        reasons.add(flight.cycles[-1].setpoint.reason)
    assert 'height jumped' in reasons and flight.bridge.gate.heights.steps == 2
    assert flight.controller.mode == OFFBOARD[personality]
    assert flight.vehicle.position[2] == pytest.approx(2.0, abs=0.3)
    flight = flown(personality, faults=[
        Fault('drop', 8.0, 99.0, 'sent', message='SCALED_PRESSURE')])
    until(flight, lambda: flight.cycles[-1].setpoint.reason == 'height stale', 8.0)
    assert flight.cycles[-1].setpoint.reason == 'height stale'
    until(flight, lambda: flight.controller.mode == HOLD_MODE[personality], 4.0)
    assert flight.controller.mode == HOLD_MODE[personality]


@pytest.mark.slow
@BOTH
def test_a_commander_that_pushes_down_or_up_stays_within_the_heights(personality):
    for push, low, high in ((-2.5, 0.2, 2.2), (2.5, 1.8, 4.3)):
        flight = flown(personality, limits=GateLimits(height_max=4.0))
        flight.planner = np.array([0.0, 0.0, push])
        heights = []
        for _ in range(200):
            flight.fly(0.1)
            heights.append(flight.vehicle.position[2])
        assert low < min(heights) and max(heights) < high
