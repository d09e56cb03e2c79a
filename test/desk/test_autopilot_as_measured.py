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

"""What the embedded autopilots learnt from the real ones, see docs/autopilots.md."""

from embedded_flight import BLIND, Flight, seen, setpoint
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk import autopilot

pytestmark = pytest.mark.slow
ORIGIN = mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85455940, 488000)


def aloft():
    """Return a PX4 without GPS and origin that has just taken off."""
    flight = Flight(start='landed', parameters=BLIND['px4'])
    flight.fly(1.0, seen(flight))
    assert flight.arm() == [1]  # in Hold, which it cannot fly
    assert flight.take_off(np.nan) == [0] and flight.arm() == [0]
    flight.fly(8.0, seen(flight), rate=30.0)
    return flight


def test_px4_without_an_origin_has_no_hold_and_stays_in_its_takeoff():
    flight = aloft()
    assert flight.controller.mode == 'AUTO.TAKEOFF'
    assert flight.vehicle.position[2] == pytest.approx(2.5, abs=0.15)
    assert flight.mode('AUTO.LOITER') == [0, 1] and flight.mode('POSCTL') == [0, 1]
    flight.send(setpoint())
    assert flight.mode('OFFBOARD') == [0, 0] and flight.mode('AUTO.LOITER') == [0, 1]
    assert flight.controller.mode == 'OFFBOARD'
    assert flight.mode('AUTO.LAND') == [0, 0]


def test_an_origin_cures_it():
    flight = aloft()
    answers = flight.send(ORIGIN)
    assert [m.get_type() for m in answers] == ['GPS_GLOBAL_ORIGIN']
    flight.fly(0.1, seen(flight))
    assert flight.controller.mode == 'AUTO.LOITER'
    flight.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 33.0)
    assert flight.last('GLOBAL_POSITION_INT').lat == pytest.approx(473977420, abs=100)


def test_px4_without_a_position_falls_back_until_something_can_be_flown():
    flight = aloft()
    flight.send(setpoint())
    flight.mode('OFFBOARD')
    flight.fly(7.0, setpoint())  # the vision is gone, and with it the position
    assert flight.controller.mode == 'OFFBOARD'
    flight.fly(1.2)
    assert (flight.controller.mode, flight.controller.in_failsafe) == ('ALTCTL', True)
    flight.send(mavlink.MAVLink_param_set_message(
        1, 1, b'COM_OBL_RC_ACT', 5 * 2.0**-149, 6))
    flight.fly(0.1)
    assert (flight.controller.mode, flight.controller.in_failsafe) == ('AUTO.LAND', True)
    flight.fly(0.1, setpoint())
    assert (flight.controller.mode, flight.controller.in_failsafe) == ('OFFBOARD', False)
    flight.command(mavlink.MAV_CMD_NAV_LAND)
    assert flight.controller.mode == 'AUTO.LAND'


@pytest.mark.parametrize(('armed', 'result', 'said'), [
    (False, 0, ['PreArm: Compass not calibrated']), (True, 1, [])])
def test_arducopter_says_what_its_checks_find(armed, result, said):
    flight = Flight('arducopter', start='armed' if armed else 'landed',
                    arming_denial='Compass not calibrated')
    assert flight.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS) == [result]
    assert flight.texts() == said


def test_arducopter_stays_in_land_which_does_not_arm():
    flight = Flight('arducopter')
    flight.mode('LAND')
    flight.fly(8.0)
    assert (flight.controller.mode, flight.controller.armed) == ('LAND', False)
    assert flight.arm() == [4] and flight.texts()[-1] == 'Arm: LAND mode not armable'
    assert flight.mode('GUIDED') == [0] and flight.arm() == [0]


@pytest.mark.parametrize(('personality', 'result'), [('px4', 4), ('arducopter', 2)])
def test_what_it_does_not_send_is_refused_as_the_real_one_refuses_it(personality, result):
    flight = Flight(personality)
    unknown = 193.0 if personality == 'px4' else 230.0
    assert flight.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, unknown, 1e5) == [result]


@pytest.mark.parametrize(('personality', 'bit'), [('px4', 0x10004000), ('arducopter', 0x10004000)])
def test_the_system_status_shows_what_is_not_well(personality, bit):
    fit = Flight(personality)
    fit.fly(0.5)
    assert fit.last('SYS_STATUS').onboard_control_sensors_health & bit == bit
    unfit = Flight(personality, start='landed', ready_after=60.0)
    unfit.mode('GUIDED' if personality == 'arducopter' else 'AUTO.LOITER')
    unfit.fly(1.5)
    assert unfit.last('SYS_STATUS').onboard_control_sensors_health & bit == 0


@pytest.mark.parametrize(('personality', 'name', 'value'), [
    ('px4', 'COM_OF_LOSS_T', 0.5), ('arducopter', 'GUID_TIMEOUT', 0.5)])
def test_the_recommended_parameters_can_be_set_from_their_file(personality, name, value):
    file = 'config/px4.params' if personality == 'px4' else 'config/ardupilot.parm'
    options = autopilot.parser().parse_args([
        '--personality', personality, '--param-file', file, '--param', f'{name}=0.25'])
    assert autopilot.settings(options)['parameters'][name] == 0.25
    options.param = []
    parameters = autopilot.settings(options)['parameters']
    assert parameters[name] == value and 'EKF2_GPS_CTRL' not in parameters
    Flight(personality, parameters=parameters)
