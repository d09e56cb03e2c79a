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

"""The embedded autopilots: motion, modes, masks, acknowledgements, faults, BRAKE, the command."""

import math
import os
import signal
import socket
import subprocess
import sys

from embedded_flight import BLIND, Flight, MASK_YAW, odometry, setpoint
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk import autopilot
from flock_desk.vehicles.embedded import STEP
from flock_desk.vehicles.quadrotor import Quadrotor
from flock_follower.geometry import GRAVITY

pytestmark = pytest.mark.slow


def offboard(flight, message):
    flight.fly(1.1, message)
    assert flight.mode('OFFBOARD') == [0, 0]


def test_the_vehicle_leans_into_its_acceleration_after_the_attitude_lag():
    vehicle = Quadrotor((0, 0, 2), yaw=math.pi / 2)
    tilts = []
    for _ in range(100):
        vehicle.step([1.0, 0.0, 0.0], math.pi / 2, STEP)
        tilts.append(math.asin(vehicle.rotation[0, 2]))
    wanted = math.atan(1.0 / GRAVITY)
    assert tilts[14] == pytest.approx(wanted * (1 - math.exp(-1)), rel=0.01)
    assert tilts[-1] == pytest.approx(wanted, rel=0.01)
    # Facing north, leaning east is a right roll: its left side points up.
    assert vehicle.rotation[2, 1] > 0.05 and abs(vehicle.rotation[2, 0]) < 1e-9


@pytest.mark.parametrize(('wait', 'loss_time', 'result'), [
    (0.9, 1.0, 0), (1.1, 1.0, 1), (0.4, 0.5, 0), (0.6, 0.5, 1)])
def test_offboard_needs_one_setpoint_that_is_not_too_old(wait, loss_time, result):
    flight = Flight(parameters={'COM_OF_LOSS_T': loss_time})
    flight.send(setpoint())
    flight.fly(wait)
    assert flight.mode('OFFBOARD') == [0, result]


def test_disarmed_any_mode_may_be_chosen_and_arming_asks_for_the_stream():
    flight = Flight(start='landed')
    assert flight.mode('OFFBOARD') == [0, 0]
    assert flight.arm() == [1] and flight.last_heartbeat().system_status == 0
    flight.send(setpoint())
    assert flight.arm() == [0] and flight.controller.mode == 'OFFBOARD'
    assert flight.arm(False) == [0] and flight.mode('AUTO.LAND') == [0, 0]
    assert flight.arm() == [1] and flight.controller.mode == 'AUTO.LAND'


def test_after_landing_the_mode_from_before_is_back_and_does_not_arm():
    flight = Flight()
    offboard(flight, setpoint())
    assert flight.mode('AUTO.LAND') == [0, 0]
    flight.fly(8.0)
    assert (flight.controller.mode, flight.controller.armed) == ('OFFBOARD', False)
    assert flight.arm() == [1]
    assert flight.take_off(math.nan) == [0] and flight.arm() == [0]


def test_a_mixed_setpoint_holds_the_altitude():
    message = setpoint(0.3, 0, 9, mask=0x93B, position_up=3.0)
    flight = Flight()
    offboard(flight, message)
    flight.fly(6.0, message)
    assert flight.vehicle.position[2] == pytest.approx(3.0, abs=0.05)
    assert flight.vehicle.velocity[0] > 1.0


def test_the_last_setpoint_is_kept_for_a_second_then_the_vehicle_descends():
    flight = Flight()
    offboard(flight, setpoint(1.0))
    flight.fly(1.0, setpoint(1.0))
    before = flight.vehicle.velocity[0]
    flight.fly(0.9)
    assert flight.controller.mode == 'OFFBOARD'
    assert flight.vehicle.velocity[0] == pytest.approx(before + 0.9, abs=0.2)
    flight.fly(3.0)
    # Without sticks Position descends.
    assert (flight.controller.mode, flight.controller.in_failsafe) == ('POSCTL', True)
    assert flight.vehicle.velocity[2] == pytest.approx(-0.7, abs=0.1)
    flight.fly(6.0)
    assert not flight.controller.armed and flight.vehicle.landed


def test_setpoints_alone_end_the_failsafe_and_a_mode_that_is_chosen_ends_it_for_good():
    flight = Flight(parameters={'COM_OBL_RC_ACT': 5})
    offboard(flight, setpoint())
    flight.fly(1.5)
    assert flight.controller.in_failsafe
    assert flight.controller.chosen == 'OFFBOARD'
    flight.fly(0.1, setpoint())
    assert (flight.controller.mode, flight.controller.in_failsafe) == ('OFFBOARD', False)
    flight.fly(1.5)
    assert flight.mode('AUTO.LOITER') == [0, 0] and not flight.controller.in_failsafe
    flight.fly(1.0, setpoint())
    assert flight.controller.mode == 'AUTO.LOITER'


def test_yaw_turns_at_a_limited_rate_to_the_setpoint():
    message = setpoint(yaw=2.5)
    flight = Flight()
    offboard(flight, message)
    start = flight.vehicle.yaw
    flight.fly(1.0, message)
    assert flight.vehicle.yaw - start == pytest.approx(math.radians(60), abs=0.02)
    flight.fly(5.0, message)
    assert flight.vehicle.yaw == pytest.approx(2.5, abs=0.01)
    attitude = [m for m in flight.messages if m.get_type() == 'ATTITUDE_QUATERNION'][-1]
    yaw = math.atan2(2 * (attitude.q1 * attitude.q4 + attitude.q2 * attitude.q3),
                     1 - 2 * (attitude.q3**2 + attitude.q4**2))
    assert yaw == pytest.approx(math.pi / 2 - 2.5, abs=0.02)


@pytest.mark.parametrize('dropped', [
    {'east': math.nan}, {'mask': MASK_YAW | 512}, {'mask': 0xFFF}, {'frame': 8}, {'target': 9}],
    ids=['NaN', 'force', 'nothing', 'body frame', 'other vehicle'])
def test_setpoints_px4_would_drop_do_not_count_as_a_stream(dropped):
    flight = Flight()
    flight.fly(1.2, setpoint(**{'east': 1.0, **dropped}))
    assert flight.mode('OFFBOARD') == [0, 1]


@pytest.mark.ros
def test_the_process_flies_logs_and_stops_cleanly(tmp_path):
    log = tmp_path / 'flight.npz'
    bridge = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bridge.bind(('127.0.0.1', 0))
    bridge.settimeout(10.0)
    codec = mavlink.MAVLink(None, 1, 191)
    with subprocess.Popen(
            [sys.executable, '-m', 'flock_desk.autopilot', '--connect',
             f'127.0.0.1:{bridge.getsockname()[1]}', '--yaw', '90', '--log', str(log)],
            stderr=subprocess.PIPE, text=True, env=os.environ) as process:
        data, vehicle = bridge.recvfrom(4096)
        bridge.sendto(setpoint(0.5).pack(codec), vehicle)
        kinds = {m.get_type() for _ in range(30) for m in codec.parse_buffer(bridge.recv(4096))}
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=5.0) == 0
        assert process.stderr.read() == ''
    bridge.close()
    assert codec.decode(bytearray(data)).get_type() == 'HEARTBEAT'
    assert {'LOCAL_POSITION_NED', 'ATTITUDE_QUATERNION'} <= kinds
    with np.load(log) as logged:
        assert logged['yaw'][0] == pytest.approx(math.pi / 2)
        assert logged['mode'][0] == 'AUTO.LOITER' and logged['armed'].all()
        np.testing.assert_allclose(logged['position'][-1], [0, 0, 2], atol=0.1)
        assert logged['setpoint_type_mask'].tolist() == [0x83F]
        np.testing.assert_allclose(logged['setpoint_acceleration'], [[0.5, 0, 0]])


@pytest.mark.parametrize(('personality', 'mode'), [('px4', 'POSCTL'), ('arducopter', 'LOITER')])
def test_the_pilot_climbs_so_long_after_the_first_setpoint(personality, mode):
    flight = Flight(personality, altitude=1.5, faults=[
        Fault('pilot', 2.0, mode=mode, climb=2.0, after='setpoint')])
    flight.mode('GUIDED' if personality == 'arducopter' else 'AUTO.LOITER')
    flight.fly(5.0)
    flight.fly(1.9, setpoint())
    assert flight.controller.mode != mode
    flight.fly(8.0, setpoint())
    assert flight.controller.mode == mode
    assert flight.vehicle.position[2] == pytest.approx(3.5, abs=0.05)


@pytest.mark.parametrize(('personality', 'mode'), [
    ('px4', 'AUTO.LOITER'), ('arducopter', 'STABILIZE')])
def test_a_reboot_is_silent_forgets_and_starts_its_clock_anew(personality, mode):
    name = 'COM_OF_LOSS_T' if personality == 'px4' else 'GUID_TIMEOUT'
    flight = Flight(personality, start='landed', parameters={name: 0.5},
                    faults=[Fault('reboot', 3.0, duration=2.0)])
    flight.fly(1.0)
    flight.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 32.0, 1e6)
    assert flight.arm() == [0]
    flight.fly(2.0)
    flight.messages.clear()
    flight.fly(1.98, setpoint())
    assert flight.messages == [] and flight.arm() == []
    flight.fly(1.1)
    assert (flight.controller.mode, flight.controller.armed) == (mode, False)
    assert flight.last('ATTITUDE_QUATERNION').time_boot_ms < 1200
    assert flight.kinds().count('LOCAL_POSITION_NED') > 50
    assert flight.controller.parameters[name] == 0.5


def test_a_reboot_in_the_air_brings_it_down():
    flight = Flight(altitude=30.0, faults=[Fault('reboot', 0.5, duration=3.0)])
    flight.fly(2.5)
    assert flight.vehicle.velocity[2] < -8.0


@pytest.mark.parametrize(('arguments', 'complaint'), [
    (['--connect', '0.0.0.0:14540'], 'must be a loopback address'),
    (['--connect', '8.8.8.8:1'], 'must be a loopback address'),
    (['--connect', '14540'], 'must be HOST:PORT'),
    (['--connect', '127.0.0.1:99999'], 'must be HOST:PORT'),
    (['--param', 'GUID_TIMEOUT'], "param = 'GUID_TIMEOUT': must be NAME=NUMBER"),
    (['--param', 'NO=1'], 'NO: must be one of COM_'),
    (['--signing-key-file', '/nowhere'], "signing_key_file = '/nowhere': No such file")])
def test_bad_arguments_are_one_line(arguments, complaint, capsys):
    assert autopilot.main(arguments) == 1
    error = capsys.readouterr().err
    assert complaint in error and error.count('\n') == 1


def test_brake_stops_quickly_and_holds_the_position():
    flight = Flight('arducopter')
    assert flight.mode('GUIDED') == [0]
    flight.fly(2.0, setpoint(1.0, 0.0, 0.3))
    assert flight.vehicle.velocity[0] > 1.5
    assert flight.mode('BRAKE') == [0]
    begun = flight.vehicle.position.copy()
    flight.fly(1.0, setpoint(1.0, 0.0, 0.3))
    assert flight.last_heartbeat().custom_mode == 17
    assert np.linalg.norm(flight.vehicle.velocity) < 0.25
    assert flight.vehicle.position[0] - begun[0] < 0.9
    flight.fly(2.0, setpoint(1.0))
    held = flight.vehicle.position.copy()
    flight.fly(10.0, setpoint(1.0))
    np.testing.assert_allclose(flight.vehicle.position, held, atol=0.05)


def test_brake_is_refused_without_a_position():
    flight = Flight('arducopter', parameters=BLIND['arducopter'])
    still = odometry((0.0, 0.0, 2.0))
    flight.fly(1.5, still, rate=30.0)
    flight.fly(7.5)
    assert flight.mode('BRAKE') == [mavlink.MAV_RESULT_FAILED]
    assert flight.texts()[-1] == 'Mode change to BRAKE failed: requires position'
    assert flight.mode('LAND') == [0]
