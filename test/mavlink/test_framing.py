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

"""Messages are found in a stream of bytes, whatever else is in it."""

import hashlib
import hmac
import random

from fuzz_mavlink import frame
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.link import Framer, MOST_FALSE_STARTS


def framer():
    return Framer(mavlink.MAVLink(None))


def messages(count, codec=None):
    """Return encoded messages with their number in ``x``."""
    codec = codec or mavlink.MAVLink(None, 1, 1)
    return [bytes(mavlink.MAVLink_local_position_ned_message(n, float(n), 0, 0, 0, 0, 0).pack(
        codec)) for n in range(count)]


def numbers(found):
    return [int(message.x) for message in found]


def test_messages_arrive_whole_however_they_are_cut():
    stream = b''.join(messages(5))
    for size in (1, 7, 50, len(stream)):
        parser, found = framer(), []
        for i in range(0, len(stream), size):
            new, unused = parser.feed(stream[i:i + size])
            found += new
            assert not unused
        assert numbers(found) == [0, 1, 2, 3, 4]


def test_a_false_start_costs_no_message():
    # 0xFD 0xFF announces 267 bytes: pymavlink would swallow the next six messages.
    found = framer().feed(b'\xfd\xff\x00' + b''.join(messages(8)))[0]
    assert numbers(found) == list(range(8))
    parser = framer()
    assert parser.feed(b'\xfd\xff\x00') == ([], {})
    assert numbers(parser.feed(messages(1)[0])[0]) == [0]


def test_half_of_the_messages_spoilt_by_garbage_leaves_the_other_half():
    lot = random.Random(1)
    parser, good, found = framer(), [], []
    for n, data in enumerate(messages(400)):
        if lot.random() < 0.5:
            cut = lot.randrange(2, len(data))
            data = data[:cut] + bytes(lot.choice([0xFD, 0xFE, lot.randrange(256)])
                                      for _ in range(32)) + data[cut:]
        else:
            good.append(n)
        found += parser.feed(data)[0]
    assert numbers(found) == good


def test_spoilt_messages_are_counted():
    data = bytearray(messages(1)[0])
    data[11] ^= 1
    found, unused = framer().feed(bytes(data))
    assert not found and unused['undecodable'] >= 1
    assert framer().feed(b'hello') == ([], {'undecodable': 1})


def test_messages_of_another_dialect_are_skipped():
    # CURRENT_EVENT_SEQUENCE of PX4, which no dialect of pymavlink has.
    strange = frame(411, b'\x07\x00\x01', crc_extra=106)
    found, unused = framer().feed(strange + messages(1)[0])
    assert numbers(found) == [0] and unused == {'unknown message': 1}


def test_mavlink_1_is_understood():
    codec = mavlink.MAVLink(None, 1, 1)
    data = mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3).pack(codec, force_mavlink1=True)
    assert framer().feed(bytes(data))[0][0].get_type() == 'HEARTBEAT'


@pytest.mark.parametrize('pattern', [
    b'\xfd', b'\xfe', b'\xfe\x03', b'\xfd\x02\x00', b'\xfe\xff\xff', b'\xfe\x08\x08\x08\x08\x03'])
def test_a_flood_of_false_starts_ends_soon(pattern):
    found, unused = framer().feed(pattern * (65535 // len(pattern)))
    assert not found and 0 < unused.total() <= MOST_FALSE_STARTS + 2


def test_no_more_messages_are_taken_than_were_asked_for():
    codec = mavlink.MAVLink(None, 1, 1)
    data = b''.join(mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3).pack(codec)
                    for _ in range(100))
    several = framer()
    assert len(several.feed(data, 30)[0]) == 30
    assert not several.feed(b'')[0]


def test_messages_that_never_end_and_wrong_signatures_are_bounded_too():
    parser = framer()
    parser.feed(b'\xfd\xff\x01' * 93)
    for _ in range(20):
        parser.feed(b'\xfd')
        assert parser.looks <= MOST_FALSE_STARTS + 1
    codec = mavlink.MAVLink(None)
    codec.signing.secret_key = bytes(32)
    parser = Framer(codec)
    assert parser.feed(b''.join(messages(1000)), 300) == ([], {'wrong signature': 300})


@given(st.lists(st.binary(max_size=400), max_size=8), st.integers(0, 2**32 - 1))
def test_no_bytes_whatsoever_raise_or_are_kept_for_ever(pieces, seed):
    parser, lot = framer(), random.Random(seed)
    for piece in pieces:
        parser.feed(piece)
        mutated = bytearray(messages(1)[0])
        mutated[lot.randrange(len(mutated))] = lot.randrange(256)
        parser.feed(bytes(mutated))
        assert len(parser._waiting) <= 280
    # Whatever was before, what follows is heard.
    assert numbers(parser.feed(b''.join(messages(2)))[0])[-2:] == [0, 1]


def test_an_unsigned_message_is_refused_by_a_signed_parser_and_costs_no_other():
    def signing(codec):
        codec.signing.secret_key, codec.signing.sign_outgoing = bytes(32), True
        codec.signing.timestamp = 1
        return codec
    signed = messages(1, signing(mavlink.MAVLink(None, 1, 1)))[0]
    digest = hashlib.sha256(bytes(32) + signed[:-6]).digest()[:6]
    assert hmac.compare_digest(digest, signed[-6:])
    parser = Framer(signing(mavlink.MAVLink(None)))
    found, unused = parser.feed(messages(1)[0] + signed)
    assert numbers(found) == [0] and unused == {'wrong signature': 1}
