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
from flock_follower.bags import mcap_file
from flock_follower.bags.bag import deserialize, open_bag, serialize
from flock_follower.bags.description import mark_incomplete
from flock_follower.bags.mcap_file import McapFile, RecordedTopic, TakenMessage
from flock_follower.bags.message_types import empty, typestore
from flock_follower.bags.writer import BagWriter
from flock_follower.check import COLUMNS, main
from flock_follower.checks.bug_report import newest_recording, write_report
from flock_follower.checks.observations import NodeStatus, Observations
from flock_follower.files import resource

pytestmark = pytest.mark.slow
SAMPLE = resource('bags/sample')
IMAGES, POSE = '/image_raw/compressed', 'geometry_msgs/msg/PoseStamped'


def checked(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    """Return the exit code, and the findings of --json, by what they are about."""
    code = main([*map(str, arguments), '--json'])
    printed = json.loads(capsys.readouterr().out)
    assert set(printed) == {'ready', 'bag', 'seconds', 'findings'}
    assert printed['ready'] is (code == 0)
    return code, {finding['what']: finding for finding in printed['findings']}


def unzipped(path: Path) -> Path:
    """Return the folder with the content of a report."""
    folder = path.with_name(f'{path.name}.content')
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    return folder


def test_a_report_holds_what_a_bug_report_needs(
        capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / 'report.zip'
    code, findings = checked(capsys, SAMPLE, '--report', path)
    assert code == 0
    found = unzipped(path)
    assert f'numpy {np.__version__}\n' in (found / 'versions.txt').read_text()
    assert (found / 'check.txt').read_text().strip().splitlines()[-1].startswith('usable')
    reported = json.loads((found / 'check.json').read_text())['findings']
    assert {finding['what'] for finding in reported} == set(findings)
    assert json.loads((found / 'diagnostics.json').read_text()) == {}
    with open_bag(found / 'recording' / 'last_minute') as part, open_bag(SAMPLE) as bag:
        assert part.message_count == bag.message_count  # 12 s: all of it


def test_a_report_that_cannot_be_written_is_refused_by_its_name(
        capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / 'missing' / 'report.zip'
    with pytest.raises(SystemExit, match='2'):  # before anything is read
        main([str(SAMPLE), '--report', str(path)])
    assert capsys.readouterr().err.endswith(
        f'error: --report = {path}: must be a file in a folder that exists\n')
    assert main([str(SAMPLE), '--report', str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f'error: --report {tmp_path}: ')


def test_the_newest_recording_is_the_one_of_the_largest_number(tmp_path: Path) -> None:
    assert newest_recording(tmp_path) is None
    names = [f'{number}_20260101T000000Z' for number in ('0001', '9999', '10000', '10001')]
    for name in (*names, 'old_flights'):
        (tmp_path / name).mkdir()
        if name != names[-1]:  # that of a recording without a file
            (tmp_path / name / 'x.mcap').touch()
    assert newest_recording(tmp_path) == tmp_path / names[2]


def test_an_unknown_message_type_leaves_the_rest_of_the_recording_in_the_report(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    foreign, data = RecordedTopic('/fmu', 'px4_msgs/msg/Foo'), b'\0\1\0\0' + bytes(8)
    known = RecordedTopic('/pose', POSE)
    with monkeypatch.context() as patch:
        patch.setattr(mcap_file, 'definition', lambda _: 'uint64 timestamp')
        file = McapFile(tmp_path / 'bag.mcap')
        file.write([TakenMessage(known, second * 1_000_000_000, serialize(empty(POSE), POSE))
                    for second in range(100)] + [TakenMessage(foreign, 99_000_000_000, data)])
        file.close()
    write_report(tmp_path / 'report.zip', Observations(), '', {}, file.path)
    found = unzipped(tmp_path / 'report.zip')
    assert (found / 'recording' / 'error.txt').read_text() == (
        '/fmu: unknown message type px4_msgs/msg/Foo\n')
    with open_bag(found / 'recording' / 'last_minute') as part:
        assert (part.topics.keys(), part.duration_ns) == ({'/pose'}, 60_000_000_000)
        assert not part.incomplete


def test_a_report_of_a_long_recording_holds_its_end(tmp_path: Path) -> None:
    array, string, second = 'diagnostic_msgs/msg/DiagnosticArray', 'std_msgs/msg/String', 10**9
    with BagWriter(tmp_path / 'bag', ['/planner/state']) as writer:
        for time in range(0, 401, 10):
            message = empty(array)
            message.status = [typestore().types['diagnostic_msgs/msg/DiagnosticStatus'](
                0, 'planner', f'at {time} s', '', [])]
            writer.write('/diagnostics', array, time * second, serialize(message, array))
        for time, state in ((1, 'IDLE'), (9, 'TRACK')):
            message = empty(string)
            message.data = state
            writer.write('/planner/state', string, time * second, serialize(message, string))
    main([str(tmp_path / 'bag'), '--report', str(tmp_path / 'report.zip')])
    path = unzipped(tmp_path / 'report.zip')
    diagnostics = json.loads((path / 'diagnostics.json').read_text())
    assert diagnostics['planner']['message'] == 'at 400 s'
    with open_bag(path / 'recording' / 'last_minute') as part:
        found = [(m.topic, m.stamp_ns // second) for m in part.messages()]
        (state,) = part.messages(['/planner/state'])
        assert deserialize(state.data, string).data == 'TRACK'
    assert found[0] == ('/planner/state', 340)
    assert found[1:] == [('/diagnostics', time) for time in range(340, 401, 10)]


def test_a_report_of_a_running_system_holds_the_recording_of_its_black_box(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen = Observations(statuses={
        'a/black_box': NodeStatus(0, '', {'recording': str(SAMPLE)})})
    monkeypatch.setattr(check, '_observe', lambda options: (seen, []))
    monkeypatch.setenv('ROS_HOME', str(tmp_path))  # without a recording in the default folder
    for namespace, there in (('a', True), ('b', False)):
        main(['--report', str(tmp_path / namespace), '--namespace', namespace])
        report = unzipped(tmp_path / namespace)
        assert (report / 'recording' / 'last_minute').exists() is there


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
        'error', 'odom', 'say nothing: quaternion = 0', 'initialised'))}


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


def configured(tmp_path: Path, text: str) -> Path:
    """Return a file of parameters."""
    config = tmp_path / 'mine.yaml'
    config.write_text(f'/**: {{ros__parameters: {{{text}}}}}')
    return config


def test_a_flight_behind_a_moving_leader_shows_focal_length_and_mounting(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def longer(message: Any) -> None:
        message.k = message.k * np.array([1.2, 1.0, 1.0, 1.0, 1.2, 1.0, 1.0, 1.0, 1.0])
    bag = excerpt(tmp_path / 'bag', 12.0, of('/camera_info', longer))
    config = configured(tmp_path, 'camera_rpy: [0.0, 0.1745, 0.0]')
    code, found = checked(capsys, bag, '--config', config)
    assert code == 1
    assert_told(found, ('error', 'focal length', '0.8', 'this lens'))
    assert_told(found, ('error', 'camera mounting', 'looks higher', 'camera_rpy:=['))


def test_topics_are_taken_by_the_names_they_have(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = excerpt(tmp_path / 'bag', 1.5, altered(IMAGES, topic='/a/image'))
    assert checked(capsys, bag, '--remap', 'image_raw:=/a/image')[0] == 0
    assert main([str(bag), '--remap', '/a/image:=image_raw']) == 2
    assert 'did you mean image_raw:=/a/image?' in capsys.readouterr().err


def test_the_table_is_narrow_and_ends_with_the_verdict(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = excerpt(tmp_path / 'bag', 1.5,
                  altered('/odom', topic='/a/very/long/name/of/a/topic/odometry'))
    mark_incomplete(bag, 'the disk is full')
    assert main([str(bag)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= COLUMNS
    assert any(line.startswith('ERROR   odom') for line in lines)
    assert any('--remap odom:=/a/very/long/name/of/a/topic/odometry' in line for line in lines)
    assert any(line.startswith('warning bag') and 'the disk is full' in line for line in lines)
    assert lines[-1].startswith('not usable as it is: 1 error, 1 warning, ')
    assert main([str(SAMPLE)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == (
        'usable: 0 errors, 0 warnings, 20 ok, 3 not measured (odom positions, marker size, '
        'camera mounting)')


@pytest.mark.parametrize(('arguments', 'words'), [
    (['/nowhere/at.bag'], 'error: /nowhere/at.bag: no such bag'),
    ([str(SAMPLE), '--config', '/nowhere.yaml'], 'error: /nowhere.yaml: No such file'),
    (['--config', '/nowhere.yaml'], 'error: /nowhere.yaml: No such file'),
    (['--namespace', 'a b'], 'error: --namespace a b: must be'),
    ([str(SAMPLE), '--remap', 'odometry:=/x'], 'odometry is no name of ours: must be one of')])
def test_what_cannot_be_checked_is_one_line(
        arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    out, error = capsys.readouterr()
    assert out == '' and error.count('\n') == 1 and words in error
