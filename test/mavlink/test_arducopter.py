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

"""The embedded autopilot with ArduCopter's personality, as measured on ArduCopter 4.7."""

import math

from embedded_flight import Flight, MASK, MASK_YAW, setpoint
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

pytestmark = pytest.mark.slow
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
MIXED = [0xD3B, 0x93B]


def guided(**options):
    flight = Flight('arducopter', **options)
    assert flight.mode('GUIDED') == [ACCEPTED]
    return flight


def taken_off(altitude=2.0):
    flight = guided(start='landed')
    assert flight.arm() == [ACCEPTED]
    assert flight.take_off(altitude) == [ACCEPTED]
    flight.fly(6.0)
    return flight


def speed(flight):
    return float(np.linalg.norm(flight.vehicle.velocity))


def test_it_introduces_itself_as_arducopter():
    flight = guided()
    flight.fly(1.5)
    heartbeat = flight.last('HEARTBEAT')
    assert (heartbeat.autopilot, heartbeat.type, heartbeat.custom_mode) == (
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_QUADROTOR, 4)
    assert heartbeat.base_mode == 1 | 128
    assert heartbeat.system_status == mavlink.MAV_STATE_ACTIVE


@pytest.mark.parametrize(('name', 'number'), [
    ('STABILIZE', 0), ('GUIDED', 4), ('LOITER', 5), ('LAND', 9), ('BRAKE', 17)])
def test_modes_have_arducopters_numbers_and_one_ack(name, number):
    flight = Flight('arducopter', start='landed')
    assert flight.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, float(number)) == [ACCEPTED]
    flight.fly(1.1)
    assert (flight.controller.mode, flight.last('HEARTBEAT').custom_mode) == (name, number)


@pytest.mark.parametrize(('params', 'result'), [
    ((1.0, 99.0), FAILED), ((0.0, 4.0), DENIED), ((math.nan, math.nan), DENIED)])
def test_unknown_modes_are_refused(params, result):
    assert Flight('arducopter').command(mavlink.MAV_CMD_DO_SET_MODE, *params) == [result]


def test_from_the_ground_into_the_air_and_down_again():
    flight = taken_off(2.0)
    assert flight.vehicle.position[2] == pytest.approx(2.0, abs=0.15)
    flight.fly(1.0, setpoint(1.0))
    assert flight.vehicle.velocity[0] == pytest.approx(0.85, abs=0.2)
    flight.fly(4.0, setpoint())
    assert flight.mode('LAND') == [ACCEPTED]
    flight.fly(8.0)
    assert flight.vehicle.landed and not flight.controller.armed


def test_on_the_ground_setpoints_do_nothing():
    flight = guided(start='landed')
    assert flight.arm() == [ACCEPTED]
    flight.fly(3.0, setpoint(1.0, up=2.0))
    assert not flight.vehicle.position.any()
    flight.fly(1.0)
    assert flight.last('HEARTBEAT').system_status == mavlink.MAV_STATE_STANDBY


def test_a_setpoint_before_it_has_lifted_off_cancels_the_take_off():
    flight = guided(start='landed')
    flight.arm()
    assert flight.take_off(2.0) == [ACCEPTED]
    flight.fly(4.0, setpoint())
    assert flight.vehicle.landed


@pytest.mark.parametrize('spoil', [
    lambda f: f.arm(False), lambda f: f.mode('LOITER'), lambda f: f.send(setpoint())],
    ids=['disarmed', 'LOITER', ''])
def test_take_off_wants_guided_armed_and_on_the_ground(spoil):
    flight = guided(start='landed')
    flight.arm()
    spoil(flight)
    possible = flight.controller.armed and flight.controller.mode == 'GUIDED'
    assert flight.take_off(2.0) == [ACCEPTED if possible else FAILED]
    assert flight.take_off(-1.0) == flight.take_off(math.nan) == [FAILED]


def test_take_off_in_the_air_is_refused():
    assert guided().take_off(5.0) == [FAILED]


def test_armed_on_the_ground_it_disarms_by_itself():
    flight = guided(start='landed')
    flight.arm()
    flight.fly(9.5)
    assert flight.controller.armed
    flight.fly(1.0)
    assert not flight.controller.armed


def test_arming_waits_for_the_ekf_and_says_so():
    flight = guided(start='landed', ready_after=2.0)
    assert flight.arm() == [FAILED]
    assert flight.texts() == ['Arm: Need Position Estimate']
    flight.fly(1.9)
    assert 'LOCAL_POSITION_NED' not in flight.kinds()
    flight.fly(0.5)
    assert flight.arm() == [ACCEPTED]


def test_stabilize_arms_without_a_position_but_land_never_arms():
    flight = Flight('arducopter', start='landed', ready_after=100.0)
    flight.mode('LAND')
    assert flight.arm() == [FAILED] and flight.texts() == ['Arm: LAND mode not armable']
    flight.mode('STABILIZE')
    assert flight.arm() == [ACCEPTED]
    assert flight.mode('GUIDED') == [FAILED]
    assert flight.texts()[-1] == 'Mode change to GUIDED failed: requires position'


def test_a_reason_not_to_arm_is_given_before_anybody_asks():
    flight = Flight('arducopter', start='landed', arming_denial='Compass not calibrated')
    flight.fly(15.1)
    assert 'PreArm: Compass not calibrated' in flight.texts()
    assert flight.arm() == [FAILED] and flight.texts()[-1] == 'Arm: Compass not calibrated'


def test_disarming_in_the_air_is_refused_unless_forced():
    flight = guided()
    assert flight.arm(False) == [FAILED] and flight.texts() == []
    assert flight.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196.0) == [ACCEPTED]
    flight.fly(0.5)
    assert flight.vehicle.velocity[2] < -2.0


def test_no_speed_limit_applies_to_accelerations():
    flight = guided()
    flight.fly(10.0, setpoint(1.0))
    assert flight.vehicle.velocity[0] > 8.0


@pytest.mark.parametrize('mask', [MASK, MASK_YAW])
def test_vertical_acceleration_zero_keeps_the_height(mask):
    flight = guided()
    flight.fly(15.0, setpoint(mask=mask))
    assert flight.vehicle.position[2] == pytest.approx(2.0, abs=0.05)


def test_yaw_is_followed_where_it_is_given():
    flight = guided()
    flight.fly(4.0, setpoint(yaw=1.5))
    assert flight.vehicle.yaw == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize('refused', [
    *({'mask': mask} for mask in MIXED), {'mask': MASK_YAW | 512}, {'mask': 0xFFF}, {'frame': 12},
    {'mask': 0xDF8}],
    ids=['mixed', 'mixed with yaw', 'force', 'nothing', 'frame', 'position'])
def test_setpoints_it_cannot_fly_stop_it_without_a_word(refused):
    flight = guided()
    flight.fly(2.0, setpoint(1.0))
    assert speed(flight) > 1.0
    flight.fly(4.0, setpoint(**{'east': 1.0, 'position_up': 5.0, **refused}))
    assert speed(flight) < 0.1 and flight.controller.mode == 'GUIDED'
    assert flight.vehicle.position[2] == pytest.approx(2.0, abs=0.1)
    assert flight.texts() == []


@pytest.mark.parametrize('bit', range(6, 9))
def test_one_ignored_axis_ignores_the_accelerations(bit):
    flight = guided()
    flight.fly(2.0, setpoint(1.0, mask=MASK_YAW | 1 << bit))
    assert speed(flight) < 0.05


@pytest.mark.parametrize(('parameters', 'timeout'), [({}, 3.0), ({'GUID_TIMEOUT': 0.5}, 0.5)])
def test_it_keeps_accelerating_for_guid_timeout_then_stops_and_stays_in_guided(
        parameters, timeout):
    flight = guided(parameters=parameters)
    flight.fly(1.0, setpoint(1.0))
    before = flight.vehicle.velocity[0]
    flight.fly(timeout - 0.05)
    assert flight.vehicle.velocity[0] == pytest.approx(before + timeout, abs=0.4)
    flight.fly(4.0)
    assert speed(flight) < 0.2 and flight.controller.mode == 'GUIDED'


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_nan_is_obeyed_and_brings_it_down(bad):
    flight = guided(altitude=20.0)
    flight.fly(0.1, setpoint(bad))
    flight.fly(1.0, setpoint(0.0))
    assert flight.vehicle.velocity[2] < -4.0


def test_setpoints_count_in_guided_only():
    flight = Flight('arducopter')
    flight.fly(3.0, setpoint(1.0))
    assert speed(flight) < 0.05 and flight.controller.mode == 'LOITER'


@pytest.mark.parametrize('mode', ['LOITER', 'BRAKE'])
def test_leaving_guided_stops_it(mode):
    flight = guided()
    flight.fly(2.0, setpoint(1.0))
    assert flight.mode(mode) == [ACCEPTED]
    flight.fly(5.0, setpoint(1.0))
    assert speed(flight) < 0.1


@pytest.mark.parametrize(('command', 'mode'), [
    (mavlink.MAV_CMD_NAV_LAND, 'LAND'), (mavlink.MAV_CMD_NAV_LOITER_UNLIM, 'LOITER')])
def test_modes_are_commands_too(command, mode):
    flight = guided()
    assert flight.command(command) == [ACCEPTED] and flight.controller.mode == mode


def test_other_commands_are_unsupported():
    assert guided().command(mavlink.MAV_CMD_DO_PARACHUTE) == [UNSUPPORTED]


def test_equal_inputs_give_bit_identical_flights():
    flights = [guided(), guided()]
    for flight in flights:
        flight.fly(3.0, setpoint(0.7, -0.2, 0.1))
    assert flights[0].vehicle.position.tobytes() == flights[1].vehicle.position.tobytes()
