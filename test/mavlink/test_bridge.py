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

"""The bridge without ROS, flying the embedded autopilot in simulated time."""

import math

from bridge_flight import Flight
from faulty_autopilot import Fault
import numpy as np
import pytest

from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.odometry_forwarding import OdometryForwarder
from flock_follower.mavlink.telemetry import wanted_rates
from flock_follower.messages import Command

pytestmark = pytest.mark.slow


def test_offboard_is_taken_over_from_hold_and_commands_are_flown():
    flight = Flight(limits=GateLimits(v_max=2.0))
    flight.engage()
    flight.planner = np.array([0.0, 0.6, 0.0])
    flight.fly(2.0)
    last = flight.setpoints()[-1]
    assert (last.type_mask, last.coordinate_frame) == (0x83F, 1)
    assert (last.afx, last.afy, last.afz) == (
        pytest.approx(0.6, abs=0.01), pytest.approx(0.0, abs=1e-6), 0.0)
    assert flight.vehicle.velocity[1] > 0.9 and abs(flight.vehicle.velocity[0]) < 1e-3


def test_the_stream_runs_at_twenty_hertz_and_the_heartbeat_at_one():
    flight = Flight()
    flight.engage()
    start = flight.now
    flight.fly(10.0)
    assert len(flight.setpoints(start)) == 200
    assert sum(m.get_type() == 'HEARTBEAT' for t, m in flight.received if t >= start) == 10


def test_the_speed_stays_within_v_max_though_the_vehicle_answers_late():
    flight = Flight()
    flight.engage()
    fastest = 0.0
    for k in range(100):
        flight.planner = 2.5 * np.array([math.cos(0.1 * k), math.sin(0.1 * k), 0.0])
        flight.fly(0.1)
        fastest = max(fastest, np.linalg.norm(flight.vehicle.velocity))
    assert 0.45 < fastest < 0.53


def test_a_dead_planner_ends_in_a_hover():
    flight = Flight()
    flight.engage()
    flight.planner = np.array([1.0, 0.0, 0.0])
    flight.fly(2.0)
    assert flight.vehicle.velocity[0] > 0.4
    flight.planner = None
    flight.fly(0.31)
    decision = flight.cycles[-1].setpoint
    assert (decision.kind, decision.reason) == ('brake', 'command stale')
    assert flight.setpoints()[-1].afy < -0.5
    flight.fly(2.5)
    assert np.linalg.norm(flight.vehicle.velocity) < 0.03
    assert flight.controller.mode == 'OFFBOARD'


def test_lost_odometry_ends_in_a_hover_on_the_estimate_of_the_autopilot():
    flight = Flight()
    flight.engage()
    flight.planner = np.array([1.0, 0.0, 0.0])
    flight.fly(2.0)
    flight.odometry = False
    flight.fly(3.0)
    assert flight.cycles[-1].setpoint.reason == 'velocity from odom stale'
    assert np.linalg.norm(flight.vehicle.velocity) < 0.03


def test_missing_heartbeats_brake():
    flight = Flight(faults=[Fault('drop', 6.5, direction='sent', message='HEARTBEAT')])
    flight.engage()
    flight.planner = np.array([1.0, 0.0, 0.0])
    flight.fly(7.9 - flight.now)
    assert flight.cycles[-1].setpoint.kind == 'command'
    flight.fly(8.6 - flight.now)
    assert flight.cycles[-1].setpoint.reason == 'link lost'


def test_the_way_out_brakes_and_leaves_the_vehicle_in_hold():
    flight = Flight()
    flight.engage()
    flight.planner = np.array([1.0, 0.0, 0.0])
    flight.fly(2.0)
    start = flight.now
    flight.bridge.stop(start)
    while not flight.bridge.stopped(flight.now):
        flight.fly(0.05)
    assert 0.2 < flight.now - start <= 1.0
    flight.bridge.finish(flight.now)
    last = flight.codec.parse_buffer(flight.wire.to_vehicle[-1])[0]
    assert last.get_type() == 'SET_POSITION_TARGET_LOCAL_NED'
    assert (last.afx, last.afy, last.afz) == (0.0, 0.0, 0.0)
    flight.planner = None
    flight.bridge.cycle = lambda now: None  # the bridge is gone
    flight.fly(5.0)
    assert flight.controller.mode == 'AUTO.LOITER'
    assert np.linalg.norm(flight.vehicle.velocity) < 0.03


def test_a_vehicle_that_does_not_obey_us_is_left_alone_on_the_way_out():
    flight = Flight()
    flight.fly(2.0)
    flight.bridge.stop(flight.now)
    assert flight.bridge.stopped(flight.now)
    flight.wire.to_vehicle = []
    flight.bridge.finish(flight.now)
    assert flight.wire.to_vehicle == []


def test_commands_after_stop_are_refused():
    flight = Flight()
    flight.bridge.stop(1.0)
    refused = flight.bridge.gate.take_command(Command([1, 0, 0], 0.0), 0.0, 1.0)
    assert refused == 'while INACTIVE'


def test_a_request_that_comes_after_stop_does_not_let_it_follow_again():
    flight = Flight('arducopter')
    flight.engage()
    flight.planner = np.array([0.6, 0.0, 0.0])
    flight.fly(3.0)
    flight.bridge.stop(flight.now)
    refused = flight.bridge.requests.offboard(True, flight.now).outcome
    assert refused == (False, 'offboard refused: the bridge is stopping')
    flight.fly(0.6)
    assert {cycle.setpoint.kind for cycle in flight.cycles[-10:]} == {'brake'}


def test_frames_that_are_not_aligned_are_refused():
    flight = Flight(odom_yaw=math.pi / 2)
    flight.fly(2.0)
    outcome = flight.ask('offboard', True)
    assert not outcome.success
    assert 'differ by 90 deg' in outcome.message and 'wrong way' in outcome.message
    assert flight.controller.mode == 'AUTO.LOITER'


def test_flying_blind_is_refused():
    flight = Flight(faults=[Fault('drop', 0.0, direction='sent', message='LOCAL_POSITION_NED')])
    flight.odometry = False
    flight.fly(1.5)
    outcome = flight.ask('offboard', True)
    assert outcome == (False, 'offboard refused: no velocity known: '
                              'neither odom nor LOCAL_POSITION_NED')


def test_a_second_request_waits_for_the_first():
    flight = Flight()
    flight.fly(1.5)
    flight.bridge.requests.offboard(True, flight.now)
    second = flight.bridge.requests.arm(True, flight.now)
    assert second.outcome == (False, 'arm refused: still waiting for offboard')


@pytest.mark.parametrize(('abort', 'name'), [('offboard', 'hold'), ('arm', 'disarm')])
def test_an_abort_waits_for_nothing(abort, name):
    flight = Flight()
    flight.fly(1.5)
    first = flight.bridge.requests.offboard(True, flight.now)
    second = getattr(flight.bridge.requests, abort)(False, flight.now)
    assert first.outcome == (False, f'offboard refused: superseded by {name}')
    assert flight.bridge.requests.newest is second
    flight.fly(3.0)
    assert flight.controller.mode == 'AUTO.LOITER'


def test_a_refusal_carries_the_words_of_the_autopilot():
    flight = Flight('arducopter', start='landed', arming_denial='Compass not calibrated')
    flight.fly(1.5)
    assert flight.ask('arm', True) == (
        False, 'arm refused: failed: Arm: Compass not calibrated')
    flight = Flight(start='landed', arming_denial='Compass not calibrated')
    flight.fly(1.5)
    assert flight.ask('arm', True) == (
        False, 'arm refused: temporarily rejected: arm authorization denied')


def test_px4s_refusals_without_a_word_tell_their_causes():
    flight = Flight(start='landed')
    flight.controller.estimator.uses_vision = True  # GPS is gone, and no vision comes
    flight.fly(1.5)
    assert flight.ask('arm', True) == (
        False, 'arm refused: temporarily rejected: no valid position estimate; no global position '
               '(neither GPS nor an origin); its estimator lacks VELOCITY_HORIZ, POS_HORIZ_REL, '
               'POS_HORIZ_ABS, PRED_POS_HORIZ_REL')
    flight = Flight(parameters={'EKF2_GPS_CTRL': 0, 'EKF2_EV_CTRL': 15, 'EKF2_HGT_REF': 3},
                    bridge={'forwarder': OdometryForwarder(30.0)}, faults=[
                        Fault('drop', 0.0, direction='received',
                              message='SET_GPS_GLOBAL_ORIGIN')])
    flight.forwards = True
    flight.bridge.telemetry.flying = lambda now: True  # AUTO.TAKEOFF is no flight yet
    flight.engage()
    outcome = flight.ask('offboard', False)
    assert outcome.message.startswith(
        'hold refused: temporarily rejected: no global position (neither GPS nor an origin); '
        'POSCTL refused: temporarily rejected: no transmitter; AUTO.LAND: ')
    assert flight.controller.mode == 'AUTO.LAND'


def test_telemetry_is_asked_for_at_the_start_and_again_when_it_stops():
    flight = Flight(faults=[Fault('drop', 3.0, 2.5, 'sent', message='ATTITUDE_QUATERNION')])
    flight.fly(3.0)

    def asked():
        return [int(m.param1) for _, m in flight.received
                if m.get_type() == 'COMMAND_LONG' and m.command == 511
                # It may not have the status.
                and m.param1 != flight.bridge.telemetry.dialect.estimator_status]
    wanted = sorted(wanted_rates(flight.bridge.telemetry.dialect, 50.0))
    wanted.remove(flight.bridge.telemetry.dialect.estimator_status)
    assert sorted(asked()) == wanted
    flight.fly(3.0)
    # Only what is missing, 0.3 s after it stopped and 2 s later.
    assert asked()[len(wanted):] == [31, 31]
    assert flight.bridge.telemetry.attitude.time > flight.now - 1.0


def test_latency_is_reported_once_for_each_command():
    flight = Flight()
    flight.engage()
    flight.cycles.clear()
    flight.planner = np.zeros(3)
    flight.fly(1.0)
    first = [cycle.first for cycle in flight.cycles if cycle.first]
    assert len(first) == 10
    assert all(c.time - c.source_time == pytest.approx(0.04) for c in first)


def test_whether_it_flies_is_asked_again_until_it_is_told():
    flight = Flight(faults=[Fault('drop', 0.0, 5.0, message='EXTENDED_SYS_STATE')])
    flight.fly(8.0)
    asked = [t for t, m in flight.received if m.get_type() == 'COMMAND_LONG'
             and m.command == 511 and m.param1 == 245]
    assert len(asked) == 3 and flight.bridge.telemetry.flying(flight.now)
