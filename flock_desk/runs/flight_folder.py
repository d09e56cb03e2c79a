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
Where `fly` leaves its flights: the last one in its folder, earlier ones by scenario below it.

A flight is whole once its summary is written: one that failed before does not count.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
import json
from pathlib import Path
import shutil

EARLIER = 'earlier'
_RECORD = 'record'
PICTURE = 'picture.jpg'
_FILES = ('flight.npz', 'report.html', PICTURE, 'summary.json')


def scenario_flown(folder: Path) -> str:
    """Return the name of the scenario of the flight in a folder, '' where none is whole."""
    try:
        summary = json.loads((folder / 'summary.json').read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return ''
    name = summary.get('scenario') if isinstance(summary, dict) else None
    return name if isinstance(name, str) else ''


def last_flight(folder: Path, scenario: str) -> Path | None:
    """Return where below the folder of `fly` the last whole flight of a scenario is, if any."""
    for place in (folder, folder / EARLIER / scenario):
        if scenario_flown(place) == scenario:
            return place
    return None


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """
    Keep a folder, which is made, from a second flight inside the block.

    :raises RuntimeError: if another flight is writing to it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / '.lock', 'w', encoding='ascii') as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RuntimeError(f'another flight writes to {folder}: give --output') from error
        yield


def clear(folder: Path) -> None:
    """Remove the record, the logs and the results of an earlier flight, and nothing else."""
    shutil.rmtree(folder / _RECORD, ignore_errors=True)
    for path in (*(folder / name for name in _FILES), *folder.glob('*.log')):
        path.unlink(missing_ok=True)


def set_aside(folder: Path) -> None:
    """
    Move the whole flight in a folder to those of before, where it replaces one of its scenario.

    :raises OSError: where it cannot be moved.
    """
    scenario = scenario_flown(folder)
    if not scenario or Path(scenario).name != scenario:
        return  # nothing there, or not written by `fly`
    place = folder / EARLIER / scenario
    clear(place)
    place.mkdir(parents=True, exist_ok=True)
    for name in (_RECORD, *_FILES):  # the summary last: what is not whole does not count
        if (folder / name).exists():
            (folder / name).replace(place / name)
