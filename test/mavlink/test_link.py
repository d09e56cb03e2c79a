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

"""The link: which sender is received and answered; messages found in a stream of bytes."""

import hashlib

from fuzz_mavlink import frame, FuzzedLine
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.link import (
    BAD_SIGNATURE,
    Codec,
    Framer,
    Link,
    MOST_FALSE_STARTS,
    Signing,
)

KEY = bytes(range(32))
UNIX = 1.8e9
PX4 = mavlink.MAV_AUTOPILOT_PX4


class Bench:
    """A link, and senders of messages to it, each with a codec of its own."""

    def __init__(self, **options):
        self.link = Link(FuzzedLine(), **options)
        self.codecs = {}

    def sends(self, peer, *messages, system=1, component=1, signing=None):
        if peer not in self.codecs:
            self.codecs[peer] = mavlink.MAVLink(None, system, component)
            if signing:
                self.codecs[peer].signing = signing.state
        self.link.transport.arrived += [
            (bytes(message.pack(self.codecs[peer])), peer) for message in messages]

    def beats(self, peer, autopilot=PX4, now=1.0, **options):
        """Return the types of the messages received, after a HEARTBEAT of a sender."""
        self.sends(peer, mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, autopilot, 1, 6 << 16, mavlink.MAV_STATE_ACTIVE, 3),
            **options)
        return [message.get_type() for message in self.link.receive(now)]

    def written(self):
        """Return the only message that the link sent since the last call."""
        data, = self.link.transport.written
        self.link.transport.written = []
        return mavlink.MAVLink(None).decode(bytearray(data))


def test_nothing_is_sent_before_autopilot_is_received():
    bench = Bench()
    link = bench.link
    assert not link.send_heartbeat() and bench.beats('vehicle') == ['HEARTBEAT']
    assert link.telemetry.status == (False, 'OFFBOARD', True)
    assert link.send_heartbeat()
    answer = bench.written()
    assert (answer.type, answer.autopilot, answer.get_srcSystem(), answer.get_srcComponent()) == (
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 1, 191)
    sent = link.bytes_sent
    assert link.request_parameter('EKF2_EV_CTRL')
    message = bench.written()
    assert message.get_msgbuf()[0] == 0xFD  # MAVLink 2
    assert (message.target_system, message.param_id, message.param_index) == (
        1, 'EKF2_EV_CTRL', -1)
    assert link.bytes_sent == sent + len(message.get_msgbuf())


@pytest.mark.parametrize(('who', 'autopilot', 'silence'), [
    ({'system': 7}, PX4, '1 of system id 7, not target_system 1'),
    ({'component': mavlink.MAV_COMP_ID_GIMBAL}, PX4,
     '1 of a gimbal (system id 1, component 154)'),
    ({'component': 42}, PX4, '1 of component 42, not of an autopilot'),
    ({}, mavlink.MAV_AUTOPILOT_GENERIC,
     "1 of GENERIC QUADROTOR, which autopilot = 'auto' does not send")])
def test_other_vehicle_gimbal_or_firmware_is_named_not_answered(
        who, autopilot, silence):
    bench = Bench()
    assert bench.beats('other', autopilot, **who) == []
    assert bench.link.telemetry.dialect is None and not bench.link.send_heartbeat()
    assert bench.link.silence() == f'received, but not used: {silence}'


def test_second_vehicle_with_same_id_waits_for_first_to_end():
    bench = Bench()
    for vehicle, now, received, answered in (
            ('first', 1.0, ['HEARTBEAT'], 'first'), ('second', 2.0, [], 'first'),
            ('second', 3.5, ['HEARTBEAT'], 'second')):
        assert bench.beats(vehicle, now=now) == received and bench.link.transport.peer == answered
    assert bench.link.ignored['second sender'] == 1 and bench.link.peer_changes == 1


def test_vehicle_that_loses_only_heartbeats_is_not_replaced():
    bench = Bench()
    bench.beats('first', now=1.0)
    home = mavlink.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    bench.sends('first', home)
    bench.link.receive(4.0)
    assert bench.beats('second', now=5.0) == [] and bench.link.transport.peer == 'first'
    assert 'HOME_POSITION' in bench.link.telemetry.newest
    # Another vehicle has another home.
    assert bench.beats('second', now=6.1) == ['HEARTBEAT']
    assert 'HOME_POSITION' not in bench.link.telemetry.newest


def test_garbage_and_floods_of_others_cost_vehicle_nothing():
    bench = Bench()
    assert bench.beats('vehicle') == ['HEARTBEAT']
    bench.link.transport.arrived += [(b'\xfd\x20\x00\x00half a message', 'noise'),
                                     *[(b'\xfd' * 1400, 'stranger')] * 60]
    assert bench.beats('vehicle') == ['HEARTBEAT']
    assert bench.link.ignored['flood'] > 20
    assert bench.link.ignored['unknown message'] + bench.link.ignored['undecodable'] < 2000


# Signing.

@pytest.mark.parametrize(('key', 'at', 'received'), [
    (None, UNIX, False), (bytes(32), UNIX + 1e8, False), (KEY, UNIX - 30.0, True),
    (KEY, UNIX - 120.0, False), (KEY, UNIX + 59.0, True), (KEY, UNIX + 86400.0, False)])
def test_signed_links_hear_only_their_key_and_time(key, at, received):
    bench = Bench(signing=Signing(KEY, UNIX))
    ours = bench.link._sender.signing.timestamp
    assert bench.beats('vehicle', signing=key and Signing(key, at)) == ['HEARTBEAT'] * received
    assert dict(bench.link.ignored) == ({} if received else {BAD_SIGNATURE: 1})
    if not received:
        assert bench.link._sender.signing.timestamp == ours  # nor is what we send of that time
    else:
        bench.link.send_heartbeat()
        assert bench.link.transport.written[0][2] & mavlink.MAVLINK_IFLAG_SIGNED


def test_signed_message_from_far_future_does_not_lock_out():
    bench = Bench(signing=Signing(KEY, UNIX))
    bench.beats('vehicle', now=100.0, signing=Signing(KEY, UNIX))
    for ahead, now, received in ((86400.0, 101.0, False), (1.0, 101.0, True), (59.0, 100.0, True),
                                 # Our clock goes on: what was too far ahead is not any more.
                                 (100.0, 139.0, False), (100.0, 141.0, True)):
        bench.codecs['vehicle'].signing.timestamp = Signing(KEY, UNIX + ahead).state.timestamp
        assert bool(bench.beats('vehicle', now=now)) == received


def test_signed_link_follows_clock_set_after_start():
    started = 1_000.0  # s since 1970: a computer without a battery for its clock
    bench = Bench(signing=Signing(KEY, started))
    assert not bench.beats('vehicle', now=100.0, signing=Signing(KEY, UNIX))
    bench.link.signing.set_clock(started + 1.0, 101.0)  # not set yet
    assert not bench.beats('vehicle', now=101.0)
    bench.link.signing.set_clock(UNIX + 2.0, 102.0)
    sent = bench.link._sender.signing.timestamp
    assert sent == Signing(KEY, UNIX + 2.0).state.timestamp
    assert bench.beats('vehicle', now=102.0)
    # Set back: MAVLink's timestamps never decrease, and the autopilot's do not either.
    bench.link.signing.set_clock(UNIX - 3600.0, 103.0)
    assert bench.link._sender.signing.timestamp >= sent
    bench.codecs['vehicle'].signing.timestamp = Signing(KEY, UNIX + 3.0).state.timestamp
    assert bench.beats('vehicle', now=103.0)
    bench.codecs['vehicle'].signing.timestamp = Signing(KEY, UNIX + 86400.0).state.timestamp
    assert not bench.beats('vehicle', now=103.0)


@pytest.mark.parametrize(('content', 'mode', 'reported'), [
    (KEY, 0o400, ''), *((content, 0o600, 'must hold 32 bytes') for content in (b'', b'z' * 64)),
    *((KEY, mode, f'mode {mode:03o} gives others access: chmod 600') for mode in (0o640, 0o601)),
    (None, 0, 'No such file')])
def test_a_bad_key_file_is_named_and_its_content_is_not(content, mode, reported, tmp_path):
    path = tmp_path / 'key'
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    if not reported:
        Signing.from_file(str(path), 0.0)
        return
    with pytest.raises(ValueError, match=f'signing_key_file = .*{reported}') as error:
        Signing.from_file(str(path), 0.0)
    assert not content or content.decode() not in str(error.value)


# Messages are found in a stream of bytes, whatever else is in it.

def framer():
    return Framer(Codec(None))


def messages(count, codec=None):
    """Return encoded messages with their number in ``x``."""
    codec = codec or mavlink.MAVLink(None, 1, 1)
    return [bytes(mavlink.MAVLink_local_position_ned_message(n, float(n), 0, 0, 0, 0, 0).pack(
        codec)) for n in range(count)]


def signing(codec):
    codec.signing.secret_key, codec.signing.sign_outgoing = bytes(32), True
    codec.signing.timestamp = 1
    return codec


def fed(parser, *pieces):
    """Return the numbers of the messages found in pieces, and what else was counted."""
    answers = [parser.feed(piece) for piece in pieces]
    return ([int(message.x) for found, _ in answers for message in found],
            {why: count for _, unused in answers for why, count in unused.items()})


EIGHT = b''.join(messages(8))
SPOILT = bytearray(messages(1)[0])
SPOILT[11] ^= 1


@pytest.mark.parametrize(('pieces', 'found', 'unused'), [
    # However they are cut.
    *(([EIGHT[i:i + size] for i in range(0, len(EIGHT), size)], 8, {})
      for size in (1, 7, 50, 999)),
    # 0xFD 0xFF announces 267 bytes: pymavlink would swallow the next six messages.
    ([b'\xfd\xff\x00' + EIGHT], 8, None), ([b'\xfd\xff\x00', EIGHT], 8, None),
    ([bytes(SPOILT), EIGHT], 8, None), ([b'hello'], 0, {'undecodable': 1}),
    # CURRENT_EVENT_SEQUENCE of PX4, which no dialect of pymavlink has.
    ([frame(411, b'\x07\x00\x01', crc_extra=106) + EIGHT], 8, {'unknown message': 1})])
def test_what_is_no_message_is_counted_and_costs_none(pieces, found, unused):
    numbers, counted = fed(framer(), *pieces)
    assert numbers == list(range(found))
    assert counted == unused if unused is not None else set(counted) <= {
        'undecodable', 'unknown message'}


@pytest.mark.parametrize('pattern', [
    b'\xfd', b'\xfe', b'\xfe\x03', b'\xfd\x02\x00', b'\xfe\xff\xff', b'\xfe\x08\x08\x08\x08\x03'])
def test_a_flood_of_false_starts_ends_soon(pattern):
    found, unused = framer().feed(pattern * (65535 // len(pattern)))
    assert not found and 0 < unused.total() <= MOST_FALSE_STARTS + 2


def test_no_more_messages_are_taken_than_were_asked_for():
    several, data = framer(), b''.join(messages(100))
    assert len(several.feed(data, 30)[0]) == 30 and not several.feed(b'')[0]
    signed = Framer(signing(Codec(None)))
    assert signed.feed(data, 30) == ([], {BAD_SIGNATURE: 30})
    unending = framer()
    unending.feed(b'\xfd\xff\x01' * 93)
    for _ in range(20):
        unending.feed(b'\xfd')
        assert unending.looks <= MOST_FALSE_STARTS + 1


def test_unsigned_message_is_refused_by_signed_parser_alone():
    signed = messages(1, signing(mavlink.MAVLink(None, 1, 1)))[0]
    assert hashlib.sha256(bytes(32) + signed[:-6]).digest()[:6] == signed[-6:]
    parser = Framer(signing(Codec(None)))
    parser.codec.latest = 2**48
    assert fed(parser, messages(1)[0] + signed) == ([0], {BAD_SIGNATURE: 1})
