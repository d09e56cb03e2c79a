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

"""The embedded autopilots: modes, setpoints, answers, parameters, reboots, the command."""

import math
import os
import signal
import socket
import struct
import subprocess
import sys

from embedded_flight import BLIND, Flight, MASK_YAW, seen, setpoint
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk import autopilot
from flock_desk.vehicles.embedded import EmbeddedAutopilot, STEP_TIME
from flock_desk.vehicles.profiles import PX4
from flock_desk.vehicles.quadrotor import Quadrotor
from flock_follower.geometry import GRAVITY

pytestmark = pytest.mark.slow
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])
ORIGIN = mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85455940, 488000)


def offboard(flight, message):
    flight.fly(1.1, message)
    assert flight.mode('OFFBOARD') == [0, 0]


def state(flight):
    return flight.controller.mode, flight.controller.in_failsafe


def test_vehicle_tilts_with_acceleration_after_attitude_lag():
    vehicle, tilts = Quadrotor((0, 0, 2), yaw=math.pi / 2), []
    vehicle.steer([1.0, 0.0, 0.0], math.pi / 2)
    for _ in range(100):
        vehicle.step(STEP_TIME)
        tilts.append(math.asin(vehicle.rotation[0, 2]))
    wanted = math.atan(1.0 / GRAVITY)
    assert [tilts[14], tilts[-1]] == pytest.approx([wanted * (1 - math.exp(-1)), wanted], rel=0.01)
    # Facing north, leaning east is a right roll: its left side points up.
    assert vehicle.rotation[2, 1] > 0.05 and abs(vehicle.rotation[2, 0]) < 1e-9


def test_wind_pushes_the_vehicle_and_the_hover_thrust_errs():
    vehicle = Quadrotor((0, 0, 50))
    for _ in range(100):
        vehicle.step(STEP_TIME, wind=[5.0, 0.0, 0.0])
    gained = 1.0 - math.exp(-0.1)  # drag of 0.1 1/s, for 1 s
    assert vehicle.velocity == pytest.approx([5.0 * gained, 0.0, 0.08 * gained], rel=0.01)


# PX4.


@pytest.mark.parametrize(('wait', 'loss_time', 'result'), [
    (0.9, 1.0, 0), (1.1, 1.0, 1), (0.4, 0.5, 0), (0.6, 0.5, 1)])
def test_offboard_needs_one_setpoint_that_is_not_too_old(wait, loss_time, result):
    flight = Flight(parameters={'COM_OF_LOSS_T': loss_time})
    flight.send(setpoint())
    flight.fly(wait)
    assert flight.mode('OFFBOARD') == [0, result]


@pytest.mark.parametrize('dropped', [
    {'east': math.nan}, {'mask': MASK_YAW | 512}, {'mask': 0xFFF}, {'frame': 8}, {'target': 9}],
    ids=['NaN', 'force', 'nothing', 'body frame', 'other vehicle'])
def test_setpoints_px4_would_drop_do_not_count_as_a_stream(dropped):
    flight = Flight()
    flight.fly(1.2, setpoint(**{'east': 1.0, **dropped}))
    assert flight.mode('OFFBOARD') == [0, 1]


def test_disarmed_any_mode_may_be_chosen_arming_needs_stream():
    flight = Flight(start='landed')
    assert flight.mode('OFFBOARD') == [0, 0] and flight.arm() == [1]
    assert flight.controller.system_status == mavlink.MAV_STATE_UNINIT
    flight.send(setpoint())
    assert flight.controller.system_status == mavlink.MAV_STATE_STANDBY
    assert flight.arm() == [0] and flight.controller.mode == 'OFFBOARD'
    assert flight.arm(False) == [0] and flight.mode('AUTO.LAND') == [0, 0]
    assert flight.arm() == [1] and flight.controller.mode == 'AUTO.LAND'


def test_mode_from_before_is_back_after_landing_without_arming():
    flight = Flight()
    offboard(flight, setpoint())
    assert flight.mode('AUTO.LAND') == [0, 0]
    flight.fly(8.0)
    assert (flight.controller.mode, flight.controller.armed) == ('OFFBOARD', False)
    assert flight.arm() == [1]
    assert flight.take_off(math.nan) == [0] and flight.arm() == [0]


@pytest.mark.parametrize(('action', 'mode'), [
    (0, 'POSCTL'), (4, 'AUTO.LAND'), (5, 'AUTO.LOITER')])
def test_the_last_setpoint_is_kept_until_the_stream_is_lost(action, mode):
    flight = Flight(parameters={'COM_OBL_RC_ACT': action})
    offboard(flight, setpoint(1.0))
    before = flight.vehicle.velocity[0]
    flight.fly(0.9)
    assert flight.controller.mode == 'OFFBOARD'
    assert flight.vehicle.velocity[0] == pytest.approx(before + 0.9, abs=0.2)
    flight.fly(0.3)
    assert state(flight) == (mode, True) and flight.controller.chosen == 'OFFBOARD'
    if mode == 'POSCTL':  # without sticks it descends
        flight.fly(8.0)
        assert not flight.controller.armed and flight.vehicle.landed


def test_setpoints_end_failsafe_and_chosen_mode_ends_it_for_good():
    flight = Flight(parameters={'COM_OBL_RC_ACT': 5})
    offboard(flight, setpoint())
    flight.fly(1.5)
    flight.fly(0.1, setpoint())
    assert state(flight) == ('OFFBOARD', False)
    flight.fly(1.5)
    assert flight.mode('AUTO.LOITER') == [0, 0]
    flight.fly(1.0, setpoint())
    assert state(flight) == ('AUTO.LOITER', False)


def aloft():
    """Return a PX4 without GPS and origin that has just taken off."""
    flight = Flight(start='landed', parameters=BLIND['px4'])
    flight.fly(1.0, seen(flight))
    assert flight.arm() == [1]  # in Hold, which it cannot fly
    assert flight.take_off(np.nan) == [0] and flight.arm() == [0]
    flight.fly(8.0, seen(flight), rate=30.0)
    return flight


def test_px4_without_origin_stays_in_take_off_until_it_has_one():
    flight = aloft()
    assert flight.controller.mode == 'AUTO.TAKEOFF'
    assert flight.vehicle.position[2] == pytest.approx(2.5, abs=0.15)
    assert flight.mode('AUTO.LOITER') == [0, 1] and flight.mode('POSCTL') == [0, 1]
    assert not flight.all('HOME_POSITION')
    assert not flight.send(ORIGIN)
    answers = flight.send(mavlink.MAVLink_command_long_message(
        1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        0, 0, 0, 0, 0, 0))
    assert [m.get_type() for m in answers] == ['GPS_GLOBAL_ORIGIN', 'COMMAND_ACK']
    flight.fly(0.1, seen(flight))
    assert flight.controller.mode == 'AUTO.LOITER'


def test_px4_without_position_falls_back_to_a_flyable_mode():
    flight = aloft()
    flight.send(setpoint())
    flight.mode('OFFBOARD')
    flight.fly(7.0, setpoint())  # the vision is gone, and with it the position
    assert flight.controller.mode == 'OFFBOARD'
    flight.fly(1.2)
    assert state(flight) == ('ALTCTL', True)
    flight.controller.parameters.set('COM_OBL_RC_ACT', 5)
    flight.fly(0.1)
    assert state(flight) == ('AUTO.LAND', True)
    flight.fly(0.1, setpoint())
    assert state(flight) == ('OFFBOARD', False)


@pytest.mark.parametrize(('rate', 'least', 'most'), [(50.0, 0.01, 0.03), (5.0, 0.1, 0.25)])
def test_px4_shows_a_change_of_the_mode_in_its_stream(rate, least, most):
    flight = Flight()
    flight.ask('CURRENT_MODE', rate)
    flight.fly(3.03)
    assert len(flight.all('CURRENT_MODE')) == 7  # twice a second while the mode stays
    flight.mode('AUTO.LAND')
    changed = flight.now
    while flight.last('CURRENT_MODE').custom_mode != PX4.modes['AUTO.LAND'].number:
        assert flight.now < changed + 5.0, 'no CURRENT_MODE shows AUTO.LAND'
        flight.fly(0.01)
    assert least <= round(flight.now - changed, 3) <= most


@pytest.mark.parametrize(('above_home', 'reached'), [(4.0, 4.0), (-400.0, 2.5)])
def test_px4_altitude_is_above_sea_and_raised_if_too_low(
        above_home, reached):
    flight = Flight(start='landed')
    flight.ask('GLOBAL_POSITION_INT')
    flight.fly(0.1)
    flight.take_off(flight.last('GLOBAL_POSITION_INT').alt * 1e-3 + above_home)
    flight.arm()
    flight.fly(12.0)
    assert flight.vehicle.position[2] == pytest.approx(reached, abs=0.2)


# ArduCopter.


def test_arducopter_says_why_it_does_not_arm_and_stays_in_land():
    flight = Flight('arducopter', start='landed', arming_denial='Compass not calibrated')
    assert flight.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS) == [0]
    assert flight.texts() == ['PreArm: Compass not calibrated']
    flight = Flight('arducopter')
    assert flight.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS) == [1] and flight.texts() == []
    flight.mode('LAND')
    flight.fly(8.0)
    assert (flight.controller.mode, flight.controller.armed) == ('LAND', False)
    assert flight.arm() == [4] and flight.texts()[-1] == 'Arm: LAND mode not armable'
    assert flight.mode('GUIDED') == [0] and flight.arm() == [0]


def test_arducopter_obeys_nan_and_falls():
    flight = Flight('arducopter', altitude=20.0)
    flight.mode('GUIDED')
    flight.fly(1.0, setpoint(math.nan))
    assert flight.vehicle.velocity[2] < -5.0


def test_brake_holds_the_position_and_is_refused_without_one():
    flight = Flight('arducopter')
    flight.mode('GUIDED')
    flight.fly(2.0, setpoint(1.0, 0.0, 0.3))
    assert flight.mode('BRAKE') == [0]
    flight.fly(16.0, setpoint(1.0))
    assert np.linalg.norm(flight.vehicle.velocity) < 0.01
    blind = Flight('arducopter', parameters=BLIND['arducopter'])
    blind.fly(7.5)
    assert blind.mode('BRAKE') == [mavlink.MAV_RESULT_FAILED] and blind.mode('LAND') == [0]
    assert blind.texts()[-1] == 'Mode change to BRAKE failed: requires position'


# Both.


@BOTH
def test_the_landed_state_shows_a_flight(personality):
    flight = Flight(personality, start='landed')
    assert flight.ask('EXTENDED_SYS_STATE') == [0]
    if personality == 'arducopter':
        flight.mode('GUIDED')
    flight.arm()
    flight.take_off(2.5 if personality == 'arducopter' else math.nan)
    flight.fly(12.0)
    flight.mode('LAND' if personality == 'arducopter' else 'AUTO.LAND')
    flight.fly(12.0)
    states = [m.landed_state for m in flight.all('EXTENDED_SYS_STATE')]
    assert [b for a, b in zip([0, *states], states) if a != b] == [1, 3, 2, 4, 1]


@pytest.mark.parametrize(('personality', 'message', 'result'), [
    ('px4', 'HEARTBEAT', 4), ('px4', 'EKF_STATUS_REPORT', 4), ('arducopter', 'CURRENT_MODE', 2)])
def test_message_rate_is_refused_as_by_real_autopilot(
        personality, message, result):
    assert Flight(personality).ask(message) == [result]


@pytest.mark.parametrize(('personality', 'name', 'kind', 'value'), [
    ('px4', 'COM_OF_LOSS_T', 9, 1.0), ('px4', 'EKF2_GPS_CTRL', 6, 7),
    ('arducopter', 'GUID_TIMEOUT', 9, 3.0), ('arducopter', 'EK3_SRC1_POSXY', 2, 3)])
def test_a_parameter_is_read_in_the_encoding_of_its_autopilot(personality, name, kind, value):
    answer, = Flight(personality).send(mavlink.MAVLink_param_request_read_message(
        1, 1, name.encode(), -1))
    encoded = answer.param_value
    if personality == 'px4' and kind == 6:
        encoded = struct.unpack('<i', struct.pack('<f', encoded))[0]
    assert (answer.param_id, answer.param_type, encoded) == (name, kind, value)


VERSION = float(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
MISSING = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST


def named(answers):
    """Return the type of each answer, and the parameter that it is about."""
    return [(m.get_type(), m.param_id) for m in answers]


@pytest.mark.parametrize(('personality', 'options', 'version'), [
    ('px4', {}, 0x011000FF), ('px4', {'version': '1.18'}, 0x011200FF),
    ('arducopter', {}, 0x040700FF)])
def test_the_version_of_the_firmware_is_reported_on_request(personality, options, version):
    flight = Flight(personality, **options)
    assert flight.command(mavlink.MAV_CMD_REQUEST_MESSAGE, VERSION) == [0]
    assert flight.last('AUTOPILOT_VERSION').flight_sw_version == version
    assert flight.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 9999.0) != [0]


@pytest.mark.parametrize(('version', 'name', 'answer'), [
    ('1.16', 'COM_RC_OVERRIDE', 'PARAM_VALUE'), ('1.16', 'MAN_OVERRIDE_SPD', None),
    ('1.18', 'COM_RC_OVERRIDE', 'PARAM_ERROR'), ('1.18', 'MPC_USE_HTE', 'PARAM_ERROR'),
    ('1.18', 'MAN_OVERRIDE_SPD', 'PARAM_VALUE')])
def test_the_version_decides_which_parameters_exist(version, name, answer):
    answers = Flight(version=version).send(
        mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    assert named(answers) == ([(answer, name)] if answer else [])
    assert [m.error for m in answers if m.get_type() == 'PARAM_ERROR'] == [MISSING] * (
        answer == 'PARAM_ERROR')


@BOTH
def test_a_reboot_is_silent_forgets_and_starts_its_clock_anew(personality):
    flight = Flight(personality, start='landed', parameters={},
                    faults=[Fault('reboot', 3.0, duration=2.0)])
    flight.fly(1.0)
    assert flight.ask('LOCAL_POSITION_NED', 1.0) == [0] and flight.arm() == [0]
    flight.fly(2.0)
    flight.messages.clear()
    flight.fly(1.98, setpoint())
    assert flight.messages == [] and flight.arm() == []
    flight.fly(1.1)
    assert not flight.controller.armed
    assert flight.last('ATTITUDE_QUATERNION').time_boot_ms < 1200
    assert len(flight.all('LOCAL_POSITION_NED')) > 50


def test_a_reboot_in_the_air_brings_it_down():
    flight = Flight(altitude=30.0, faults=[Fault('reboot', 0.5, duration=3.0)])
    flight.fly(2.5)
    assert flight.vehicle.velocity[2] < -8.0


@pytest.mark.parametrize(('parameters', 'message'), [
    ({'GUID_TIMEOUT': 1.0}, 'GUID_TIMEOUT: must be one of COM_DISARM_LAND, '),
    ({'COM_OBL_RC_ACT': 1.5}, 'COM_OBL_RC_ACT = 1.5: must be an integer in '),
    ({'COM_OF_LOSS_T': math.inf}, 'COM_OF_LOSS_T = inf: must be a finite number')])
def test_bad_parameters_are_named(parameters, message):
    with pytest.raises(ValueError, match=f'^{message}'):
        EmbeddedAutopilot(now=0.0, parameters=parameters)


# The command.


@pytest.mark.parametrize(('arguments', 'complaint'), [
    (['--connect', '8.8.8.8:1'], 'must be a loopback address'),
    (['--connect', '127.0.0.1:99999'], 'must be HOST:PORT'),
    (['--firmware', '1.17'], "version = '1.17': must be one of 1.16, 1.18"),
    (['--param', 'GUID_TIMEOUT'], "param = 'GUID_TIMEOUT': must be NAME=NUMBER")])
def test_bad_arguments_are_one_line(arguments, complaint, capsys):
    assert autopilot.main(arguments) == 1
    error = capsys.readouterr().err
    assert complaint in error and error.count('\n') == 1


@pytest.mark.parametrize(('personality', 'version', 'file', 'name'), [
    ('px4', '1.16', 'config/px4.params', 'COM_OF_LOSS_T'),
    ('px4', '1.18', 'config/px4.params', 'COM_OF_LOSS_T'),
    ('arducopter', '4.7', 'config/ardupilot.parm', 'GUID_TIMEOUT')])
def test_the_recommended_parameters_can_be_set_from_their_file(personality, version, file, name):
    options = autopilot.parser().parse_args(
        ['--personality', personality, '--firmware', version, '--param-file', file])
    parameters = autopilot.settings(options)['parameters']
    options.param = [f'{name}=0.25']
    changed = autopilot.settings(options)['parameters']
    assert (parameters[name], changed[name]) == (0.5, 0.25)
    assert 'EKF2_GPS_CTRL' not in parameters
    Flight(personality, parameters=parameters, version=version)


@pytest.mark.ros
def test_the_process_flies_logs_and_stops_cleanly(tmp_path):
    log, codec = tmp_path / 'flight.npz', mavlink.MAVLink(None, 1, 191)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bridge:
        bridge.bind(('127.0.0.1', 0))
        bridge.settimeout(10.0)
        with subprocess.Popen(
                [sys.executable, '-m', 'flock_desk.autopilot', '--connect',
                 f'127.0.0.1:{bridge.getsockname()[1]}', '--yaw', '90', '--log', str(log)],
                stderr=subprocess.PIPE, text=True, env=os.environ) as process:
            data, vehicle = bridge.recvfrom(4096)
            bridge.sendto(setpoint(0.5).pack(codec), vehicle)
            for _ in range(30):
                data += bridge.recv(4096)
            process.send_signal(signal.SIGTERM)
            assert (process.wait(timeout=5.0), process.stderr.read()) == (0, '')
    kinds = [m.get_type() for m in codec.parse_buffer(data)]
    assert kinds[0] == 'HEARTBEAT' and {'LOCAL_POSITION_NED', 'ATTITUDE_QUATERNION'} <= {*kinds}
    with np.load(log) as logged:
        assert (logged['yaw'][0], logged['mode'][0]) == (pytest.approx(math.pi / 2), 'AUTO.LOITER')
        np.testing.assert_allclose(logged['position'][-1], [0, 0, 2], atol=0.1)
        np.testing.assert_allclose(logged['setpoint_acceleration'], [[0.5, 0, 0]])
