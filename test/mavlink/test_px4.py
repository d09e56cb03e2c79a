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

"""The PX4 dialect: masks, signs, modes."""

import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.geometry import wrap_angle, yaw_ned_to_enu
from flock_follower.mavlink.dialects import is_autopilot, PX4
from flock_follower.mavlink.setpoint_rules import encode_setpoint

FINITE = st.floats(-50.0, 50.0)


@pytest.mark.parametrize(('enu', 'ned'), [
    ((1, 0, 0), (0, 1, 0)), ((0, 1, 0), (1, 0, 0)), ((0, 0, 1), (0, 0, -1))],
    ids=['east is y', 'north is x', 'up is minus z'])
def test_accelerations_are_sent_in_ned(enu, ned):
    setpoint = encode_setpoint(enu, 0.0)
    assert (setpoint.afx, setpoint.afy, setpoint.afz) == ned


@pytest.mark.parametrize(('enu', 'ned'), [(0, 90), (90, 0), (180, -90), (-90, 180), (45, 45)],
                         ids=['east', 'north', 'west', 'south', 'north-east'])
def test_yaw_is_sent_clockwise_from_north(enu, ned):
    yaw = encode_setpoint([0, 0, 0], math.radians(enu)).yaw
    assert wrap_angle(yaw - math.radians(ned)) == pytest.approx(0.0, abs=1e-12)


@given(st.tuples(FINITE, FINITE, FINITE), st.floats(-10.0, 10.0))
def test_acceleration_and_yaw_survive_the_way_to_ned_and_back(acceleration, yaw):
    setpoint = encode_setpoint(acceleration, yaw)
    assert (setpoint.afy, setpoint.afx, -setpoint.afz) == acceleration
    assert wrap_angle(yaw_ned_to_enu(setpoint.yaw) - yaw) == pytest.approx(0.0, abs=1e-9)


def test_an_unknown_yaw_is_masked_out():
    assert encode_setpoint([1, 2, 3], None).type_mask == 0xC3F


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_never_encoded(bad):
    with pytest.raises(ValueError, match='must be finite'):
        encode_setpoint([bad, 0, 0], 0.0)
    with pytest.raises(ValueError, match='must be finite'):
        encode_setpoint([0, 0, 0], bad)


@pytest.mark.parametrize('name', PX4.modes)
def test_mode_names_round_trip(name):
    assert PX4.mode_name(PX4.modes[name]) == name


def test_custom_modes_have_the_values_of_px4():
    assert PX4.modes['OFFBOARD'] == 6 << 16
    assert PX4.modes['AUTO.LOITER'] == 4 << 16 | 3 << 24
    assert PX4.mode_name(3 << 16 | 2 << 24) == 'POSCTL'
    assert PX4.mode_name(0) == 'mode 0.0'
    with pytest.raises(ValueError, match="mode = 'FLIP'"):
        PX4.set_mode_parameters('FLIP')


def heartbeat(base_mode=0, custom=0, state=mavlink.MAV_STATE_STANDBY,
              kind=mavlink.MAV_TYPE_QUADROTOR, autopilot=mavlink.MAV_AUTOPILOT_PX4):
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, base_mode, custom, state, 3)


def test_a_heartbeat_tells_arming_mode_and_failsafe():
    status = PX4.status(heartbeat(
        1 | mavlink.MAV_MODE_FLAG_SAFETY_ARMED, 6 << 16, mavlink.MAV_STATE_CRITICAL))
    assert status == (True, 'OFFBOARD', 'critical', True)
    assert PX4.status(heartbeat(1, 3 << 16)) == (False, 'POSCTL', 'standby', False)


def test_gimbals_stations_and_companions_are_no_autopilot():
    assert is_autopilot(heartbeat())
    assert not is_autopilot(heartbeat(kind=mavlink.MAV_TYPE_GIMBAL))
    assert not is_autopilot(heartbeat(kind=mavlink.MAV_TYPE_GCS))
    assert not is_autopilot(heartbeat(autopilot=mavlink.MAV_AUTOPILOT_INVALID))


def test_the_setpoint_packs_as_px4_reads_it():
    message = encode_setpoint(np.array([1.0, 2.0, 0.5]), 0.25, 7, 1, 1)
    data = message.pack(mavlink.MAVLink(None, 1, 191))
    decoded = mavlink.MAVLink(None).parse_buffer(data)[0]
    assert (decoded.type_mask, decoded.coordinate_frame) == (0x83F, 1)
    assert (decoded.afx, decoded.afy, decoded.afz) == (2.0, 1.0, -0.5)
    assert decoded.yaw == pytest.approx(math.pi / 2 - 0.25, abs=1e-6)
