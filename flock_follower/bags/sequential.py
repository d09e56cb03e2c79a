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
Sequential reader of ROS 2 recordings: needs no index, and changes no file.

rosbags needs the end and the index of a file, and the ``metadata.yaml`` of a folder, and refuses a
file if one channel is not of ROS 2. This reader needs only the content of the files, and reads the
files one after the other; an MCAP file without an end is read up to its last whole chunk. The
library mcap reads MCAP files; a vehicle does not need this library.

``in_order`` and ``overlap`` serve both readers: the files of a folder may overlap in time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import closing
import heapq
from itertools import chain
from pathlib import Path
import sqlite3
import sys
from typing import NamedTuple

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
)
from rosbags.rosbag2.metadata import parse_qos

from flock_follower.bags.bag_files import has_end, MCAP

_ROS1, _CDR = 'ros1', 'cdr'
_ZSTD = b'\x28\xb5\x2f\xfd'  # the first bytes of compressed data; those of CDR are 0


class _Channel(NamedTuple):
    """The channel of a message; ``encoding`` is that of its bytes."""

    topic: str
    msgtype: str
    encoding: str
    definition: str = ''
    qos: str = ''


_Record = tuple[_Channel, int, bytes]
_Message = tuple[Connection, int, bytes]


class Span(NamedTuple):
    """First stamp of a file, one ns more than its last stamp, and its topics."""

    start: int
    end: int
    topics: set[str]


class SequentialReader:
    """
    Files of a recording, read one after the other, with rosbags' interface of a reader.

    The messages of each file are in the order of their stamps; ``in_order`` gives the order of
    several files. ``start_time`` is the stamp of the first message, ``end_time`` one nanosecond
    more than the stamp of the last message, ns.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.start_time, self.end_time = 2**63, 0
        self._files = files
        self.spans: dict[Path, Span] = {}
        """A span for each file that holds messages."""
        self._connections: dict[_Channel, Connection] = {}
        self.disorder = 0  # ns by which a message may be older than one before it in its file

    @property
    def connections(self) -> list[Connection]:
        """Return the topics that hold messages."""
        return list(self._connections.values())

    def open(self) -> None:
        """
        Scan the files, and omit empty files.

        :raises ValueError: all files are empty, a file holds fewer messages than its index states,
            or the library mcap is not installed.
        """
        counts: Counter[_Channel] = Counter()
        for file in self._files:
            newest = 0
            for channel, stamp, _ in _records(file):
                counts[channel] += 1
                newest = max(newest, stamp)
                self.disorder = max(self.disorder, newest - stamp)
                span = self.spans.setdefault(file, Span(stamp, stamp + 1, set()))
                span.topics.add(channel.topic)
                if not span.start <= stamp < span.end:
                    self.spans[file] = span._replace(
                        start=min(span.start, stamp), end=max(span.end, stamp + 1))
            if file in self.spans:
                self.start_time = min(self.start_time, self.spans[file].start)
                self.end_time = max(self.end_time, self.spans[file].end)
        if not counts:
            raise ValueError('it holds no message, or was cut short before its first: nothing is '
                             'in it')
        self._connections = {
            channel: _connection(number, channel, count)
            for number, (channel, count) in enumerate(counts.items(), 1)}

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Iterator[_Message]:
        """Yield the messages of some connections from ``start`` to before ``stop``, ns."""
        wanted = {one.id for one in connections}
        first, end = start or 0, self.end_time if stop is None else stop
        return in_order([(span, self._messages_of(file, wanted, first, end))
                         for file, span in self.spans.items()])

    def _messages_of(self, file: Path, wanted: Collection[int], start: int, stop: int
                     ) -> Iterator[_Message]:
        newest = 0
        held: list[tuple[int, int, Connection, bytes]] = []
        for number, (channel, stamp, data) in enumerate(_records(file)):
            newest = max(newest, stamp)
            connection = self._connections[channel]
            if connection.id in wanted and start <= stamp < stop:
                heapq.heappush(held, (stamp, number, connection, decompress(data) if is_compressed(
                    channel.encoding, data) else data))
            while held and held[0][0] <= newest - self.disorder:
                yield _message_of(heapq.heappop(held))
        while held:
            yield _message_of(heapq.heappop(held))

    def close(self) -> None:
        """Do nothing: no file stays open."""


def overlap(files: Iterable[Span]) -> int:
    """Return by how much a file begins before the end of an earlier file with its topics, ns."""
    longest, before = 0, list[Span]()
    for span in files:
        for other in before:
            if span.end > other.start and span.topics & other.topics:
                longest = max(longest, other.end - 1 - span.start)
        before.append(span)
    return longest


def in_order(files: Sequence[tuple[Span, Iterator[_Message]]]) -> Iterator[_Message]:
    """
    Yield the messages of several files; each file has its messages in the order of their stamps.

    Files that overlap in time are merged by the stamps. Other files are read one after the other,
    so a clock that was set back between two files remains visible.
    """
    groups: list[list[int]] = []
    for number, (span, _) in enumerate(files):
        near = [group for group in groups if any(
            span.start < files[i][0].end and files[i][0].start < span.end for i in group)]
        groups = [group for group in groups if group not in near]
        groups.append(sorted((*chain(*near), number)))
    for group in sorted(groups):
        yield from _merge([files[i] for i in group])


def _merge(files: Sequence[tuple[Span, Iterator[_Message]]]) -> Iterator[_Message]:
    """Yield messages by their stamps; a file is not read before its first stamp."""
    waiting = sorted(((span.start, number, messages)
                      for number, (span, messages) in enumerate(files)), reverse=True)
    opened: list[tuple[int, int, _Message, Iterator[_Message]]] = []

    def read_on(number: int, messages: Iterator[_Message]) -> None:
        message = next(messages, None)
        if message is not None:
            heapq.heappush(opened, (message[1], number, message, messages))

    while waiting or opened:
        if waiting and (not opened or waiting[-1][0] <= opened[0][0]):
            read_on(*waiting.pop()[1:])
        else:
            _, number, message, messages = heapq.heappop(opened)
            yield message
            read_on(number, messages)


def is_compressed(encoding: str, data: bytes) -> bool:
    """Return whether a message is compressed: only the metadata.yaml of its folder says so."""
    return encoding == _CDR and data.startswith(_ZSTD)


def decompress(data: bytes) -> bytes:
    """
    Return compressed data as they were.

    :raises Exception: the library's, if they are damaged.
    """
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd  # installed by rosbags
    return zstd.decompress(data)


def _message_of(held: tuple[int, int, Connection, bytes]) -> _Message:
    stamp, _, connection, data = held
    return connection, stamp, data


def _records(file: Path) -> Iterator[_Record]:
    """
    Yield the channel, the stamp, ns, and the bytes of each message of a file, as it holds them.

    :raises ValueError: it holds less than it announces, or the library mcap is not installed.
    :raises Exception: whatever the libraries raise for damage in a file that has an end.
    """
    return _mcap_records(file) if file.suffix == MCAP else _sqlite_records(file)


def _mcap_records(path: Path) -> Iterator[_Record]:
    try:
        from mcap.records import Channel, Message, Schema, Statistics
        from mcap.stream_reader import StreamReader
    except ImportError:
        raise ValueError('its end or its index is missing, or a channel is not of ROS 2; to read '
                         'it needs the library mcap: pip install mcap') from None
    schemas: dict[int, Schema] = {}
    channels: dict[int, _Channel] = {}
    found = announced = 0
    with path.open('rb') as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Message):
                    found += 1
                    yield channels[record.channel_id], record.log_time, record.data
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = schemas.get(record.schema_id)
                    channels[record.id] = _Channel(
                        record.topic, _type_name(schema.name if schema else ''),
                        record.message_encoding,
                        schema.data.decode(errors='replace') if schema else '',
                        record.metadata.get('offered_qos_profiles', ''))
                elif isinstance(record, Statistics):
                    announced = record.message_count
        except Exception:
            if has_end(path):
                raise
    if found < announced:
        raise ValueError(f'{found} of {announced} announced messages found')


def _sqlite_records(path: Path) -> Iterator[_Record]:
    if not path.stat().st_size:
        return
    with closing(sqlite3.connect(f'{path.resolve().as_uri()}?immutable=1', uri=True)) as file:
        described = {row[1] for row in file.execute('PRAGMA table_info(topics)')}
        qos = 'offered_qos_profiles' if 'offered_qos_profiles' in described else "''"
        channels = {
            number: _Channel(topic, _type_name(msgtype), encoding, '', profiles or '')
            for number, topic, msgtype, encoding, profiles in file.execute(
                f'SELECT id, name, type, serialization_format, {qos} FROM topics')}
        for number, stamp, data in file.execute(
                'SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp'):
            yield channels[number], stamp, data


def _type_name(name: str) -> str:
    """Return the ROS 2 name of a type: ROS 1 has no ``msg`` in it."""
    package, *others = name.split('/')
    return f'{package}/msg/{others[0]}' if len(others) == 1 else name


def _connection(number: int, channel: _Channel, count: int) -> Connection:
    return Connection(
        number, channel.topic, channel.msgtype,
        MessageDefinition(MessageDefinitionFormat.MSG, channel.definition), '', count,
        ConnectionExtRosbag1(None, None) if channel.encoding == _ROS1
        else ConnectionExtRosbag2(channel.encoding, _profiles(channel.qos)), None)


def _profiles(qos: str) -> list[Qos]:
    """Return the QoS profiles; an empty list if the text cannot be parsed."""
    try:
        return parse_qos(qos)
    except Exception:  # the recorder's text: anything can be wrong, and no message depends on it
        return []
