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

from dataclasses import replace
import math

from fuzz_mavlink import FuzzedLine
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.gate.gate import Gate
from flock_follower.geometry import wrap_angle
from flock_follower.mavlink import dialects
from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.commands import NOT_RECEIVED
from flock_follower.mavlink.dialects import ARDUPILOT, dialect_of, DIALECTS, PX4, Rule
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.parameter_check import obstacle
from flock_follower.mavlink.setpoint_encoding import encode_setpoint

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
    *((name, firmware, kind, None) for name, firmware in (
        ('ardupilot', ARDUPILOT.firmware), ('auto', ARDUPILOT.firmware), ('px4', PX4.firmware),
        ('auto', PX4.firmware)) for kind in (
            ROVER, mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_TYPE_SUBMARINE,
            mavlink.MAV_TYPE_SURFACE_BOAT, mavlink.MAV_TYPE_CAMERA, mavlink.MAV_TYPE_GENERIC)),
    # QuadPlanes are planes to ArduPilot; those of PX4 may hover.
    ('auto', ARDUPILOT.firmware, mavlink.MAV_TYPE_VTOL_TILTROTOR, None),
    ('auto', PX4.firmware, mavlink.MAV_TYPE_VTOL_TILTROTOR, PX4),
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


def test_px4_takes_off_above_sea_and_arducopter_above_home():
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


def test_a_third_autopilot_is_one_record(monkeypatch):
    third = replace(
        ARDUPILOT, name='third', title='Third', firmware=mavlink.MAV_AUTOPILOT_PPZ,
        vehicle_types=frozenset({QUADROTOR}), velocity_flags=(mavlink.ESTIMATOR_VELOCITY_HORIZ, 0),
        estimator_status=mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, hover_thrust='THIRD_HOVER',
        offboard_rules=(Rule('THIRD_LOSS', lambda value: value > 1.0, ' s: too long'),))
    monkeypatch.setattr(dialects, 'DIALECTS', {**DIALECTS, 'third': third})
    line, codec, now = FuzzedLine(), mavlink.MAVLink(None, 1, 1), 1.0
    bridge = Bridge(Link(line), Gate(), now=0.0)

    def cycle(*messages):
        line.arrived += [(bytes(message.pack(codec)), 'vehicle') for message in messages]
        bridge.receive(now)
        assert bridge.cycle(now).setpoint.reason in (NOT_RECEIVED, 'offboard was not requested')

    cycle(heartbeat(third.firmware, ROVER))
    assert bridge.telemetry.dialect is None
    cycle(heartbeat(third.firmware), mavlink.MAVLink_estimator_status_message(
        0, mavlink.ESTIMATOR_ATTITUDE, 0, 0, 0, 0, 0, 0, 0, 0))
    assert bridge.telemetry.dialect is third
    assert bridge.gate.autopilot.hover_thrust == 'THIRD_HOVER'
    assert bridge.velocity_fault(now) == 'is invalid according to its estimator'
    asked = [mavlink.MAVLink(None).decode(bytearray(data)) for data in line.written]
    assert 'THIRD_LOSS' in [m.param_id for m in asked if m.get_type() == 'PARAM_REQUEST_READ']
    cycle(mavlink.MAVLink_param_value_message(
        b'THIRD_LOSS', 3.0, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0))
    assert obstacle(third, bridge.housekeeping.parameters, False) == (
        'THIRD_LOSS = 3 s: too long (or require_failsafe:=false)')
