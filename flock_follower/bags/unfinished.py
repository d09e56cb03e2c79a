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

rosbags needs a file's end, and a folder's ``metadata.yaml``. If one is missing, the library mcap
reads the files of the folder one after the other, each up to its last good chunk. On a vehicle it
need not be installed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
import os
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2.metadata import parse_qos

from flock_follower.bags.mcap_file import MCAP_MAGIC


def has_end(file: Path) -> bool:
    """
    Return whether an MCAP file ends as a finished one does.

    :raises OSError: it cannot be read.
    """
    with file.open('rb') as opened:
        size = opened.seek(0, os.SEEK_END)
        opened.seek(max(size - len(MCAP_MAGIC), 0))
        return size > len(MCAP_MAGIC) and opened.read() == MCAP_MAGIC


class UnfinishedReader:
    """
    MCAP files, read one after the other, with rosbags' interface of a reader.

    ``start_time`` is the stamp of the first message, ``end_time`` a nanosecond more than that of
    the last, ns.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.start_time, self.end_time = 2**63, 0
        self._files = files
        self._connections: dict[tuple[str, str], Connection] = {}

    @property
    def connections(self) -> list[Connection]:
        """Return the topics that hold messages."""
        return list(self._connections.values())

    def open(self) -> None:
        """
        Look through the files; those that hold nothing are left out.

        :raises ValueError: all of them hold nothing, or the library mcap is not installed.
        """
        counts: Counter[tuple[str, str]] = Counter()
        for schema, channel, message in self._records():
            key = channel.topic, schema.name
            counts[key] += 1
            self.start_time = min(self.start_time, message.log_time)
            self.end_time = max(self.end_time, message.log_time + 1)
            if key not in self._connections:
                qos = channel.metadata.get('offered_qos_profiles')
                self._connections[key] = Connection(
                    len(counts), channel.topic, schema.name,
                    MessageDefinition(MessageDefinitionFormat.MSG, schema.data.decode()), '', 0,
                    ConnectionExtRosbag2(
                        channel.message_encoding, parse_qos(qos) if qos else []), None)
        if not counts:
            raise ValueError(
                'cut short before its first message, or no MCAP file: nothing is in it')
        for key, count in counts.items():
            self._connections[key] = self._connections[key]._replace(msgcount=count)

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the messages of some connections from ``start`` to before ``stop``, ns."""
        wanted = {(one.topic, one.msgtype) for one in connections}
        stop = self.end_time if stop is None else stop
        for schema, channel, message in self._records():
            key = channel.topic, schema.name
            if key in wanted and (start or 0) <= message.log_time < stop:
                yield self._connections[key], message.log_time, message.data

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _records(self) -> Iterator[tuple[Any, Any, Any]]:
        """
        Yield the schema, the channel and the message for each message, as far as the files go.

        :raises ValueError: the library mcap is not installed.
        :raises Exception: whatever the library raises for damage in a file that has an end.
        """
        try:
            from mcap.reader import NonSeekingReader
        except ImportError:
            raise ValueError('its end is missing, and to read it without one needs the library '
                             'mcap: pip install mcap') from None
        for path in self._files:
            with path.open('rb') as file:
                try:
                    yield from NonSeekingReader(
                        file, validate_crcs=True).iter_messages(log_time_order=False)
                except Exception:
                    if has_end(path):
                        raise
