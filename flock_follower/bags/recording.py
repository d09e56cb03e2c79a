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
Recordings in flight: one folder each, in files of limited size, of which the oldest make way.

Each recording is a ROS 2 bag of several MCAP files. The data is on the disk when ``write``
returns. Whatever is at hand goes with it as files beside them, see ``note``.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
import errno
import fcntl
import os
from pathlib import Path
import re
import shutil
import time

from flock_follower.bags.description import (
    describe,
    Facts,
    facts_of,
    finish,
    incomplete,
    mark_incomplete,
    mcap_files,
    METADATA,
    replace,
)
from flock_follower.bags.mcap_file import McapFile, RecordedTopic, TakenMessage
from flock_follower.bags.schedule import NANOSECONDS

#: The name of the folder of a recording; the group is its number.
NAME = re.compile(r'(\d{4,})_\d{8}T\d{6}Z')
_LOOK_PERIOD = 5.0  # s between looks at the space on the disk
_STEP = NANOSECONDS  # by which a clock may go back within a recording ...
_FORWARD = 10.0  # s: ... and ahead, of a computer that gets the time from the network
_MEGABYTE = 1_000_000


@dataclass(frozen=True)
class Limits:
    """
    What recordings may take of a disk, MB: each file, all of them, and what stays free.

    ``kept`` is the time, s, back from now of which nothing is deleted to keep to ``disk_used``.
    """

    disk_used: float
    disk_free: float
    file_size: float = 64.0
    kept: float = 600.0


class FlightRecording:
    """
    The recordings in a folder, and the current one, which begins with the first message.

    Interrupted recordings are completed. ``now`` is s of a monotonic clock throughout.

    :param folder: for the recordings of one vehicle; created if missing.
    :param clock: the time of day, s since 1970.
    :raises OSError: it cannot be read or made, or another process records there.
    """

    def __init__(self, folder: Path, limits: Limits, now: float, clock: float) -> None:
        self.folder = folder
        self.path: Path | None = None
        self._limits = limits
        self._lock = _locked(folder)
        self._file: McapFile | None = None
        self._number = 0
        self._last = 0
        self._looked = -_LOOK_PERIOD
        self._latched: dict[RecordedTopic, bytes] = {}
        self._notes: dict[str, str] = {}
        self._facts: dict[Path, Facts] = {}
        # When each file was written last; that of a clock which is wrong is taken for new.
        self._written: dict[Path, float] = {}
        self._ahead: float | None = None  # the time of day of the last message less ``now``, s
        try:
            for earlier in self._recordings():
                for file in mcap_files(earlier):
                    self._written[file] = now - max(clock - file.stat().st_mtime, 0.0)
                if incomplete(earlier):
                    with suppress(OSError):  # a full disk, or not ours: it can be read as it is
                        finish(earlier)
        except OSError:
            os.close(self._lock)
            raise

    def note(self, name: str, text: str) -> None:
        """
        Have a file beside the recording, and beside those that follow.

        :raises OSError: it cannot be written.
        """
        if self._notes.get(name) != text:
            self._notes[name] = text
            if self.path is not None:
                replace(self.path / name, text.encode())

    def write(self, messages: Sequence[TakenMessage], now: float) -> None:
        """
        Write messages and have them on the disk.

        :raises OSError: if that fails; nothing of the messages is kept then, the file is
            closed, and the next ones go into a new one.
        """
        if not messages:
            return
        first = min(message.stamp_ns for message in messages)
        ahead, before = max(m.stamp_ns for m in messages) * 1e-9 - now, self._ahead
        if first < self._last - _STEP or (  # the clock was set, back or ahead
                before is not None and ahead - before > _FORWARD):
            self._end()
        self._ahead = ahead
        if now - self._looked >= _LOOK_PERIOD:
            self._looked = now
            self._make_room(now)
        # They come once: each file has them, as the oldest make way.
        latched = [TakenMessage(topic, first, data) for topic, data in self._latched.items()]
        self._latched.update({
            message.topic: message.data for message in messages if message.topic.latched})
        # Readers want files that have no index in order.
        try:
            file = self._opened(first, now)
            file.write([message._replace(stamp_ns=max(message.stamp_ns, self._last))
                        for message in (*(() if file.counts else latched), *messages)])
        except OSError:
            self._close_file()
            raise
        self._last = file.end_ns
        self._written[file.path] = now
        if file.size >= self._limits.file_size * _MEGABYTE:
            self._close_file()

    def close(self) -> None:
        """
        Finish the recording under way.

        :raises OSError: if that fails; the recording stays readable.
        """
        try:
            self._end()
        finally:
            os.close(self._lock)

    def _end(self) -> None:
        self._close_file()
        path, self.path, self._last = self.path, None, 0
        if path is not None:
            finish(path)

    def _opened(self, stamp_ns: int, now: float) -> McapFile:
        """Return the file to write to."""
        if self.path is None:
            numbers = [int(path.name.partition('_')[0]) for path in self._recordings()]
            began = time.strftime('%Y%m%dT%H%M%SZ', time.gmtime(stamp_ns // NANOSECONDS))
            path = self.folder / f'{max(numbers, default=0) + 1:04d}_{began}'
            path.mkdir(parents=True)
            mark_incomplete(path)
            for name, text in self._notes.items():
                replace(path / name, text.encode())
            self.path, self._number = path, 0
            _sync(self.folder)
        if self._file is None:
            self._file = McapFile(self.path / f'{self.path.name}_{self._number}.mcap')
            self._number += 1
            self._written[self._file.path] = now
            _sync(self.path)
        return self._file

    def _close_file(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        with suppress(OSError):  # without its summary it is read, too
            file.close()
        with suppress(OSError):
            if not file.counts:
                self._delete(file.path)
            else:
                self._describe(file.path.parent)

    def _recordings(self) -> list[Path]:
        return sorted((path for path in self.folder.iterdir()
                       if NAME.fullmatch(path.name) and path.is_dir()),
                      key=lambda path: int(path.name.partition('_')[0]))

    def _make_room(self, now: float) -> None:
        """
        Delete the oldest files where recordings take too much, or little of the disk is free.

        :raises OSError: too little is free, and there is nothing more to delete.
        """
        limits = self._limits
        sizes = {file: file.stat().st_size for path in self._recordings()
                 for file in mcap_files(path)}
        used = sum(sizes.values())
        if self._file is not None:
            sizes.pop(self._file.path)
        # If another program fills the disk, deleting new recordings would not help.
        helps = _free(self.folder) + sum(sizes.values()) > _MEGABYTE * (
            limits.disk_free + limits.file_size)
        for oldest, size in sizes.items():
            old = now - self._written.get(oldest, now) > limits.kept
            if not (self._little_room and (helps or old)) and not (
                    old and used > limits.disk_used * _MEGABYTE):
                break
            with suppress(OSError):  # not ours: the next one, then
                self._delete(oldest)
                used -= size
        if self._little_room:
            self._close_file()
            raise OSError(errno.ENOSPC, f'less than {limits.disk_free:.0f} MB free')

    @property
    def _little_room(self) -> bool:
        return _free(self.folder) < self._limits.disk_free * _MEGABYTE

    def _delete(self, file: Path) -> None:
        file.unlink()
        self._written.pop(file, None)
        self._facts.pop(file, None)
        if file.parent != self.path and not mcap_files(file.parent):
            shutil.rmtree(file.parent, ignore_errors=True)
        elif (file.parent / METADATA).exists():
            self._describe(file.parent)

    def _describe(self, path: Path) -> None:
        """Write the ``metadata.yaml`` of a recording, of all files but the one under way."""
        for file in mcap_files(path):
            if (self._file is None or file != self._file.path) and file not in self._facts and (
                    found := facts_of(file)):
                self._facts[file] = found
        describe(path, {file: self._facts[file] for file in mcap_files(path)
                        if file in self._facts})


def _free(folder: Path) -> int:
    """Return how many bytes are free on the disk of a folder."""
    room = os.statvfs(folder)
    return room.f_bavail * room.f_frsize


def _locked(folder: Path) -> int:
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
    """Have the names of the files in a folder on the disk."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
