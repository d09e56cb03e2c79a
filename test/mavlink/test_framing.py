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

from fuzz_mavlink import frame
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.link import BAD_SIGNATURE, Codec, Framer, MOST_FALSE_STARTS


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


def test_an_unsigned_message_is_refused_by_a_signed_parser_and_costs_no_other():
    signed = messages(1, signing(mavlink.MAVLink(None, 1, 1)))[0]
    assert hashlib.sha256(bytes(32) + signed[:-6]).digest()[:6] == signed[-6:]
    parser = Framer(signing(Codec(None)))
    parser.codec.latest = 2**48
    assert fed(parser, messages(1)[0] + signed) == ([0], {BAD_SIGNATURE: 1})
