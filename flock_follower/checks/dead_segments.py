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

"""Shared memory that killed processes have left: hundreds of files double all latencies."""

from __future__ import annotations

import contextlib
import fcntl
from pathlib import Path
import time
from typing import Final

from flock_follower.system.fast_dds import lock_files, SHARED_MEMORY

#: A younger lock may be one whose process is about to lock it, s.
_YOUNG: Final = 10.0


def dead_segments(folder: Path = SHARED_MEMORY) -> list[Path]:
    """Return the lock files of shared memory whose processes were killed."""
    dead = []
    for path in lock_files(folder):
        with contextlib.suppress(OSError), open(path, 'rb') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if time.time() - path.stat().st_mtime > _YOUNG:
                dead.append(path)
    return dead
