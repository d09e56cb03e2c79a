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

"""Whole flights by the bridge's requests, against both embedded autopilots, and every refusal."""

import math

from bridge_flight import Flight, SlowWire
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.mavlink.parameter_check import Recommendation

pytestmark = pytest.mark.slow
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])
OFFBOARD = {'px4': 'OFFBOARD', 'arducopter': 'GUIDED'}
HOLD = {'px4': 'AUTO.LOITER', 'arducopter': 'BRAKE'}
LAND = {'px4': 'AUTO.LAND', 'arducopter': 'LAND'}
MANUAL = {'px4': 'POSCTL', 'arducopter': 'STABILIZE'}
EAST = np.array([0.5, 0.0, 0.0])


@BOTH
def test_a_whole_flight_from_arming_to_landing(personality):
    flight = Flight(personality, start='landed', ready_after=1.0)
    flight.fly(2.5)
    assert flight.ask('arm', True).success
    outcome = flight.ask('takeoff', 2.5, seconds=30.0)
    assert outcome.success, outcome
    flight.fly(4.0)
    assert flight.vehicle.position[2] == pytest.approx(2.5, abs=0.3)
    outcome = flight.ask('offboard', True)
    assert outcome.success and OFFBOARD[personality] in outcome.message
    start, fastest = flight.now, 0.0
    while flight.now < start + 30.0:
        angle = 0.5 * (flight.now - start)
        # A planner closes the altitude; here it holds what it has at the take-over.
        up = 2.0 * (2.5 - flight.vehicle.position[2]) - 2.5 * flight.vehicle.velocity[2]
        flight.planner = np.array([0.4 * math.cos(angle), 0.4 * math.sin(angle), up])
        flight.fly(0.1)
        fastest = max(fastest, float(np.linalg.norm(flight.vehicle.velocity)))
    assert flight.controller.mode == OFFBOARD[personality]
    assert 0.3 < fastest < 0.55
    assert flight.vehicle.position[2] == pytest.approx(2.5, abs=0.2)
    flight.planner = None
    assert flight.ask('offboard', False).success
    assert flight.controller.mode == HOLD[personality]
    outcome = flight.ask('land')
    assert outcome.success and LAND[personality] in outcome.message
    flight.fly(10.0)
    assert flight.vehicle.landed and not flight.controller.armed


def test_arducopter_keeps_its_place_after_a_take_off_until_offboard_is_asked_for():
    flight = Flight('arducopter', start='landed')
    flight.fly(1.5)
    assert flight.ask('arm', True).success
    assert flight.ask('takeoff', 2.0, seconds=30.0).success
    flight.planner = EAST
    flight.fly(3.0)
    assert flight.controller.mode == 'GUIDED' and not flight.setpoints()
    assert flight.cycles[-1].setpoint.reason == 'offboard was not requested'
    assert flight.ask('offboard', True).success
    flight.fly(1.0)
    assert flight.vehicle.velocity[0] > 0.2


@BOTH
def test_a_pilot_who_switches_away_stays_in_command_until_a_new_request(personality):
    flight = Flight(personality, limits=GateLimits(v_max=2.0))
    flight.engage()
    flight.planner = EAST
    flight.fly(1.0)
    flight.controller.pilot_switches(MANUAL[personality])
    flight.fly(1.2)  # HEARTBEAT comes at 1 Hz
    switched = flight.now
    flight.fly(3.0)
    assert not flight.setpoints(switched)
    left = f'offboard was left for {MANUAL[personality]}'
    assert flight.cycles[-1].setpoint.reason == left
    assert flight.bridge.state(flight.now) == f'TAKEN_OVER: {left}'
    flight.controller.pilot_switches(OFFBOARD[personality])
    flight.fly(0.9)
    assert not flight.setpoints(switched)
    flight.controller.pilot_switches(HOLD[personality])
    flight.fly(3.0)
    assert not flight.setpoints(switched)
    assert 'the pilot took over' in flight.ask('offboard', True).message
    assert flight.controller.mode == HOLD[personality]
    flight.fly(2.0)
    assert flight.ask('offboard', True).success
    flight.fly(0.5)
    assert flight.setpoints(flight.now - 0.3)[-1].afy > 0.0


def test_a_refused_request_does_not_let_the_stream_go_on():
    flight = Flight(announce_as_gcs=True)
    flight.engage()
    flight.controller.pilot_switches('POSCTL')
    flight.fly(11.5)
    flight.autopilot.faults = [Fault('refuse', 0.0, command='DO_SET_MODE', reason='Not now')]
    outcome = flight.ask('offboard', True)
    assert not outcome.success and outcome.message == 'offboard refused: denied: Not now'
    refused = flight.now
    flight.fly(2.0)
    assert not flight.setpoints(refused + 0.1)


@BOTH
def test_a_rebooted_autopilot_is_asked_again_for_everything_but_offboard(personality):
    flight = Flight(personality, bridge={'recommendations': {
        name: [Recommendation('MAV_SYS_ID', 1.0, '')] for name in ('px4', 'ardupilot')}})
    flight.engage()
    flight.planner = EAST
    flight.fly(1.0)
    asked = sum(m.get_type() == 'PARAM_REQUEST_READ' for _, m in flight.received)
    flight.autopilot.reboot(flight.now, 2.0)
    flight.vehicle.position[2] = 2.0
    flight.fly(8.0)
    assert flight.bridge.telemetry.reboots == 1
    assert flight.bridge.telemetry.attitude.time > flight.now - 0.1
    assert sum(m.get_type() == 'PARAM_REQUEST_READ' for _, m in flight.received) > asked
    assert not flight.setpoints(flight.now - 3.0)


@BOTH
def test_a_refusal_of_each_request_names_the_words_of_the_autopilot(personality):
    faults = [Fault('refuse', 0.0, command=command, reason=f'No {command}')
              for command in ('DO_SET_MODE', 'COMPONENT_ARM_DISARM', 'NAV_TAKEOFF')]
    flight = Flight(personality, start='armed', faults=faults, announce_as_gcs=True)
    flight.fly(1.5)
    for what, arguments, command in (
            ('arm', (False,), 'COMPONENT_ARM_DISARM'), ('land', (), 'DO_SET_MODE')):
        outcome = flight.ask(what, *arguments)
        assert not outcome.success and outcome.message.endswith(f'denied: No {command}')
    outcome = flight.ask('takeoff', 2.5)
    last = 'NAV_TAKEOFF' if personality == 'px4' else 'DO_SET_MODE'
    assert not outcome.success and outcome.message.endswith(f'denied: No {last}')


@BOTH
def test_a_take_off_that_cannot_be_is_refused_before_it_is_asked_for(personality):
    flight = Flight(personality, start='landed')
    assert flight.ask('takeoff', 2.5) == (
        False, 'takeoff refused: no HEARTBEAT from the autopilot')
    flight.fly(1.5)
    assert flight.ask('takeoff', 2.5) == (False, 'takeoff refused: disarmed: arm first')
    flight = Flight(personality)
    flight.fly(1.5)
    assert flight.ask('takeoff', 2.5) == (False, 'takeoff refused: already in the air')
    flight = Flight(personality, start='armed', faults=[
        Fault('drop', 0.0, direction='sent', message='LOCAL_POSITION_NED')])
    flight.fly(1.5)
    assert 'nothing would tell when the height is reached' in flight.ask('takeoff', 2.5).message


def test_px4_is_not_asked_for_less_than_its_minimum_height():
    flight = Flight(start='landed', bridge={'recommendations': {
        'px4': [Recommendation('MIS_TAKEOFF_ALT', 2.5, '')]}})
    flight.fly(1.5)
    assert flight.ask('arm', True).success
    assert flight.ask('takeoff', 1.5) == (
        False, 'takeoff refused: PX4 would climb to MIS_TAKEOFF_ALT = 2.5 m, '
               'above takeoff_height = 1.5 m')
    assert flight.ask('takeoff', 4.0, seconds=30.0).success
    flight.fly(4.0)
    assert flight.vehicle.position[2] == pytest.approx(4.0, abs=0.2)


def test_px4_without_a_sea_level_altitude_climbs_to_its_own_height():
    flight = Flight(start='landed', faults=[
        Fault('drop', 0.0, direction='sent', message='GLOBAL_POSITION_INT')])
    flight.fly(1.5)
    assert flight.ask('arm', True).success
    assert flight.ask('takeoff', 2.5, seconds=30.0).success


@BOTH
def test_a_vehicle_that_does_not_climb_is_told_after_a_while(personality):
    flight = Flight(personality, start='armed', parameters={
        'COM_DISARM_PRFLT' if personality == 'px4' else 'DISARM_DELAY': 0.0})
    flight.fly(1.5)
    flight.vehicle.step = lambda *arguments, **options: None  # it is tied down
    outcome = flight.ask('takeoff', 2.5, seconds=30.0)
    assert not outcome.success and 'takeoff not reached within 18.3 s' in outcome.message


@BOTH
def test_a_pilot_who_interrupts_the_take_off_is_obeyed(personality):
    flight = Flight(personality, start='landed')
    flight.fly(1.5)
    assert flight.ask('arm', True).success
    request = flight.bridge.requests.takeoff(8.0, flight.now)
    flight.fly(2.5)
    assert request.outcome is None
    flight.controller.pilot_switches('POSCTL' if personality == 'px4' else 'LOITER')
    flight.fly(1.5)
    assert 'the mode was changed to' in request.outcome.message
    flight.fly(2.0)
    assert flight.controller.mode in ('POSCTL', 'LOITER')


@BOTH
def test_arming_is_refused_until_the_estimator_is_ready(personality):
    flight = Flight(personality, start='landed', ready_after=20.0)
    if personality == 'arducopter':
        flight.controller.pilot_switches('GUIDED')  # it needs a position to arm
    flight.fly(1.5)
    outcome = flight.ask('arm', True)
    assert not outcome.success and 'osition' in outcome.message


def test_a_link_that_loses_a_tenth_of_everything_still_flies():
    flight = Flight(faults=[Fault('drop', 0.0, share=0.1)])
    flight.fly(3.0)
    outcome = flight.ask('offboard', True)
    assert outcome.success, outcome
    flight.planner = EAST
    flight.fly(3.0)
    assert flight.controller.mode == 'OFFBOARD' and flight.vehicle.velocity[0] > 0.4


def test_garbage_and_duplicates_on_the_line_move_nothing():
    flight = Flight(faults=[Fault('garbage', 3.0, share=0.5), Fault('duplicate', 3.0)])
    flight.engage()
    flight.planner = EAST
    flight.fly(5.0)
    assert flight.controller.mode == 'OFFBOARD'
    assert all(c.setpoint.kind == 'command' for c in flight.cycles[-80:])
    assert flight.bridge.link.ignored['undecodable'] > 0
    assert 0.4 < np.linalg.norm(flight.vehicle.velocity) < 0.53


NO_GPS = {
    'px4': {'EKF2_GPS_CTRL': 0, 'EKF2_EV_CTRL': 13, 'EKF2_HGT_REF': 0},
    'arducopter': {'GPS1_TYPE': 0, 'VISO_TYPE': 1, 'EK3_SRC1_POSXY': 6, 'EK3_SRC1_VELXY': 6,
                   'EK3_SRC1_VELZ': 6, 'EK3_SRC1_YAW': 6}}


@BOTH
def test_without_gps_the_forwarded_odometry_carries_a_whole_flight(personality):
    flight = Flight(personality, start='landed', parameters=NO_GPS[personality], bridge={
        'forwarder': OdometryForwarder(30.0), 'origin': (47.4, 8.5, 488.0)})
    flight.forwards = True
    flight.fly(3.0)
    for what, arguments in (('arm', (True,)), ('takeoff', (2.5,)), ('offboard', (True,))):
        outcome = flight.ask(what, *arguments, seconds=30.0)
        assert outcome.success, outcome
    flight.planner = EAST
    flight.fly(5.0)
    assert flight.controller.mode == OFFBOARD[personality]
    assert 0.4 < flight.vehicle.velocity[0] < 0.55
    assert flight.bridge.forwarder.counters['gaps over 100 ms'] == 0


@BOTH
@pytest.mark.parametrize('wrong', [0.3, -1.5])
def test_the_vertical_velocity_that_is_forwarded_is_corrected_by_the_barometer(personality, wrong):
    """The autopilot's height follows it, in the hold mode too: on real ones to the ground."""
    flight = Flight(personality, parameters=NO_GPS[personality],
                    bridge={'forwarder': OdometryForwarder(30.0)})
    flight.forwards = True
    flight.engage()
    flight.odom_climb = wrong
    flight.fly(6.0)
    errors = []
    for _ in range(20):
        flight.fly(0.05)
        told = [m for _, m in flight.received if m.get_type() == 'ODOMETRY'][-1]
        errors.append(-told.vz - flight.vehicle.velocity[2])  # it is almost level
    assert np.mean(errors) == pytest.approx(0.0, abs=0.1)


@BOTH
def test_odometry_that_is_lost_brakes_before_the_autopilot_notices(personality):
    flight = Flight(personality, parameters=NO_GPS[personality],
                    bridge={'forwarder': OdometryForwarder(30.0)})
    flight.forwards = True
    flight.engage()
    flight.planner = EAST
    flight.fly(2.0)
    flight.forwards = flight.odometry = False
    flight.fly(0.4)
    assert flight.controller.mode == OFFBOARD[personality]
    assert flight.cycles[-1].setpoint.reason == 'velocity from odom stale'
    assert flight.cycles[-1].setpoint.kind == 'brake'
    assert flight.bridge.forwarder.silence(flight.now) > 0.1


def asked_to_land(flight):
    dialect = flight.bridge.telemetry.dialect
    wanted = dialect.set_mode_parameters(dialect.land)
    return sum(m.get_type() == 'COMMAND_LONG' and m.command == mavlink.MAV_CMD_DO_SET_MODE
               and (m.param1, m.param2, m.param3)[:len(wanted)] == wanted
               for _, m in flight.received)


@BOTH
@pytest.mark.parametrize('action', ['silence', 'land'])
def test_lost_odometry_that_the_autopilots_estimate_rests_on_ends_the_stream(personality, action):
    flight = Flight(personality, parameters=NO_GPS[personality],
                    bridge={'forwarder': OdometryForwarder(30.0), 'blind_action': action})
    flight.forwards = True
    flight.engage()
    flight.planner = EAST
    flight.fly(2.0)
    lost = flight.now
    flight.forwards = flight.odometry = False
    flight.fly(1.0)
    sent = [t for t, m in flight.received if m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED']
    assert 0.6 < max(sent) - lost < 0.85
    kinds = [cycle.setpoint.kind for cycle in flight.cycles[-20:]]
    # No later than this it no longer brakes on what the estimate has become without odometry.
    assert 'brake' not in kinds[10:] and kinds[11] == 'level'
    assert flight.bridge.state(flight.now) == 'INACTIVE: fell silent: velocity from odom stale'
    lands = action == 'land'
    assert bool(asked_to_land(flight)) == lands
    assert (flight.bridge.blind_landing is not None) == lands
    flight.forwards = flight.odometry = True  # it comes back: setpoints alone would end a failsafe
    flight.fly(3.0)
    assert flight.bridge.withheld().startswith('fell silent')
    assert max(t for t, m in flight.received
               if m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED') == max(sent)
    if lands:
        assert flight.bridge.blind_landing.outcome.success
        assert flight.controller.mode == LAND[personality]


@BOTH
def test_with_gps_lost_odometry_is_braked_on_the_autopilots_velocity_as_long_as_need_be(
        personality):
    flight = Flight(personality)
    flight.engage()
    flight.planner = EAST
    flight.fly(2.0)
    flight.odometry = False
    flight.fly(5.0)
    assert {cycle.setpoint.kind for cycle in flight.cycles[-80:]} == {'brake'}
    assert np.linalg.norm(flight.vehicle.velocity) < 0.1


def test_on_a_slow_line_setpoints_come_first_and_odometry_takes_what_is_left():
    flight = Flight(wire=SlowWire(57600), parameters=NO_GPS['px4'],
                    bridge={'forwarder': OdometryForwarder(30.0)})
    flight.forwards = True
    flight.engage()
    flight.planner = EAST
    start = flight.now
    flight.fly(10.0)
    times = [t for t, m in flight.received
             if m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED' and t >= start]
    assert len(times) == pytest.approx(200, abs=2)
    assert np.diff(times).max() <= 0.1
    forwarded = sum(m.get_type() == 'ODOMETRY' for t, m in flight.received if t >= start) / 10
    # 57,600 baud carry 5,760 bytes per second, of which 247 are one ODOMETRY.
    assert 8.0 < forwarded < 18.0
    assert flight.bridge.forwarder.counters['not sent'] > 0


def test_an_origin_is_told_until_the_autopilot_has_one():
    flight = Flight('arducopter', bridge={'origin': (47.4, 8.5, 488.0)}, faults=[
        Fault('drop', 0.0, direction='sent', message='GPS_GLOBAL_ORIGIN')])
    flight.fly(12.0)
    told = [m for _, m in flight.received if m.get_type() == 'SET_GPS_GLOBAL_ORIGIN']
    assert 2 <= len(told) <= 3
    assert (told[0].latitude, told[0].longitude, told[0].altitude) == (
        474000000, 85000000, 488000)
    origin = mavlink.MAVLink_gps_global_origin_message(474000000, 85000000, 488000)
    flight.wire.to_bridge.append(origin.pack(mavlink.MAVLink(None, 1, 1)))
    flight.fly(12.0)
    again = [m for _, m in flight.received if m.get_type() == 'SET_GPS_GLOBAL_ORIGIN']
    assert len(again) == len(told)


@pytest.mark.parametrize(('parameters', 'origin', 'told'), [
    (NO_GPS['px4'], None, {(473977420, 85455940, 0)}), ({}, None, set()),
    (NO_GPS['px4'], (47.4, 8.5, 488.0), {(474000000, 85000000, 0)})])
def test_px4_is_told_an_origin_without_height_and_any_where_it_flies_without_gps(
        parameters, origin, told):
    flight = Flight(parameters=parameters, bridge={
        'forwarder': OdometryForwarder(30.0), 'origin': origin})
    flight.forwards = True
    flight.fly(6.0)
    origins = [(m.latitude, m.longitude, m.altitude) for _, m in flight.received
               if m.get_type() == 'SET_GPS_GLOBAL_ORIGIN']
    assert set(origins) == told


@BOTH
def test_offboard_is_refused_while_a_dead_bridge_would_be_obeyed_for_long(personality):
    name = {'px4': 'COM_OF_LOSS_T', 'arducopter': 'GUID_TIMEOUT'}[personality]
    flight = Flight(personality, parameters={name: 3.0})
    flight.fly(3.0)
    outcome = flight.ask('offboard', True)
    assert not outcome.success
    assert outcome.message.startswith(f'offboard refused: {name} = 3 s: ')
    assert not flight.bridge.gate.permission.streams
    free = Flight(personality, parameters={name: 3.0}, bridge={'require_failsafe': False})
    free.fly(3.0)
    assert free.ask('offboard', True).success


@BOTH
def test_offboard_is_refused_where_forwarded_odometry_is_not_fused(personality):
    name = {'px4': 'EKF2_EV_CTRL', 'arducopter': 'VISO_TYPE'}[personality]
    flight = Flight(personality, bridge={'forwarder': OdometryForwarder(30.0)})
    flight.forwards = True
    flight.fly(3.0)
    outcome = flight.ask('offboard', True)
    assert not outcome.success
    assert outcome.message.startswith(f'offboard refused: {name} = 0: it does not fuse ')
    assert not flight.bridge.gate.permission.streams


@BOTH
def test_offboard_is_refused_where_that_cannot_be_read(personality):
    flight = Flight(personality, faults=[Fault('drop', 0.0, message='PARAM_VALUE')])
    flight.fly(3.0)
    outcome = flight.ask('offboard', True, seconds=6.0)
    assert not outcome.success and 'could not be read' in outcome.message
    assert not flight.bridge.gate.permission.streams


@BOTH
def test_a_second_flight_needs_nothing_but_the_services(personality):
    flight = Flight(personality, start='landed')
    flight.fly(2.0)
    for _ in range(2):
        for what, arguments in (('arm', (True,)), ('takeoff', (2.5,)), ('offboard', (True,))):
            outcome = flight.ask(what, *arguments, seconds=30.0)
            assert outcome.success, outcome
        assert flight.ask('land').success
        flight.fly(15.0)
        assert not flight.controller.armed
        assert flight.bridge.state(flight.now).startswith('INACTIVE')
