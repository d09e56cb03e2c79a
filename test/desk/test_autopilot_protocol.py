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

"""The embedded autopilot's parameters, clock, take-off, external vision and what they lead to."""

import math
import struct

from embedded_flight import BLIND, Flight, odometry, seen, setpoint
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.vehicles.embedded import EmbeddedAutopilot

pytestmark = pytest.mark.slow
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])


def ask(flight, name):
    answers = flight.send(
        mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    return [m for m in answers if m.get_type() == 'PARAM_VALUE']


@pytest.mark.parametrize(('personality', 'name', 'kind', 'value'), [
    ('px4', 'COM_OF_LOSS_T', 9, 1.0), ('px4', 'EKF2_GPS_CTRL', 6, 7),
    ('arducopter', 'GUID_TIMEOUT', 9, 3.0), ('arducopter', 'EK3_SRC1_POSXY', 2, 3),
    ('arducopter', 'GUID_OPTIONS', 6, 0)])
def test_a_parameter_is_read_by_name_in_the_encoding_of_its_autopilot(
        personality, name, kind, value):
    answer, = ask(Flight(personality), name)
    encoded = answer.param_value
    if personality == 'px4' and kind == 6:
        encoded = struct.unpack('<i', struct.pack('<f', encoded))[0]
    assert (answer.param_id, answer.param_type, encoded) == (name, kind, value)


def test_a_parameter_can_be_set_and_takes_effect():
    flight = Flight('arducopter')
    answers = flight.send(mavlink.MAVLink_param_set_message(1, 1, b'GUID_TIMEOUT', 0.5, 9))
    assert [m.param_value for m in answers] == [0.5]
    answers = flight.send(mavlink.MAVLink_param_set_message(1, 1, b'GUID_TIMEOUT', math.nan, 9))
    assert [m.param_value for m in answers] == [0.5]
    flight.mode('GUIDED')
    flight.fly(1.0, setpoint(1.0))
    flight.fly(2.5)
    assert np.linalg.norm(flight.vehicle.velocity) < 0.1


@pytest.mark.parametrize(('options', 'message'), [
    ({'personality': 'betaflight'}, "personality = 'betaflight': must be one of px4, arducopter"),
    ({'start': 'diving'}, "start = 'diving': must be one of airborne, armed, landed"),
    ({'system_id': 0}, 'system_id = 0: must be an integer in [1, 255]'),
    ({'parameters': {'GUID_TIMEOUT': 1.0}}, 'GUID_TIMEOUT: must be one of COM_DISARM_LAND, '),
    ({'parameters': {'COM_OBL_RC_ACT': 1.5}}, 'COM_OBL_RC_ACT = 1.5: must be an integer in '),
    ({'parameters': {'COM_OF_LOSS_T': math.inf}}, 'COM_OF_LOSS_T = inf: must be a finite number')])
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError) as error:
        EmbeddedAutopilot(now=0.0, **options)
    assert str(error.value).startswith(message)


@BOTH
def test_the_landed_state_tells_a_flight(personality):
    flight = Flight(personality, start='landed')
    assert flight.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 245.0, 1e5) == [0]
    if personality == 'arducopter':
        flight.mode('GUIDED')
    flight.arm()
    flight.take_off(2.5 if personality == 'arducopter' else math.nan)
    flight.fly(12.0)
    flight.command(mavlink.MAV_CMD_NAV_LAND)
    flight.fly(12.0)
    states = [m.landed_state for m in flight.messages if m.get_type() == 'EXTENDED_SYS_STATE']
    changes = [b for a, b in zip([0, *states], states) if a != b]
    assert changes == [1, 3, 2, 4, 1]


def test_px4_takes_the_altitude_as_above_sea_level_and_raises_what_is_too_low():
    flight = Flight(start='landed')
    flight.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 33.0)
    flight.take_off(flight.last('GLOBAL_POSITION_INT').alt * 1e-3 + 4.0)
    flight.arm()
    flight.fly(12.0)
    assert flight.vehicle.position[2] == pytest.approx(4.0, abs=0.2)
    flight = Flight(start='landed')
    flight.take_off(4.0)
    flight.arm()
    flight.fly(12.0)
    assert flight.vehicle.position[2] == pytest.approx(2.5, abs=0.2)


@pytest.mark.parametrize(('action', 'mode'), [
    (0, 'POSCTL'), (4, 'AUTO.LAND'), (5, 'AUTO.LOITER')])
def test_px4_does_what_its_parameters_say_when_the_stream_stops(action, mode):
    timeout = 0.5
    flight = Flight(parameters={'COM_OBL_RC_ACT': action, 'COM_OF_LOSS_T': timeout})
    flight.fly(1.2, setpoint())
    flight.mode('OFFBOARD')
    flight.fly(timeout - 0.1)
    assert flight.controller.mode == 'OFFBOARD'
    flight.fly(0.3)
    assert (flight.controller.mode, flight.controller.armed) == (mode, True)


@pytest.mark.parametrize(('personality', 'options', 'used'), [
    ('px4', {'frame': mavlink.MAV_FRAME_LOCAL_NED}, True), ('px4', {}, True),
    ('px4', {'variance': math.nan}, False), ('px4', {'variance': 0.0}, False),
    ('px4', {'child': mavlink.MAV_FRAME_LOCAL_FRD}, False),
    ('px4', {'frame': mavlink.MAV_FRAME_BODY_FRD}, False),
    ('arducopter', {}, True), ('arducopter', {'variance': math.nan}, True),
    ('arducopter', {'frame': mavlink.MAV_FRAME_LOCAL_NED}, False),
    ('arducopter', {'child': mavlink.MAV_FRAME_BODY_NED}, False)])
def test_odometry_counts_only_in_the_frames_the_autopilot_wants(personality, options, used):
    flight = Flight(personality, start='landed', parameters=BLIND[personality])
    flight.fly(1.0, seen(flight, **options))
    # PX4 sends it whether it knows anything or not.
    assert ('LOCAL_POSITION_NED' in flight.kinds()) == (used or personality == 'px4')
    if personality == 'arducopter':
        flight.mode('GUIDED')
    else:
        flight.take_off(math.nan)
    assert (flight.arm() == [0]) == used


@BOTH
def test_the_estimate_follows_the_vision_even_where_it_is_wrong(personality):
    flight = Flight(personality, parameters=BLIND[personality])
    flight.fly(3.0, seen(flight, error=np.array([3.0, 0.0, 0.5]), yaw_error=0.5), rate=30.0)
    position = flight.last('LOCAL_POSITION_NED')
    truth = flight.vehicle.position
    assert position.y == pytest.approx(truth[0] + 3.0, abs=0.1)
    assert -position.z == pytest.approx(truth[2] + 0.5, abs=0.1)
    attitude = flight.last('ATTITUDE_QUATERNION')
    assert 2 * math.atan2(attitude.q4, attitude.q1) == pytest.approx(
        math.pi / 2 - flight.vehicle.yaw - 0.5, abs=0.05)


def test_a_jump_is_an_outlier_unless_the_reset_counter_announces_it():
    flight = Flight(parameters=BLIND['px4'])
    flight.fly(1.0, seen(flight), rate=30.0)
    away = np.array([5.0, 0.0, 0.0])
    flight.fly(0.5, seen(flight, error=away), rate=30.0)
    assert abs(flight.last('LOCAL_POSITION_NED').y) < 0.5
    flight.fly(0.2, seen(flight, error=away, reset_counter=1), rate=30.0)
    assert flight.last('LOCAL_POSITION_NED').y == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize(('personality', 'synchronised', 'age', 'used'), [
    ('px4', True, 0.05, True), ('px4', True, 0.5, False), ('px4', True, -1.0, False),
    ('px4', False, 0.5, True), ('arducopter', True, 0.5, True)])
def test_px4_uses_no_vision_that_is_old_by_the_clock_it_has_learnt(
        personality, synchronised, age, used):
    flight = Flight(personality, start='landed', parameters=BLIND[personality])
    flight.fly(0.01)
    question = flight.last('TIMESYNC')
    assert question.tc1 == 0
    if synchronised:  # our clock is 1000 s ahead of the autopilot's
        flight.send(mavlink.MAVLink_timesync_message(
            round((1000.0 + flight.now) * 1e9), question.ts1))
    flight.fly(0.5, lambda: odometry((0.0, 0.0, 0.0), time=1000.0 + flight.now - age))
    assert flight.controller.position_known(flight.now) == used


def test_px4_stays_in_offboard_without_vision_and_drifts_metres():
    flight = Flight(parameters=BLIND['px4'])
    flight.fly(1.2, seen(flight), setpoint(mask=0xDF8))
    assert flight.mode('OFFBOARD') == [0, 0]
    flight.fly(12.0, setpoint(mask=0xDF8))
    assert flight.controller.mode == 'OFFBOARD'
    assert 5.0 < np.linalg.norm(flight.vehicle.position[:2]) < 12.0
    assert abs(flight.last('LOCAL_POSITION_NED').y) < 0.3  # it goes on, and shows none of it


def test_arducopter_lands_when_its_ekf_has_had_no_vision_for_seconds():
    flight = Flight('arducopter', parameters=BLIND['arducopter'])
    flight.fly(1.0, seen(flight))
    flight.mode('GUIDED')
    flight.fly(7.0, setpoint())
    assert flight.controller.mode == 'GUIDED'
    flight.fly(2.0, setpoint())
    assert flight.controller.mode == 'LAND'
    assert flight.texts()[-1] == 'EKF Failsafe: changed to LAND Mode'
    assert flight.last('HEARTBEAT').system_status == mavlink.MAV_STATE_CRITICAL
    flight.fly(8.0)
    assert flight.vehicle.landed and not flight.controller.armed


def test_arducopter_clears_its_failsafe_when_vision_comes_back():
    flight = Flight('arducopter', altitude=20.0, parameters=BLIND['arducopter'])
    flight.fly(1.0, seen(flight))
    flight.mode('GUIDED')
    flight.fly(9.0, setpoint())
    flight.fly(0.5, seen(flight, reset_counter=1))
    assert flight.controller.mode == 'LAND' and not flight.controller.in_failsafe
