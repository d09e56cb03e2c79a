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

"""What stands beside the files of a recording: their description, for rosbag2 and all who read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
import json
import os
from pathlib import Path
import shutil
from typing import NamedTuple

from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosDurability
from rosbags.rosbag2 import Reader

from flock_follower.bags.integrity import end_mcap, MARK
from flock_follower.bags.mcap_file import RecordedTopic, type_hash
from flock_follower.bags.unfinished import mcap_files


class Facts(NamedTuple):
    """What a file holds: messages by topic, and the stamps of the first and the last."""

    counts: Mapping[RecordedTopic, int]
    start_ns: int
    end_ns: int


def finish(path: Path, known: Mapping[Path, Facts] | None = None) -> None:
    """
    Finish a recording, also one that was broken off; where nothing is in it nothing is left.

    Damaged files stay where they are, but are no part of it any more.

    :param known: what is known of files already, so that they need not be read.
    :raises OSError: it cannot be written.
    """
    facts = {}
    for file in mcap_files(path):
        end_mcap(file)
        found = (known or {}).get(file) or facts_of(file)
        if found is not None and found.counts:
            facts[file] = found
        elif found is not None:
            file.unlink()
    if not facts and not mcap_files(path):
        shutil.rmtree(path)
        return
    replace(path / 'metadata.yaml', metadata(facts).encode())
    (path / MARK).unlink()


def facts_of(file: Path) -> Facts | None:
    """Return what a finished file holds; None where it is damaged."""
    try:
        with Reader(file) as reader:
            counts = {RecordedTopic(one.topic, one.msgtype, _is_latched(one)): one.msgcount
                      for one in reader.connections if one.msgcount}
            return Facts(counts, reader.start_time, reader.end_time - 1)
    except Exception:  # whatever a damaged file makes rosbags raise
        return None


def _is_latched(connection: Connection) -> bool:
    return isinstance(connection.ext, ConnectionExtRosbag2) and any(
        qos.durability is QosDurability.TRANSIENT_LOCAL
        for qos in connection.ext.offered_qos_profiles)


def metadata(files: Mapping[Path, Facts]) -> str:
    """Return the description of a bag of several files, as rosbag2 wants it; JSON is YAML."""
    told = [facts for facts in files.values() if facts.counts]
    counts: dict[RecordedTopic, int] = {}
    for facts in told:
        for topic, count in facts.counts.items():
            counts[topic] = counts.get(topic, 0) + count
    return json.dumps({'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap', 'compression_format': '',
        'compression_mode': '', 'custom_data': None, 'ros_distro': 'jazzy',
        'relative_file_paths': [file.name for file in files],
        'message_count': sum(counts.values()), **_span(told),
        'files': [{'path': file.name, 'message_count': sum(facts.counts.values()),
                   **_span([facts])} for file, facts in files.items()],
        'topics_with_message_count': [{
            'topic_metadata': {
                'name': topic.name, 'type': topic.msgtype, 'serialization_format': 'cdr',
                'offered_qos_profiles': topic.qos,
                'type_description_hash': type_hash(topic.msgtype)},
            'message_count': count} for topic, count in counts.items()]}}, indent=1)


def _span(files: Iterable[Facts]) -> dict[str, dict[str, int]]:
    files = list(files)
    start = min((facts.start_ns for facts in files), default=0)
    end = max((facts.end_ns for facts in files), default=0)
    return {'starting_time': {'nanoseconds_since_epoch': start},
            'duration': {'nanoseconds': end - start}}


def replace(path: Path, data: bytes) -> None:
    """Write a small file that is whole, or as it was, whatever happens."""
    part = path.with_name(f'{path.name}.part')
    try:
        with part.open('wb') as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink()
        raise
