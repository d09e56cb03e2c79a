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
otherwise (a full disk, an exception, a kill), the mark stays.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

from flock_follower.bags.mcap_file import McapFile, RecordedTopic, type_hash
from flock_follower.files import whole_file

#: The file in a bag's folder until the bag is finished.
MARK = 'INCOMPLETE.txt'
METADATA = 'metadata.yaml'
_UNFINISHED = 'still being written, or the process that wrote it failed or was killed'


def mark_incomplete(folder: Path) -> None:
    """
    Mark a bag as not finished.

    :raises OSError: that cannot be written.
    """
    (folder / MARK).write_text(f'This bag is incomplete: {_UNFINISHED}\n')


def incomplete(path: Path) -> str:
    """Return why a bag, its folder or the file in it, was not finished; '' if it was."""
    folder = path if path.is_dir() else path.parent
    return _UNFINISHED if (folder / MARK).exists() else ''


def mcap_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a recording in the order in which they were written."""
    return sorted((file for file in folder.iterdir() if file.suffix == '.mcap'),
                  key=lambda file: (len(file.name), file.name))


def finish(folder: Path, files: Sequence[McapFile]) -> None:
    """
    Write the ``metadata.yaml`` of a bag of several closed files, and remove its mark.

    :raises OSError: if that fails.
    """
    counts: Counter[RecordedTopic] = Counter()
    for file in files:
        counts.update(file.counts)
    with whole_file(folder / METADATA) as metadata:  # as rosbag2 has it; JSON is YAML
        metadata.write(json.dumps({'rosbag2_bagfile_information': {
            'version': 9, 'storage_identifier': 'mcap', 'compression_format': '',
            'compression_mode': '', 'custom_data': None, 'ros_distro': 'jazzy',
            'relative_file_paths': [file.path.name for file in files],
            'message_count': counts.total(), **_span(files),
            'files': [{'path': file.path.name, 'message_count': file.counts.total(),
                       **_span([file])} for file in files],
            'topics_with_message_count': [{
                'topic_metadata': {
                    'name': topic.name, 'type': topic.msgtype, 'serialization_format': 'cdr',
                    'offered_qos_profiles': topic.qos,
                    'type_description_hash': type_hash(topic.msgtype)},
                'message_count': count} for topic, count in counts.items()]}}, indent=1).encode())
    (folder / MARK).unlink()


def _span(files: Sequence[McapFile]) -> dict[str, Any]:
    start = min((file.start_ns for file in files if file.counts), default=0)
    end = max((file.end_ns for file in files), default=0)
    return {'starting_time': {'nanoseconds_since_epoch': start},
            'duration': {'nanoseconds': end - start}}
