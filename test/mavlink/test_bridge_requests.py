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

"""Requests by people: what is refused and why, what supersedes what, and what is asked for."""

import math

from bridge_flight import BOTH, Flight, NO_GPS
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.gate.envelope import GateLimits
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder

pytestmark = pytest.mark.slow


def never(message):
    """Return the fault that this message of the autopilot never arrives."""
    return {'faults': [Fault('drop', 0.0, 99.0, 'sent', message=message)]}


def forwarding():
    return {'bridge': {'forwarder': OdometryForwarder(30.0)}}


@pytest.mark.parametrize(('personality', 'waits', 'options', 'changes', 'reason'), [
    ('px4', 0.0, {}, {}, 'no HEARTBEAT from the autopilot'),
    ('px4', 2.0, {'odom_yaw': math.pi / 2}, {}, 'commands would go the wrong way'),
    ('px4', 2.0, never('LOCAL_POSITION_NED'), {'odometry': False},
     'no velocity known: neither odom nor LOCAL_POSITION_NED'),
    ('px4', 5.0, {'source': 'autopilot', 'faults': [Fault('delay', 0.0, 60.0, 'sent', by=0.5)]},
     {'odometry': False}, 'no velocity known'),
    ('px4', 2.0, {}, {'odom_error': np.array([0.0, 1.5, 0.0])}, 'disagree by 1.20 m/s'),
    ('px4', 3.0, {'parameters': {'COM_OF_LOSS_T': 3.0}}, {}, 'COM_OF_LOSS_T = 3 s: '),
    ('arducopter', 3.0, {'parameters': {'GUID_TIMEOUT': 3.0}}, {}, 'GUID_TIMEOUT = 3 s: '),
    ('px4', 3.0, forwarding(), {}, 'EKF2_EV_CTRL = 0: it does not fuse '),
    ('arducopter', 3.0, forwarding(), {}, 'VISO_TYPE = 0: it does not fuse '),
    ('px4', 3.0, never('PARAM_VALUE'), {}, 'could not be read'),
    ('arducopter', 4.0, never('EXTENDED_SYS_STATE'), {}, 'counts as on the ground'),
    ('px4', 2.0, {'start': 'armed'}, {}, 'on the ground: arm, call takeoff'),
    ('px4', 2.0, {'limits': GateLimits(height_max=1.5)}, {}, 'height_max')])
def test_offboard_is_refused_for_what_would_be_dangerous(
        personality, waits, options, changes, reason):
    flight = Flight(personality, **options)
    for name, value in changes.items():
        setattr(flight, name, value)
    flight.fly(waits)
    if waits == 3.0 and 'faults' not in options:  # known before it is asked for
        assert reason in flight.bridge.refusal(flight.now)
    mode, outcome = flight.mode, flight.ask('offboard', True)
    assert not outcome.success and reason in outcome.message
    flight.fly(1.0)
    assert not flight.bridge.gate.permission.streams and flight.kinds(10) == {'none'}
    assert flight.mode == mode and flight.bridge.state(flight.now).startswith('INACTIVE: ')


def test_what_was_waived_is_not_refused():
    flight = Flight(parameters={'COM_OF_LOSS_T': 3.0}, bridge={'require_failsafe': False})
    flight.fly(3.0)
    assert flight.ask('offboard', True).success


@pytest.mark.parametrize(('options', 'waits', 'height', 'reason'), [
    ({'start': 'landed'}, 0.0, 2.5, 'no HEARTBEAT from the autopilot'),
    ({'start': 'landed'}, 1.5, 2.5, 'disarmed: arm first'), ({}, 1.5, 2.5, 'already in the air'),
    (never('EXTENDED_SYS_STATE'), 1.5, 2.5, 'does not report whether it flies'),
    ({'start': 'armed', **never('LOCAL_POSITION_NED')}, 1.5, 2.5,
     'the height reached would be unknown'),
    ({'start': 'armed', 'parameters': {'MIS_TAKEOFF_ALT': 10.0}}, 7.0, 1.0,
     'MIS_TAKEOFF_ALT = 10.0 m: it would climb that high'),
    ({'start': 'armed', **never('PARAM_VALUE')}, 7.0, 1.0, 'MIS_TAKEOFF_ALT = unknown m'),
    ({'start': 'armed'}, 3.0, 20.0, 'above height_max = 10 m')])
def test_impossible_take_off_is_refused_before_request(
        options, waits, height, reason):
    flight = Flight(**options)
    flight.fly(waits)
    outcome = flight.ask('takeoff', height)
    assert not outcome.success and reason in outcome.message
    assert not flight.commands(mavlink.MAV_CMD_NAV_TAKEOFF)


@pytest.mark.parametrize('lands', [False, True])
def test_a_take_off_is_refused_while_it_climbs_out_or_lands(lands):
    """A second climb, as after a lost answer, would go on from the height of now."""
    flight = Flight(start='airborne' if lands else 'armed', faults=[
        Fault('drop', 0.0, direction='sent', message='COMMAND_ACK')])
    flight.fly(2.5)
    flight.ask(*(('land',) if lands else ('takeoff', 8.0)))
    flight.fly(0.5)
    assert flight.bridge.telemetry.landed == (
        mavlink.MAV_LANDED_STATE_LANDING if lands else mavlink.MAV_LANDED_STATE_TAKEOFF)
    assert flight.ask('takeoff', 8.0) == (False, 'takeoff refused: already in the air')


@pytest.mark.parametrize(('abort', 'argument', 'name'), [
    ('offboard', [False], 'hold'), ('arm', [False], 'disarm'), ('land', [], 'land')])
def test_a_request_waits_for_another_and_an_abort_for_nothing(abort, argument, name):
    flight = Flight('arducopter')
    flight.fly(1.5)
    asked = flight.bridge.requests
    first = asked.offboard(True, flight.now)
    assert asked.arm(True, flight.now).outcome == (
        False, 'arm refused: still waiting for offboard')
    second = getattr(asked, abort)(*argument, flight.now)
    assert first.outcome == (False, f'offboard refused: superseded by {name}')
    assert second.outcome is None
    flight.controller.pilot_switches('GUIDED')  # nor does the mode alone let it follow
    flight.planner = np.array([0.6, 0.0, 0.0])
    flight.fly(3.0)
    assert flight.kinds(40) == {'none'}


def test_a_request_ends_with_the_permission_and_its_reason():
    flight = Flight()
    flight.fly(1.5)
    request = flight.bridge.requests.offboard(True, flight.now)
    flight.fly(0.5)
    flight.autopilot.reboot(flight.now, 0.2)
    flight.fly(0.5)
    assert request.outcome == (False, 'offboard refused: disarmed')


@BOTH
@pytest.mark.parametrize(('abort', 'arguments'), [('land', []), ('offboard', [False])])
@pytest.mark.parametrize('kind', ['drop', 'delay'])
def test_pilot_who_switches_after_a_request_keeps_the_mode(personality, abort, arguments, kind):
    """Nothing that the autopilot sends arrives, or all of it arrives together, too late."""
    flight = Flight(personality).follow(1.0)
    begun = flight.now
    silent = [Fault(kind, begun + at, 0.05, 'sent', by=2.5 - at) for at in np.arange(0, 2.5, 0.05)]
    flight.autopilot._sent._faults += silent
    getattr(flight.bridge.requests, abort)(*arguments, flight.now)
    flight.fly(0.5)
    flight.controller.pilot_switches(flight.modes.manual)
    flight.fly(5.0)
    assert flight.mode == flight.modes.manual


@pytest.mark.parametrize(('options', 'reported'), [
    ({'personality': 'arducopter', 'arming_denial': 'Compass not calibrated'},
     'failed: Arm: Compass not calibrated'),
    # GPS is off, and no vision comes.
    ({'parameters': NO_GPS['px4']}, 'its estimator lacks VELOCITY_HORIZ, POS_HORIZ_REL')])
def test_a_refusal_carries_the_words_of_the_autopilot(options, reported):
    flight = Flight(start='landed', **options)
    flight.fly(1.5)
    outcome = flight.ask('arm', True)
    assert outcome.message.startswith('arm refused: ') and reported in outcome.message


def test_a_disarmed_autopilot_is_asked_what_keeps_it_from_arming():
    flight = Flight('arducopter', start='landed', arming_denial='the safety button')
    bridge = flight.bridge
    flight.fly(2.0)
    assert bridge.unready(flight.now) is None
    flight.fly(3.0)
    assert bridge.unready(flight.now) == 'the safety button'


def test_arming_after_take_off_ended_by_landing_does_not_climb():
    """PX4 is in AUTO.TAKEOFF again, and takes off as soon as it is armed."""
    flight = Flight(start='landed')
    flight.fly(2.0)
    assert flight.ask('arm', True).success
    flight.bridge.requests.takeoff(2.5, flight.now)
    flight.fly_until(lambda: flight.vehicle.position[2] > 0.8, 10.0)
    assert flight.ask('land').success
    flight.fly_until(lambda: not flight.controller.armed, 30.0)
    flight.fly(1.5)  # until a HEARTBEAT shows it
    assert flight.mode == 'AUTO.TAKEOFF' and flight.ask('arm', True).success
    flight.fly(4.0)
    assert flight.mode == 'AUTO.LOITER' and flight.vehicle.position[2] < 0.1


@pytest.mark.parametrize(('system', 'component', 'estimated'), [
    (255, 190, False), (1, 190, False), (0, 0, True), (1, 191, True)])
def test_only_answers_to_us_are_believed(system, component, estimated):
    flight = Flight(faults=[Fault('drop', 1.6, 9.0, 'received', message='COMMAND_LONG')])
    flight.fly(2.0)
    request = flight.bridge.requests.offboard(True, flight.now)
    flight.fly(1.7)  # PX4 wants a stream first
    flight.wire.arrived.append(mavlink.MAVLink_command_ack_message(
        mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_RESULT_DENIED, target_system=system,
        target_component=component).pack(mavlink.MAVLink(None, 1, 1)))
    flight.fly(1.0)
    assert (request.outcome is not None and 'denied' in request.outcome.message) == estimated
