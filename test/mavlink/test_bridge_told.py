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

"""What the bridge tells about autopilots that do not hear it, and about modes nobody asked for."""

from bridge_flight import Flight, Wire
from faulty_autopilot import Fault
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink import requests as takeoff
from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.gate import Gate
from flock_follower.mavlink.link import Link, Signing

pytestmark = pytest.mark.slow
KEY = bytes(range(32))


class SigningWire(Wire):
    """The wire to a vehicle that signs; unsigned messages it hears or drops without a word."""

    def __init__(self, hears):
        super().__init__()
        self.hears = hears
        self.reader = mavlink.MAVLink(None)
        self.signer = mavlink.MAVLink(None, 1, 1)
        self.signer.signing = Signing(KEY, 1.8e9).state

    def read(self):
        for data, peer in super().read():
            for message in self.reader.parse_buffer(data) or []:
                yield bytes(message.pack(self.signer)), peer

    def write(self, data):
        if self.hears or data[2] & mavlink.MAVLINK_IFLAG_SIGNED:
            super().write(data)
        return True


def test_an_autopilot_that_signs_and_answers_nothing_is_told():
    flight = Flight('arducopter', wire=SigningWire(hears=False))
    flight.fly(4.0)
    assert flight.bridge.alive(flight.now) and flight.bridge.link.autopilot_signs
    assert flight.bridge.housekeeping.unreceived(flight.now) == ''
    flight.fly(3.0)
    assert flight.bridge.housekeeping.unreceived(flight.now) == (
        'the autopilot signs its messages and answers none of ours: signing_key_file is not set, '
        'it will not hear us')


def test_an_autopilot_that_signs_and_hears_us_all_the_same_is_no_error():
    flight = Flight('arducopter', wire=SigningWire(hears=True))
    flight.fly(8.0)
    assert flight.bridge.link.autopilot_signs
    assert flight.bridge.housekeeping.unreceived(flight.now) == ''


def test_with_the_key_nothing_is_told():
    flight = Flight('arducopter', wire=SigningWire(hears=False))
    flight.bridge = Bridge(Link(flight.wire, signing=Signing(KEY, 1.8e9)), Gate(), now=0.0)
    flight.fly(8.0)
    assert flight.bridge.alive(flight.now) and flight.bridge.link.autopilot_signs
    assert flight.bridge.housekeeping.unreceived(flight.now) == ''


def test_an_autopilot_that_does_not_sign_is_not_told_to():
    flight = Flight('arducopter')
    flight.autopilot.receive = lambda data, now: []  # a line on which we are not heard
    flight.fly(8.0)
    assert flight.bridge.housekeeping.timesync.unanswered(round(flight.now * 1e9)) > 5.0
    assert flight.bridge.housekeeping.unreceived(flight.now) == ''


def explained(flight):
    bridge = flight.bridge
    return takeoff.explains_mode(bridge.requests.newest, bridge.telemetry, flight.now)


def test_arducopters_own_take_off_explains_guided_before_while_and_after_it_climbs():
    flight = Flight('arducopter', start='landed')
    flight.fly(2.5)
    assert flight.ask('arm', True).success
    request = flight.bridge.requests.takeoff(2.5, flight.now)
    while request.outcome is None:
        flight.fly(0.05)
        if flight.bridge.telemetry.status.offboard:
            assert explained(flight)
    assert request.outcome.success
    flight.fly(2.0)
    assert flight.bridge.telemetry.status.offboard and flight.bridge.telemetry.flying(flight.now)
    assert explained(flight)
    assert flight.ask('offboard', True).success
    assert not explained(flight)


def test_guided_by_somebody_else_in_the_air_is_not_explained():
    flight = Flight('arducopter')
    flight.controller.pilot_switches('GUIDED')
    flight.fly(2.0)
    assert flight.bridge.telemetry.status.offboard and not explained(flight)


def test_nothing_explains_offboard_mode_of_px4_to_which_no_take_off_leads():
    flight = Flight(start='landed')
    flight.fly(2.5)
    assert flight.ask('arm', True).success
    assert flight.ask('takeoff', 2.5, seconds=30.0).success
    assert not explained(flight)


def test_a_take_off_is_refused_while_it_lands():
    flight = Flight('arducopter')
    flight.fly(1.5)
    assert flight.ask('land').success
    flight.fly(0.5)
    assert flight.bridge.telemetry.landed == mavlink.MAV_LANDED_STATE_LANDING
    assert flight.ask('takeoff', 2.5) == (False, 'takeoff refused: already in the air')


@pytest.mark.parametrize(('personality', 'words'), [
    ('px4', 'arm authorization denied'), ('arducopter', 'the safety button')])
def test_a_disarmed_autopilot_is_asked_what_keeps_it_from_arming(personality, words):
    flight = Flight(personality, start='landed', arming_denial='the safety button')
    flight.fly(2.0)
    assert not flight.bridge.housekeeping.has_reasons(flight.now)
    flight.fly(3.0)
    bridge = flight.bridge
    assert bridge.housekeeping.has_reasons(flight.now)
    assert bridge.texts.unready(flight.now, bridge.telemetry.status.mode) == words
    assert not bridge.telemetry.status.armed


def test_why_offboard_would_be_refused_is_known_before_it_is_asked_for():
    flight = Flight('arducopter', parameters={'GUID_TIMEOUT': 3.0})
    flight.fly(4.0)
    assert flight.bridge.refusal(flight.now).startswith('GUID_TIMEOUT = 3 s')
    assert 'GUID_TIMEOUT = 3 s' in flight.ask('offboard', True).message


def test_a_second_take_off_is_refused_while_it_climbs_out():
    """As after a first one whose answer was lost: it would climb on from the height of now."""
    flight = Flight(start='armed', faults=[
        Fault('drop', 0.0, direction='sent', message='COMMAND_ACK')])
    flight.fly(2.5)
    assert not flight.ask('takeoff', 8.0).success
    assert flight.bridge.telemetry.landed == mavlink.MAV_LANDED_STATE_TAKEOFF
    assert flight.ask('takeoff', 8.0) == (False, 'takeoff refused: already in the air')
