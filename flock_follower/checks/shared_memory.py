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
Why shared memory delivers nothing to a process, though its subscriber is matched.

Discovery goes by UDP. Fast DDS delivers through files in /dev/shm, and locks ``NAME_el`` beside
each of its own. If they are removed (a login that ends), belong to another user, or lie in
another /dev/shm (a container), publishers are found, and their messages never arrive.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
import os
from pathlib import Path
import pwd
from typing import Final

#: Words of every such reason, by which ``check`` finds its advice.
UNDELIVERED: Final = 'the transport delivers nothing'
_FOLDER: Final = Path('/dev/shm')
_OWN: Final = f'{_FOLDER}/fastrtps_'
_REMOVED: Final = ' (deleted)'


def open_files() -> Iterator[str]:
    """Yield the names of the files that this process has open; the kernel marks removed ones."""
    for link in Path('/proc/self/fd').glob('*'):
        with contextlib.suppress(OSError):  # closed meanwhile by another thread
            yield os.readlink(link)


def undelivered(opened: Iterable[str], user: int, folder: Path = _FOLDER) -> str:
    """
    Return why shared memory delivers nothing to this process, or ''.

    :param opened: names of its open files. :param user: its user id.
    """
    own = {name for name in opened if name.startswith(_OWN)}
    if not own:
        return ''  # it uses UDP
    if any(name.endswith(_REMOVED) for name in own):
        return (f'{UNDELIVERED}: the shared memory of this node was removed from {folder}, as '
                'systemd does when a login ends: restart the node')
    others = set()
    for lock in folder.glob('fastrtps_*_el'):
        with contextlib.suppress(OSError):  # removed meanwhile
            if str(_FOLDER / lock.name) not in own:
                others.add(lock.stat().st_uid)
    if not others:
        return (f'none sending, or {UNDELIVERED}: no other process has shared memory in this '
                f'{folder}; containers need --ipc host')
    if foreign := others - {user}:
        return (f'{UNDELIVERED} from processes of {", ".join(map(_name, sorted(foreign)))}: Fast '
                f'DDS shares no memory between two users, and this node is of {_name(user)}')
    return ''


def _name(user: int) -> str:
    try:
        return f'user {pwd.getpwuid(user).pw_name}'
    except KeyError:
        return f'user id {user}'
