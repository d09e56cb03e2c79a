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

from pymavlink import mavutil
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.dialects import (
    ARDUPILOT,
    AUTOPILOTS,
    describe,
    dialect_of,
    DIALECTS,
    PX4,
)

PX4_FIRMWARE, ARDUPILOT_FIRMWARE = PX4.firmware, ARDUPILOT.firmware


def heartbeat(autopilot=PX4_FIRMWARE, kind=mavlink.MAV_TYPE_QUADROTOR, base=0, custom=0):
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, base, custom, 4, 3)


@pytest.mark.parametrize(('autopilot', 'firmware', 'name'), [
    ('auto', PX4_FIRMWARE, 'px4'), ('auto', ARDUPILOT_FIRMWARE, 'ardupilot'),
    ('px4', PX4_FIRMWARE, 'px4'), ('ardupilot', ARDUPILOT_FIRMWARE, 'ardupilot'),
    # A firmware that does not say which it is, is what the parameter says.
    ('px4', mavlink.MAV_AUTOPILOT_GENERIC, 'px4'),
    ('ardupilot', mavlink.MAV_AUTOPILOT_GENERIC, 'ardupilot')])
def test_the_heartbeat_and_the_parameter_tell_the_dialect(autopilot, firmware, name):
    assert dialect_of(heartbeat(firmware), autopilot).name == name


@pytest.mark.parametrize(('autopilot', 'firmware', 'kind'), [
    ('px4', ARDUPILOT_FIRMWARE, mavlink.MAV_TYPE_QUADROTOR),
    ('ardupilot', PX4_FIRMWARE, mavlink.MAV_TYPE_QUADROTOR),
    ('auto', mavlink.MAV_AUTOPILOT_GENERIC, mavlink.MAV_TYPE_QUADROTOR),
    ('auto', ARDUPILOT_FIRMWARE, mavlink.MAV_TYPE_FIXED_WING),
    ('ardupilot', ARDUPILOT_FIRMWARE, mavlink.MAV_TYPE_GROUND_ROVER)])
def test_firmware_that_is_not_spoken_here_has_no_dialect(autopilot, firmware, kind):
    assert dialect_of(heartbeat(firmware, kind), autopilot) is None


def test_an_unknown_autopilot_names_the_valid_ones():
    assert AUTOPILOTS == ('auto', 'px4', 'ardupilot')
    with pytest.raises(ValueError, match="autopilot = 'inav': must be one of auto, px4, ardup"):
        dialect_of(heartbeat(), 'inav')


def test_a_stranger_is_described():
    assert describe(heartbeat(ARDUPILOT_FIRMWARE, mavlink.MAV_TYPE_FIXED_WING)) == (
        'ARDUPILOTMEGA FIXED_WING')
    assert describe(heartbeat(200, 201)) == 'MAV_AUTOPILOT 200 MAV_TYPE 201'


@pytest.mark.parametrize('name', ARDUPILOT.modes)
def test_the_modes_of_arducopter_are_those_pymavlink_knows(name):
    assert mavutil.mode_mapping_acm[ARDUPILOT.modes[name]] == name
    assert ARDUPILOT.mode_name(ARDUPILOT.modes[name]) == name


def test_an_unknown_mode_of_arducopter_is_told_by_its_number():
    assert ARDUPILOT.mode_name(99) == 'mode 99'
    with pytest.raises(ValueError, match="mode = 'OFFBOARD': must be one of STABILIZE"):
        ARDUPILOT.set_mode_parameters('OFFBOARD')


def test_guided_is_the_mode_that_obeys():
    status = ARDUPILOT.status(heartbeat(ARDUPILOT_FIRMWARE, base=128 | 1, custom=4))
    assert status == (True, 'GUIDED', 'active', True)
    assert not ARDUPILOT.status(heartbeat(ARDUPILOT_FIRMWARE, custom=5)).offboard


@pytest.mark.parametrize('dialect', DIALECTS.values(), ids=DIALECTS)
def test_every_mode_that_is_asked_for_exists(dialect):
    for name in (dialect.offboard, dialect.hold, dialect.land):
        assert dialect.set_mode_parameters(name)[0] == 1.0
    with pytest.raises(ValueError, match="mode = 'FLY'"):
        dialect.set_mode_parameters('FLY')


def test_modes_are_set_as_each_wants_it():
    assert PX4.set_mode_parameters('AUTO.LAND') == (1.0, 4.0, 6.0)
    assert ARDUPILOT.set_mode_parameters('LAND') == (1.0, 9.0)


def test_px4_takes_off_to_an_altitude_above_the_sea_and_arducopter_above_home():
    px4 = PX4.takeoff_parameters(2.0, 488.0, -0.8)
    assert px4[6] == 490.0 and all(math.isnan(p) for p in px4[3:6])
    assert math.isnan(PX4.takeoff_parameters(2.0, None, 0.0)[6])
    assert ARDUPILOT.takeoff_parameters(2.0, 488.0, -0.8)[6] == pytest.approx(1.2)


def test_odometry_is_sent_in_the_frame_each_takes():
    assert PX4.odometry_frame == 1 and ARDUPILOT.odometry_frame == 20
