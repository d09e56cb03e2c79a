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
Damage to bag files that neither SQLite nor rosbags notices, checksums against it, and its mark.

A bag's folder holds a file MARK from when it is made until it is finished. Where writing ended
otherwise (a full disk, an exception, a kill), the mark stays and says why, as far as could be
said: whoever reads the bag sees by it that the end is missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple
import zlib

#: The file in a bag's folder that says that the bag was not finished, and why.
MARK = 'INCOMPLETE.txt'

_MARK_SIZE = 400
_UNFINISHED = 'still being written, or the process that wrote it was killed'
#: The first and the last bytes of every MCAP file.
MCAP_MAGIC = b'\x89MCAP0\r\n'
MCAP_HEADER, MCAP_CHUNK, MCAP_MESSAGE_INDEX = 0x01, 0x06, 0x07
# Header, schema, channel, message, chunk, message index, attachment, metadata: what holds data.
_MCAP_DATA = (MCAP_HEADER, 0x03, 0x04, 0x05, MCAP_CHUNK, MCAP_MESSAGE_INDEX, 0x09, 0x0C)
#: Records "data end" and "footer", that of a file without a summary, and the magic bytes.
MCAP_END = (struct.pack('<BQI', 0x0F, 4, 0) + struct.pack('<BQQQI', 0x02, 20, 0, 0, 0)
             + MCAP_MAGIC)


def mark_incomplete(folder: Path, reason: str = _UNFINISHED) -> None:
    """
    Mark a bag as not finished, and say why.

    A mark that is there already is written over in place: a full disk has room for nothing new.

    :raises OSError: where there is no mark yet, and none can be made.
    """
    text = f'This bag is incomplete: {" ".join(reason.split())}'.encode()[:_MARK_SIZE - 1]
    line = text.ljust(_MARK_SIZE - 1) + b'\n'
    try:
        with (folder / MARK).open('r+b') as file:
            file.write(line)
    except FileNotFoundError:
        (folder / MARK).write_bytes(line)


def incomplete(path: Path) -> str:
    """Return why a bag, its folder or the file in it, was not finished; '' where it was."""
    mark = (path if path.is_dir() else path.parent) / MARK
    with suppress(OSError):
        return mark.read_text(errors='replace').partition(': ')[2].strip() or _UNFINISHED
    return ''


def end_mcap(path: Path) -> None:
    """
    Make an MCAP file whose writing broke off readable: cut it after its last whole chunk, end it.

    Without an index then, which readers make for themselves. Where the disk has no room for the 50
    bytes of the end, the last chunk makes way.

    :raises OSError: where the file cannot be written at all.
    """
    with path.open('rb') as file:
        if has_mcap_end(file):
            return  # whole: something else failed
        ends = [len(MCAP_MAGIC), *(record.end for record in mcap_records(file))]
    for end in reversed(ends):
        try:
            with path.open('r+b') as file:
                file.truncate(end)
                file.seek(end)
                file.write(MCAP_END)
            return
        except OSError:
            if end == ends[0]:
                raise


class McapRecord(NamedTuple):
    """A record of an MCAP file: its kind, and where its content begins and ends, in bytes."""

    kind: int
    start: int
    end: int


def has_mcap_end(file: BinaryIO) -> bool:
    """Return whether an MCAP file ends as one does that was finished."""
    size = file.seek(0, 2)
    file.seek(max(size - len(MCAP_MAGIC), 0))
    return size > len(MCAP_END) and file.read() == MCAP_MAGIC


def mcap_records(file: BinaryIO) -> Iterator[McapRecord]:
    """Yield the records that hold data, up to the first that is cut short or damaged."""
    size = file.seek(0, 2)
    file.seek(0)
    if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
        return
    while len(header := file.read(9)) == 9:
        kind, length = struct.unpack('<BQ', header)
        record = McapRecord(kind, file.tell(), file.tell() + length)
        if record.end > size or kind not in _MCAP_DATA:
            return
        if kind == MCAP_CHUNK and not _chunk_is_good(file.read(length)):
            return
        yield record
        file.seek(record.end)


def _chunk_is_good(content: bytes) -> bool:
    """Return whether a chunk is as it was written, where it carries a checksum of that."""
    if len(content) < 40:
        return False
    checksum, name = struct.unpack_from('<II', content, 24)
    return bool(name or not checksum or zlib.crc32(memoryview(content)[40:]) == checksum)


def sqlite3_problem(path: Path) -> str:
    """
    Return why a ``.db3`` file lost its end or was never closed; '' for all others.

    SQLite reads a file cut in its last pages, and one whose newest rows still lie in a
    write-ahead log, as if nothing were missing. Its header counts the pages (offsets: page
    size 16, change counter 24, pages 28, change counter the page count is valid for 92).
    """
    with path.open('rb') as file:
        header = file.read(100)
    if path.suffix != '.db3' or len(header) < 100:
        return ''
    page_size, changes, pages, valid_for = struct.unpack('>16xH6xII60xI4x', header)
    size = pages * (65536 if page_size == 1 else page_size)
    if changes == valid_for and path.stat().st_size < size:
        return f'truncated: {path.stat().st_size} of {size} bytes'
    log = Path(f'{path}-wal')
    if log.exists() and log.stat().st_size:
        return f'recording was not closed: {log.name} holds part of it'
    return ''
