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


"""A file that is named and cannot be read is refused by its name, never replaced by a default."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from flock_desk.program import PROGRAMS
from flock_follower.system.files import resource

SAMPLE = str(resource('bags/sample'))


@pytest.mark.parametrize('fault', ['missing', 'unreadable', 'a folder'])
@pytest.mark.parametrize(('command', 'options'), [
    ('evaluate', [SAMPLE, '--config']), ('evaluate', [SAMPLE, '--expect']), ('evaluate', []),
    ('check', [SAMPLE, '--config']), ('check', []), ('figures', ['--campaign']),
    ('fly', ['--scenario']), ('fly', ['--detector']), ('flights', ['--scenario']),
    ('autopilot', ['--param-file'])])
def test_a_command_refuses_a_named_file(
        command: str, options: list[str], fault: str, tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    suffix = {'--detector': '.py', '--campaign': '.json'}.get(options[-1] if options else '')
    path = tmp_path / f'mine{suffix or ".yaml"}'
    if fault == 'unreadable':
        path.symlink_to('/proc/self/mem')
    elif fault == 'a folder':
        path.mkdir()
    monkeypatch.chdir(tmp_path)  # where an output would be
    try:
        module = import_module({**PROGRAMS, 'autopilot': 'flock_desk.autopilot'}[command])
        code = module.main([*options, str(path)])
    except SystemExit as ended:
        code = ended.code
    assert code in (1, 2)
    error = capsys.readouterr().err
    assert str(path) in error.splitlines()[-1] and 'Traceback' not in error
