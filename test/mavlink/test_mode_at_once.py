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

"""The pilot's switch: which messages show it, how soon, and what CURRENT_MODE does not tell."""

from bridge_flight import Flight, Wire
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.dialects import DIALECTS, PX4
from flock_follower.mavlink.permission import Phase
from flock_follower.mavlink.telemetry import Telemetry, wanted_rates

BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])
OFFBOARD = {'px4': 'OFFBOARD', 'arducopter': 'GUIDED'}
HOLD = {'px4': 'AUTO.LOITER', 'arducopter': 'LOITER'}
EAST = np.array([0.6, 0.0, 0.0])
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def heartbeat(mode='OFFBOARD', base_mode=ARMED):
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base_mode, PX4.modes[mode],
        mavlink.MAV_STATE_ACTIVE, 3)


def tells(mode):
    return mavlink.MAVLink_current_mode_message(0, PX4.modes[mode], PX4.modes[mode])


def heard(*messages):
    telemetry = Telemetry()
    for time, message in enumerate(messages, start=1):
        telemetry.update(message, float(time))
    return telemetry


def test_pymavlink_decodes_current_mode_as_common_xml_defines_it():
    # CURRENT_MODE of system 1: custom_mode, intended_custom_mode, standard_mode, by PX4 1.16.
    frame = bytes([0xFD, 9, 0, 0, 7, 1, 1, 0xB4, 0x01, 0x00]) + bytes.fromhex('000004030000040303')
    checksum = mavlink.x25crc(frame[1:] + bytes([193])).crc
    message = mavlink.MAVLink(None).decode(bytearray(frame + checksum.to_bytes(2, 'little')))
    assert message.get_type() == 'CURRENT_MODE'
    assert PX4.mode_name(message.custom_mode) == 'AUTO.LOITER'


def test_each_autopilot_is_asked_for_what_it_grants():
    asked = {name: wanted_rates(dialect, 50.0) for name, dialect in DIALECTS.items()}
    assert asked['px4'][436] == 50.0 and 0 not in asked['px4']
    assert asked['ardupilot'][0] == 5.0 and 436 not in asked['ardupilot']


def test_current_mode_tells_the_mode_and_leaves_the_rest_to_heartbeat():
    telemetry = heard(heartbeat('OFFBOARD'), tells('POSCTL'))
    assert telemetry.status == (True, 'POSCTL', 'active', False)
    assert (telemetry.heartbeat_time, telemetry.mode_time) == (1.0, 2.0)
    telemetry.update(tells('OFFBOARD'), 3.0)
    assert telemetry.status == (True, 'OFFBOARD', 'active', True)
    telemetry.update(heartbeat('OFFBOARD', base_mode=0), 4.0)
    assert not telemetry.status.armed and telemetry.mode_time == 4.0


def test_current_mode_before_any_heartbeat_tells_nothing():
    telemetry = heard(tells('OFFBOARD'))
    assert telemetry.status is None and telemetry.mode_time == -np.inf


def test_current_mode_alone_does_not_keep_the_link_alive():
    telemetry = heard(heartbeat(), *[tells('OFFBOARD')] * 5)
    assert telemetry.silence(6.0) == 4.0


def test_only_heartbeat_shows_that_arming_was_obeyed():
    telemetry = heard(heartbeat(), tells('OFFBOARD'))
    assert telemetry.shown_time(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) == 1.0
    assert telemetry.shown_time(mavlink.MAV_CMD_DO_SET_MODE) == 2.0


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize('gap', [0.03, 0.1, 0.3])
def test_a_switch_away_and_back_is_seen(personality, gap):
    flight = Flight(personality)
    flight.engage()
    flight.planner = EAST
    flight.fly(1.0)
    flight.controller.pilot_switches(HOLD[personality])
    flight.fly(gap)
    flight.controller.pilot_switches(OFFBOARD[personality])
    flight.fly(0.1)
    assert flight.bridge.gate.permission.phase is Phase.TAKEN_OVER
    assert flight.bridge.telemetry.status.mode == OFFBOARD[personality]
    assert not flight.setpoints(flight.now - 0.05)


@pytest.mark.slow
def test_away_and_back_in_messages_that_come_at_once_is_seen():
    flight = Flight()
    flight.engage()
    flight.fly(1.0)
    codec = mavlink.MAVLink(None, 1, 1)
    flight.wire.to_bridge += [tells(mode).pack(codec) for mode in ('POSCTL', 'OFFBOARD')]
    flight.fly(0.05)
    assert flight.bridge.state(flight.now) == 'TAKEN_OVER: offboard was left for POSCTL'


@pytest.mark.slow
def test_a_px4_without_current_mode_is_flown_by_its_heartbeat():
    class OldWire(Wire):
        def read(self):
            for data, peer in super().read():
                if int.from_bytes(data[7:10], 'little') != mavlink.MAVLINK_MSG_ID_CURRENT_MODE:
                    yield data, peer

    flight = Flight(wire=OldWire())
    flight.engage()
    flight.planner = EAST
    flight.fly(1.0)
    flight.controller.pilot_switches('AUTO.LOITER')
    flight.fly(1.1)
    assert flight.bridge.gate.permission.phase is Phase.TAKEN_OVER


@pytest.mark.slow
def test_offboard_is_confirmed_without_waiting_for_a_heartbeat():
    flight = Flight()
    flight.fly(2.1)
    asked = flight.now
    assert flight.ask('offboard', True).success
    # PX4 wants setpoints for 1.5 s first.
    assert flight.now - asked < 1.6
    assert flight.bridge.state(flight.now) == 'ACTIVE'


@pytest.mark.slow
def test_disarming_is_believed_from_a_heartbeat_only():
    flight = Flight(start='landed')
    flight.fly(1.5)
    assert flight.ask('arm', True).success
    flight.fly(0.1)
    request = flight.bridge.requests.arm(False, flight.now)
    while request.outcome is None:
        before = flight.bridge.telemetry.heartbeat_time
        flight.fly(0.01)
    assert request.outcome.success and not flight.controller.armed
    assert flight.bridge.telemetry.heartbeat_time > max(before, request.begun)
