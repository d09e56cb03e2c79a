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

"""The computer: processor time left, shared memory for images."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
from pathlib import Path
import time

import numpy as np

from flock_follower.checks.findings import error, Finding, ok, warning
from flock_follower.checks.observations import Observations
from flock_follower.checks.topic_names import COMPRESSED_IMAGES

#: Share of the processors that is idle: below the first a warning, below the second an error.
IDLE = 0.25
NONE_IDLE = 0.05
#: MB free in /dev/shm.
ROOM = 32.0
#: Segments of killed processes from which on it is told: 180 made the latency of the demonstration
#: from image to setpoint, 95 %, 239 ms instead of 90 ms.
DEAD_SEGMENTS = 20
#: A younger segment may be one whose process is about to lock it, s.
YOUNG = 10.0
#: Share of images that came, of those that were sent, below which it is told.
COMING = 0.8
#: Share of the images that relative_pose processes below which it is told.
PROCESSED = 0.7
#: Fewer images tell nothing of that.
FEW = 10


def check_machine(seen: Observations) -> Iterator[Finding]:
    """Yield what is to be said of the computer that runs all this."""
    if not seen.live:
        return
    machine = seen.machine
    if machine.idle is not None:
        told = f'{machine.idle:.0%} of {machine.processors} cores left'
        wanted = f'{IDLE:.0%} or more left'
        advice = 'end what need not run (rviz, recordings), or ask less of the odometry'
        if machine.idle < IDLE:
            say = error if machine.idle < NONE_IDLE else warning
            yield say('processor', told, wanted, advice)
        else:
            yield ok('processor', told, wanted)
    yield from _shared_memory(seen)
    yield from _processed(seen)


def _shared_memory(seen: Observations) -> Iterator[Finding]:
    machine = seen.machine
    what, large = 'shared memory', f'images fit into {machine.segment // 1024} kB'
    if not machine.shares_memory:
        return
    if machine.shared_memory_free is not None and machine.shared_memory_free < ROOM:
        yield error(what, f'{machine.shared_memory_free:.0f} MB free in /dev/shm',
                    f'{ROOM:.0f} MB', 'delete /dev/shm/fastrtps_* of processes that are gone; '
                    'in a container, --shm-size')
    if machine.dead_segments >= DEAD_SEGMENTS:
        yield warning(what, f'{machine.dead_segments} segments of processes that were killed',
                      'none: they slow every node', 'fastdds shm clean')
    largest = max((picture.bytes for picture in seen.pictures), default=0)
    if not largest:
        return
    images, infos = seen.topic(seen.image_name).rate, seen.topic('camera_info').rate
    lost = seen.image_name != COMPRESSED_IMAGES and images < COMING * infos
    told = f'images of {largest / 1024:.0f} kB'
    if largest > machine.segment:
        say = error if lost else warning
        yield say(what, f'{told}{f", {1.0 - images / infos:.0%} are lost" if lost else ""}', large,
                  'export FASTRTPS_DEFAULT_PROFILES_FILE=.../config/fastdds.xml for every node')
    else:
        yield ok(what, told, large)


def dead_segments(folder: Path = Path('/dev/shm')) -> list[Path]:
    """
    Return the lock files of Fast DDS's segments in shared memory whose processes were killed.

    A process locks the file ``NAME_el`` beside each of its segments, and removes both at its end.
    """
    dead = []
    for path in folder.glob('fastrtps_*_el'):
        with contextlib.suppress(OSError), open(path, 'rb') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if time.time() - path.stat().st_mtime > YOUNG:
                dead.append(path)
    return dead


def _processed(seen: Observations) -> Iterator[Finding]:
    """Yield whether relative_pose keeps up with the images."""
    images, frames = seen.topic(seen.image_name), seen.topic('neighbors/frames')
    if len(images.arrivals) < FEW or not frames.publishers:
        return
    share = frames.rate / images.rate
    told, wanted = f'{min(share, 1.0):.0%} of the images', f'{PROCESSED:.0%} or more'
    if not frames.arrivals:
        yield error('images processed', 'none', wanted,
                    'see images, calibration and odometry; its log says what it drops')
    elif share < PROCESSED:
        yield warning('images processed', told, wanted,
                      'less to do for the processor, or a lower frame rate')
    else:
        yield ok('images processed', told, wanted)


def idle_share(before: str, after: str) -> float | None:
    """Return the share of the processors that was idle between two readings of /proc/stat."""
    try:
        rows = [np.array(text.splitlines()[0].split()[1:9], dtype=float)
                for text in (before, after)]
    except (IndexError, ValueError):
        return None
    spent = rows[1] - rows[0]
    total = float(spent.sum())
    return float(spent[3] + spent[4]) / total if total > 0.0 else None
