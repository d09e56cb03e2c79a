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

"""The files of parameters that running nodes of ours were started with, and whom they miss."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path

from flock_follower.checks.observations import OURS
from flock_follower.parameters.files import files_in, unheeded


def misses(path: str, node: str) -> str:
    """Return that a file means nothing, or another node, or ''."""
    try:
        return unheeded(path, node)
    except (ValueError, OSError) as problem:
        return str(problem)


def files_of_processes() -> Iterator[tuple[str, str]]:
    """Yield which of our nodes runs on this computer with which file of parameters."""
    for command in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            words = command.read_bytes().decode(errors='replace').split('\0')
            folder = os.readlink(command.with_name('cwd'))
        except OSError:
            continue  # ended meanwhile, or somebody else's
        for node in OURS:
            if any(word.rsplit('/', 1)[-1].rsplit('.', 1)[-1] == node for word in words[:3]):
                yield from ((node, os.path.join(folder, path)) for path in files_in(words))
