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

"""What `make` refuses before it makes anything."""

import os
from pathlib import Path
import shutil
import subprocess

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(shutil.which('make') is None, reason='make is not there')


def make(*arguments):
    # Settings of the `make test` that runs these tests are no settings of this make.
    outside = {name: value for name, value in os.environ.items()
               if name not in ('MAKEFLAGS', 'MAKELEVEL', 'MAKEOVERRIDES', 'MFLAGS', 'TESTS',
                               'MARKERS', 'ROS', 'VISION')}
    return subprocess.run(['make', '--dry-run', *arguments], cwd=ROOT, capture_output=True,
                          text=True, timeout=20.0, env=outside)


@pytest.mark.parametrize('version', ['3', '4', '4.6', '5.0', ''])
def test_opencv_version_without_lock_is_refused_with_choices(version):
    ended = make('test', f'VISION={version}')
    assert ended.returncode == 2
    assert f'VISION = {version}: must be 5 or 4.10.  Stop.' in ended.stderr


def test_ros_distribution_without_lock_is_refused_with_choices():
    ended = make('test', 'ROS=lyrical')
    assert ended.returncode == 2
    assert 'ROS = lyrical: must be jazzy or kilted.  Stop.' in ended.stderr


def test_the_live_page_is_on_or_off():
    ended = make('fly', 'VIEW=maybe')
    assert ended.returncode == 2 and 'VIEW = maybe: must be yes or no.  Stop.' in ended.stderr
    assert make('fly', 'VIEW=no').returncode == 0


@pytest.mark.parametrize(('settings', 'environment', 'locks'), [
    ([], '.venv', ('lock-jazzy', 'vision-5')),
    (['VISION=4.10'], '.venv-opencv-4.10', ('lock-jazzy', 'vision-4.10')),
    (['ROS=kilted'], '.venv-kilted', ('lock-kilted', 'vision-5')),
    (['ROS=kilted', 'VISION=4.10'], '.venv-kilted-opencv-4.10', ('lock-kilted', 'vision-4.10'))])
@pytest.mark.parametrize('command', ['setup', 'test', 'demo'])
def test_each_ros_and_opencv_has_an_environment_of_its_own(command, settings, environment, locks):
    ended = make(command, *settings)
    files = [f'requirements/{lock}.txt' for lock in locks]
    assert ended.returncode == 0
    assert f'requirements/make_venv.sh {environment} {" ".join(files)}\n' in ended.stdout
    assert command == 'setup' or f'{environment}/bin/python ' in ended.stdout
    assert all((ROOT / file).is_file() for file in files)


@pytest.mark.parametrize(('command', 'default'), [('demo', 'build/demo'), ('fly', 'build/fly')])
def test_a_flight_writes_to_the_folder_that_is_given(command, default):
    for given, folder in (([], default), (['OUTPUT=elsewhere'], 'elsewhere')):
        ended = make(command, *given)
        assert ended.returncode == 0 and f'--output {folder}' in ended.stdout


@pytest.mark.parametrize(('given', 'arguments'), [
    ([], ''), (['TESTS=test/flocks'], 'test/flocks'),
    (['MARKERS=not ros', 'TESTS=test/flocks test/runs'], "test/flocks test/runs -m 'not ros'")])
def test_the_suite_runs_all_tests_or_those_that_are_named(given, arguments):
    ended = make('test', *given)
    assert ended.returncode == 0
    assert ended.stdout.splitlines()[-1].strip().endswith(f'test/suite.py {arguments}'.strip())
