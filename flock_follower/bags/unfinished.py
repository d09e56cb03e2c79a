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

rosbags wants a file's end, and a folder's ``metadata.yaml``. Where the former is missing it is
given one to read behind the last good chunk; where the latter is, or tells of too little, the
files of the folder are read one after the other.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
import io
from pathlib import Path
import struct
from typing import Any, BinaryIO, cast

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from flock_follower.bags.integrity import (
    has_mcap_end,
    MCAP_CHUNK,
    MCAP_END,
    MCAP_MAGIC,
    mcap_records,
)

_SCHEMA, _CHANNEL, _MESSAGE = 0x03, 0x04, 0x05
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
    if files and path.is_dir() and not (path / 'metadata.yaml').is_file():
        return 'no metadata.yaml in it'
    return ''


def mcap_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a recording in the order in which they were written."""
    return sorted((file for file in folder.iterdir() if file.suffix == '.mcap'),
                  key=lambda file: (len(file.name), file.name))


class UnfinishedReader:
    """
    The files of a recording, read one after the other, with rosbags' interface of a reader.

    :param path: an MCAP file, or a folder of them.
    """

    def __init__(self, path: Path) -> None:
        self.connections: list[Connection] = []
        self._path = path
        self._readers: list[Reader] = []

    @property
    def start_time(self) -> int:
        """Return the stamp of the first message, ns."""
        return min(reader.start_time for reader in self._readers)

    @property
    def end_time(self) -> int:
        """Return a nanosecond more than the stamp of the last message."""
        return max(reader.end_time for reader in self._readers)

    def open(self) -> None:
        """
        Open the files; those that hold nothing are left out.

        :raises ValueError: all of them hold nothing.
        """
        files = mcap_files(self._path) if self._path.is_dir() else [self._path]
        try:
            for file in files:
                mended = _Mended(file)
                if not mended.size:
                    continue
                reader = Reader(cast(Any, mended))
                reader.open()
                if reader.message_count:
                    self._readers.append(reader)
                    self.connections += reader.connections
                else:
                    reader.close()
        except BaseException:
            self.close()
            raise
        if not self._readers:
            raise ValueError(f'{_NOTHING}, nothing is in it')

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the messages of some connections from ``start`` to before ``stop``, ns."""
        for reader in self._readers:
            if own := [one for one in reader.connections if one in connections]:
                yield from reader.messages(connections=own, start=start, stop=stop)

    def close(self) -> None:
        """Close the files."""
        for reader in self._readers:
            reader.close()
        self._readers.clear()


class _Mended:
    """An MCAP file as rosbags takes a path, with an end where it has none; ``size`` in bytes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.name, self.suffix = path.name, path.suffix
        with path.open('rb') as file:
            if has_mcap_end(file):
                self._good, self._tail = file.tell(), b''
            else:
                self._good, self._tail = _tail(file)
        self.size = self._good + len(self._tail)

    def __str__(self) -> str:
        """Return the path of the file."""
        return str(self._path)

    def exists(self) -> bool:
        """Return True: it was read."""
        return True

    def is_dir(self) -> bool:
        """Return False."""
        return False

    def open(self, *_: Any) -> BinaryIO:
        """Return it open for reading."""
        file = self._path.open('rb')
        if not self._tail:
            return file
        return io.BufferedReader(_Joined(file, self._good, self._tail))


class _Joined(io.RawIOBase):
    """The first ``good`` bytes of a file, then others."""

    def __init__(self, file: BinaryIO, good: int, tail: bytes) -> None:
        self._file, self._good, self._tail = file, good, tail
        self._at = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the position."""
        return self._at

    def seek(self, offset: int, whence: int = 0) -> int:
        """Set the position and return it."""
        self._at = offset + (0, self._at, self._good + len(self._tail))[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer, and return how many bytes."""
        if self._at < self._good:
            self._file.seek(self._at)
            data = self._file.read(min(len(buffer), self._good - self._at))
        else:
            data = self._tail[self._at - self._good:][:len(buffer)]
        buffer[:len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def _tail(file: BinaryIO) -> tuple[int, bytes]:
    """
    Return how many bytes of a file are good, and an end for it; (0, b'') where none are.

    Chunks that are not compressed are listed in it, so that a reader can sort their messages.
    """
    good = 0
    listed: bytearray | None = bytearray()
    repeated: dict[bytes, None] = {}
    for record in mcap_records(file):
        good = record.end
        if record.kind != MCAP_CHUNK or listed is None:
            continue
        file.seek(record.start)
        content = file.read(record.end - record.start)
        if content[28:32] != bytes(4):
            listed = None  # compressed: its channels are not to be seen from here
            continue
        counts = _counts(content[40:], repeated)
        place = record.end
        offsets = bytearray()
        for channel, count in counts.items():
            offsets += struct.pack('<HQ', channel, place)
            place += 15 + 16 * count  # the length of the index that is, or would be, there
        entry = (content[:16] + struct.pack('<QQI', record.start - 9, len(content) + 9,
                                            len(offsets)) + offsets
                 + struct.pack('<QI', place - record.end, 0) + content[16:24] * 2)
        listed += struct.pack('<BQ', 0x08, len(entry)) + entry
    if not good or not listed:
        return good, MCAP_END if good else b''
    data_end = struct.pack('<BQI', 0x0F, 4, 0)
    summary = b''.join(repeated) + listed
    footer = struct.pack('<BQQQI', 0x02, 20, good + len(data_end), 0, 0)
    return good, data_end + summary + footer + MCAP_MAGIC


def _counts(content: bytes, repeated: dict[bytes, None]) -> dict[int, int]:
    """Return the messages in a chunk by channel, and note its schemas and channels."""
    counts: dict[int, int] = {}
    at = 0
    while at + 9 <= len(content):
        kind, length = struct.unpack_from('<BQ', content, at)
        if kind == _MESSAGE:
            channel, = struct.unpack_from('<H', content, at + 9)
            counts[channel] = counts.get(channel, 0) + 1
        elif kind in (_SCHEMA, _CHANNEL):
            repeated[content[at:at + 9 + length]] = None
        at += 9 + length
    return counts
