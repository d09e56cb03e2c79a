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
import sys
from typing import Any
from xml.etree import ElementTree

import pytest

from flock_desk import program

ROOT = Path(__file__).resolve().parents[2]
#: What the packages of package.xml are called on PyPI.
ON_PYPI = {'rclpy': 'ros-jazzy-rclpy', 'python3-opencv': 'opencv-python-headless',
           'python3-numpy': 'numpy', 'python3-yaml': 'pyyaml', 'python3-matplotlib': 'matplotlib',
           'python3-pymavlink-pip': 'pymavlink', 'python3-rosbags-pip': 'rosbags',
           'python3-scipy': 'scipy', 'python3-tqdm': 'tqdm'}


def setup(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what setup.py gives setuptools."""
    said: dict[str, Any] = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr('setuptools.setup', lambda **values: said.update(values))
    runpy.run_path('setup.py')
    return said


def programs(said: dict[str, Any]) -> dict[str, str]:
    return dict(line.split(' = ') for line in said['entry_points']['console_scripts'])


def test_every_installation_has_every_program(monkeypatch: pytest.MonkeyPatch) -> None:
    made = programs(setup(monkeypatch))
    assert made.pop('flock_follower') == 'flock_desk.program:main'
    # These two have no name of their own in ROS, which has `ros2 service call` and `ros2 bag`.
    assert made == {name: f'{module}:main' for name, module in program.PROGRAMS.items()
                    if name not in ('call', 'recorder')}
    for module in program.PROGRAMS.values():
        file = ROOT / f'{module.replace(".", "/")}.py'
        assert 'main' in {node.name for node in ast.parse(file.read_text()).body
                          if isinstance(node, ast.FunctionDef)}, module


def test_every_shipped_file_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    said = setup(monkeypatch)
    installed = {name for _, names in said['data_files'] for name in names}
    for folder in ('config', 'launch', 'deploy', 'bags/sample'):
        files = {str(path.relative_to(ROOT)) for path in (ROOT / folder).rglob('*')
                 if path.is_file() and '__pycache__' not in path.parts}
        assert files <= installed
    data = {path for package, patterns in said['package_data'].items() for pattern in patterns
            for path in (ROOT / package.replace('.', '/')).glob(pattern)}
    assert data == {path for package in ('flock_desk', 'flock_follower')
                    for path in (ROOT / package).rglob('*')
                    if path.is_file() and path.suffix not in ('.py', '.pyc')}


def test_both_descriptions_of_the_package_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    said = setup(monkeypatch)
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    maintainer, urls = package.find('maintainer'), package.findall('url')
    assert maintainer is not None
    assert (maintainer.text, maintainer.get('email')) == (
        said['maintainer'], said['maintainer_email'])
    assert 'example.com' not in said['maintainer_email']
    assert {url.get('type'): url.text for url in urls} == {
        'website': said['url'], 'repository': said['url'],
        'bugtracker': said['project_urls']['Bugs']}
    assert package.findtext('version') == said['version']


@pytest.mark.ros
def test_the_one_command_starts_what_is_named(monkeypatch: pytest.MonkeyPatch,
                                              capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, code, text in (([], 0, '  relative_pose planner'),
                                  (['judge'], 2, 'judge: no such program'),
                                  (['planner', '-h'], 0, 'Usage: planner')):
        monkeypatch.setattr(sys, 'argv', ['flock_follower', *arguments])
        assert program.main() == code
        assert text in ''.join(capsys.readouterr())


def test_dependencies_of_package_xml_are_in_extra_not_required(
        monkeypatch: pytest.MonkeyPatch) -> None:
    said = setup(monkeypatch)
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
