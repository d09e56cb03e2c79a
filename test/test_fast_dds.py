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

"""The reason why shared memory delivers nothing, for every way in which it can be lost."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flock_follower.checks.system import ADVICE
from flock_follower.system.fast_dds import UNDELIVERED, undelivered

OWN = ['/dev/shm/fastrtps_ab_el', '/dev/shm/fastrtps_port7001_el', 'socket:[17]']


@pytest.mark.parametrize('prefix', ['fastrtps_', 'fastdds_'])  # of Jazzy and Kilted
@pytest.mark.parametrize(('opened', 'others', 'user', 'said'), [
    (['socket:[17]'], ['fastrtps_cd_el'], os.getuid() + 1, ''),  # UDP alone
    (OWN, ['fastrtps_cd_el'], os.getuid(), ''),
    ([f'{name} (deleted)' for name in OWN], ['fastrtps_cd_el'], os.getuid(), 'was removed'),
    ([OWN[0], f'{OWN[1]} (deleted)'], ['fastrtps_cd_el'], os.getuid(), 'was removed'),
    (OWN, ['fastrtps_cd_el'], os.getuid() + 1, 'between two users'),
    (OWN, ['fastrtps_cd', 'sem.other'], os.getuid(), '--ipc host')])
def test_lost_shared_memory_is_named_with_its_cause(
        tmp_path: Path, opened: list[str], others: list[str], user: int, said: str,
        prefix: str) -> None:
    opened, others = ([name.replace('fastrtps_', prefix) for name in names]
                      for names in (opened, others))
    for name in ('fastrtps_ab_el', 'fastrtps_port7001_el', *others):
        (tmp_path / name.replace('fastrtps_', prefix)).touch()
    found = undelivered(opened, user, tmp_path)
    assert said in found and bool(found) == bool(said)
    assert not said or UNDELIVERED in found


def test_check_advises_on_the_transport_not_on_the_publisher() -> None:
    reason = undelivered([f'{OWN[0]} (deleted)'], 0)
    message = f'no /odom for 5 s: 1 publisher(s), matched: {reason}'
    advice = next(advice for words, advice in ADVICE.items() if words in message)
    assert 'shared memory' in advice
