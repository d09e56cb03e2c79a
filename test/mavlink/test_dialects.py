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

"""PX4 and ArduPilot behind one interface, and which of them a HEARTBEAT comes from."""

import math

from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.geometry import wrap_angle
from flock_follower.mavlink.dialects import (
    ARDUPILOT,
    dialect_of,
    DIALECTS,
    PX4,
)
from flock_follower.mavlink.setpoint_rules import encode_setpoint

GENERIC = mavlink.MAV_AUTOPILOT_GENERIC
QUADROTOR, ROVER = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_GROUND_ROVER
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
FINITE = st.floats(-50.0, 50.0)


def heartbeat(autopilot=PX4.firmware, kind=QUADROTOR, base=1, custom=0):
    return mavlink.MAVLink_heartbeat_message(
        kind, autopilot, base, custom, mavlink.MAV_STATE_ACTIVE, 3)


@pytest.mark.parametrize(('autopilot', 'firmware', 'kind', 'dialect'), [
    ('auto', PX4.firmware, QUADROTOR, PX4), ('auto', ARDUPILOT.firmware, QUADROTOR, ARDUPILOT),
    # A firmware that does not say which it is, is what the parameter says.
    ('px4', GENERIC, QUADROTOR, PX4), ('ardupilot', GENERIC, QUADROTOR, ARDUPILOT),
    ('auto', GENERIC, QUADROTOR, None), ('px4', ARDUPILOT.firmware, QUADROTOR, None),
    ('ardupilot', ARDUPILOT.firmware, ROVER, None),
    ('px4', mavlink.MAV_AUTOPILOT_INVALID, mavlink.MAV_TYPE_GCS, None)])
def test_the_heartbeat_and_the_parameter_tell_the_dialect(autopilot, firmware, kind, dialect):
    assert dialect_of(heartbeat(firmware, kind), autopilot) is dialect


def test_modes_have_the_numbers_of_each_autopilot():
    assert {name: mavutil.mode_mapping_acm[number] for name, number in ARDUPILOT.modes.items()
            } == {name: name for name in ARDUPILOT.modes}
    assert (PX4.modes['OFFBOARD'], PX4.modes['AUTO.LOITER']) == (6 << 16, 4 << 16 | 3 << 24)
    assert (PX4.mode_name(0), ARDUPILOT.mode_name(99)) == ('mode 0.0', 'mode 99')
    assert PX4.set_mode_parameters('AUTO.LAND') == (1.0, 4.0, 6.0)
    assert ARDUPILOT.set_mode_parameters('LAND') == (1.0, 9.0)
    for dialect in DIALECTS.values():
        assert {dialect.offboard, dialect.hold, dialect.land} <= set(dialect.modes)
        assert [dialect.mode_name(number) for number in dialect.modes.values()] == [*dialect.modes]


@pytest.mark.parametrize(('dialect', 'base', 'custom', 'status'), [
    (PX4, 1 | ARMED, 6 << 16, (True, 'OFFBOARD', True)),
    (PX4, 1, 3 << 16, (False, 'POSCTL', False)),
    (ARDUPILOT, 1 | ARMED, 4, (True, 'GUIDED', True)),
    (ARDUPILOT, 1, 5, (False, 'LOITER', False))])
def test_a_heartbeat_tells_arming_and_mode(dialect, base, custom, status):
    assert dialect.status(heartbeat(dialect.firmware, QUADROTOR, base, custom)) == status


def test_px4_takes_off_to_an_altitude_above_the_sea_and_arducopter_above_home():
    px4 = PX4.takeoff_parameters(2.0, 488.0, -0.8)
    assert px4[6] == 490.0 and all(math.isnan(p) for p in px4[3:6])
    assert math.isnan(PX4.takeoff_parameters(2.0, None, 0.0)[6])
    assert ARDUPILOT.takeoff_parameters(2.0, 488.0, -0.8)[6] == pytest.approx(1.2)


@given(st.tuples(FINITE, FINITE, FINITE), st.none() | st.floats(-10.0, 10.0))
def test_setpoints_leave_in_ned_as_px4_reads_them(acceleration, yaw):
    message = encode_setpoint(acceleration, yaw, 7, 1, 1)
    assert (message.afy, message.afx, -message.afz) == acceleration
    assert (message.time_boot_ms, message.coordinate_frame, message.type_mask) == (
        7, mavlink.MAV_FRAME_LOCAL_NED, 0xC3F if yaw is None else 0x83F)
    if yaw is not None:  # clockwise from north
        assert wrap_angle(message.yaw + yaw - math.pi / 2) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_never_encoded(bad):
    for acceleration, yaw in (([bad, 0, 0], 0.0), ([0, 0, 0], bad)):
        with pytest.raises(ValueError, match='must be finite'):
            encode_setpoint(acceleration, yaw)
