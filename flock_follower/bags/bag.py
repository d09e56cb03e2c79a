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
Read bags: ROS 1 ``.bag``, ROS 2 sqlite3 and MCAP, without ROS.

For every format, a reader returns ROS 2 Jazzy types serialized as CDR. ROS 2 messages are returned
without decoding. ROS 1 messages are converted: ``Header.seq`` is dropped, ``time`` and
``duration`` become ``builtin_interfaces``, and names of fields become lower case, such as
``CameraInfo``'s D, K, R, P. Every failure is a :class:`BagError` whose message is one line. Damage
inside a message is detected only if the format has a checksum: MCAP chunks (always in the bags
written here) and ROS 1 chunks compressed with bz2.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from copy import copy
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rosbags.interfaces import Connection, ConnectionExtRosbag1, QosDurability
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.rosbag2.storage_mcap import McapReader

from flock_follower.bags.bag_files import BagFiles, find_files, packed_fault, ZSTD
from flock_follower.bags.message_types import migration_obstacle, typestore
from flock_follower.bags.sequential import (
    in_order,
    is_compressed,
    overlap,
    SequentialReader,
    Span,
)

_UNREADABLE = 'corrupt, truncated or unsupported'
_UNTYPED = '__schemaless__'  # rosbags' type of a channel whose schema the summary does not repeat
Reader: TypeAlias = Rosbag1Reader | Rosbag2Reader | SequentialReader


class BagError(ValueError):
    """A bag that cannot be read or written; the message is one line for the user."""


class BagMessage(NamedTuple):
    """One message: its topic, ROS 2 type, recording time [ns] and serialized CDR bytes."""

    topic: str
    msgtype: str
    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class Topic:
    """One topic of a bag; ``latched`` is ROS 1's term for transient local."""

    name: str
    msgtype: str
    count: int
    latched: bool


def serialize(message: Any, msgtype: str) -> bytes:
    """Return the little-endian CDR bytes of a typestore message."""
    return bytes(typestore().serialize_cdr(message, msgtype, little_endian=True))


def deserialize(data: bytes, msgtype: str) -> Any:
    """
    Return the typestore message in CDR bytes; its arrays, such as pixels, are views of the bytes.

    :raises BagError: if ROS 2 Jazzy does not have the type, or the bytes do not fit the type.
    """
    if msgtype not in typestore().types:
        raise BagError(f'unknown message type {msgtype}')
    with failures(msgtype, 'corrupt message'):
        return typestore().deserialize_cdr(memoryview(data), msgtype)


class Bag(AbstractContextManager['Bag']):
    """
    An open bag; use :func:`open_bag`, and ``with`` to close it.

    ``topics`` maps names to :class:`Topic`; ``skipped`` maps each topic that cannot be read to the
    reason. ``start_ns`` and ``end_ns`` are the stamps of the first and last message.
    ``incomplete`` is the reason if the bag was never finished, else ''.
    """

    def __init__(self, path: Path, reader: Reader, reason: str = '', remedy: str = '') -> None:
        self.path = path
        self.incomplete = reason
        self.topics: dict[str, Topic] = {}
        self.skipped: dict[str, str] = {}
        self._reader = reader
        self._unreadable = f'{_UNREADABLE} (to save what is whole: {remedy})'
        # The files of a folder are the authority: its metadata.yaml may describe them otherwise.
        files = _storages(reader)
        self.start_ns = min(file.metadata.start_time for file in files) if files else (
            reader.start_time)
        self.end_ns = (max(file.metadata.end_time for file in files) if files else (
            reader.end_time)) - 1
        described = _by_topic(reader.connections)
        self._connections = {**described, **_by_topic(
            connection for file in files for connection in file.connections)}
        for name, connections in sorted(self._connections.items()):
            announced = described.get(name, [])
            if why := _unreadable(connections):
                self.skipped[name] = why
            else:
                self.topics[name] = Topic(
                    name, connections[0].msgtype, max(
                        sum(c.msgcount for c in each) for each in (connections, announced)),
                    any(map(_is_latched, (*connections, *announced))))

    @property
    def duration_ns(self) -> int:
        """Return the time from the first to the last message [ns]."""
        return int(self.end_ns - self.start_ns)

    @property
    def set_back_ns(self) -> int:
        """
        Return by how much the clock was set back during the recording, ns; about 0 if it was not.

        Messages are returned in the order of their times, so messages from before and after the
        step are mixed.
        """
        if isinstance(self._reader, SequentialReader):
            return max(self._reader.disorder, overlap(self._reader.spans.values()))
        files = _storages(self._reader)
        back = overlap(map(_span, files))
        for file in files or [getattr(self._reader, 'storage', None)]:
            newest = 0
            for chunk in sorted(getattr(file, 'chunks', []), key=lambda c: c.chunk_start_offset):
                newest = max(newest, chunk.message_start_time)
                back = max(back, newest - chunk.message_start_time)
        return back

    @property
    def message_count(self) -> int:
        """Return the number of readable messages."""
        return sum(topic.count for topic in self.topics.values())

    def select(self, topics: Collection[str] = ()) -> list[str]:
        """
        Return the absolute names of the requested topics; of all readable topics if none is named.

        :raises BagError: if a requested topic is not in the bag, or cannot be read.
        """
        names = list(dict.fromkeys(map(absolute, topics))) or list(self.topics)
        for name in names:
            if name in self.skipped:
                raise BagError(f'{self.path}: topic {name} cannot be read: {self.skipped[name]}')
            if name not in self.topics:
                raise BagError(
                    f'{self.path}: holds no topic {name}, only {", ".join(self.topics)}')
        return names

    def messages(
        self, topics: Collection[str] = (), start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """
        Yield the messages of the given topics with ``start_ns <= stamp_ns < stop_ns``, in order.

        :raises BagError: if a topic is unknown, or data is corrupt or incomplete.
        """
        names = self.select(topics)
        yielded = 0
        with failures(self.path, self._unreadable):
            for connection, stamp_ns, raw in self._read(
                    [c for name in names for c in self._connections[name]], start_ns, stop_ns):
                topic = self.topics[absolute(connection.topic)]
                yielded += 1
                if isinstance(connection.ext, ConnectionExtRosbag1):
                    raw = bytes(typestore().ros1_to_cdr(raw, topic.msgtype))
                yield BagMessage(topic.name, topic.msgtype, stamp_ns, raw)
        announced = sum(self.topics[name].count for name in names)
        if start_ns is None and stop_ns is None and yielded < announced:
            raise BagError(
                f'{self.path}: {self._unreadable}: {yielded} of {announced} announced messages '
                f'found; if only metadata.yaml is wrong: ros2 bag reindex {self.path}')

    def _read(self, connections: Collection[Connection], start: int | None, stop: int | None
              ) -> Iterator[tuple[Connection, int, bytes]]:
        files = _storages(self._reader)
        if not files:
            return self._reader.messages(connections=connections, start=start, stop=stop)
        # rosbags reads the files of a folder one after the other, however they overlap in time.
        folders = [copy(self._reader.storage) for _ in files]  # type: ignore[union-attr]
        for folder, file in zip(folders, files):
            folder.storages = [file]
        return in_order([(_span(file), folder.messages(connections, start, stop))
                         for folder, file in zip(folders, files)])

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def __exit__(self, *_: object) -> None:
        """Close the bag."""
        self.close()


def open_bag(path: str | Path) -> Bag:
    """
    Open a ROS 1 ``.bag``, a ROS 2 bag directory, or a bare ``.mcap`` or ``.db3`` file.

    If rosbags refuses a file, or cannot read its last message, the file is read sequentially. An
    unfinished MCAP file is read up to its last whole chunk, see ``Bag.incomplete``.

    :raises BagError: if the bag is missing, empty, corrupt, truncated or of an unknown format.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise BagError(f'{path}: no such bag')
    if path.suffix == ZSTD and path.is_file():
        raise BagError(f'{path}: {packed_fault([path])}')
    if path.suffix not in ('.bag', '.mcap', '.db3') and not path.is_dir():
        raise BagError(f'{path}: unknown format: must be .bag, .mcap, .db3 or a ROS 2 bag folder')
    if path.suffix == '.bag' and path.is_file():
        reason, remedy = '', f'rosbag reindex {path}'
        with failures(path, f'{_UNREADABLE} (to save what is whole: {remedy})'):
            reader: Reader = Rosbag1Reader(path)
            reader.open()
            bag = Bag(path, reader, reason, remedy)
    else:
        try:
            files = find_files(path)
        except (OSError, ValueError) as error:
            raise BagError(f'{path}: {getattr(error, "strerror", "") or error}') from error
        reason, remedy = files.fault, files.remedy
        what = f'{_UNREADABLE} (to save what is whole: {remedy})'
        with failures(path, f'incomplete ({reason}), and {what}' if reason else what):
            bag = Bag(path, _ros2_reader(path, files), reason, remedy)
    if bag.message_count == 0:
        bag.close()
        reasons = ''.join(f'; {name}: {why}' for name, why in bag.skipped.items())
        raise BagError(f'{path}: holds no message that can be read{reasons}')
    return bag


def _ros2_reader(path: Path, files: BagFiles) -> Rosbag2Reader | SequentialReader:
    """
    Return an open reader: rosbags' if it reads every message, else the sequential one.

    :raises Exception: whatever the libraries raise for damage.
    """
    refusal: Exception | None = None
    if files.compressed or not files.fault:
        try:
            reader = Rosbag2Reader(path)
            reader.open()
            if files.compressed or (not _is_compressed(reader) and all(
                    map(_is_indexed, _storages(reader) or [reader.storage]))):
                return reader
            reader.close()
        except Exception as error:  # as many as it has reasons to refuse a file
            if files.compressed:
                raise
            refusal = error
    sequential = SequentialReader(files.paths)
    try:
        sequential.open()
    except ValueError as error:
        raise error from refusal
    return sequential


def _storages(reader: Reader) -> list[Any]:
    """Return rosbags' readers of the files of a folder; none for other readers."""
    return getattr(getattr(reader, 'storage', None), 'storages', [])


def _span(storage: Any) -> Span:
    return Span(storage.metadata.start_time, storage.metadata.end_time,
                {connection.topic for connection in storage.connections})


def _is_indexed(storage: Any) -> bool:
    """Return whether a file's index lists every message and its type."""
    if not isinstance(storage, McapReader):
        return True
    indexed = sum(sum(chunk.channel_count.values()) for chunk in storage.chunks)
    listed = sum(connection.msgcount for connection in storage.connections)
    return indexed == listed == storage.metadata.message_count and all(
        connection.msgtype != _UNTYPED for connection in storage.connections)


def _is_compressed(reader: Rosbag2Reader) -> bool:
    """Return whether the first message is compressed."""
    return any(is_compressed(connection.ext.serialization_format, data)
               for connection, _, data in islice(reader.messages(), 1))


def _by_topic(connections: Iterable[Connection]) -> dict[str, list[Connection]]:
    """Return connections by the absolute names of their topics."""
    groups: dict[str, list[Connection]] = {}
    for connection in connections:
        groups.setdefault(absolute(connection.topic), []).append(connection)
    return groups


@contextmanager
def failures(subject: str | Path, what: str) -> Iterator[None]:
    """Turn every exception that the libraries raise for a damaged file into a BagError."""
    try:
        yield
    except BagError:
        raise
    except OSError as error:
        raise BagError(f'{subject}: {error.strerror or error}') from error
    except Exception as error:  # struct, yaml, sqlite, zlib, assertion and type errors alike
        reason = ' '.join(str(error).split())
        raise BagError(f'{subject}: {what}{": " if reason else ""}{reason}') from error


def absolute(topic: str) -> str:
    """Return the name of a topic with one leading slash and no trailing slash."""
    return f'/{topic.strip("/")}'


def _is_latched(connection: Connection) -> bool:
    if isinstance(connection.ext, ConnectionExtRosbag1):
        return bool(connection.ext.latching)
    return any(qos.durability is QosDurability.TRANSIENT_LOCAL
               for qos in connection.ext.offered_qos_profiles)


def _unreadable(connections: list[Connection]) -> str | None:
    """Return why the messages of one topic cannot be returned as ROS 2 CDR, or None."""
    msgtypes = sorted({c.msgtype for c in connections})
    if len(msgtypes) > 1:
        return f'several types on one topic ({", ".join(msgtypes)})'
    for connection in connections:
        if not isinstance(connection.ext, ConnectionExtRosbag1):
            if connection.ext.serialization_format != 'cdr':
                return f'serialized as {connection.ext.serialization_format!r}, not CDR'
        elif reason := migration_obstacle(connection.msgtype, connection.msgdef.data):
            return reason
    return None
