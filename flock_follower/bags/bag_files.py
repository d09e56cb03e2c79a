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
The files of a ROS 2 bag, and the reason if the bag is incomplete.

A folder's ``metadata.yaml`` names its files; without it, all files of one storage format are used.
The files describe their own content.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import yaml

from flock_follower.bags.mcap_file import incomplete, mcap_files, MCAP_MAGIC, METADATA

MCAP, SQLITE, ZSTD = '.mcap', '.db3', '.zstd'
_SQLITE_MAGIC = b'SQLite format 3\0'


class BagFiles(NamedTuple):
    """
    The files of a bag, in the order in which they were written.

    ``fault`` is the reason if the bag is incomplete, else ''. ``compressed`` is whether the files,
    or the messages in them, are compressed as a whole by ``metadata.yaml``.
    """

    paths: list[Path]
    fault: str
    compressed: bool = False

    @property
    def remedy(self) -> str:
        """Return the command that recovers the undamaged messages."""
        if self.compressed:
            return "decompress it by 'ros2 bag convert', with the plugin that compressed it"
        file = self.paths[0] if len(self.paths) == 1 else 'FILE'
        if self.paths[0].suffix == MCAP:
            return f'mcap recover {file} -o recovered.mcap'
        return f'sqlite3 {file} .recover | sqlite3 recovered.db3'


def find_files(path: Path) -> BagFiles:
    """
    Return the files of a bag, which may be one bare file.

    :raises ValueError: if there is no file, or if an SQLite file was never closed, or was cut
        short: readers of SQLite ignore rows in a write-ahead log, and read missing bytes as zeros.
    :raises OSError: if the folder or ``metadata.yaml`` cannot be read.
    """
    files = BagFiles([path], '') if path.is_file() else _in_folder(path)
    for file in files.paths:
        log = Path(f'{file}-wal')
        if log.exists() and log.stat().st_size:
            raise ValueError(f'recording was not closed: {log.name} holds part of it; to close '
                             f"it: sqlite3 {file} 'PRAGMA wal_checkpoint(TRUNCATE)'")
        size, whole = file.stat().st_size, _sqlite_size(file)
        if size < whole:
            raise ValueError(f'{file.name} was cut short: {size} of {whole} bytes; to save what '
                             f'is whole: {files.remedy}')
    return files._replace(fault=incomplete(path) or _cut_short(files.paths) or files.fault)


def has_end(file: Path) -> bool:
    """
    Return whether an MCAP file has the end of a finished file.

    :raises OSError: if the file cannot be read.
    """
    with file.open('rb') as opened:
        size = opened.seek(0, os.SEEK_END)
        opened.seek(max(size - len(MCAP_MAGIC), 0))
        return size > len(MCAP_MAGIC) and opened.read() == MCAP_MAGIC


def _sqlite_size(file: Path) -> int:
    """Return the size of an SQLite file, bytes, by its header; 0 if that has none."""
    with file.open('rb') as opened:
        header = opened.read(100)
    if len(header) < 100 or not header.startswith(_SQLITE_MAGIC):
        return 0
    page, changed, pages, valid_for = (int.from_bytes(header[at:end], 'big') for at, end in (
        (16, 18), (24, 28), (28, 32), (92, 96)))
    # https://sqlite.org/fileformat.html: a page of 65536 bytes is a 1; older writers set no size.
    return pages * (65536 if page == 1 else page) if changed == valid_for else 0


def packed_fault(files: Sequence[Path]) -> str:
    """Return the fault of files that are compressed as a whole, and the commands against it."""
    commands = '; '.join(f'zstd -d {file} -o {file.with_suffix("")}' for file in files)
    return f'compressed as a whole; to unpack it: {commands}'


def _in_folder(folder: Path) -> BagFiles:
    present = mcap_files(folder) or sorted(
        folder.glob(f'*{SQLITE}'), key=lambda file: (len(file.name), file.name))
    try:
        content: Any = yaml.safe_load((folder / METADATA).read_text(encoding='utf-8'))
        described = content['rosbag2_bagfile_information']
        named = [PurePath(name).name for name in described['relative_file_paths']]
        mode = str(described.get('compression_mode') or 'none').lower()
    except FileNotFoundError:
        if packed := [file for file in sorted(folder.glob(f'*{ZSTD}'))
                      if not file.with_suffix('').exists()]:
            raise ValueError(f'no {METADATA} in it: {packed_fault(packed)}') from None
        if not present:
            raise ValueError(f'no {METADATA} in it, so not a finished ROS 2 bag') from None
        return BagFiles(present, f'no {METADATA} in it')
    except (yaml.YAMLError, LookupError, TypeError, ValueError, AttributeError):
        if not present:
            raise ValueError(f'its {METADATA} cannot be read, and there is no file') from None
        return BagFiles(present, f'{METADATA} cannot be read')
    missing = [name for name in named if not (folder / name).is_file()]
    files = [folder / name for name in named if name not in missing] or present
    if not files:
        raise ValueError(f'no {", ".join(named) or "file"} in it')
    fault = f'no {", ".join(missing)} in it, which {METADATA} names' if missing else ''
    return BagFiles(files, fault, mode != 'none')


def _cut_short(files: Sequence[Path]) -> str:
    for file in files:
        if not file.stat().st_size or (file.suffix == MCAP and not has_end(file)):
            return f'{file.name} was cut short'
    return ''
