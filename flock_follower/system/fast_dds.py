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
Fast DDS of ROS 2: its profiles, and its shared memory.

Names of settings differ between version 2 (ROS 2 Jazzy) and 3 (Kilted). Discovery uses UDP.
Messages pass through files in /dev/shm. For each of its files NAME a process locks a file
``NAME_el``, and removes both files when it ends.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
import os
from pathlib import Path
import pwd
from typing import Final

from flock_follower.system.files import resource

#: Variables that name a profile. Fast DDS 3 prefers the first; Fast DDS 2 reads the second alone.
PROFILE_VARIABLES: Final = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
#: Words of every reason of ``undelivered``, by which ``check`` finds its advice.
UNDELIVERED: Final = 'the transport delivers nothing'
#: Where the shared memory is, and how the names of its files begin.
SHARED_MEMORY: Final = Path('/dev/shm')
_PREFIXES: Final = ('fastdds_', 'fastrtps_')
LOCK_SUFFIX: Final = '_el'
#: So the kernel marks an open file that was removed.
_REMOVED: Final = ' (deleted)'


def profile_variables(relative: str) -> dict[str, str]:
    """Return the variables for a profile of the package, such as 'config/dds/fastdds.xml'."""
    return dict.fromkeys(PROFILE_VARIABLES, str(resource(relative)))


def opened_segment_names() -> list[str]:
    """Return the names of the shared-memory files that this process has open."""
    opened = []
    for link in Path('/proc/self/fd').glob('*'):
        with contextlib.suppress(OSError):  # closed meanwhile by another thread
            opened.append(os.readlink(link))
    return [name for name in opened if _is_shared_memory(Path(name))]


def undelivered(opened: Iterable[str], user: int, folder: Path = SHARED_MEMORY) -> str:
    """
    Return why this process receives nothing over shared memory, or ''.

    If the files were removed (when a login ended), belong to another user, or lie in another
    /dev/shm (of a container), publishers are found, but their messages never arrive.

    :param opened: names of its open files. :param user: its user id.
    """
    own = {name for name in opened if _is_shared_memory(Path(name))}
    if not own:
        return ''  # it uses UDP
    if any(name.endswith(_REMOVED) for name in own):
        return (f'{UNDELIVERED}: the shared memory of this node was removed from {folder}, as '
                'systemd does when a login ends: restart the node')
    others = set()
    for lock in lock_files(folder):
        with contextlib.suppress(OSError):  # removed meanwhile
            if str(SHARED_MEMORY / lock.name) not in own:
                others.add(lock.stat().st_uid)
    if not others:
        return (f'none sending, or {UNDELIVERED}: no other process has shared memory in this '
                f'{folder}; containers need --ipc host')
    if foreign := others - {user}:
        return (f'{UNDELIVERED} from processes of {", ".join(map(_user_name, sorted(foreign)))}: '
                f'Fast DDS shares no memory between two users, and this node is of '
                f'{_user_name(user)}')
    return ''


def _is_shared_memory(file: Path) -> bool:
    return file.parent == SHARED_MEMORY and file.name.startswith(_PREFIXES)


def lock_files(folder: Path) -> Iterator[Path]:
    """Yield the lock files of all processes."""
    for prefix in _PREFIXES:
        yield from folder.glob(f'{prefix}*{LOCK_SUFFIX}')


def _user_name(user: int) -> str:
    try:
        return f'user {pwd.getpwuid(user).pw_name}'
    except KeyError:
        return f'user id {user}'
