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

"""Whoever takes the vehicle back gets it: aborts, the pilot, lost links, other vehicles."""

from bridge_flight import BOTH, EAST, Flight
from faulty_autopilot import Fault
from memory_line import MemoryLine
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.gate.permission import Phase
from flock_follower.mavlink.dialects import PX4

pytestmark = pytest.mark.slow
SET_MODE, DISARM = mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_CMD_COMPONENT_ARM_DISARM


def in_offboard_before_a_heartbeat_says_so(personality):
    flight = Flight(personality)
    flight.fly(2.1)
    flight.planner = EAST
    request = flight.bridge.requests.offboard(True, flight.now)
    while flight.mode != flight.modes.offboard:
        assert flight.now < 10.0, f'not {flight.modes.offboard}, but {flight.mode}'
        flight.fly(0.01)
    assert request.outcome is None
    return flight, request


# What no HEARTBEAT has shown yet.


@BOTH
def test_abort_after_offboard_holds_though_heartbeat_shows_hold(personality):
    flight, _ = in_offboard_before_a_heartbeat_says_so(personality)
    assert flight.ask('offboard', False).success
    flight.fly(2.0)
    assert flight.mode == flight.modes.hold and flight.speed < 0.1


@BOTH
def test_pilot_takeover_without_heartbeat_is_not_overruled(personality):
    flight, request = in_offboard_before_a_heartbeat_says_so(personality)
    flight.controller.pilot_switches(flight.modes.loiter)  # the mode it was in before
    flight.fly(5.0)
    assert flight.mode == flight.modes.loiter and not request.outcome.success
    assert flight.bridge.state(flight.now).startswith('INACTIVE: offboard not reached')


# The pilot.


@BOTH
@pytest.mark.parametrize('gap', [0.03, 0.3])
def test_a_switch_away_and_back_is_seen(personality, gap):
    flight = Flight(personality).follow(1.0)
    switched = flight.now
    for mode, seconds in ((flight.modes.loiter, gap), (flight.modes.offboard, 0.1)):
        flight.controller.pilot_switches(mode)
        flight.fly(seconds)
    assert flight.bridge.gate.permission.phase is Phase.TAKEN_OVER
    assert flight.bridge.telemetry.status.mode == flight.modes.offboard
    assert not flight.setpoints(flight.now - 0.05)
    flight.fly(2.0)
    assert 'the pilot took over' in flight.ask('offboard', True).message
    assert not flight.commands(SET_MODE, switched)  # nor is anything asked of the vehicle


def test_switch_away_and_back_arriving_together_is_seen():
    flight = Flight().follow(1.0)
    codec = mavlink.MAVLink(None, 1, 1)
    flight.wire.arrived += [
        mavlink.MAVLink_current_mode_message(0, PX4.modes[mode], PX4.modes[mode]).pack(codec)
        for mode in ('POSCTL', 'OFFBOARD')]
    flight.fly(0.05)
    assert flight.bridge.state(flight.now) == (
        'TAKEN_OVER: offboard was left for POSCTL: the pilot took over')


def test_late_line_gets_no_setpoint_while_nothing_is_received():
    wire = MemoryLine()
    wire.delivers_late = True
    flight = Flight(wire=wire, faults=[Fault('drop', 4.0, 4.0, 'sent')]).follow(4.5)
    assert not flight.setpoints(flight.now - 0.5)
    assert flight.mode != 'OFFBOARD'  # PX4's own failsafe acts


# Refused, lost, late.


@BOTH
@pytest.mark.parametrize(('what', 'arguments', 'command'), [
    ('land', [], SET_MODE), ('offboard', [False], SET_MODE), ('arm', [False], DISARM)])
def test_an_abort_is_sent_though_nothing_is_heard(personality, what, arguments, command):
    flight = Flight(personality, faults=[Fault('drop', 4.0, 30.0, 'sent')])
    flight.follow(6.0 - 3.0)
    since, outcome = flight.now, flight.ask(what, *arguments)
    assert not outcome.success and 'no answer' in outcome.message
    assert len(flight.commands(command, since)) >= 3
    assert not flight.commands(command, since + 0.2)  # a pilot may have switched
    assert what != 'land' or flight.mode == flight.modes.land


# The mode has its own clock.


def mode_lost(at, personality='px4', duration=30.0):
    return [Fault('drop', at, duration, 'sent', message=message)
            for message in ('HEARTBEAT', 'CURRENT_MODE')]


@BOTH
def test_missing_mode_brakes_after_3_s_and_ends_permission(personality):
    flight = Flight(personality, faults=mode_lost(4.0)).follow(1.0)
    flight.fly_until(lambda: flight.bridge.telemetry.mode_age(flight.now) > 2.9, 10.0)
    assert flight.kinds(5) == {'command'} and flight.mode == flight.modes.offboard
    flight.fly(0.3)
    assert flight.reason == 'mode unknown' and flight.kinds(3) == {'brake'}
    assert flight.bridge.state(flight.now) == 'ACTIVE'  # the link is alive
    flight.fly(1.7)
    assert flight.kinds(30) == {'brake'} and flight.speed < 0.1
    flight.fly(0.5)
    assert flight.bridge.state(flight.now).startswith('READY: giving back: mode unknown for 5 s')
    assert flight.bridge.gate.permission.phase is Phase.GIVING_BACK


@BOTH
def test_a_pilot_who_switched_unseen_bars_offboard(personality):
    flight = Flight(personality, faults=mode_lost(4.0, duration=6.0)).follow(2.0)
    flight.controller.pilot_switches(flight.modes.loiter)
    flight.fly(6.5)
    assert flight.bridge.gate.permission.phase is Phase.TAKEN_OVER
    assert not flight.commands(SET_MODE, 4.5) and not flight.setpoints(flight.now - 0.1)
    assert not flight.ask('offboard', True).success


@pytest.mark.parametrize(('message', 'share'), [
    ('', 0.2), ('HEARTBEAT alone', 0.05),
    *(pytest.param(*each, marks=pytest.mark.sweep) for each in (
        ('', 0.05), ('HEARTBEAT', 0.05), ('HEARTBEAT', 0.2), ('HEARTBEAT alone', 0.2)))])
def test_random_loss_is_no_loss_of_the_autopilot(message, share):
    message, _, alone = message.partition(' ')
    loss = [Fault('drop', 0.0, 1e3, 'sent', share, message),
            *([Fault('drop', 0.0, 1e3, 'sent', 1.0, 'CURRENT_MODE')] if alone else [])]
    flight = Flight(faults=loss, seed=5)
    flight.fly(8.0)  # 20 parameters, one by one
    flight.engage()
    flight.planner = 0.0 * EAST
    states, asked = set(), len(flight.bridge.housekeeping.parameters.values)
    for _ in range(24):
        flight.fly(0.5)
        states.add(flight.bridge.state(flight.now))
    assert states == {'ACTIVE'}
    # Without CURRENT_MODE three lost HEARTBEATs in a row brake.
    assert alone or flight.kinds(230) == {'command'}
    assert len(flight.bridge.housekeeping.parameters.values) >= asked > 0


def test_a_short_loss_forgets_no_answer_of_the_autopilot():
    flight = Flight(faults=[Fault('drop', 8.0, 2.0, 'sent')]).follow(5.0)
    bridge, values = flight.bridge, dict(flight.bridge.housekeeping.parameters.values)
    assert flight.fly_until(lambda: not bridge.alive(flight.now), 5.0) < 5.0
    flight.fly_until(lambda: bridge.alive(flight.now), 5.0)
    assert values and bridge.housekeeping.parameters.values == values
    assert 'HOME_POSITION' in bridge.telemetry.newest
    assert flight.ask('offboard', True).success


# Another flight, another vehicle.


def test_rebooted_autopilot_is_asked_again_except_offboard():
    flight = Flight().follow(1.0)
    asked = sum(m.get_type() == 'PARAM_REQUEST_READ' for _, m in flight.received)
    flight.autopilot.reboot(flight.now, 1.0)
    flight.vehicle.position[2] = 2.0
    flight.fly(4.0)
    assert flight.bridge.telemetry.reboots == 1
    assert flight.bridge.telemetry.attitude.time > flight.now - 0.1
    assert sum(m.get_type() == 'PARAM_REQUEST_READ' for _, m in flight.received) > asked
    assert not flight.setpoints(flight.now - 2.0)


@pytest.mark.parametrize(('what', 'why'), [
    ('reboots', 'the autopilot rebooted'), ('peer_changes', 'another vehicle took the place')])
def test_reboot_or_other_vehicle_needs_new_request_to_send(what, why):
    flight = Flight('arducopter').follow(1.0)
    owner = flight.bridge.telemetry if what == 'reboots' else flight.bridge.link
    checked = flight.bridge.housekeeping.parameters
    setattr(owner, what, getattr(owner, what) + 1)
    flight.fly(1.0)
    assert flight.bridge.housekeeping.parameters is not checked  # they are read again
    assert flight.kinds(15) == {'none'} and why in flight.bridge.state(flight.now)
    assert flight.ask('offboard', True).success
    request = flight.bridge.requests.land(flight.now)
    flight.bridge.link.peer_changes += 1
    flight.fly(0.05)
    assert 'another vehicle took the place' in request.outcome.message
