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

"""What an installation holds: programs where they belong, and what they need."""

from __future__ import annotations

import ast
from pathlib import Path
import re
import runpy
import subprocess
import sys
from typing import Any

import pytest

from flock_desk import program

ROOT = Path(__file__).resolve().parents[2]
#: What the packages of package.xml are called on PyPI.
ON_PYPI = {'rclpy': 'ros-jazzy-rclpy', 'python3-opencv': 'opencv-python-headless',
           'python3-numpy': 'numpy', 'python3-yaml': 'pyyaml', 'python3-matplotlib': 'matplotlib',
           'python3-pymavlink-pip': 'pymavlink', 'python3-rosbags-pip': 'rosbags'}
#: Commands of builds for ROS, and of pip.
BUILDS = {'install': True, 'develop': True, 'bdist_wheel': False, 'editable_wheel': False}


def setup(monkeypatch: pytest.MonkeyPatch, command: str) -> dict[str, Any]:
    """Return what setup.py gives setuptools when a command is asked for."""
    said: dict[str, Any] = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, 'argv', ['setup.py', command])
    monkeypatch.setattr('setuptools.setup', lambda **values: said.update(values))
    runpy.run_path('setup.py')
    return said


def programs(said: dict[str, Any]) -> dict[str, str]:
    return dict(line.split(' = ') for line in said['entry_points']['console_scripts'])


@pytest.mark.parametrize('command', BUILDS)
def test_generic_names_are_made_only_where_they_go_to_ros(
        monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    made = programs(setup(monkeypatch, command))
    if BUILDS[command]:
        assert {'planner', 'replay', 'figures', 'evaluate'} <= made.keys()
    else:
        assert made == {'flock_follower': 'flock_desk.program:main'}


def test_the_one_command_knows_every_program(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, target in programs(setup(monkeypatch, 'install')).items():
        assert f'{program.PROGRAMS[name]}:main' == target
    for module in program.PROGRAMS.values():
        file = ROOT / f'{module.replace(".", "/")}.py'
        assert 'main' in {node.name for node in ast.parse(file.read_text()).body
                          if isinstance(node, ast.FunctionDef)}, module


@pytest.mark.ros
def test_the_one_command_starts_what_is_named(monkeypatch: pytest.MonkeyPatch,
                                              capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, code, text in (([], 0, '  relative_pose planner'),
                                  (['judge'], 2, 'judge: no such program'),
                                  (['planner', '-h'], 0, 'Usage: planner')):
        monkeypatch.setattr(sys, 'argv', ['flock_follower', *arguments])
        assert program.main() == code
        assert text in ''.join(capsys.readouterr())


def test_what_package_xml_asks_for_is_in_the_extra_and_not_required(
        monkeypatch: pytest.MonkeyPatch) -> None:
    said = setup(monkeypatch, 'bdist_wheel')
    assert said['install_requires'] == ['setuptools']
    extra = {re.split(r'[\[=>]', name)[0]: name for name in said['extras_require']['runtime']}
    keys = re.findall(r'<exec_depend>(.*?)<', (ROOT / 'package.xml').read_text())
    for key in keys:
        if key in ON_PYPI:
            assert ON_PYPI[key] in extra
    # The same ROS as the suite runs with.
    locked = (ROOT / 'requirements' / 'jazzy.in').read_text().splitlines()
    for name in ('ros-jazzy-rclpy', 'ros-jazzy-common-interfaces'):
        assert extra[name] in locked


@pytest.mark.ros
def test_what_flies_loads_no_bag_reader_and_no_heavy_library() -> None:
    script = """
import sys
from importlib import import_module
for name in ('rosbags', 'matplotlib', 'mpl_toolkits', 'scipy', 'tqdm', 'flock_follower.bags'):
    sys.modules[name] = None  # as if it were not there
for node in ('relative_pose', 'planner', 'mavlink_bridge', 'flock', 'sharing'):
    import_module('flock_follower.nodes.' + node)
import_module('flock_follower.nodes.replay')
"""
    ended = subprocess.run([sys.executable, '-c', script], cwd=ROOT, text=True,
                           capture_output=True, timeout=60.0)
    # They all load; what reads bags does not, and so the script has proved something.
    assert 'nodes/replay.py' in ended.stderr and 'bags' in ended.stderr.splitlines()[-1]
