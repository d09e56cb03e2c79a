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
The files beside the data of a recording: its ``metadata.yaml``, and the mark of an unfinished one.

A bag's folder holds a file MARK from when it is made until it is finished. If writing ended
otherwise (a full disk, an exception, a kill), the mark stays and says why, as far as it is known.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
import json
import os
from pathlib import Path
import shutil
from typing import NamedTuple

from rosbags.interfaces import Connection, QosDurability
from rosbags.rosbag2 import Reader

from flock_follower.bags.mcap_file import end_mcap, RecordedTopic, type_hash

#: The file in a bag's folder that says that the bag was not finished, and why.
MARK = 'INCOMPLETE.txt'
METADATA = 'metadata.yaml'
_MARK_SIZE = 400
_UNFINISHED = 'still being written, or the process that wrote it was killed'


def mark_incomplete(folder: Path, reason: str = _UNFINISHED) -> None:
    """
    Mark a bag as not finished, and say why.

    An existing mark is overwritten in place: a full disk has no room for a new file.

    :raises OSError: there is no mark yet, and none can be made.
    """
    text = f'This bag is incomplete: {" ".join(reason.split())}'.encode()[:_MARK_SIZE - 1]
    with (folder / MARK).open('r+b' if (folder / MARK).exists() else 'wb') as file:
        file.write(text.ljust(_MARK_SIZE - 1) + b'\n')


def incomplete(path: Path) -> str:
    """Return why a bag, its folder or the file in it, was not finished; '' if it was."""
    mark = (path if path.is_dir() else path.parent) / MARK
    with suppress(OSError):
        return mark.read_text(errors='replace').partition(': ')[2].strip() or _UNFINISHED
    return ''


def mcap_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a recording in the order in which they were written."""
    return sorted((file for file in folder.iterdir() if file.suffix == '.mcap'),
                  key=lambda file: (len(file.name), file.name))


class Facts(NamedTuple):
    """The content of a file: messages by topic, and the stamps of the first and the last, ns."""

    counts: Mapping[RecordedTopic, int]
    start_ns: int
    end_ns: int


def finish(path: Path) -> None:
    """
    Finish a recording, also one that was broken off; an empty one is deleted.

    Damaged files stay in place, but are no part of the recording any more.

    :raises OSError: it cannot be written.
    """
    facts = {}
    for file in mcap_files(path):
        end_mcap(file)
        found = facts_of(file)
        if found is not None and found.counts:
            facts[file] = found
        elif found is not None:
            file.unlink()
    if not mcap_files(path):
        shutil.rmtree(path)
        return
    describe(path, facts)
    (path / MARK).unlink()


def facts_of(file: Path) -> Facts | None:
    """Return the content of a finished file; None if it is damaged."""
    try:
        with Reader(file) as reader:
            counts = {RecordedTopic(one.topic, one.msgtype, is_latched(one)): one.msgcount
                      for one in reader.connections if one.msgcount}
            return Facts(counts, reader.start_time, reader.end_time - 1)
    except Exception:  # whatever a damaged file makes rosbags raise
        return None


def is_latched(connection: Connection) -> bool:
    """Return whether a topic of a ROS 2 bag is transient local."""
    return any(qos.durability is QosDurability.TRANSIENT_LOCAL
               for qos in connection.ext.offered_qos_profiles)


def describe(folder: Path, files: Mapping[Path, Facts]) -> None:
    """Write the ``metadata.yaml`` of a bag of several files, as rosbag2 wants it; JSON is YAML."""
    counts: Counter[RecordedTopic] = Counter()
    for facts in files.values():
        counts.update(facts.counts)
    replace(folder / METADATA, json.dumps({'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap', 'compression_format': '',
        'compression_mode': '', 'custom_data': None, 'ros_distro': 'jazzy',
        'relative_file_paths': [file.name for file in files],
        'message_count': counts.total(), **_span(files.values()),
        'files': [{'path': file.name, 'message_count': sum(facts.counts.values()),
                   **_span([facts])} for file, facts in files.items()],
        'topics_with_message_count': [{
            'topic_metadata': {
                'name': topic.name, 'type': topic.msgtype, 'serialization_format': 'cdr',
                'offered_qos_profiles': topic.qos,
                'type_description_hash': type_hash(topic.msgtype)},
            'message_count': count} for topic, count in counts.items()]}}, indent=1).encode())


def _span(files: Iterable[Facts]) -> dict[str, dict[str, int]]:
    filled = [facts for facts in files if facts.counts]
    start = min((facts.start_ns for facts in filled), default=0)
    end = max((facts.end_ns for facts in filled), default=0)
    return {'starting_time': {'nanoseconds_since_epoch': start},
            'duration': {'nanoseconds': end - start}}


def replace(path: Path, data: bytes) -> None:
    """Write a small file: whatever happens, it is whole, or as before."""
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
