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

"""The command on recordings: the sample as it is, and with one thing amiss; and its refusals."""

from __future__ import annotations

from collections.abc import Callable
import json
from pathlib import Path
from typing import Any
import zipfile

from bag_excerpts import Change, edited, excerpt
import numpy as np
import pytest

from flock_follower import check
from flock_follower.bags.mcap_file import MARK
from flock_follower.check import main, newest_recording
from flock_follower.checks.observations import NodeStatus, Observations
from flock_follower.system.files import resource

pytestmark = pytest.mark.slow
SAMPLE = resource('bags/sample')
IMAGES = '/image_raw/compressed'


def checked(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    """Return the exit code, and the findings of --json, by what they are about."""
    code = main([*map(str, arguments), '--json'])
    printed = json.loads(capsys.readouterr().out)
    assert set(printed) == {'ready', 'bag', 'seconds', 'findings'}
    assert printed['ready'] is (code == 0)
    return code, {finding['what']: finding for finding in printed['findings']}


def test_a_report_holds_what_a_bug_report_needs(
        capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / 'report.zip'
    code, findings = checked(capsys, SAMPLE, '--report', path)
    assert code == 0
    with zipfile.ZipFile(path) as found:
        assert f'numpy {np.__version__}\n' in found.read('versions.txt').decode()
        assert found.read('check.txt').decode().splitlines()[-1] == (
            'usable: 0 errors, 0 warnings, 16 ok, 3 not measured (odom positions, marker size, '
            'camera mounting)')
        reported = json.loads(found.read('check.json'))['findings']
        assert {finding['what'] for finding in reported} == set(findings)
        assert json.loads(found.read('diagnostics.json')) == {}
        assert {name for name in found.namelist() if 'recording' in name} == {
            'recording/sample.mcap', 'recording/metadata.yaml', 'recording/parameters.yaml'}
    short = excerpt(tmp_path / 'bag', 0.3)
    assert main([str(short), '--report', str(tmp_path / 'missing' / 'report.zip')]) == 2
    assert 'missing/report.zip' in capsys.readouterr().err


def test_the_newest_recording_is_the_one_of_the_largest_number(tmp_path: Path) -> None:
    assert newest_recording(tmp_path) is None
    names = [f'{number}_20260101T000000Z' for number in ('0001', '9999', '10000', '10001')]
    for name in (*names, 'old_flights'):
        (tmp_path / name).mkdir()
        if name != names[-1]:  # that of a recording without a file
            (tmp_path / name / 'x.mcap').touch()
    assert newest_recording(tmp_path) == tmp_path / names[2]


def test_report_of_running_system_holds_black_box_recording(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    statuses = {'a/black_box': NodeStatus(0, '', {'recording': str(SAMPLE)})}
    monkeypatch.setattr(check, '_observe', lambda options: (
        Observations(namespace=options.namespace, statuses=statuses), []))
    monkeypatch.setenv('ROS_HOME', str(tmp_path))  # without a recording in the default folder
    for namespace, there in (('a', True), ('b', False)):
        main(['--report', str(tmp_path / namespace), '--namespace', namespace])
        with zipfile.ZipFile(tmp_path / namespace) as found:
            assert ('recording/sample.mcap' in found.namelist()) is there


def of(topic: str, edit: Callable[[Any], None]) -> Change:
    """Return a change of every message of a topic."""
    return lambda message: edited(message, edit) if message.topic == topic else message


def altered(name: str, **fields: Any) -> Change:
    """Return a change of topic, type or time of the messages of a topic, and of their bytes."""
    return lambda message: message._replace(**fields) if message.topic == name else message


def unreadable(message: Any) -> None:
    message.data = np.zeros(9, np.uint8)


def lost(message: Any) -> None:
    message.pose.pose.orientation = type(message.pose.pose.orientation)(0.0, 0.0, 0.0, 0.0)


#: The change, and the row that has to be there: level, what, words of what was measured and of
#: what to do. The rules themselves are held by test/checks/test_every_check.py.
FAULTS: dict[str, tuple[Change, tuple[str, str, str, str]]] = {
    'no images': (of(IMAGES, unreadable), ('error', 'images', '', 'mono8')),
    'a lost source': (of('/odom', lost), (
        'error', 'odom', 'are invalid: quaternion = 0', 'initialized'))}


def assert_told(found: dict[str, Any], row: tuple[str, str, str, str]) -> None:
    level, what, measured, advice = row
    finding = found[what]
    assert finding['level'] == level and measured in finding['measured'], finding
    assert advice in finding['advice'] and finding['advice'] and '\n' not in str(finding)


@pytest.mark.parametrize(('change', 'row'), FAULTS.values(), ids=FAULTS)
def test_a_fault_in_a_bag_is_named(change: Change, row: tuple[str, str, str, str], tmp_path: Path,
                                   capsys: pytest.CaptureFixture[str]) -> None:
    code, found = checked(capsys, excerpt(tmp_path / 'bag', 1.5, change))
    assert_told(found, row)
    assert code == (row[0] == 'error')


def test_a_bag_that_holds_less_than_it_announces_is_incomplete(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, shorter = (excerpt(tmp_path / name / 'bag', length) for name, length in (
        ('whole', 1.5), ('shorter', 1.2)))
    (shorter / 'bag.mcap').replace(bag / 'bag.mcap')
    assert 'announced messages found' in checked(capsys, bag)[1]['bag']['measured']


def test_flight_behind_leader_shows_focal_length_and_mounting(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def longer(message: Any) -> None:
        message.k = message.k * np.array([1.2, 1.0, 1.0, 1.0, 1.2, 1.0, 1.0, 1.0, 1.0])
    bag = excerpt(tmp_path / 'bag', 12.0, of('/camera_info', longer))
    config = tmp_path / 'mine.yaml'
    config.write_text('/**: {ros__parameters: {camera_rpy: [0.0, 0.1745, 0.0]}}')
    code, found = checked(capsys, bag, '--config', config)
    assert code == 1
    assert_told(found, ('error', 'focal length', '0.8', 'this lens'))
    assert_told(found, ('error', 'camera mounting', 'looks higher', 'camera_rpy:=['))


def test_table_names_topic_to_remap_and_ends_with_verdict(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = excerpt(tmp_path / 'bag', 1.5, altered('/odom', topic='/vio/odometry'))
    (bag / MARK).touch()
    assert main([str(bag)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith('ERROR   odom: the bag lacks /odom') for line in lines)
    assert any('--remap odom:=/vio/odometry' in line for line in lines)
    assert any(line.startswith('warning bag: incomplete: still being written') for line in lines)
    assert lines[-1].startswith('not usable as it is: 1 error, 1 warning, ')
    assert main([str(bag), '--remap', 'odom:=/vio/odometry']) == 0
    assert '\nusable: 0 errors, 1 warning, ' in capsys.readouterr().out


@pytest.mark.parametrize(('arguments', 'words'), [
    (['/nowhere/at.bag'], 'error: /nowhere/at.bag: no such bag'),
    ([str(SAMPLE), '--config', '/nowhere.yaml'], 'No such file or directory'),
    (['--namespace', 'a b'], 'error: --namespace a b: must be'),
    (['--seconds', '0.5'], 'error: --seconds = 0.5: must be a number in [1, 600] s'),
    ([str(SAMPLE), '--remap', 'odometry:=/x'], 'with a name of ours: one of')])
def test_a_wrong_argument_is_one_line(
        arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    out, error = capsys.readouterr()
    assert out == '' and error.count('\n') == 1 and words in error
