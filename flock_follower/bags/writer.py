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

"""Writing bags, ROS 2 MCAP and sqlite3: what was written stays, whatever ends the writing."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
import shutil
from typing import Any

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from flock_follower.bags.bag import absolute, BagError, failures, reason_of, serialize
from flock_follower.bags.integrity import (
    end_mcap,
    MARK,
    mark_incomplete,
    write_chunk_checksums,
)
from flock_follower.bags.message_types import typestore

#: Storage plugins a :class:`BagWriter` knows.
STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}

_NEVER = QosTime(9223372036, 854775807)  # rosbag2's spelling of an infinite duration


class BagWriter:
    """
    Write a ROS 2 bag directory: ``with BagWriter(path) as bag: bag.write(...)``.

    The bytes written depend only on the calls made, the directory's name and the version of
    rosbags, never on a clock, so a regenerated bag is identical. After a failure inside the
    ``with`` block, or of the disk, what was written before is kept and marked incomplete (see
    ``bags.integrity``): of an MCAP bag all but the last chunk of 1 MiB; an sqlite3 bag is one
    transaction, which a full disk may undo. Where nothing was written nothing is left.

    :param path: directory to create; it must not exist.
    :param storage: ``'mcap'`` or ``'sqlite3'``.
    :param latched: topics recorded as transient local; all others are reliable and volatile.
    :raises BagError: the bag exists already or the place cannot be written.
    """

    def __init__(
        self, path: str | Path, storage: str = 'mcap', latched: Collection[str] = (),
    ) -> None:
        if storage not in STORAGES:
            raise ValueError(f'storage = {storage!r}: must be one of {", ".join(STORAGES)}')
        self.path = Path(path).expanduser()
        self._latched = {absolute(topic) for topic in latched}
        self._connections: dict[str, Connection] = {}
        self._fault = ''
        self._written = False
        if self.path.exists():
            raise BagError(f'{self.path}: exists already, not overwritten')
        with failures(self.path, 'cannot be written'):
            self._writer = Writer(self.path, version=9, storage_plugin=STORAGES[storage])
            try:
                self._writer.open()
                mark_incomplete(self.path)
            except Exception:
                self._remove()
                raise

    def write(self, topic: str, msgtype: str, stamp_ns: int, message: Any) -> None:
        """
        Append one message.

        :param topic: topic name; recorded as an absolute name.
        :param msgtype: type name as in ``'nav_msgs/msg/Odometry'``.
        :param stamp_ns: recording time [ns].
        :param message: a message of :func:`typestore`, or its CDR bytes.
        :raises BagError: the type is unknown, the topic has another type, or the disk is full.
        """
        if self._fault:
            raise BagError(self._fault)
        data = message if isinstance(message, bytes) else serialize(message, msgtype)
        with failures(self.path, 'cannot be written'):
            connection = self._connection(absolute(topic), msgtype)
            try:
                self._writer.write(connection, stamp_ns, data)
            except Exception as error:
                self._fault = f'{self.path}: {reason_of(error)}'
                raise
        self._written = True

    def close(self) -> None:
        """
        Finish the bag: its index, checksums and ``metadata.yaml``.

        :raises BagError: where that fails, or a write has failed before; what was written up to
            then is kept, and marked incomplete.
        """
        self._finish()
        if self._fault:
            raise BagError(self._fault)
        with failures(self.path, 'cannot be written'):
            (self.path / MARK).unlink()

    def _finish(self) -> None:
        """Finish the files, as far as the disk lets us; the mark is there still."""
        if not self._fault:
            try:
                self._writer.close()
                for file in self.path.glob('*.mcap'):
                    write_chunk_checksums(file)
                return
            except Exception as error:
                self._fault = f'{self.path}: {reason_of(error)}'
        with suppress(Exception):
            self._writer.abort()
        with suppress(OSError):
            (self.path / 'metadata.yaml.tmp').unlink(missing_ok=True)  # of rosbags, half-written
            mark_incomplete(self.path, self._fault)
            for file in self.path.glob('*.mcap'):
                end_mcap(file)
                write_chunk_checksums(file)

    def _remove(self) -> None:
        with suppress(Exception):
            self._writer.abort()
        shutil.rmtree(self.path, ignore_errors=True)

    def _connection(self, topic: str, msgtype: str) -> Connection:
        connection = self._connections.get(topic)
        if connection is None:
            if msgtype not in typestore().types:
                raise BagError(f'{self.path}: {topic}: unknown message type {msgtype}')
            connection = self._connections[topic] = self._writer.add_connection(
                topic, msgtype, typestore=typestore(),
                offered_qos_profiles=[_recorded_qos(topic in self._latched)])
        elif connection.msgtype != msgtype:
            raise BagError(f'{self.path}: {topic}: holds {connection.msgtype}, not {msgtype}')
        return connection

    def __enter__(self) -> BagWriter:
        """Return the writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 _: object) -> None:
        """Finish the bag; after a failure mark it incomplete, or remove an empty one."""
        if kind is None:
            self.close()
        elif self._written:
            self._finish()
            if not self._fault:
                with suppress(OSError):
                    mark_incomplete(self.path, f'{kind.__name__}: {error}')
        else:
            self._remove()


def _recorded_qos(latched: bool) -> Qos:
    """Return the profile written into a bag: reliable, so that any subscriber can match it."""
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(
        QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, durability, _NEVER, _NEVER,
        QosLiveliness.AUTOMATIC, _NEVER, avoid_ros_namespace_conventions=False)
