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

"""Damage to bag files that neither SQLite nor rosbags notices, and checksums against it."""

from __future__ import annotations

from pathlib import Path
import struct
import zlib

_MCAP_MAGIC_SIZE, _MCAP_CHUNK = 8, 0x06


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


def write_chunk_checksums(path: Path) -> None:
    """
    Fill in the CRC-32 of every uncompressed MCAP chunk; rosbags leaves it zero, unchecked.

    Layout of a chunk record: start, end and uncompressed size (8 bytes each), CRC-32, compression
    name with its length (4 + n), size of the records (8), the records.
    """
    with path.open('r+b') as file:
        file.seek(_MCAP_MAGIC_SIZE)
        while len(header := file.read(9)) == 9:
            opcode, length = struct.unpack('<BQ', header)
            start = file.tell()
            if opcode == _MCAP_CHUNK:
                file.seek(start + 28 + 4 + 8)
                checksum = zlib.crc32(file.read(length - 40))
                file.seek(start + 24)
                file.write(struct.pack('<I', checksum))
            file.seek(start + length)
