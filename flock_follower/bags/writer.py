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

"""Writing ROS 2 bags in MCAP: written messages stay readable, even after a crash."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import AbstractContextManager, suppress
from pathlib import Path
import shutil
from typing import Any

from flock_follower.bags.bag import absolute, BagError, failures, serialize
from flock_follower.bags.mcap_file import (
    finish,
    mark_incomplete,
    McapFile,
    RecordedTopic,
    TakenMessage,
)
from flock_follower.bags.message_types import typestore

#: Messages of so many bytes are written at once.
CHUNK = 1 << 20


class BagWriter(AbstractContextManager['BagWriter']):
    """
    Write a ROS 2 bag directory: ``with BagWriter(path) as bag: bag.write(...)``.

    The bytes written depend only on the calls made and the directory's name, never on a clock, so
    a regenerated bag is identical. After an exception inside the ``with`` block, or a failure of
    the disk, the bag lacks the last chunk of 1 MiB, and is marked incomplete, see
    ``bags.mcap_file``. If the bag is then empty, it is deleted.

    :param path: directory to create; it must not exist.
    :param latched: topics recorded as transient local; all others are reliable and volatile.
    :raises BagError: if the bag exists already, or the folder cannot be written.
    """

    def __init__(self, path: str | Path, latched: Collection[str] = ()) -> None:
        self.path = Path(path).expanduser()
        self._latched = {absolute(topic) for topic in latched}
        self._topics: dict[str, RecordedTopic] = {}
        self._pending: list[TakenMessage] = []
        self._size = 0
        if self.path.exists():
            raise BagError(f'{self.path}: exists already, not overwritten')
        with failures(self.path, 'cannot be written'):
            self.path.mkdir(parents=True)
            mark_incomplete(self.path)
            self._file = McapFile(self.path / f'{self.path.name}.mcap', durable=False)

    def write(self, topic: str, msgtype: str, stamp_ns: int, message: Any) -> None:
        """
        Append one message.

        :param topic: topic name; recorded as an absolute name.
        :param msgtype: type name as in ``'nav_msgs/msg/Odometry'``.
        :param stamp_ns: recording time [ns].
        :param message: a message of :func:`typestore`, or its CDR bytes.
        :raises BagError: if the type is unknown, the topic has another type, or the disk is full.
        """
        data = message if isinstance(message, bytes) else serialize(message, msgtype)
        self._pending.append(TakenMessage(self._topic(topic, msgtype), stamp_ns, data))
        self._size += len(data)
        if self._size >= CHUNK:
            self._flush()

    def close(self) -> None:
        """
        Finish the bag: its index and ``metadata.yaml``.

        :raises BagError: if writing fails; the messages written before are kept, and the bag is
            marked incomplete.
        """
        self._flush()
        with failures(self.path, 'cannot be finished'):
            self._file.close()
            finish(self.path, [self._file])

    def _flush(self) -> None:
        pending, self._pending, self._size = self._pending, [], 0
        with failures(self.path, 'cannot be written'):
            self._file.write(pending)

    def _topic(self, name: str, msgtype: str) -> RecordedTopic:
        topic = self._topics.get(name)
        if topic is None:
            if msgtype not in typestore().types:
                raise BagError(f'{self.path}: {absolute(name)}: unknown message type {msgtype}')
            topic = self._topics[name] = RecordedTopic(
                absolute(name), msgtype, absolute(name) in self._latched)
        if topic.msgtype != msgtype:
            raise BagError(f'{self.path}: {topic.name}: has type {topic.msgtype}, not {msgtype}')
        return topic

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 _: object) -> None:
        """Finish the bag; after a failure mark it incomplete, or remove an empty one."""
        if kind is None:
            self.close()
            return
        if not self._pending and not self._file.counts:
            shutil.rmtree(self.path, ignore_errors=True)
        with suppress(BagError, OSError):
            self._flush()
            self._file.close()
