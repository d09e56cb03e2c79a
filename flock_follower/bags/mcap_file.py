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
An MCAP file with an index and checksums; bags and recordings in flight use this writer.

On request every write is flushed to the disk, because a recording must survive a kill or a power
cut. The file has the profile ``ros2``, chunks without compression, an index after each chunk, and
a summary at the end (https://mcap.dev/spec has the names of the records). If the end of a file is
missing, its whole chunks can still be read, see ``bags.sequential``.

The folder of a bag also holds ``metadata.yaml`` and, until the bag is finished, a file MARK. If
writing ends early (full disk, exception, kill), MARK remains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache
import json
import os
from pathlib import Path
import struct
from typing import Any, NamedTuple
import zlib

from flock_follower.bags.message_types import typestore
from flock_follower.system.whole_file import whole_file

#: The first and the last bytes of every MCAP file.
MCAP_MAGIC = b'\x89MCAP0\r\n'
_OP_HEADER = 0x01
_OP_FOOTER = 0x02
_OP_SCHEMA = 0x03
_OP_CHANNEL = 0x04
_OP_MESSAGE = 0x05
_OP_CHUNK = 0x06
_OP_MESSAGE_INDEX = 0x07
_OP_CHUNK_INDEX = 0x08
_OP_STATISTICS = 0x0B
_OP_DATA_END = 0x0F
#: The file in a bag's folder until the bag is finished.
MARK = 'INCOMPLETE.txt'
METADATA = 'metadata.yaml'
_UNFINISHED = 'still being written, or the process that wrote it failed or was killed'
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

    ``size`` [bytes] and ``counts``, messages by topic, describe the file on disk. ``start_ns`` and
    ``end_ns`` are the stamps of its first and last message; 0 without a message.

    :param durable: whether the data is on the disk when ``write`` returns.
    :raises OSError: if the file exists already, or cannot be written.
    """

    def __init__(self, path: Path, durable: bool = True) -> None:
        self.path = path
        self._durable = durable
        self.size = 0
        self.counts: Counter[RecordedTopic] = Counter()
        self.start_ns = self.end_ns = 0
        self._channels: dict[RecordedTopic, int] = {}
        # What the summary repeats, in the order in which it does.
        self._summary: dict[int, list[bytes]] = {_OP_SCHEMA: [], _OP_CHANNEL: [],
                                                 _OP_CHUNK_INDEX: []}
        self._file = path.open('xb', buffering=0)
        try:
            self._append(MCAP_MAGIC + _record(_OP_HEADER, _text('ros2'), _text('flock_follower')))
        except OSError:
            self._file.close()
            path.unlink()
            raise

    def write(self, messages: Sequence[TakenMessage]) -> None:
        """
        Write messages as one chunk, in the order of their stamps.

        :raises OSError: if writing fails; the file then ends as before the call, and only
            ``close`` may be called.
        :raises KeyError: for a type that ROS 2 Jazzy does not have.
        """
        if not messages:
            return
        messages = sorted(messages, key=lambda message: message.stamp_ns)
        first, last = messages[0].stamp_ns, messages[-1].stamp_ns
        content, entries = bytearray(), dict[int, bytearray]()
        for topic, stamp, data in messages:
            channel = self._channels.get(topic) or self._introduce(topic, content)
            entries.setdefault(channel, bytearray()).extend(
                struct.pack('<QQ', stamp, len(content)))
            content += _record(_OP_MESSAGE, struct.pack('<HIQQ', channel, 0, stamp, stamp), data)
        span, size = struct.pack('<QQ', first, last), struct.pack('<Q', len(content))
        chunk = _record(_OP_CHUNK, span, size, struct.pack('<I', zlib.crc32(content)), _text(''),
                        size, content)
        places, index = bytearray(), bytearray()
        for channel, entry in entries.items():
            places += struct.pack('<HQ', channel, self.size + len(chunk) + len(index))
            index += _record(_OP_MESSAGE_INDEX, struct.pack('<H', channel), _prefix_size(entry))
        chunk_index = _record(
            _OP_CHUNK_INDEX, span, struct.pack('<QQ', self.size, len(chunk)), _prefix_size(places),
            struct.pack('<Q', len(index)), _text(''), size, size)
        self._append(chunk + index)
        self._summary[_OP_CHUNK_INDEX].append(chunk_index)
        self.start_ns = min(self.start_ns, first) if self.counts else first
        self.end_ns = max(self.end_ns, last)
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
        """Write the description of a topic and its type to a chunk; return the channel number."""
        number = self._channels[topic] = len(self._channels) + 1
        qos = _text('offered_qos_profiles') + _text(json.dumps(topic.qos))
        source = _text('source') + _text(topic.source) if topic.source else b''
        for kind, record in (
                (_OP_SCHEMA, _record(_OP_SCHEMA, struct.pack('<H', number), _text(topic.msgtype),
                                     _text('ros2msg'), _text(definition(topic.msgtype)))),
                (_OP_CHANNEL, _record(
                    _OP_CHANNEL, struct.pack('<HH', number, number), _text(topic.name),
                    _text('cdr'), _prefix_size(qos + source)))):
            self._summary[kind].append(record)
            content += record
        return number

    def _end(self) -> bytes:
        end = _record(_OP_DATA_END, struct.pack('<I', 0))
        start = self.size + len(end)
        counts = b''.join(struct.pack('<HQ', self._channels[topic], count)
                          for topic, count in self.counts.items())
        statistics = _record(
            _OP_STATISTICS, struct.pack(
                '<QHIIIIQQ', self.counts.total(), len(self._channels), len(self._channels), 0, 0,
                len(self._summary[_OP_CHUNK_INDEX]), self.start_ns, self.end_ns),
            _prefix_size(counts))
        summary = b''.join(record for records in self._summary.values() for record in records)
        footer = _record(_OP_FOOTER, struct.pack('<QQI', start, 0, 0))
        return end + summary + statistics + footer + MCAP_MAGIC


def _record(kind: int, *parts: bytes | bytearray) -> bytes:
    return b''.join((struct.pack('<BQ', kind, sum(map(len, parts))), *parts))


def _prefix_size(data: bytes | bytearray) -> bytes:
    return struct.pack('<I', len(data)) + data


def _text(text: str) -> bytes:
    return _prefix_size(text.encode())


@cache
def definition(msgtype: str) -> str:
    """
    Return the definition text of a type.

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


def mark_incomplete(folder: Path) -> None:
    """
    Mark a bag as not finished.

    :raises OSError: if the mark cannot be written.
    """
    (folder / MARK).write_text(f'This bag is incomplete: {_UNFINISHED}\n')


def incomplete(path: Path) -> str:
    """Return why a bag (a folder, or a file in it) is unfinished; '' if it is finished."""
    folder = path if path.is_dir() else path.parent
    return _UNFINISHED if (folder / MARK).exists() else ''


def mcap_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a recording in the order in which they were written."""
    return sorted((file for file in folder.iterdir() if file.suffix == '.mcap'),
                  key=lambda file: (len(file.name), file.name))


def finish(folder: Path, files: Sequence[McapFile]) -> None:
    """
    Write the ``metadata.yaml`` of a bag of several closed files, and remove its mark.

    :raises OSError: if ``metadata.yaml`` cannot be written, or the mark cannot be removed.
    """
    counts: Counter[RecordedTopic] = Counter()
    for file in files:
        counts.update(file.counts)
    with whole_file(folder / METADATA) as metadata:  # as rosbag2 has it; JSON is YAML
        metadata.write(json.dumps({'rosbag2_bagfile_information': {
            'version': 9, 'storage_identifier': 'mcap', 'compression_format': '',
            'compression_mode': '', 'custom_data': None, 'ros_distro': 'jazzy',
            'relative_file_paths': [file.path.name for file in files],
            'message_count': counts.total(), **_span(files),
            'files': [{'path': file.path.name, 'message_count': file.counts.total(),
                       **_span([file])} for file in files],
            'topics_with_message_count': [{
                'topic_metadata': {
                    'name': topic.name, 'type': topic.msgtype, 'serialization_format': 'cdr',
                    'offered_qos_profiles': topic.qos,
                    'type_description_hash': type_hash(topic.msgtype)},
                'message_count': count} for topic, count in counts.items()]}}, indent=1).encode())
    (folder / MARK).unlink()


def _span(files: Sequence[McapFile]) -> dict[str, Any]:
    start = min((file.start_ns for file in files if file.counts), default=0)
    end = max((file.end_ns for file in files), default=0)
    return {'starting_time': {'nanoseconds_since_epoch': start},
            'duration': {'nanoseconds': end - start}}
