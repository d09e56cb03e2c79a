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
An MCAP file with an index and checksums: the one writer of bags and of recordings in flight.

On request every write is flushed to the disk: a recording has to survive a kill or
a power cut. Profile ``ros2``, chunks that are not compressed, an index behind each, and a summary
at the end (https://mcap.dev/spec, which names the records). A file without its end is good up to
its last whole chunk: ``end_mcap`` finds that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
import json
import os
from pathlib import Path
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

from flock_follower.bags.message_types import typestore

#: The first and the last bytes of every MCAP file.
MCAP_MAGIC = b'\x89MCAP0\r\n'
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06
_MESSAGE_INDEX, _CHUNK_INDEX, _STATISTICS, _SUMMARY_OFFSET = 0x07, 0x08, 0x0B, 0x0E
_ATTACHMENT, _METADATA, _DATA_END = 0x09, 0x0C, 0x0F
#: The records that hold data.
_DATA = (_HEADER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _ATTACHMENT, _METADATA)
#: The end of a file without a summary: "data end", "footer" and the magic bytes.
_END = (struct.pack('<BQI', _DATA_END, 4, 0) + struct.pack('<BQQQI', _FOOTER, 20, 0, 0, 0)
        + MCAP_MAGIC)
_INFINITE = {'sec': 9223372036, 'nsec': 854775807}  # rosbag2's spelling


class RecordedTopic(NamedTuple):
    """A topic in a recording; ``source`` is the name under which it was received."""

    name: str
    msgtype: str
    latched: bool = False
    source: str = ''

    @property
    def qos(self) -> list[dict[str, Any]]:
        """Return the QoS profile for playback: reliable matches every subscriber."""
        return [{'history': 'keep_last', 'depth': 10, 'reliability': 'reliable',
                 'durability': 'transient_local' if self.latched else 'volatile',
                 'deadline': _INFINITE, 'lifespan': _INFINITE, 'liveliness': 'automatic',
                 'liveliness_lease_duration': _INFINITE,
                 'avoid_ros_namespace_conventions': False}]


class TakenMessage(NamedTuple):
    """One message: its topic, when it was received [ns], and its CDR bytes."""

    topic: RecordedTopic
    stamp_ns: int
    data: bytes


class McapFile:
    """
    One MCAP file that is being written.

    ``size`` [bytes] and ``counts``, messages by topic, describe the file on disk; ``start_ns`` and
    ``end_ns`` are the stamps of its first and last message, 0 without one.

    :param durable: whether the data is on the disk when ``write`` returns.
    :raises OSError: it exists, or cannot be written.
    """

    def __init__(self, path: Path, durable: bool = True) -> None:
        self.path = path
        self._durable = durable
        self.size = 0
        self.counts: Counter[RecordedTopic] = Counter()
        self.start_ns = self.end_ns = 0
        self._channels: dict[RecordedTopic, int] = {}
        self._schemas: dict[str, int] = {}
        # What the summary repeats, in the order in which it does.
        self._summary: dict[int, list[bytes]] = {_SCHEMA: [], _CHANNEL: [], _CHUNK_INDEX: []}
        self._file = path.open('xb', buffering=0)
        try:
            self._append(MCAP_MAGIC + _record(_HEADER, _text('ros2'), _text('flock_follower')))
        except OSError:
            self._file.close()
            path.unlink()
            raise

    def write(self, messages: Sequence[TakenMessage]) -> None:
        """
        Write messages as one chunk, in the order of their stamps.

        :raises OSError: if that fails; the file ends where it did before, and only ``close``
            makes sense after it.
        :raises KeyError: for a type that ROS 2 Jazzy does not have.
        """
        if not messages:
            return
        messages = sorted(messages, key=lambda message: message.stamp_ns)
        content, indices = bytearray(), dict[int, bytearray]()
        for topic, stamp, data in messages:
            channel = self._channels.get(topic) or self._introduce(topic, content)
            indices.setdefault(channel, bytearray()).extend(
                struct.pack('<QQ', stamp, len(content)))
            content += _record(_MESSAGE, struct.pack('<HIQQ', channel, 0, stamp, stamp), data)
        stamps = struct.pack('<QQ', messages[0].stamp_ns, messages[-1].stamp_ns)
        size = struct.pack('<Q', len(content))
        chunk = _record(_CHUNK, stamps, size, struct.pack('<I', zlib.crc32(content)), _text(''),
                        size, content)
        places = bytearray()
        records = [chunk]
        end = self.size + len(chunk)
        for channel, entries in indices.items():
            places += struct.pack('<HQ', channel, end)
            records.append(_record(_MESSAGE_INDEX, struct.pack('<H', channel), _sized(entries)))
            end += len(records[-1])
        index = _record(
            _CHUNK_INDEX, stamps, struct.pack('<QQ', self.size, len(chunk)), _sized(places),
            struct.pack('<Q', end - self.size - len(chunk)), _text(''), size, size)
        self._append(b''.join(records))
        self._summary[_CHUNK_INDEX].append(index)
        first = messages[0].stamp_ns
        self.start_ns = min(self.start_ns, first) if self.counts else first
        self.end_ns = max(self.end_ns, messages[-1].stamp_ns)
        self.counts.update(message.topic for message in messages)

    def close(self) -> None:
        """
        Write the summary and close the file.

        :raises OSError: if the summary cannot be written; the file is closed in any case.
        """
        try:
            self._append(self._end())
        finally:
            self._file.close()

    def _append(self, data: bytes) -> None:
        try:
            left = memoryview(data)
            while left:
                left = left[self._file.write(left):]
            if self._durable:
                os.fsync(self._file.fileno())
        except BaseException:
            self._file.truncate(self.size)
            self._file.seek(self.size)
            raise
        self.size += len(data)

    def _introduce(self, topic: RecordedTopic, content: bytearray) -> int:
        """Say in a chunk what a topic and its type are; return the channel's number."""
        schema = self._schemas.get(topic.msgtype)
        if schema is None:
            schema = self._schemas[topic.msgtype] = len(self._schemas) + 1
            record = _record(_SCHEMA, struct.pack('<H', schema), _text(topic.msgtype),
                             _text('ros2msg'), _text(definition(topic.msgtype)))
            self._summary[_SCHEMA].append(record)
            content += record
        channel = self._channels[topic] = len(self._channels) + 1
        about = {'offered_qos_profiles': json.dumps(topic.qos)}
        if topic.source:
            about['source'] = topic.source
        record = _record(
            _CHANNEL, struct.pack('<HH', channel, schema), _text(topic.name), _text('cdr'),
            _sized(b''.join(_text(key) + _text(value) for key, value in about.items())))
        self._summary[_CHANNEL].append(record)
        content += record
        return channel

    def _end(self) -> bytes:
        counts = b''.join(struct.pack('<HQ', self._channels[topic], count)
                          for topic, count in self.counts.items())
        statistics = _record(
            _STATISTICS, struct.pack(
                '<QHIIIIQQ', self.counts.total(), len(self._schemas), len(self._channels), 0, 0,
                len(self._summary[_CHUNK_INDEX]), self.start_ns, self.end_ns), _sized(counts))
        end = bytearray(_record(_DATA_END, struct.pack('<I', 0)))
        start = self.size + len(end)
        offsets = bytearray()
        for kind, records in (*self._summary.items(), (_STATISTICS, [statistics])):
            group = b''.join(records)
            if group:
                offsets += _record(_SUMMARY_OFFSET, struct.pack(
                    '<BQQ', kind, self.size + len(end), len(group)))
            end += group
        offset_start = self.size + len(end)
        end += offsets
        end += _record(_FOOTER, struct.pack('<QQI', start, offset_start, 0))
        return bytes(end + MCAP_MAGIC)


def _record(kind: int, *parts: bytes | bytearray) -> bytes:
    return b''.join((struct.pack('<BQ', kind, sum(map(len, parts))), *parts))


def _sized(data: bytes | bytearray) -> bytes:
    return struct.pack('<I', len(data)) + data


def _text(text: str) -> bytes:
    return _sized(text.encode())


@cache
def definition(msgtype: str) -> str:
    """
    Return the text that says what a type holds.

    :raises KeyError: for a type that ROS 2 Jazzy does not have.
    """
    return str(typestore().generate_msgdef(msgtype, ros_version=2)[0])


@cache
def type_hash(msgtype: str) -> str:
    """
    Return the type hash of ROS 2.

    :raises KeyError: for a type that ROS 2 Jazzy does not have.
    """
    return str(typestore().hash_rihs01(msgtype))


def has_mcap_end(file: BinaryIO) -> bool:
    """Return whether an MCAP file ends as a finished one does."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - len(MCAP_MAGIC), 0))
    return size > len(_END) and file.read() == MCAP_MAGIC


def end_mcap(path: Path) -> None:
    """
    Make an MCAP file whose writing broke off readable: cut it after its last whole chunk, end it.

    The file has no index then; readers make one. If the disk has no room for the 50 bytes of the
    end, the last chunk makes way.

    :raises OSError: the file cannot be written at all.
    """
    with path.open('rb') as file:
        if has_mcap_end(file):
            return  # whole: something else failed
        ends = [len(MCAP_MAGIC), *_ends_of_records(file)]
    for end in reversed(ends):
        try:
            with path.open('r+b') as file:
                file.truncate(end)
                file.seek(end)
                file.write(_END)
            return
        except OSError:
            if end == ends[0]:
                raise


def _ends_of_records(file: BinaryIO) -> Iterator[int]:
    """Yield where each record that holds data ends, up to the first that is cut or damaged."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    whole = file.read(len(MCAP_MAGIC)) == MCAP_MAGIC
    while whole and len(header := file.read(9)) == 9:
        kind, length = struct.unpack('<BQ', header)
        end = file.tell() + length
        whole = end <= size and kind in _DATA and (
            kind != _CHUNK or _chunk_is_good(file.read(length)))
        if whole:
            yield end
            file.seek(end)


def _chunk_is_good(content: bytes) -> bool:
    """Return whether a chunk agrees with its checksum, if it has one and is not compressed."""
    if len(content) < 40:
        return False
    checksum, compression = struct.unpack_from('<II', content, 24)
    return bool(compression or not checksum
                or zlib.crc32(memoryview(content)[40:]) == checksum)
