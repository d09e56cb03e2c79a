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

"""Whoever takes the vehicle back gets it: aborts, the pilot, answers late or not to us."""

from bridge_flight import Flight, Wire
from faulty_autopilot import Fault, FaultyAutopilot
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

pytestmark = pytest.mark.slow
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])
OFFBOARD = {'px4': 'OFFBOARD', 'arducopter': 'GUIDED'}
HOLD = {'px4': 'AUTO.LOITER', 'arducopter': 'BRAKE'}
LOITER = {'px4': 'AUTO.LOITER', 'arducopter': 'LOITER'}
LAND = {'px4': 'AUTO.LAND', 'arducopter': 'LAND'}
EAST = np.array([0.6, 0.0, 0.0])


def commands(flight, command, since=0.0):
    return [m for t, m in flight.received
            if m.get_type() == 'COMMAND_LONG' and m.command == command and t >= since]


def kinds(flight, cycles=40):
    return {c.setpoint.kind for c in flight.cycles[-cycles:]}


def in_offboard_before_a_heartbeat_says_so(personality):
    flight = Flight(personality)
    flight.fly(2.1)
    flight.planner = EAST
    request = flight.bridge.requests.offboard(True, flight.now)
    while flight.controller.mode != OFFBOARD[personality]:
        flight.fly(0.01)
    assert request.outcome is None
    return flight, request


@BOTH
def test_disarming_right_after_arming_disarms_though_heartbeat_shows_neither(personality):
    flight = Flight(personality, start='landed')
    flight.fly(2.1)
    flight.bridge.requests.arm(True, flight.now)
    flight.fly(0.06)
    assert flight.controller.armed and not flight.bridge.telemetry.status.armed
    assert flight.ask('arm', False).success
    flight.fly(3.0)
    assert not flight.controller.armed


@BOTH
def test_an_abort_right_after_offboard_holds_though_heartbeat_shows_hold_still(personality):
    flight, _ = in_offboard_before_a_heartbeat_says_so(personality)
    assert flight.ask('offboard', False).success
    flight.fly(4.0)
    assert flight.controller.mode == HOLD[personality]
    assert np.linalg.norm(flight.vehicle.velocity) < 0.1


@BOTH
def test_who_flies_by_hand_is_left_alone_by_offboard_false(personality):
    flight = Flight(personality)
    flight.fly(2.1)
    manual = {'px4': 'POSCTL', 'arducopter': 'ALT_HOLD'}[personality]
    flight.controller.pilot_switches(manual)
    assert flight.ask('offboard', False).success
    assert flight.controller.mode == manual
    assert not commands(flight, mavlink.MAV_CMD_DO_SET_MODE)


@pytest.mark.parametrize('manual', ['POSCTL', 'ALTCTL'])
def test_the_pilots_hold_ends_an_offboard_request_on_px4(manual):
    flight = Flight()
    flight.engage()
    flight.controller.pilot_switches(manual)
    flight.fly(11.5)
    request = flight.bridge.requests.offboard(True, flight.now)
    flight.fly(0.5)  # the stream has to run for longer before the mode is asked for
    flight.controller.pilot_switches('AUTO.LOITER')
    flight.fly(4.0)
    assert request.outcome.message == (
        'offboard refused: the mode was changed to AUTO.LOITER meanwhile')
    assert flight.controller.mode == 'AUTO.LOITER'


@BOTH
@pytest.mark.parametrize('what', ['land', 'offboard'])
def test_where_hold_or_land_is_refused_it_brakes_and_obeys_no_command(personality, what):
    flight = Flight(personality, announce_as_gcs=True, faults=[
        Fault('refuse', 5.0, command='DO_SET_MODE', reason='no position')])
    flight.engage()
    flight.planner = EAST
    flight.fly(5.0)
    assert flight.vehicle.velocity[0] > 0.3
    outcome = flight.ask(what, *([False] if what == 'offboard' else []))
    assert not outcome.success and 'no position' in outcome.message
    flight.fly(3.0)
    assert kinds(flight) == {'brake'}
    assert np.linalg.norm(flight.vehicle.velocity) < 0.1


@BOTH
def test_a_pilot_who_takes_back_what_no_heartbeat_has_shown_is_not_overruled(personality):
    flight, request = in_offboard_before_a_heartbeat_says_so(personality)
    flight.controller.pilot_switches(LOITER[personality])  # the mode it was in before
    for _ in range(50):
        flight.fly(0.1)
        assert flight.controller.mode == LOITER[personality]
    assert not request.outcome.success
    assert flight.bridge.state(flight.now).startswith('INACTIVE: offboard not reached')


def test_offboard_that_comes_late_after_it_was_told_to_have_failed_is_not_flown():
    flight = Flight(faults=[
        Fault('delay', 2.0, 6.0, 'received', message='COMMAND_LONG', by=5.0)])
    flight.fly(2.1)
    flight.planner = EAST
    assert flight.ask('offboard', True, seconds=12.0).message.startswith('offboard: no answer')
    flight.fly(6.0)
    assert kinds(flight) == {'none'}
    assert flight.cycles[-1].setpoint.reason.startswith('offboard: no answer')
    assert flight.ask('offboard', True).success


def ack(flight, command, result, system, component):
    codec = mavlink.MAVLink(None, 1, 1)
    flight.wire.to_bridge.append(mavlink.MAVLink_command_ack_message(
        command, result, target_system=system, target_component=component).pack(codec))


@pytest.mark.parametrize(('system', 'component', 'believed'), [
    (255, 190, False), (1, 190, False), (0, 0, True), (1, 191, True)])
def test_only_answers_to_us_are_believed(system, component, believed):
    flight = Flight(faults=[Fault('drop', 1.6, 9.0, 'received', message='COMMAND_LONG')])
    assert flight.bridge.link.source_component == 191
    flight.fly(2.0)
    request = flight.bridge.requests.offboard(True, flight.now)
    flight.fly(1.7)  # PX4 wants a stream first
    ack(flight, mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_RESULT_DENIED, system, component)
    flight.fly(1.0)
    assert (request.outcome is not None and 'denied' in request.outcome.message) == believed


@BOTH
def test_land_is_asked_for_until_it_shows_whatever_is_acknowledged(personality):
    flight = Flight(personality, faults=[
        Fault('drop', 5.0, 1.0, 'received', message='COMMAND_LONG')])
    flight.engage()
    while flight.now < 5.1:
        flight.fly(0.1)
    request = flight.bridge.requests.land(flight.now)
    flight.fly(0.2)
    # As if from an earlier mode command of ours.
    ack(flight, mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_RESULT_ACCEPTED, 1, 191)
    flight.fly(3.0)
    assert request.outcome.success and flight.controller.mode == LAND[personality]


@BOTH
@pytest.mark.parametrize(('what', 'argument', 'command'), [
    ('land', [], mavlink.MAV_CMD_DO_SET_MODE), ('offboard', [False], mavlink.MAV_CMD_DO_SET_MODE),
    ('arm', [False], mavlink.MAV_CMD_COMPONENT_ARM_DISARM)])
def test_an_abort_is_sent_though_nothing_is_heard(personality, what, argument, command):
    flight = Flight(personality, faults=[Fault('drop', 5.0, 30.0, 'sent')])
    flight.engage()
    while flight.now < 8.0:
        flight.fly(0.1)
    since = flight.now
    outcome = flight.ask(what, *argument)
    assert not outcome.success and 'no answer' in outcome.message
    assert len(commands(flight, command, since)) >= 3
    if what == 'land':
        assert flight.controller.mode == LAND[personality]


def test_after_a_reboot_into_offboard_nothing_is_sent_before_a_new_request():
    flight = Flight('arducopter')
    flight.engage()
    flight.planner = EAST
    flight.bridge.telemetry.reboots += 1  # as time_boot_ms told it
    flight.fly(2.0)
    assert kinds(flight, 30) == {'none'}
    assert flight.ask('offboard', True).success
    flight.fly(1.0)
    assert 'command' in kinds(flight, 10)


@BOTH
def test_one_message_that_comes_late_does_not_end_the_flight_without_braking(personality):
    # The stream ended at once: ArduCopter, 3 s by its default, flew 31 m with the last setpoint.
    flight = Flight(personality)
    flight.engage()
    flight.planner = EAST
    flight.fly(0.5)
    late = flight.bridge.telemetry.local_position.time_boot_ms - 1200
    flight.wire.to_bridge.append(mavlink.MAVLink_local_position_ned_message(
        late, 0, 0, -2.5, 0, 0, 0).pack(mavlink.MAVLink(None, 1, 1)))
    flight.fly(1.0)
    assert flight.bridge.state(flight.now) == 'ACTIVE'
    assert 'none' not in kinds(flight, 20)


def test_a_reboot_ends_a_request_for_offboard_too():
    flight = Flight('arducopter')
    flight.fly(2.1)
    request = flight.bridge.requests.offboard(True, flight.now)
    flight.bridge.telemetry.reboots += 1  # as time_boot_ms told it
    flight.fly(3.0)
    assert request.outcome == (False, 'offboard refused: the autopilot rebooted')
    assert not commands(flight, mavlink.MAV_CMD_DO_SET_MODE)


def test_guided_before_a_take_off_is_no_request_for_offboard():
    flight = Flight('arducopter', start='landed')
    flight.fly(2.0)
    flight.controller.pilot_switches('GUIDED')
    flight.fly(1.5)
    assert flight.ask('arm', True).success
    assert flight.ask('takeoff', 2.0, seconds=30.0).success
    flight.planner = EAST
    flight.fly(3.0)
    assert kinds(flight) == {'none'} and not flight.setpoints()


class SharedWire(Wire):
    """One port that two vehicles with the same system id reach."""

    def __init__(self):
        super().__init__()
        self.to_other, self.from_other = [], []

    def read(self):
        yield from super().read()
        arrived, self.from_other = self.from_other, []
        for data in arrived:
            yield data, 'other'

    def write(self, data):
        (self.to_other if self.peer == 'other' else self.to_vehicle).append(data)
        return True


def test_a_vehicle_that_takes_the_place_of_a_silent_one_is_not_flown_unasked():
    wire = SharedWire()
    flight = Flight('arducopter', wire=wire, faults=[Fault('drop', 4.0, 99.0, 'sent')])
    other = FaultyAutopilot('arducopter', now=0.0, faults=[Fault('pilot', 1.0, mode='GUIDED')])
    flight.engage()
    flight.planner = EAST
    while flight.now < 12.0:
        flight.fly(0.01)
        wire.from_other += other.step(flight.now)
        for data in wire.to_other:
            wire.from_other += other.receive(data, flight.now)
        wire.to_other = []
    assert wire.peer == 'other' and other.controller.mode == 'GUIDED'
    assert kinds(flight) == {'none'}
    assert np.linalg.norm(other.vehicle.velocity) < 0.05


@pytest.mark.parametrize('parameters', [None, {'MIS_TAKEOFF_ALT'}])
def test_px4_is_not_asked_to_take_off_before_its_least_height_is_known(parameters):
    faults = [] if parameters is None else [
        Fault('drop', 0.0, 8.0, 'sent', message='PARAM_VALUE')]
    flight = Flight(start='landed', parameters={'MIS_TAKEOFF_ALT': 10.0}, faults=faults)
    flight.fly(7.0)
    assert flight.ask('arm', True).success
    expected = 'PX4 would climb to MIS_TAKEOFF_ALT = 10 m' if not faults else (
        'MIS_TAKEOFF_ALT is not known yet: PX4 would climb that high at least')
    assert expected in flight.ask('takeoff', 1.0).message
    flight.fly(3.0)
    assert 'PX4 would climb to MIS_TAKEOFF_ALT = 10 m' in flight.ask('takeoff', 1.0).message


def test_whether_it_has_landed_is_the_past_once_it_is_no_longer_told():
    flight = Flight('arducopter', start='landed', faults=[
        Fault('drop', 5.0, 30.0, 'sent', message='EXTENDED_SYS_STATE')])
    flight.fly(3.0)
    assert flight.ask('arm', True).success
    while flight.now < 5.1:
        flight.fly(0.1)
    assert flight.ask('takeoff', 2.5, seconds=20.0).success
    assert 'EXTENDED_SYS_STATE' in flight.ask('offboard', True).message  # unknown: on the ground
    flight.fly(3.0)
    asked = [m for m in commands(flight, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 5.5)
             if m.param1 == mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE]
    assert len(asked) >= 2


@BOTH
def test_offboard_is_refused_where_the_velocities_disagree(personality):
    flight = Flight(personality)
    flight.odometry = False
    for _ in range(40):
        flight.bridge.on_odometry((0.0, 1.5, 0.0), flight.vehicle.yaw, 0.0, flight.now)
        flight.fly(0.05)
    outcome = flight.bridge.requests.offboard(True, flight.now).outcome
    assert outcome.message == (
        'offboard refused: velocities of odom and of the autopilot disagree by 1.20 m/s, '
        'more than 0.40 m/s (velocity_disagreement)')  # it counts up to three times as much


@BOTH
def test_heartbeat_is_asked_for_often_so_that_the_pilots_switch_shows_soon(personality):
    flight = Flight(personality)
    flight.engage()
    flight.planner = EAST
    flight.fly(1.0)
    flight.controller.pilot_switches(HOLD[personality])
    flight.fly(0.3)
    assert not flight.setpoints(flight.now - 0.05)
    assert flight.cycles[-1].setpoint.reason == f'offboard was left for {HOLD[personality]}'


@pytest.mark.parametrize('keeps', [False, True])
def test_into_a_line_that_keeps_what_is_late_no_setpoint_goes_while_nobody_is_heard(keeps):
    wire = Wire()
    wire.delivers_late = keeps
    flight = Flight(wire=wire, faults=[Fault('drop', 4.0, 4.0, 'sent')])
    flight.engage()
    while flight.now < 7.5:
        flight.fly(0.1)
    assert bool(flight.setpoints(flight.now - 0.5)) != keeps
    # Without them PX4's own failsafe acts.
    assert (flight.controller.mode == 'OFFBOARD') != keeps


@pytest.mark.parametrize(('what', 'argument', 'name'), [
    ('land', [], 'land'), ('offboard', [False], 'hold'), ('arm', [False], 'disarm')])
def test_before_any_autopilot_was_heard_an_abort_says_so_at_once(what, argument, name):
    flight = Flight()
    outcome = getattr(flight.bridge.requests, what)(*argument, 0.0).outcome
    assert outcome == (False, f'{name} refused: no HEARTBEAT from the autopilot')


def test_an_abort_before_any_autopilot_was_heard_ends_the_request_for_offboard_all_the_same():
    flight = Flight('arducopter', faults=[Fault('pilot', 0.5, mode='GUIDED')])
    request = flight.bridge.requests.offboard(True, 0.0)
    assert not flight.bridge.requests.offboard(False, 0.0).outcome.success
    assert request.outcome == (False, 'offboard refused: superseded by hold')
    flight.planner = EAST
    flight.fly(5.0)
    assert not flight.setpoints()
    assert flight.bridge.state(flight.now) == 'INACTIVE: hold requested'


@BOTH
@pytest.mark.parametrize('kind', ['brake', 'none'])
def test_the_end_of_the_bridge_sends_no_setpoint_if_the_gate_decides_on_none(personality, kind):
    flight = Flight(personality)
    flight.engage()
    decide = flight.bridge.gate.decide

    def decide_so(*arguments):
        setpoint, command = decide(*arguments)
        return setpoint._replace(kind=kind), command
    flight.bridge.gate.decide = decide_so
    flight.bridge.stop(flight.now)
    flight.bridge.cycle = lambda now: None  # the bridge is gone
    flight.fly(0.02)  # what the last cycle sent arrives
    ended = flight.now
    flight.bridge.finish(ended)
    flight.fly(0.1)
    assert len(flight.setpoints(ended)) == (kind == 'brake')


@BOTH
def test_the_end_of_the_bridge_does_not_end_a_landing_that_no_heartbeat_has_shown(personality):
    flight = Flight(personality)
    flight.engage()
    flight.bridge.requests.land(flight.now)
    while flight.controller.mode != LAND[personality]:
        flight.fly(0.01)
    flight.bridge.stop(flight.now)
    assert flight.bridge.gate.flies and flight.bridge.stopped(flight.now)
    flight.bridge.finish(flight.now)
    flight.bridge.cycle = lambda now: None  # the bridge is gone
    flight.fly(2.0)
    assert flight.controller.mode == LAND[personality]


@BOTH
def test_a_switch_away_and_back_while_nothing_is_heard_does_not_give_back(personality):
    flight = Flight(personality, faults=[Fault('drop', 6.0, 6.0, 'sent')])
    flight.engage()
    flight.planner = EAST
    while flight.now < 7.5:
        flight.fly(0.1)
    flight.controller.pilot_switches({'px4': 'POSCTL', 'arducopter': 'ALT_HOLD'}[personality])
    flight.fly(2.0)
    flight.controller.pilot_switches(OFFBOARD[personality])
    while flight.now < 15.0:
        flight.fly(0.1)
    assert kinds(flight, 20) == {'brake'}
    assert 'the pilot may have taken over' in flight.bridge.state(flight.now)
    assert flight.ask('offboard', True).success
    flight.fly(1.0)
    assert 'command' in kinds(flight, 10)


def test_what_was_asked_of_one_vehicle_is_not_asked_of_another():
    wire = SharedWire()
    flight = Flight('arducopter', wire=wire, faults=[Fault('drop', 4.0, 99.0)])
    flight.engage()
    while flight.now < 7.5:
        flight.fly(0.1)
    request = flight.bridge.requests.land(flight.now)
    other = FaultyAutopilot('arducopter', now=flight.now)
    start = flight.now
    while flight.now < start + 3.0:
        flight.fly(0.01)
        wire.from_other += other.step(flight.now)
        for data in wire.to_other:
            wire.from_other += other.receive(data, flight.now)
        wire.to_other = []
    assert wire.peer == 'other' and other.controller.mode != 'LAND'
    assert 'another vehicle took the place' in request.outcome.message


@BOTH
def test_offboard_asked_for_before_anything_is_heard_is_refused_where_frames_do_not_fit(
        personality):
    flight = Flight(personality, odom_yaw=1.5)
    outcome = flight.ask('offboard', True)
    assert not outcome.success and 'commands would go the wrong way' in outcome.message
    flight.fly(1.0)
    assert flight.bridge.state(flight.now).startswith('INACTIVE: ')
    assert kinds(flight, 15) == {'none'}


@BOTH
def test_offboard_asked_for_before_anything_is_heard_waits_for_a_velocity_and_then_fails(
        personality):
    flight = Flight(personality, faults=[
        Fault('drop', 0.0, direction='sent', message='LOCAL_POSITION_NED')])
    flight.odometry = False
    outcome = flight.ask('offboard', True)
    assert outcome == (False, 'offboard refused: no velocity known: '
                              'neither odom nor LOCAL_POSITION_NED')
    flight.fly(1.0)
    assert kinds(flight, 15) == {'none'} and flight.controller.mode == LOITER[personality]
    flight = Flight(personality)
    flight.odometry = False
    assert flight.ask('offboard', True).success  # the autopilot's own velocity came in time
