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

Whatever the format, a reader gets ROS 2 Jazzy types serialised as CDR. ROS 2 messages pass
through undecoded; ROS 1 messages are migrated (``Header.seq`` dropped, ``time`` and ``duration``
to ``builtin_interfaces``, fields in lower case, as ``CameraInfo``'s D, K, R, P).
Every failure is a :class:`BagError` whose message is one line. Damage inside a message shows only
where the format carries a checksum: MCAP chunks (always in the bags written here) and ROS 1
chunks compressed with bz2.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Connection, ConnectionExtRosbag1, QosDurability
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader

from flock_follower.bags.mcap_file import incomplete, mcap_files, METADATA
from flock_follower.bags.message_types import migration_obstacle, typestore
from flock_follower.bags.unfinished import has_end, UnfinishedReader

_UNREADABLE = 'corrupt, truncated or unsupported'


class BagError(ValueError):
    """A bag that cannot be read or written; the message is one line for the user."""


class BagMessage(NamedTuple):
    """One message: its topic, ROS 2 type, recording time [ns] and serialised CDR bytes."""

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
    Return the typestore message held in CDR bytes; its arrays, as pixels, are views of them.

    :raises BagError: the type is not one of ROS 2 Jazzy's, or the bytes do not fit it.
    """
    if msgtype not in typestore().types:
        raise BagError(f'unknown message type {msgtype}')
    with failures(msgtype, 'corrupt message'):
        return typestore().deserialize_cdr(memoryview(data), msgtype)


class Bag(AbstractContextManager['Bag']):
    """
    An open bag; use :func:`open_bag`, and ``with`` to close it.

    ``topics`` maps names to :class:`Topic`, ``skipped`` maps the names of topics that cannot be
    read to the reason; ``start_ns`` and ``end_ns`` are the stamps of the first and last message;
    ``incomplete`` is the reason if the bag was never finished, else ''.
    """

    def __init__(self, path: Path, reader: Rosbag1Reader | Rosbag2Reader | UnfinishedReader,
                 reason: str = '') -> None:
        self.path = path
        self.incomplete = reason
        self.topics: dict[str, Topic] = {}
        self.skipped: dict[str, str] = {}
        self.start_ns, self.end_ns = reader.start_time, reader.end_time - 1
        self._reader = reader
        groups: dict[str, list[Connection]] = {}
        for connection in reader.connections:
            groups.setdefault(absolute(connection.topic), []).append(connection)
        for name, connections in sorted(groups.items()):
            if why := _unreadable(connections):
                self.skipped[name] = why
            else:
                self.topics[name] = Topic(
                    name, connections[0].msgtype, sum(c.msgcount for c in connections),
                    any(map(_latched, connections)))
        self._connections = groups

    @property
    def duration_ns(self) -> int:
        """Return the time from the first to the last message [ns]."""
        return int(self.end_ns - self.start_ns)

    @property
    def message_count(self) -> int:
        """Return the number of readable messages."""
        return sum(topic.count for topic in self.topics.values())

    def select(self, topics: Collection[str] = ()) -> list[str]:
        """
        Return the absolute names of the topics requested, all readable ones if none are named.

        :raises BagError: the bag does not hold one of them, or cannot read it.
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

        :raises BagError: an unknown topic, or data that is corrupt or incomplete.
        """
        names = self.select(topics)
        yielded = 0
        with failures(self.path, _UNREADABLE):
            for connection, stamp_ns, raw in self._reader.messages(
                    connections=[c for name in names for c in self._connections[name]],
                    start=start_ns, stop=stop_ns):
                topic = self.topics[absolute(connection.topic)]
                yielded += 1
                if isinstance(connection.ext, ConnectionExtRosbag1):
                    raw = bytes(typestore().ros1_to_cdr(raw, topic.msgtype))
                yield BagMessage(topic.name, topic.msgtype, stamp_ns, raw)
        announced = sum(self.topics[name].count for name in names)
        if start_ns is None and stop_ns is None and yielded != announced:
            raise BagError(
                f'{self.path}: {_UNREADABLE}: {yielded} of {announced} announced messages found')

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def __exit__(self, *_: object) -> None:
        """Close the bag."""
        self.close()


def open_bag(path: str | Path) -> Bag:
    """
    Open a ROS 1 ``.bag``, a ROS 2 bag directory, or a bare ``.mcap`` or ``.db3`` file.

    One in MCAP that was never finished is read as far as it goes, see ``Bag.incomplete``.

    :raises BagError: it is missing, empty, corrupt, truncated or of an unknown format.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise BagError(f'{path}: no such bag')
    if path.suffix not in ('.bag', '.mcap', '.db3') and not path.is_dir():
        raise BagError(f'{path}: unknown format: must be .bag, .mcap, .db3 or a ROS 2 bag folder')
    with failures(path, _UNREADABLE):
        _refuse_unclosed(path)
        files = mcap_files(path) if path.is_dir() else [path] if path.suffix == '.mcap' else []
        reason = incomplete(path) or _missing_end(path, files)
        reader: Rosbag1Reader | Rosbag2Reader | UnfinishedReader
        if files and reason:
            reader = UnfinishedReader(files)
        elif path.suffix == '.bag' and path.is_file():
            reader = Rosbag1Reader(path)
        else:
            reader = Rosbag2Reader(path)
    with failures(path, f'incomplete ({reason}), and {_UNREADABLE}' if reason else _UNREADABLE):
        reader.open()
        bag = Bag(path, reader, reason)
        if bag.message_count == 0:
            bag.close()
            reasons = ''.join(f'; {name}: {why}' for name, why in bag.skipped.items())
            raise BagError(f'{path}: holds no message that can be read{reasons}')
    return bag


def _refuse_unclosed(path: Path) -> None:
    """
    Refuse a folder that no recorder finished, and an SQLite file that none closed.

    SQLite's readers ignore rows in a write-ahead log, as if nothing were missing.
    """
    if path.is_dir() and not mcap_files(path) and not (path / METADATA).is_file():
        raise BagError(f'{path}: no {METADATA} in it, so not a finished ROS 2 bag')
    for log in path.glob('*.db3-wal') if path.is_dir() else [Path(f'{path}-wal')]:
        if log.exists() and log.stat().st_size:
            raise BagError(f'{path}: recording was not closed: {log.name} holds part of it')


def _missing_end(path: Path, files: Sequence[Path]) -> str:
    """Return the part of a finished bag that MCAP files lack, or ''."""
    for file in files:
        if not has_end(file):
            return f'{file.name} was cut short'
    if files and path.is_dir() and not (path / METADATA).is_file():
        return 'no metadata.yaml in it'
    return ''


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
    """Return the name of a topic with a slash before it, and none after it."""
    return f'/{topic.strip("/")}'


def _latched(connection: Connection) -> bool:
    if isinstance(connection.ext, ConnectionExtRosbag1):
        return bool(connection.ext.latching)
    return any(qos.durability is QosDurability.TRANSIENT_LOCAL
               for qos in connection.ext.offered_qos_profiles)


def _unreadable(connections: list[Connection]) -> str | None:
    """Return why the messages of one topic cannot be handed out as ROS 2 CDR, or None."""
    msgtypes = sorted({c.msgtype for c in connections})
    if len(msgtypes) > 1:
        return f'several types on one topic ({", ".join(msgtypes)})'
    for connection in connections:
        if not isinstance(connection.ext, ConnectionExtRosbag1):
            if connection.ext.serialization_format != 'cdr':
                return f'serialised as {connection.ext.serialization_format!r}, not CDR'
        elif reason := migration_obstacle(connection.msgtype, connection.msgdef.data):
            return reason
    return None
