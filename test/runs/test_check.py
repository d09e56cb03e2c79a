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

from bag_excerpts import Change, edited, excerpt, without
from carried_camera import SIDE_LENGTH, write_carried
import cv2
import numpy as np
import pytest
from rewritten_odometry import IMU_RPY, rewritten_bag, Source

from flock_follower.bags.bag import BagMessage, serialize
from flock_follower.bags.description import mark_incomplete
from flock_follower.bags.message_types import empty
from flock_follower.check import COLUMNS, main
from flock_follower.perception.markers import draw_marker
from flock_follower.resources import resource

pytestmark = pytest.mark.slow
SAMPLE = resource('bags/sample')
SECONDS = 3.0


def checked(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    """Return the exit code, and what --json prints, its findings by what they are about."""
    code = main([*map(str, arguments), '--json'])
    told = json.loads(capsys.readouterr().out)
    assert set(told) == {'ready', 'bag', 'seconds', 'findings'}
    assert told['ready'] is (code == 0)
    return code, {finding['what']: finding for finding in told['findings']}


def of(topic: str, edit: Callable[[Any], None]) -> Change:
    """Return a change of every message of a topic."""
    return lambda message: edited(message, edit) if message.topic == topic else message


def under(name: str, other: str) -> Change:
    return lambda message: message._replace(topic=other) if message.topic == name else message


def moved(name: str, nanoseconds: int) -> Change:
    """Return a change of when the messages of a topic were recorded."""
    return lambda message: message._replace(stamp_ns=message.stamp_ns + nanoseconds) if (
        message.topic == name) else message


def thinned(name: str, every: int) -> Change:
    count = [0]

    def keep(message: BagMessage) -> BagMessage | None:
        count[0] += message.topic == name
        return message if message.topic != name or count[0] % every == 0 else None
    return keep


def stamped(seconds: float) -> Callable[[Any], None]:
    def edit(message: Any) -> None:
        nanoseconds = round(seconds * 1e9) + message.header.stamp.nanosec
        message.header.stamp.sec += nanoseconds // 10**9
        message.header.stamp.nanosec = nanoseconds % 10**9
    return edit


def calibrated(**fields: Any) -> Callable[[Any], None]:
    def edit(message: Any) -> None:
        for name, value in fields.items():
            setattr(message, name, value)
    return edit


def painted(pixels: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]) -> Change:
    def edit(message: Any) -> None:
        image = pixels(cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE))
        message.data = cv2.imencode('.jpg', image)[1].ravel()
    return of('/image_raw/compressed', edit)


def retyped(name: str, msgtype: str) -> Change:
    return lambda message: message._replace(
        msgtype=msgtype, data=serialize(empty(msgtype), msgtype)) if message.topic == name else (
        message)


def another_marker(image: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    image[:] = 160
    image[100:300, 200:400] = 255
    image[120:280, 220:380] = draw_marker('DICT_5X5_100', 7, 160)
    return image


def printed_twice(image: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    image[20:140, 20:140] = 255
    image[40:120, 40:120] = draw_marker('DICT_4X4_50', 0, 80)
    return image


def unstamped(message: Any) -> None:
    message.header.stamp.sec = message.header.stamp.nanosec = 0


def lost(message: Any) -> None:
    for axis in 'xyzw':
        setattr(message.pose.pose.orientation, axis, 0.0)


#: What is amiss, the change that makes it so, and the line that has to be there: level, what,
#: words of what was measured, words of what to do.
FAULTS: list[tuple[str, Change, tuple[str, str, str, str]]] = [
    ('images under another name', under('/image_raw/compressed', '/cam/image_rect/compressed'),
     ('error', 'images', 'the bag lacks /image_raw',
      '--remap image_raw/compressed:=/cam/image_rect/compressed')),
    ('no images', without('/image_raw/compressed'), ('error', 'images', 'lacks', 'record it')),
    ('no calibration', without('/camera_info'), ('error', 'camera_info', 'lacks', 'record it')),
    ('odometry under another name', under('/odom', '/vins_estimator/odometry'),
     ('error', 'odom', 'lacks /odom', '--remap odom:=/vins_estimator/odometry')),
    ('poses as odometry', retyped('/odom', 'geometry_msgs/msg/PoseStamped'),
     ('error', 'odom', '/odom holds geometry_msgs/msg/PoseStamped', 'nav_msgs/msg/Odometry')),
    ('a slow camera', thinned('/image_raw/compressed', 15),
     ('error', 'images rate', '2.0 Hz', 'frame rate')),
    ('slow odometry', thinned('/odom', 40), ('error', 'odom rate', '5.0 Hz', 'output rate')),
    ('late odometry', moved('/odom', 400_000_000), ('error', 'odom latency', '402 ms', '')),
    ('stamps ahead', of('/image_raw/compressed', stamped(0.1)),
     ('error', 'images latency', '89 ms in the future', 'clocks')),
    ('another clock', of('/image_raw/compressed', stamped(-1e6)),
     ('error', 'camera and odometry', 'days apart', 'clock of ROS')),
    ('stamps of zero', of('/odom', unstamped),
     ('error', 'odom stamps', 'are zero', 'header.stamp')),
    ('another size', of('/camera_info', calibrated(width=1280, height=720)),
     ('error', 'calibration', 'for 1280x720, images are 640x480', 'calibrate')),
    ('not calibrated', of('/camera_info', calibrated(k=np.zeros(9))),
     ('error', 'calibration', 'K = 0', 'calibrate')),
    ('an unknown lens', of('/camera_info', calibrated(distortion_model='mei')),
     ('error', 'calibration', "'mei'", 'calibrate')),
    ('images that are none', of('/image_raw/compressed', calibrated(data=np.zeros(9, np.uint8))),
     ('error', 'images', '', 'mono8')),
    ('a cap on the lens', painted(lambda image: image // 40),
     ('error', 'images', 'black', 'cap')),
    ('a marker of another dictionary', painted(another_marker),
     ('error', 'marker', 'marker 7 of DICT_5X5', 'config/neighbors.yaml')),
    ('a second print of the marker', painted(printed_twice),
     ('warning', 'marker id', 'marker 0 twice', 'cover the print')),
    ('a marker too small', painted(lambda image: np.ascontiguousarray(cv2.copyMakeBorder(
        cv2.resize(image, (224, 168), interpolation=cv2.INTER_AREA), 156, 156, 208, 208,
        cv2.BORDER_CONSTANT, value=128))), ('warning', 'marker', 'px wide', 'larger')),
    ('no marker', painted(lambda image: cv2.GaussianBlur(image, (0, 0), 9.0)),
     ('warning', 'marker', 'not in sight', 'leader')),
    ('a source that is lost', of('/odom', lost),
     ('error', 'odom', 'say nothing: quaternion = 0', 'initialised'))]
#: The same for sources of odometry, and stamps of the camera.
SOURCES: list[tuple[str, Source, float, tuple[str, str, str, str]]] = [
    ('the axes of an IMU', Source(imu=True), 0.0,
     ('error', 'odom up', '-y of base_link is up', 'odom_child_rpy:=[-1.5708,0.0,-1.5708]')),
    ('no twist', Source(twist='none', rates=False), 0.0,
     ('warning', 'odom velocity', 'however it is read', 'derived')),
    ('no rates', Source(rates=False), 0.0, ('warning', 'odom angular rate', 'zero', 'derived')),
    ('no covariances', Source(covariances=False), 0.0,
     ('warning', 'odom covariances', 'pose and twist', 'odom_std')),
    ('camera stamps off', Source(), -0.05,
     ('error', 'camera time offset', '50 ms earlier', 'exposure'))]


def assert_told(found: dict[str, Any], line: tuple[str, str, str, str]) -> None:
    level, what, measured, advice = line
    finding = found[what]
    assert finding['level'] == level and measured in finding['measured'], finding
    assert advice in finding['advice'] and finding['advice'] and '\n' not in str(finding)


def test_of_the_sample_nothing_is_amiss(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = checked(capsys, SAMPLE)
    assert code == 0
    assert {what: finding['level'] for what, finding in found.items()
            if finding['level'] != 'ok'} == {
        'marker size': 'not measured', 'camera mounting': 'not measured'}
    assert found['odom velocity']['measured'] == 'in the child frame'
    assert found['camera time offset']['measured'] == 'about 0 ms'
    assert float(found['odom ahead']['measured'].split('%')[0].split()[-1]) > 95.0


@pytest.mark.parametrize(('change', 'line'), [fault[1:] for fault in FAULTS],
                         ids=[fault[0] for fault in FAULTS])
def test_a_fault_in_a_bag_is_named(change: Change, line: tuple[str, str, str, str], tmp_path: Path,
                                   capsys: pytest.CaptureFixture[str]) -> None:
    bag = excerpt(tmp_path / 'bag', SECONDS, change)
    code, found = checked(capsys, bag)
    assert_told(found, line)
    assert code == (1 if line[0] == 'error' else 0)


@pytest.mark.parametrize(('source', 'offset', 'line'), [fault[1:] for fault in SOURCES],
                         ids=[fault[0] for fault in SOURCES])
def test_a_source_that_differs_is_named(
        source: Source, offset: float, line: tuple[str, str, str, str], tmp_path: Path,
        capsys: pytest.CaptureFixture[str]) -> None:
    bag = rewritten_bag(SAMPLE, tmp_path / 'bag', source, image_offset=offset)
    _, found = checked(capsys, bag)
    assert_told(found, line)


def test_a_twist_told_wrongly_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = rewritten_bag(SAMPLE, tmp_path / 'bag', Source(twist='odom'))
    config = tmp_path / 'mine.yaml'
    config.write_text('/**: {ros__parameters: {odom_twist_frame: child}}')
    code, found = checked(capsys, bag, '--config', config)
    assert code == 1
    assert_told(found, ('error', 'odom velocity', 'read in child, the positions say odom', 'auto'))
    assert checked(capsys, bag)[0] == 0


def test_the_pose_of_an_imu_that_is_told_is_believed(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = rewritten_bag(SAMPLE, tmp_path / 'bag', Source(imu=True))
    config = tmp_path / 'mine.yaml'
    config.write_text(f'/**: {{ros__parameters: {{odom_child_rpy: {list(map(float, IMU_RPY))}}}}}')
    code, found = checked(capsys, bag, '--config', config)
    assert code == 0 and found['odom up']['level'] == found['odom ahead']['level'] == 'ok'


def test_a_camera_mounted_otherwise_than_told_is_named(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / 'mine.yaml'
    config.write_text('/**: {ros__parameters: {camera_rpy: [0.0, 0.0, 1.5708]}}')
    code, found = checked(capsys, SAMPLE, '--config', config)
    assert code == 1
    assert_told(found, ('error', 'odom ahead', 'with other axes', 'check camera_rpy'))


def test_topics_are_taken_by_the_names_they_have(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = excerpt(tmp_path / 'bag', 1.5, under('/image_raw/compressed', '/a/image'))
    assert checked(capsys, bag, '--remap', 'image_raw:=/a/image')[0] == 0
    assert checked(capsys, bag, '--remap', 'image_raw/compressed:=a/image')[0] == 0
    assert main([str(bag), '--remap', '/a/image:=image_raw']) == 2
    assert 'did you mean image_raw:=/a/image?' in capsys.readouterr().err


@pytest.fixture(scope='module')
def carried_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_carried(tmp_path_factory.mktemp('carried') / 'bag')


def carried_with(tmp_path: Path, told: str = '', size: float = SIDE_LENGTH) -> Path:
    """Return a file of parameters, and of markers of a size, m."""
    neighbors, config = tmp_path / 'neighbors.yaml', tmp_path / 'mine.yaml'
    neighbors.write_text(resource('config/neighbors.yaml').read_text().replace(
        f'side_length: {SIDE_LENGTH}', f'side_length: {size}'))
    config.write_text(f'/**: {{ros__parameters: {{neighbors_file: {neighbors}, {told}}}}}')
    return config


def test_a_marker_of_the_size_told_is_as_told(
        carried_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = checked(capsys, carried_bag, '--config', carried_with(tmp_path))
    assert code == 0
    assert found['marker size']['level'] == found['camera mounting']['level'] == 'ok'
    assert found['marker size']['measured'].startswith('moves 1.0')
    assert found['camera mounting']['measured'] in ('off by 0 deg', 'off by 1 deg')


@pytest.mark.parametrize(('size', 'ratio'), [(0.128, '0.80'), (0.2, '1.25'), (0.148, '0.9')])
def test_a_marker_of_another_size_is_named(size: float, ratio: str, carried_bag: Path,
                                           tmp_path: Path,
                                           capsys: pytest.CaptureFixture[str]) -> None:
    code, found = checked(capsys, carried_bag, '--config', carried_with(tmp_path, size=size))
    level = 'warning' if ratio == '0.9' else 'error'
    assert code == (level == 'error')
    assert_told(found, (level, 'marker size', f'moves {ratio}', '0.16'))


@pytest.mark.parametrize(('rpy', 'words', 'fitting'), [
    ('[0.0, -0.2, 0.0]', 'looks lower by 11 deg', 'camera_rpy:=['),
    ('[0.0, 0.0, 0.25]', 'looks further right by 14 deg', 'camera_rpy:=[')])
def test_a_camera_mounted_a_little_otherwise_is_named(
        rpy: str, words: str, fitting: str, carried_bag: Path, tmp_path: Path,
        capsys: pytest.CaptureFixture[str]) -> None:
    config = carried_with(tmp_path, f'camera_rpy: {rpy}')
    code, found = checked(capsys, carried_bag, '--config', config)
    assert code == 1
    assert_told(found, ('error', 'camera mounting', words, fitting))
    assert found['marker size']['level'] == 'ok'


def test_of_a_leader_that_moves_no_size_is_told(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_carried(tmp_path / 'bag', moving=True)
    _, found = checked(capsys, bag, '--config', carried_with(tmp_path, size=0.128))
    for what in ('marker size', 'camera mounting'):
        assert found[what]['level'] == 'not measured'
        assert 'the leader moves' in found[what]['measured']
    _, found = checked(capsys, SAMPLE)
    assert 'the leader moves' in found['marker size']['measured']


def test_a_bag_cut_short_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = excerpt(tmp_path / 'bag', 1.5)
    mark_incomplete(bag, 'the disk is full')
    code, found = checked(capsys, bag)
    assert code == 0
    assert_told(found, ('warning', 'bag', 'the disk is full', 'record anew'))


def test_the_table_is_narrow_and_ends_with_the_verdict(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = excerpt(tmp_path / 'bag', 1.5, under('/odom', '/a/very/long/name/of/a/topic/odometry'))
    assert main([str(bag)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= COLUMNS
    assert any(line.startswith('ERROR   odom') for line in lines)
    assert any('--remap odom:=/a/very/long/name/of/a/topic/odometry' in line for line in lines)
    assert lines[-1].startswith('not usable as it is: 1 error, 0 warnings, ')
    assert main([str(SAMPLE)]) == 0
    assert capsys.readouterr().out.splitlines()[-1]== (
        'usable: 0 errors, 0 warnings, 19 ok, 2 not measured (marker size, camera mounting)')


@pytest.mark.parametrize(('arguments', 'told'), [
    (['/nowhere/at.bag'], 'error: /nowhere/at.bag: no such bag'),
    ([str(SAMPLE), '--config', '/nowhere.yaml'], 'error: /nowhere.yaml: No such file'),
    (['--config', '/nowhere.yaml'], 'error: /nowhere.yaml: No such file'),
    (['--namespace', 'a b'], 'error: --namespace a b: must be'),
    ([str(SAMPLE), '--remap', 'odom'], 'error: --remap odom: must be from:=to'),
    ([str(SAMPLE), '--remap', 'odometry:=/x'], 'odometry is no name of ours: must be one of')])
def test_what_cannot_be_checked_is_one_line(
        arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    out, error = capsys.readouterr()
    assert out == '' and error.count('\n') == 1 and told in error
