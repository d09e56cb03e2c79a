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

"""
Finding MAVLink messages in a stream of bytes that may have garbage in it.

pymavlink's own parser takes a byte that looks like the start of a message at its word, and throws
away up to 280 bytes of good messages when it was none: on a line with a little garbage little
comes through. Here only a message whose checksum is right uses bytes up.
"""

from __future__ import annotations

from collections import Counter
import struct
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

_MARKERS: Final[tuple[int, int]] = (mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2)
_SIGNED: Final[int] = mavlink.MAVLINK_IFLAG_SIGNED
#: After this many false starts, or unknown messages, in one piece the rest of it is dropped: a
#: flood of bytes that look like starts must not keep the caller from its other work.
MOST_FALSE_STARTS: Final[int] = 64

UNDECODABLE: Final[str] = 'undecodable'
WRONG_SIGNATURE: Final[str] = 'wrong signature'
UNKNOWN_MESSAGE: Final[str] = 'unknown message'


class Framer:
    """
    Takes the bytes of one sender as they arrive.

    :param codec: a ``mavlink.MAVLink`` that decodes, and checks signatures.
    """

    def __init__(self, codec: Any) -> None:
        self.codec = codec
        self._waiting = bytearray()
        self.looks = 0
        """How many starts the last piece had, true and false: what it cost."""

    def feed(self, data: bytes, most: int = 10_000) -> tuple[list[Any], Counter[str]]:
        """
        Return the messages that are whole now, and how many pieces were not used and why.

        After ``most`` starts of messages, true and false, the rest is dropped.
        """
        buffer = self._waiting + data
        messages: list[Any] = []
        unused: Counter[str] = Counter()
        start, incomplete = 0, -1
        self.looks = 0
        while (start := _next_marker(buffer, start)) >= 0:
            whole = len(messages) + unused[WRONG_SIGNATURE]
            if self.looks >= most or self.looks - whole > MOST_FALSE_STARTS:
                incomplete = -1
                break
            self.looks += 1
            end = start + frame_length(buffer, start)
            if end > len(buffer):
                # Either the rest has not arrived yet, or this byte was no start. Look on: a whole
                # message behind it tells that it was none.
                incomplete = start if incomplete < 0 else incomplete
                start += 1
                continue
            try:
                message = self.codec.decode(buffer[start:end])
            except (mavlink.MAVError, struct.error, ValueError, IndexError) as error:
                if 'signature' in str(error).lower():  # whole, but not from whom we trust
                    unused[WRONG_SIGNATURE] += 1
                    start, incomplete = end, -1
                    continue
                unused[UNDECODABLE] += 1
                start += 1
                continue
            if message.get_type().startswith('UNKNOWN'):
                # Another dialect's, or garbage: the checksum of an unknown kind says nothing.
                unused[UNKNOWN_MESSAGE] += 1
                start += 1
                continue
            messages.append(message)
            start, incomplete = end, -1
        if not messages and not unused and incomplete < 0:
            unused[UNDECODABLE] += bool(buffer)
        self._waiting = buffer[incomplete:] if incomplete >= 0 else bytearray()
        return messages, unused


def frame_length(buffer: bytearray, start: int) -> int:
    """Return the length of the message that starts there, or more than there is if unknown."""
    header = buffer[start:start + 3]
    if len(header) < 3:
        return len(header) + 1
    marker, payload, flags = header
    if marker == mavlink.PROTOCOL_MARKER_V1:
        return int(payload + 8)
    signature = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if flags & _SIGNED else 0
    return int(payload + 12 + signature)


def _next_marker(buffer: bytearray, start: int) -> int:
    found = [i for marker in _MARKERS if (i := buffer.find(marker, start)) >= 0]
    return min(found, default=-1)
