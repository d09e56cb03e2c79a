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

"""The linters of ROS, which `colcon test` runs; `make lint` runs ruff and mypy."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = [str(ROOT / name) for name in (
    'benchmarks', 'examples', 'flock_desk', 'flock_follower', 'launch', 'test', 'setup.py')]
pytestmark = pytest.mark.linter


@pytest.mark.parametrize('name', ['ament_copyright', 'ament_flake8', 'ament_pep257'])
def test_a_linter_of_ros_finds_nothing(
        name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    linter = pytest.importorskip(f'{name}.main', reason=f'{name} is not installed')
    monkeypatch.chdir(ROOT)
    if name == 'ament_flake8':
        code, errors = linter.main_with_errors(argv=FOLDERS)
        assert code == 0, '\n'.join(errors)
    else:
        assert linter.main(argv=FOLDERS) == 0, '\n'.join(capsys.readouterr())
