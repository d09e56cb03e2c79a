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

"""One file for a bug report: versions, findings, parameters, diagnostics, the last minute."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
import json
from pathlib import Path
import platform
import tempfile
from typing import Any, Final
import zipfile

from flock_follower.bags.bag import BagError, open_bag
from flock_follower.bags.message_types import typestore
from flock_follower.bags.recording import NAME
from flock_follower.bags.writer import BagWriter
from flock_follower.checks.observations import Observations
from flock_follower.checks.recorded_system import LAST
from flock_follower.files import whole_file

PACKAGES: Final[tuple[str, ...]] = (
    'flock_follower', 'numpy', 'opencv-python-headless', 'opencv-python', 'pymavlink', 'rosbags',
    'rclpy', 'ros-jazzy-rclpy')
#: Files beside a recording that explain it.
BESIDE: Final[tuple[str, ...]] = ('parameters.yaml', 'neighbors.yaml')


def write_report(path: Path, seen: Observations, table: str, findings: Mapping[str, Any],
                 recording: Path | None) -> None:
    """
    Write a zip file.

    :param table: the findings as ``check`` prints them; ``findings``: as JSON.
    :param recording: of which the last 60 s are included, and the newest message before of each
        latched topic; None: there is none.
    :raises OSError: naming the file, if it cannot be written.
    """
    with whole_file(path) as file, zipfile.ZipFile(file, 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr('versions.txt', versions())
        archive.writestr('check.txt', f'{table}\n')
        for name, content in (('check.json', findings), ('parameters.json', seen.parameters),
                              ('diagnostics.json', {node: asdict(status) for node, status
                                                    in seen.statuses.items()})):
            archive.writestr(name, json.dumps(content, indent=1, default=str))
        if recording is not None:
            _add_recording(archive, recording)


def versions() -> str:
    """Return the versions of Python, the system and the packages, one per line."""
    lines = [f'Python {platform.python_version()}', platform.platform()]
    for package in PACKAGES:
        try:
            lines.append(f'{package} {version(package)}')
        except PackageNotFoundError:
            lines.append(f'{package} not installed')
    return '\n'.join([*lines, ''])


def newest_recording(folder: Path) -> Path | None:
    """Return the newest recording of the black box in a folder; None if there is none."""
    numbers = {path: int(name[1]) for path in folder.glob('*_*')
               if (name := NAME.fullmatch(path.name)) and any(path.glob('*.mcap'))}
    return max(numbers, key=numbers.__getitem__, default=None)


def _add_recording(archive: zipfile.ZipFile, recording: Path) -> None:
    """Add the last minute as a bag; what cannot be read of it, and why, is in error.txt."""
    beside = recording if recording.is_dir() else recording.parent
    for name in BESIDE:
        if (beside / name).is_file():
            archive.write(beside / name, f'recording/{name}')
    with tempfile.TemporaryDirectory() as scratch:
        excerpt, problems = Path(scratch) / 'last_minute', []
        try:
            with open_bag(recording) as bag:
                known = {name: topic for name, topic in bag.topics.items()
                         if topic.msgtype in typestore().types}
                problems += [f'{name}: {reason}' for name, reason in bag.skipped.items()]
                problems += [f'{name}: unknown message type {bag.topics[name].msgtype}'
                             for name in bag.topics.keys() - known]
                latched, start = [name for name in known if known[name].latched], bag.end_ns - LAST
                with BagWriter(excerpt, latched) as part:
                    for message in {message.topic: message for message in (  # the newest of each
                            bag.messages(latched, stop_ns=start) if latched else ())}.values():
                        part.write(*message._replace(stamp_ns=start))
                    for message in bag.messages(known, start, bag.end_ns + 1):
                        if message.topic in known:  # without any name the bag yields all
                            part.write(*message)
        except BagError as error:
            problems.append(str(error))
        if problems:
            archive.writestr('recording/error.txt', '\n'.join([*sorted(problems), '']))
        for file in sorted(excerpt.glob('*')):
            archive.write(file, f'recording/last_minute/{file.name}')
