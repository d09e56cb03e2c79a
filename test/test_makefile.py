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
                               'MARKERS', 'VISION')}
    return subprocess.run(['make', '--dry-run', *arguments], cwd=ROOT, capture_output=True,
                          text=True, timeout=20.0, env=outside)


@pytest.mark.parametrize('version', ['3', '4', '4.6', '5.0', ''])
def test_a_version_of_opencv_that_has_no_lock_is_refused_with_those_that_have(version):
    ended = make('test', f'VISION={version}')
    assert ended.returncode == 2
    assert f'VISION = {version}: must be 5 or 4.10.  Stop.' in ended.stderr


@pytest.mark.parametrize('version', ['5', '4.10'])
def test_every_version_that_is_offered_has_a_lock(version):
    ended = make('test', f'VISION={version}')
    assert ended.returncode == 0
    assert f'requirements/vision-{version}.txt' in ended.stdout
    assert (ROOT / 'requirements' / f'vision-{version}.txt').is_file()


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
