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
Recordings in flight: one folder each, in files of limited size; the oldest files are deleted.

Each recording is a ROS 2 bag of several MCAP files. The data is on the disk when ``write``
returns. ``note`` adds text files to the folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
import errno
import fcntl
import os
from pathlib import Path
import re
import shutil
import time

from flock_follower.bags.mcap_file import (
    finish,
    mark_incomplete,
    mcap_files,
    McapFile,
    METADATA,
    RecordedTopic,
    TakenMessage,
)
from flock_follower.bags.schedule import NS_PER_S
from flock_follower.system.whole_file import whole_file

#: The name of the folder of a recording; the group is its number.
NAME = re.compile(r'(\d{4,})_\d{8}T\d{6}Z')
_LOOK_PERIOD = 5.0  # s between looks at the space on the disk
_CLOCK_STEP = 5.0  # s by which a clock may be set, back or ahead, within a recording

_BYTES_PER_MB = 1_000_000
FILE_SIZE = 64.0  # MB, from which on the next file begins
KEPT = 15  # the newest files, which are never deleted: at 1.5 MB/s the last 10 minutes


class FlightRecording:
    """
    The recordings in a folder; the first message begins the current recording.

    :param folder: for the recordings of one vehicle; created if missing.
    :param disk_used: largest size of all recordings, MB.
    :param disk_free: space that stays free on the disk, MB.
    :raises OSError: if the folder cannot be made, or another process records there.
    """

    def __init__(self, folder: Path, disk_used: float, disk_free: float) -> None:
        self.folder = folder
        self.path: Path | None = None
        self._disk_used, self._disk_free = disk_used, disk_free
        self._lock = _lock_folder(folder)
        self._files: list[McapFile] = []  # of the current recording
        self._file: McapFile | None = None  # the last of them, while it is open
        self._last = 0
        self._looked = -_LOOK_PERIOD
        self._latched: dict[RecordedTopic, bytes] = {}
        self._notes: dict[str, str] = {}
        self._ahead: float | None = None  # the first stamp of the last write less ``now``, s

    def note(self, name: str, text: str) -> None:
        """
        Write a text file into the folder of this recording, and of each later recording.

        :raises OSError: if the file cannot be written.
        """
        self._notes[name] = text
        if self.path is not None:
            with whole_file(self.path / name) as file:
                file.write(text.encode())

    def write(self, messages: Sequence[TakenMessage], now: float) -> None:
        """
        Write messages, and return once the disk holds them.

        :param now: s of a monotonic clock.
        :raises OSError: if writing fails; these messages are then lost, the file is closed, and
            the next messages go into a new file.
        """
        if not messages:
            return
        first = min(message.stamp_ns for message in messages)
        before, self._ahead = self._ahead, first / NS_PER_S - now
        if before is not None and abs(self._ahead - before) > _CLOCK_STEP:
            self._end()
        if now - self._looked >= _LOOK_PERIOD:
            self._looked = now
            self._make_room()
        # They come once: each file has them, as the oldest make way.
        latched = [TakenMessage(topic, first, data) for topic, data in self._latched.items()]
        self._latched.update({
            message.topic: message.data for message in messages if message.topic.latched})
        # Readers need files that have no index in order.
        try:
            file = self._open_file(first)
            file.write([message._replace(stamp_ns=max(message.stamp_ns, self._last))
                        for message in (*(() if file.counts else latched), *messages)])
        except OSError:
            self._close_file()
            raise
        self._last = file.end_ns
        if file.size >= FILE_SIZE * _BYTES_PER_MB:
            self._close_file()

    def close(self) -> None:
        """
        Finish the current recording.

        :raises OSError: if the summary cannot be written; the recording can still be read.
        """
        try:
            self._end()
        finally:
            os.close(self._lock)

    def _end(self) -> None:
        self._close_file()
        path, files = self.path, [file for file in self._files if file.path.exists()]
        self.path, self._files, self._last = None, [], 0
        if path is not None and files:
            finish(path, files)
        elif path is not None:
            shutil.rmtree(path, ignore_errors=True)

    def _open_file(self, stamp_ns: int) -> McapFile:
        """Return the file to write to."""
        if self.path is None:
            numbers = [int(path.name.partition('_')[0]) for path in self._recordings()]
            began = time.strftime('%Y%m%dT%H%M%SZ', time.gmtime(stamp_ns // NS_PER_S))
            path = self.folder / f'{max(numbers, default=0) + 1:04d}_{began}'
            path.mkdir()
            mark_incomplete(path)
            self.path = path
            for name, text in self._notes.items():
                self.note(name, text)
            _sync(self.folder)
        if self._file is None:
            self._file = McapFile(self.path / f'{self.path.name}_{len(self._files)}.mcap')
            self._files.append(self._file)
            _sync(self.path)
        return self._file

    def _close_file(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):  # without its summary it is read, too
                file.close()
            if not file.counts:
                file.path.unlink()

    def _recordings(self) -> list[Path]:
        return sorted((path for path in self.folder.iterdir() if NAME.fullmatch(path.name)),
                      key=lambda path: int(path.name.partition('_')[0]))

    def _make_room(self) -> None:
        """
        Delete the oldest files if the recordings are too large or the disk is nearly full.

        :raises OSError: the disk is full, and there is no file left to delete.
        """
        files = [file for path in self._recordings() for file in mcap_files(path)]
        sizes = [file.stat().st_size for file in files]
        used, least = sum(sizes), self._disk_free * _BYTES_PER_MB
        for file, size in list(zip(files, sizes))[:-KEPT]:
            if used <= self._disk_used * _BYTES_PER_MB and _free(self.folder) >= least:
                break
            with suppress(OSError):  # of another owner: the next one, then
                self._delete(file)
                used -= size
        if _free(self.folder) < least:
            self._close_file()
            raise OSError(errno.ENOSPC, f'less than {self._disk_free:.0f} MB free')

    def _delete(self, file: Path) -> None:
        """
        Delete a file, and with its last file the recording.

        The remaining files are an incomplete bag.
        """
        file.unlink()
        if file.parent != self.path:
            (file.parent / METADATA).unlink(missing_ok=True)
            if not mcap_files(file.parent):
                shutil.rmtree(file.parent, ignore_errors=True)


def _free(folder: Path) -> int:
    """Return how many bytes are free on the disk of a folder."""
    room = os.statvfs(folder)
    return room.f_bavail * room.f_frsize


def _lock_folder(folder: Path) -> int:
    """Make a folder and lock it for as long as the returned file is open."""
    folder.mkdir(parents=True, exist_ok=True)
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(opened)
        raise OSError(errno.EBUSY, f'another process records in {folder}') from None
    return opened


def _sync(folder: Path) -> None:
    """Write the directory entries of a folder to the disk (fsync)."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
