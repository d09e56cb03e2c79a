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

"""What the real autopilots sent, see test/captures/README.md."""

from pathlib import Path
import struct

from memory_line import MemoryLine
from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.link import Link

CAPTURES = Path(__file__).parent / 'captures'


def captured(name):
    """Return the times, s, and the bytes of every message of a capture."""
    data, messages = (CAPTURES / f'{name}.tlog').read_bytes(), []
    while data:
        length = data[9] + 12
        messages.append((struct.unpack('>Q', data[:8])[0] * 1e-6, data[8:8 + length]))
        data = data[8 + length:]
    return messages


def decoded(name):
    """Return the times, s, and the messages of a capture."""
    codec = mavlink.MAVLink(None)
    return [(time, codec.decode(bytearray(data))) for time, data in captured(name)]


def link(**options):
    """Return a link that hears what is put into ``transport.arrived``."""
    return Link(MemoryLine(), **options)
