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

"""The link: who is heard and answered, over real sockets on loopback."""

import os
import select
import socket

from hypothesis import given
from hypothesis import strategies as st
from memory_line import MemoryLine
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.link import Link, Signing
from flock_follower.mavlink.setpoint_rules import encode_setpoint
from flock_follower.mavlink.transport import open_transport

KEY = bytes(range(32))
UNIX = 1.8e9


class Vehicle:
    """The other end: a socket and a pymavlink codec."""

    def __init__(self, address, system=1, component=1, signing=None):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(('127.0.0.1', 0))
        self.socket.settimeout(2.0)
        self.address = address
        self.codec = mavlink.MAVLink(None, system, component)
        self.codec.robust_parsing = True
        if signing:
            self.codec.signing = signing.state

    def send(self, message):
        self.socket.sendto(message.pack(self.codec), self.address)

    def heartbeat(self, autopilot=mavlink.MAV_AUTOPILOT_PX4):
        self.send(mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, autopilot, 1, 6 << 16, mavlink.MAV_STATE_ACTIVE, 3))

    def receive(self):
        return self.codec.parse_buffer(self.socket.recv(4096))[0]

    def silent(self):
        return not select.select([self.socket], [], [], 0.05)[0]


class Bench:
    """A link listening on a free port, and the vehicles that talk to it."""

    def __init__(self, **options):
        self.link = Link(open_transport('udpin:127.0.0.1:0'), **options)
        self.vehicles = []

    def vehicle(self, **options):
        self.vehicles.append(Vehicle(self.link.transport.address, **options))
        return self.vehicles[-1]

    def receive(self, now):
        assert select.select([self.link.transport], [], [], 2.0)[0]
        return [message.get_type() for message in self.link.receive(now)]


@pytest.fixture
def make_bench():
    benches = []

    def make(**options):
        benches.append(Bench(**options))
        return benches[-1]
    yield make
    for bench in benches:
        bench.link.close()
        for vehicle in bench.vehicles:
            vehicle.socket.close()


def test_nothing_is_sent_before_the_autopilot_is_heard_then_it_is_answered(make_bench):
    bench = make_bench()
    vehicle = bench.vehicle()
    assert not bench.link.send_heartbeat()
    vehicle.heartbeat()
    assert bench.receive(1.0) == ['HEARTBEAT']
    assert bench.link.telemetry.status == (False, 'OFFBOARD', 'active', True)
    assert bench.link.send_heartbeat()
    answer = vehicle.receive()
    assert (answer.type, answer.autopilot, answer.get_srcSystem(), answer.get_srcComponent()) == (
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 1, 191)
    bench.link.send(encode_setpoint([1.0, 2.0, 3.0], 0.0, 1234, 1, 1))
    message = vehicle.receive()
    assert message.get_msgbuf()[0] == 0xFD  # MAVLink 2
    assert (message.target_system, message.time_boot_ms, message.type_mask) == (1, 1234, 0x83F)
    assert (message.afx, message.afy, message.afz) == (2.0, 1.0, -3.0)
    sent = bench.link.bytes_sent
    assert bench.link.request_parameter('EKF2_EV_CTRL')
    message = vehicle.receive()
    assert (message.param_id, message.param_index) == ('EKF2_EV_CTRL', -1)
    assert bench.link.bytes_sent == sent + len(message.get_msgbuf())


@pytest.mark.parametrize(('who', 'autopilot', 'silence'), [
    ({'system': 7}, mavlink.MAV_AUTOPILOT_PX4, 'heard system id 7, not target_system 1'),
    ({'component': mavlink.MAV_COMP_ID_GIMBAL}, mavlink.MAV_AUTOPILOT_PX4,
     'no autopilot with system id 1'),
    ({}, mavlink.MAV_AUTOPILOT_GENERIC,
     "heard GENERIC QUADROTOR, which autopilot = 'auto' does not speak")])
def test_another_vehicle_a_gimbal_and_an_unknown_firmware_are_named_and_never_answered(
        make_bench, who, autopilot, silence):
    bench = make_bench()
    other = bench.vehicle(**who)
    other.heartbeat(autopilot)
    assert bench.receive(1.0) == []
    assert bench.link.telemetry.dialect is None and not bench.link.send_heartbeat()
    assert silence in bench.link.silence() and other.silent()


def test_a_second_vehicle_with_the_same_id_must_wait_until_the_first_is_silent(make_bench):
    bench = make_bench()
    first, second = bench.vehicle(), bench.vehicle()
    for vehicle, now, heard, answered in (
            (first, 1.0, ['HEARTBEAT'], first), (second, 2.0, [], first),
            (second, 3.5, ['HEARTBEAT'], second)):
        vehicle.heartbeat()
        assert bench.receive(now) == heard
        bench.link.send_heartbeat()
        assert answered.receive().get_type() == 'HEARTBEAT'
    assert bench.link.ignored['second sender'] == 1 and first.silent() and second.silent()


def test_a_flood_from_elsewhere_is_dropped_and_the_vehicle_heard(make_bench):
    bench = make_bench()
    vehicle, stranger = bench.vehicle(), bench.vehicle(system=9)
    vehicle.heartbeat()
    assert bench.receive(0.0) == ['HEARTBEAT']
    for _ in range(60):
        stranger.socket.sendto(b'\xfd' * 1400, stranger.address)
    vehicle.heartbeat()
    while bench.link.received < 2:
        bench.link.receive(0.1)
    assert bench.link.ignored['flood'] > 20
    assert bench.link.ignored['unknown message'] + bench.link.ignored['undecodable'] < 2000


@given(st.binary(min_size=1, max_size=300))
def test_no_bytes_whatsoever_break_the_link(data):
    link = Link(MemoryLine())
    for now in (1.0, 2.0):
        link.transport.arrived.append(data)
        assert link.receive(now) == []


# Signing.

@pytest.mark.parametrize(('key', 'at', 'reason', 'told'), [
    (None, UNIX, 'wrong signature', 'signed with another key'),
    (bytes(32), UNIX + 1e8, 'wrong signature', 'signed with another key'),
    (KEY, UNIX - 30.0, '', ''), (KEY, UNIX - 120.0, 'older timestamp', 'older timestamp'),
    (KEY, UNIX + 59.0, '', ''), (KEY, UNIX + 86400.0, 'future timestamp', 'ahead of this')])
def test_signed_links_hear_only_their_key_and_time(make_bench, key, at, reason, told):
    bench = make_bench(signing=Signing(KEY, UNIX))
    vehicle = bench.vehicle(signing=key and Signing(key, at))
    ours = bench.link._sender.signing.timestamp
    vehicle.heartbeat()
    assert bench.receive(1.0) == ([] if reason else ['HEARTBEAT'])
    assert dict(bench.link.ignored) == ({reason: 1} if reason else {})
    assert told in bench.link.silence()
    if reason:
        assert bench.link._sender.signing.timestamp == ours  # nor is what we send of that time
    else:
        bench.link.send_heartbeat()
        assert vehicle.receive().get_signed()


def test_a_signed_message_from_the_far_future_does_not_lock_the_vehicle_out(make_bench):
    bench = make_bench(signing=Signing(KEY, UNIX))
    vehicle = bench.vehicle(signing=Signing(KEY, UNIX))
    vehicle.heartbeat()
    bench.receive(100.0)
    for ahead, now, heard in ((86400.0, 101.0, False), (1.0, 101.0, True), (59.0, 100.0, True),
                              # Our clock goes on: what was too far ahead is not any more.
                              (100.0, 139.0, False), (100.0, 141.0, True)):
        vehicle.codec.signing.timestamp = Signing(KEY, UNIX + ahead).state.timestamp
        vehicle.heartbeat()
        assert bool(bench.receive(now)) == heard


@pytest.mark.parametrize(('content', 'mode', 'told'), [
    (KEY, 0o400, ''), (KEY.hex().encode() + b'\n', 0o600, ''),
    *((content, 0o600, 'must hold 32 bytes') for content in (b'', b'short', b'z' * 64, b'a' * 63)),
    *((KEY, mode, f'mode {mode:03o} gives others access: chmod 600')
      for mode in (0o640, 0o604, 0o620, 0o601)),
    (None, 0, 'No such file')])
def test_a_bad_key_file_is_named_and_its_content_is_not(content, mode, told, tmp_path):
    path = tmp_path / 'key'
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    if not told:
        Signing.from_file(str(path), 0.0)
        return
    with pytest.raises(ValueError, match=f'signing_key_file = .*{told}') as error:
        Signing.from_file(str(path), 0.0)
    assert not content or content.decode() not in str(error.value)


# Where it listens.

@pytest.mark.parametrize(('url', 'reason'), [
    ('14540', 'must be udpin:HOST:PORT'), ('udpin:127.0.0.1', 'must be udpin:HOST:PORT'),
    ('tcp:127.0.0.1:0', r'port = \d+: must be an integer in \[1, 65535\]'),
    ('udpin:127.0.0.1:70000', r'port = \d+: must be an integer in \[0, 65535\]'),
    ('udpout:127.0.0.1:0', r'port = \d+: must be an integer in \[1, 65535\]'),
    ('udpin:no.such.host.invalid:14540', 'unknown host no.such.host.invalid'),
    ('/dev/ttyACM0,12345', 'baud rate must be one of 9600')])
def test_a_bad_url_is_refused_with_the_valid_forms(url, reason):
    with pytest.raises(ValueError, match=f'connection = .*{reason}'):
        open_transport(url)


def test_a_port_in_use_is_named():
    first = open_transport('udpin:127.0.0.1:0')
    url = f'udpin:127.0.0.1:{first.address[1]}'
    with pytest.raises(OSError, match=f'connection = .{url}.: cannot listen there: Address'):
        open_transport(url)
    first.close()


def test_a_serial_line_carries_the_link_both_ways():
    main, replica = os.openpty()
    link = Link(open_transport(f'{os.ttyname(replica)},57600'))
    codec = mavlink.MAVLink(None, 1, 1)
    message = mavlink.MAVLink_heartbeat_message(2, 12, 1, 6 << 16, 4, 3).pack(codec)
    for part, heard in ((message[:9], []), (message[9:], ['HEARTBEAT'])):
        os.write(main, part)
        assert select.select([link.transport], [], [], 2.0)[0]
        assert [m.get_type() for m in link.receive(1.0)] == heard
    assert link.send_heartbeat()
    assert codec.parse_buffer(os.read(main, 100))[0].type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER
    link.close()
    for end in (main, replica):
        os.close(end)

