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

"""What running nodes of ours were started with: files of parameters, and their environment."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
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
    for node, process, words in _ours():
        with suppress(OSError):
            folder = os.readlink(process / 'cwd')
            yield from ((node, os.path.join(folder, path)) for path in files_in(words))


def environments_of_processes() -> Iterator[tuple[str, dict[str, str]]]:
    """Yield which of our nodes was started on this computer with which environment."""
    for node, process, _ in _ours():
        with suppress(OSError):
            entries = (process / 'environ').read_bytes().decode(errors='replace').split('\0')
            yield node, dict(entry.split('=', 1) for entry in entries if '=' in entry)


def _ours() -> Iterator[tuple[str, Path, list[str]]]:
    """Yield our nodes that run here, their folders in /proc and their command lines."""
    for command in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            words = command.read_bytes().decode(errors='replace').split('\0')
        except OSError:
            continue  # ended meanwhile, or of another user
        for node in OURS:
            if any(word.rsplit('/', 1)[-1].rsplit('.', 1)[-1] == node for word in words[:3]):
                yield node, command.parent, words
