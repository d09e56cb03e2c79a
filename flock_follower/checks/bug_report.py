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

"""One file for a bug report: versions, findings, parameters, diagnostics, the newest recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import distributions
import json
from pathlib import Path
import platform
from typing import Any, Final
import zipfile

from flock_follower.bags.recording import NAME
from flock_follower.checks.observations import Observations
from flock_follower.files import whole_file

#: Files of a recording larger than this are left out, bytes; those of the black box are smaller.
LARGEST: Final = 200_000_000


def write_report(path: Path, seen: Observations, table: str, findings: Mapping[str, Any],
                 recording: Path | None) -> None:
    """
    Write a zip file.

    :param table: the findings as ``check`` prints them; ``findings``: as JSON.
    :param recording: a bag, of which the newest file is included, and the YAML files beside it;
        None: there is none.
    :raises OSError: naming the file, if it cannot be written.
    """
    with whole_file(path) as file, zipfile.ZipFile(file, 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr('versions.txt', versions())
        archive.writestr('check.txt', f'{table}\n')
        for name, content in (('check.json', findings), ('parameters.json', seen.parameters),
                              ('diagnostics.json', {node: asdict(status) for node, status
                                                    in seen.statuses.items()})):
            archive.writestr(name, json.dumps(content, indent=1, default=str))
        for each in _files(recording) if recording else ():
            if each.stat().st_size <= LARGEST:
                archive.write(each, f'recording/{each.name}')


def versions() -> str:
    """Return the versions of Python, the system and the installed packages, one per line."""
    packages = sorted(f'{each.name} {each.version}' for each in distributions())
    return '\n'.join([f'Python {platform.python_version()}', platform.platform(), *packages, ''])


def newest_recording(folder: Path) -> Path | None:
    """Return the newest recording of the black box in a folder; None if there is none."""
    numbers = {path: int(name[1]) for path in folder.glob('*_*')
               if (name := NAME.fullmatch(path.name)) and any(path.glob('*.mcap'))}
    return max(numbers, key=numbers.__getitem__, default=None)


def _files(recording: Path) -> list[Path]:
    """Return the YAML files of a bag and its newest file of messages."""
    if recording.is_file():
        return [recording]
    data = [file for file in recording.iterdir() if file.suffix in ('.mcap', '.db3')]
    return [*recording.glob('*.yaml'), *sorted(data, key=lambda file: file.stat().st_mtime)[-1:]]
