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
Reading ROS 2 recordings in MCAP that were never finished: as far as they go, changing nothing.

rosbags wants a file's end, and a folder's ``metadata.yaml``. If one is missing, the library mcap
reads the files of the folder one after the other, each up to its last good chunk. On a vehicle it
need not be installed: the black box completes unfinished files by itself.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2.metadata import parse_qos

from flock_follower.bags.description import mcap_files, METADATA
from flock_follower.bags.mcap_file import has_mcap_end, MCAP_MAGIC

_NOTHING = 'cut short before its first message'


def missing_end(path: Path) -> str:
    """
    Return what an MCAP file, or a folder of them, lacks that one that was finished has; or ''.

    :raises OSError: it cannot be read.
    """
    files = mcap_files(path) if path.is_dir() else [path] if path.suffix == '.mcap' else []
    for file in files:
        with file.open('rb') as opened:
            if opened.read(len(MCAP_MAGIC)) in (MCAP_MAGIC, b'') and not has_mcap_end(opened):
                return f'{file.name} was cut short'
    if files and path.is_dir() and not (path / METADATA).is_file():
        return 'no metadata.yaml in it'
    return ''


class UnfinishedReader:
    """
    The files of a recording, read one after the other, with rosbags' interface of a reader.

    :param path: an MCAP file, or a folder of them.
    """

    def __init__(self, path: Path) -> None:
        self.connections: list[Connection] = []
        self.start_time, self.end_time = 2**63, 0
        """The stamp of the first message, and a nanosecond more than that of the last, ns."""
        self._path = path
        self._files: dict[Path, dict[int, Connection]] = {}

    def open(self) -> None:
        """
        Look through the files; those that hold nothing are left out.

        :raises ValueError: all of them hold nothing, or the library mcap is not installed.
        """
        for file in mcap_files(self._path) if self._path.is_dir() else [self._path]:
            schemas, channels, counts = dict[int, Any](), dict[int, Any](), dict[int, int]()
            for record in _records(file):
                if hasattr(record, 'log_time'):
                    counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
                    self.start_time = min(self.start_time, record.log_time)
                    self.end_time = max(self.end_time, record.log_time + 1)
                else:
                    (channels if hasattr(record, 'topic') else schemas)[record.id] = record
            own = self._files[file] = {
                number: _connection(channels[number], schemas[channels[number].schema_id], count)
                for number, count in counts.items()}
            self.connections += own.values()
        if not self.connections:
            raise ValueError(f'{_NOTHING}, nothing is in it')

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the messages of some connections from ``start`` to before ``stop``, ns."""
        for file, own in self._files.items():
            wanted = {number: one for number, one in own.items() if one in connections}
            for record in _records(file):
                if hasattr(record, 'log_time') and record.channel_id in wanted and (
                        start or 0) <= record.log_time < (self.end_time if stop is None else stop):
                    yield wanted[record.channel_id], record.log_time, record.data

    def close(self) -> None:
        """Forget the files: none stays open."""
        self._files.clear()


def _connection(channel: Any, schema: Any, count: int) -> Connection:
    qos = channel.metadata.get('offered_qos_profiles')
    return Connection(
        channel.id, channel.topic, schema.name,
        MessageDefinition(MessageDefinitionFormat.MSG, schema.data.decode()), '', count,
        ConnectionExtRosbag2(channel.message_encoding, parse_qos(qos) if qos else []), None)


def _records(path: Path) -> Iterator[Any]:
    """
    Yield schemas, channels and messages, those of a chunk by their stamps, as far as it goes.

    :raises ValueError: the library mcap is not installed.
    :raises Exception: whatever the library raises for damage in a file that has an end.
    """
    try:
        from mcap.records import Chunk
        from mcap.stream_reader import breakup_chunk, StreamReader
    except ImportError:
        raise ValueError('its end is missing, and to read it without one needs the library mcap: '
                         'pip install mcap') from None
    with path.open('rb') as file:
        whole = has_mcap_end(file)
        file.seek(0)
        chunks = StreamReader(file, emit_chunks=True).records
        while True:
            try:
                record = next(chunks, None)
                if record is None:
                    return
                held = breakup_chunk(record, True) if isinstance(record, Chunk) else []
            except Exception:
                if whole:
                    raise
                return
            yield from sorted(held, key=lambda each: getattr(each, 'log_time', 0))
