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

"""The installer shows what it does, does it once, keeps what is the user's, and undoes it."""

from __future__ import annotations

from pathlib import Path
import subprocess

import pytest

DEPLOY = Path(__file__).resolve().parents[2] / 'deploy'


def install(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ['bash', str(DEPLOY / 'install.sh'), '--root', str(root), '--user', 'pilot',
         '--workspace', '/home/pilot/ws', *arguments],
        text=True, capture_output=True, timeout=20.0)


def files(root: Path) -> dict[str, str]:
    return {str(path.relative_to(root)): path.read_text()
            for path in root.rglob('*') if path.is_file()}


SETTINGS = 'etc/flock_follower/follower.env'
INSTALLED = {'etc/systemd/system/flock_follower@.service', SETTINGS,
             'etc/sysctl.d/05-flock_follower.conf',
             'etc/systemd/logind.conf.d/05-flock_follower.conf',
             'etc/udev/rules.d/61-flight-controller.rules',
             'usr/local/lib/flock_follower/start',
             'usr/local/lib/flock_follower/prefer_realtime',
             'usr/local/lib/flock_follower/follower.env'}


def test_it_prints_and_writes_its_files_and_undoes_them(tmp_path: Path) -> None:
    planned = install(tmp_path, '--dry-run').stdout
    assert files(tmp_path) == {}
    assert install(tmp_path).stdout == planned
    there = files(tmp_path)
    assert there.keys() == INSTALLED
    assert all(f'write {tmp_path / file}\n' in planned for file in INSTALLED)
    unit = there['etc/systemd/system/flock_follower@.service']
    assert '\nUser=pilot\n' in unit
    assert '\nExecStart=/bin/bash /usr/local/lib/flock_follower/start ' in unit
    # Else the shared memory of a running service goes when its user logs out.
    assert '\n[Login]\nRemoveIPC=no\n' in there['etc/systemd/logind.conf.d/05-flock_follower.conf']
    assert (tmp_path / 'usr/local/lib/flock_follower/start').stat().st_mode & 0o111
    assert '\nWORKSPACE=/home/pilot/ws\n' in there[SETTINGS]
    install(tmp_path, '--name', 'drone2')
    assert 'etc/flock_follower/drone2.env' in files(tmp_path)
    install(tmp_path, '--undo')
    assert files(tmp_path) == {}


def test_changed_settings_outlive_update_and_undo(tmp_path: Path) -> None:
    install(tmp_path)
    (tmp_path / SETTINGS).write_text('WORKSPACE=/mine\n')
    for arguments in ([], ['--undo']):
        assert f'yours, unchanged: {tmp_path / SETTINGS}' in install(
            tmp_path, *arguments).stdout
    assert files(tmp_path) == {SETTINGS: 'WORKSPACE=/mine\n'}


@pytest.mark.parametrize(('arguments', 'reported'), [
    (['--name', 'a b'], 'letters, digits and _ only'), (['--user', 'a b'], 'not a user name'),
    (['--workspace', 'ws'], 'must begin with /'), (['--user', ''], '--user USER names the user'),
    (['--what'], 'unknown argument: --what'), (['--name'], '--name needs a value')])
def test_what_cannot_be_is_refused_before_anything_is_written(
        tmp_path: Path, arguments: list[str], reported: str) -> None:
    ended = install(tmp_path, *arguments)
    assert ended.returncode == 2 and reported in ended.stderr
    assert files(tmp_path) == {}
