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

"""The command: its files, its exit codes, and that two runs agree."""

from __future__ import annotations

from collections import Counter
import json
from pathlib import Path
import re
import shutil
from types import SimpleNamespace
from typing import Any

from bag_excerpts import edited, excerpt, SAMPLE, without
import numpy as np
import pytest

from flock_desk.evaluate import main
from flock_desk.runs.evaluation import topics_used
from flock_follower.bags import live_line
from flock_follower.bags.bag import BagError, BagMessage, deserialize, open_bag, serialize
from flock_follower.bags.message_types import empty
from flock_follower.bags.writer import BagWriter
from flock_follower.checks.recorded_system import check_bag
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import ODOMETRY
from flock_follower.messages.topic_names import IMAGE, RANGE
from flock_follower.parameters.files import read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.system.files import resource

pytestmark = pytest.mark.slow
TRUTH = ('/truth/odom', '/truth/neighbors')
#: Figures that differ from run to run.
TIMINGS = ('cpu_ms_per_frame', 'realtime_factor', 'timings')


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return excerpt(tmp_path_factory.mktemp('bags') / 'short')


@pytest.fixture(scope='module')
def result(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('out')
    out, bounds = folder / 'deep' / 'result', folder / 'bounds.yaml'
    bounds.write_text('planner.ticks: {min: 11}')  # it is 11
    assert main([str(bag), '--output', str(out), '--expect', str(bounds)]) == 0
    return out


def summary(out: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((out / 'summary.json').read_text())
    return loaded


def without_timings(figures: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in figures.items() if key not in TIMINGS}


def with_ranges(path: Path, seen: float, seconds: float) -> Path:
    """Write a bag with ranges at 30 Hz, 0.15 m too long, and images up to a time, s, only."""
    own = np.zeros(3)
    with open_bag(SAMPLE) as bag, BagWriter(path) as writer:
        for m in bag.messages(stop_ns=bag.start_ns + round(seconds * 1e9)):
            if not m.topic.startswith('/image') or m.stamp_ns < bag.start_ns + seen * 1e9:
                writer.write(m.topic, m.msgtype, m.stamp_ns, m.data)
            if m.topic == TRUTH[0]:
                own = from_odometry(deserialize(m.data, m.msgtype)).position
            elif m.topic == TRUTH[1]:
                leader = deserialize(m.data, m.msgtype)
                measured = empty(RANGE)
                measured.header.stamp, measured.header.frame_id = leader.header.stamp, 'leader'
                measured.range = 0.15 + np.linalg.norm(from_odometry(leader).position - own)
                writer.write('/ranges', RANGE, m.stamp_ns, serialize(measured, RANGE))
    return path


@pytest.mark.usefixtures('undrawn')
def test_ranges_in_a_bag_are_used_out_of_sight(tmp_path: Path) -> None:
    bag_path = with_ranges(tmp_path / 'bag', 1.5, 4.0)
    assert main([str(bag_path), '--output', str(tmp_path / 'out')]) == 0
    with open_bag(bag_path) as bag, open_bag(tmp_path / 'out' / 'result.mcap') as result:
        times = np.array([(m.stamp_ns - bag.start_ns) * 1e-9
                          for m in result.messages(['/neighbors'])])
    assert np.sum((times > 1.6) & (times < 1.9)) == 0  # images cease at 1.5 s
    assert np.sum(times > 1.9) > 45  # of 60


def test_the_summary_has_the_figures_others_rely_on(result: Path) -> None:
    figures = summary(result)
    assert figures['frames'] == figures['frames_in_view'] == 36
    assert figures['recall'] == 1.0
    for key in ('cpu_ms_per_frame', 'distance_rms_m', 'position_rms_m', 'velocity_rms_m_s',
                'nees_position', 'nees_velocity', 'realtime_factor'):
        assert figures[key] > 0.0, key
    assert figures['distance_rms_m'] < 0.05
    assert sum(figures['detections'].values()) == figures['frames']
    assert figures['distance_m']['min'] <= figures['distance_m']['mean'] < 3.0
    assert sum(figures['planner']['states'].values()) == figures['planner']['ticks'] == 11
    spent = figures['timings']['cpu_ms']
    assert spent['decode']['count'] == 36 and spent['gate']['p50'] <= spent['gate']['p99']
    assert sum(spent[stage]['count'] for stage in ('none', 'track', 'roi', 'full')) == 36
    assert sorted(p.name for p in result.iterdir()) == [
        'report.html', 'result.mcap', 'summary.json']
    with open_bag(result / 'result.mcap') as bag:
        assert set(bag.topics) == {'/neighbors', '/neighbors/acceleration',
                                   '/neighbors/leader/pose', '/planner/state',
                                   '/command/trajectory', '/setpoint'}
        assert bag.topics['/planner/state'].latched
        assert bag.topics['/neighbors'].count == figures['frames']
    report = (result / 'report.html').read_text()
    assert report.count('src="data:image/png;base64,') == 2
    assert not re.search(r'(src|href)="(?!data:)', report)  # it needs no other file


@pytest.mark.usefixtures('undrawn')
def test_a_bag_faster_than_v_max_is_told_first(
        bag: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    slow = tmp_path / 'slow.yaml'
    slow.write_text('planner: {ros__parameters: {v_max: 0.1}}\n')
    assert main([str(bag), '--config', str(slow), '--output', str(tmp_path / 'slow')]) == 0
    reported = capsys.readouterr().err
    assert reported.startswith('warning: the follower in this bag flies at up to 0.')
    assert 'above v_max = 0.1 m/s: there the setpoints brake' in reported
    page = (tmp_path / 'slow' / 'report.html').read_text()
    assert page.index('<p class="warning">The follower in this bag') < page.index('<h2>')
    assert summary(tmp_path / 'slow')['faster_than_v_max_share'] > 0.5
    assert summary(result)['faster_than_v_max_share'] == 0.0
    assert 'class="warning">' not in (result / 'report.html').read_text()


def late(message: BagMessage) -> BagMessage:
    """Return odometry that comes 0.4 s late."""
    return message._replace(stamp_ns=message.stamp_ns + 400_000_000 * (message.topic == '/odom'))


@pytest.mark.usefixtures('undrawn')
def test_check_errors_fail_run_and_stand_before_figures(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    what = 'odom latency: '
    out, spoilt = tmp_path / 'out', excerpt(tmp_path / 'bag', 1.2, late)
    assert main([str(spoilt), '--output', str(out)]) == 1
    first = capsys.readouterr().err.splitlines()[0]
    assert first.startswith(f'error: {what}')
    page = (out / 'report.html').read_text()
    assert page.index('Error: odom latency') < page.index('<h2>')
    _, findings = check_bag(spoilt, read_parameters(resource('config/follower.yaml'), TABLE))
    for level in ('error', 'warning'):
        assert summary(out)['check'][f'{level}s'] == [
            finding.line for finding in findings if finding.level == level]
    assert main([str(spoilt), '--output', str(out), '--check', 'report']) == 0
    assert what in capsys.readouterr().err
    assert main([str(spoilt), '--output', str(out), '--check', 'skip']) == 0
    assert summary(out)['check'] == {'errors': [], 'warnings': []}


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize(('first', 'step', 'stamped', 'level', 'what'), [
    pytest.param(0.6, 3600, True, 'error', 'bag clock: times jump by +3600.0 s after 0.6 s',
                 marks=pytest.mark.sweep),
    (0.6, 3600, False, 'error', 'bag clock: times jump by +3600.0 s after 0.6 s'),
    pytest.param(0.6, 6, True, 'error', 'bag clock: times jump by +6.0 s after 0.6 s',
                 marks=pytest.mark.sweep),
    # Played in the order of their times, what was recorded later comes first.
    (0.6, -3600, True, 'error', 'bag clock: times jump by +3598.8 s after 0.6 s')])
def test_a_clock_set_in_flight_is_an_error(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], first: float, step: int,
        stamped: bool, level: str, what: str) -> None:
    began: list[int] = []

    def set_clock(message: BagMessage) -> BagMessage:
        began.append(message.stamp_ns)
        if message.stamp_ns - began[0] < first * 1e9:
            return message
        data = bytearray(message.data)
        if stamped:
            data[4:8] = (int.from_bytes(data[4:8], 'little') + step).to_bytes(4, 'little')
        return message._replace(stamp_ns=message.stamp_ns + step * 10**9, data=bytes(data))
    spoilt = excerpt(tmp_path / 'bag', 1.2, set_clock)
    assert main([str(spoilt), '--output', str(tmp_path / 'out')]) == 1
    assert f'{level}: {what}' in capsys.readouterr().err
    seen, findings = check_bag(spoilt, read_parameters(resource('config/follower.yaml'), TABLE))
    assert [each.level for each in findings if each.what == 'bag clock'] == [level]
    assert len(seen.topic('odom').arrivals) == 240
    assert [each.level for each in findings if each.what in ('odom rate', 'settings')] == [
        'ok', 'ok']


@pytest.mark.usefixtures('undrawn')
def test_after_a_gap_all_begins_anew_and_figures_leave_it_out(tmp_path: Path) -> None:
    began: list[int] = []

    def recorded_later(message: BagMessage) -> BagMessage:
        began.append(message.stamp_ns)
        if message.stamp_ns - began[0] < 0.6e9:
            return message
        data = bytearray(message.data)
        data[4:8] = (int.from_bytes(data[4:8], 'little') + 3600).to_bytes(4, 'little')
        return message._replace(stamp_ns=message.stamp_ns + 3600 * 10**9, data=bytes(data))

    bag = excerpt(tmp_path / 'bag', 1.2, recorded_later)
    assert main([str(bag), '--output', str(tmp_path / 'out'), '--check', 'skip']) == 0
    figures = summary(tmp_path / 'out')
    assert figures['duration_s'] == pytest.approx(1.2, abs=0.1)
    assert figures['recall'] > 0.9
    states = figures['planner']['states']
    assert 9 <= sum(states.values()) <= 14  # none in the gap
    assert states['TRACK'] >= 6


@pytest.mark.usefixtures('undrawn')
def test_invalid_bytes_are_counted_and_progress_is_shown(
        tmp_path: Path, capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_line, 'LOG_PERIOD', 0.0)  # as of a long bag
    count = Counter[str]()

    def cut(message: BagMessage) -> BagMessage:
        count[message.topic] += 1
        wrong = message.topic in ('/odom', '/image_raw/compressed') and count[message.topic] == 20
        return message._replace(data=message.data[:40]) if wrong else message
    spoilt = excerpt(tmp_path / 'bag', change=cut)
    assert main([str(spoilt), '--output', str(tmp_path / 'out')]) == 0
    rejections = summary(tmp_path / 'out')['rejections']
    assert (rejections['invalid odom'], rejections['invalid image']) == (1, 1)
    error = capsys.readouterr().err
    assert 'odom: 1 of 240' in error and '50% of bag\n' in error


def test_errors_without_truth_are_null_recall_of_all_images(tmp_path: Path) -> None:
    bag = excerpt(tmp_path / 'bag', 0.5, without(*TRUTH))
    assert main([str(bag), '--output', str(tmp_path)]) == 0
    figures = summary(tmp_path)
    for key in ('distance_rms_m', 'distance_bias_m', 'position_rms_m', 'velocity_rms_m_s',
                'nees_position', 'nees_velocity', 'orientation_wrong_share', 'frames_in_view'):
        assert figures[key] is None, key
    assert figures['recall'] == 1.0 and figures['distance_m']['mean'] > 1.0
    assert (tmp_path / 'report.html').read_text().count('base64,') == 1


@pytest.mark.usefixtures('undrawn')
def test_a_broken_bound_is_exit_code_1_and_named(
        bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bounds = tmp_path / 'bounds.yaml'
    bounds.write_text('planner.ticks: {min: 12}\nrejections.invalid image: {max: 0}')
    assert main([str(bag), '--output', str(tmp_path), '--expect', str(bounds)]) == 1
    assert capsys.readouterr().err == 'FAILED: planner.ticks = 11: must be at least 12\n'
    assert (tmp_path / 'report.html').read_text().count('>FAILED<') == 1


@pytest.mark.usefixtures('undrawn')
def test_truth_of_another_name_is_reported_in_any_namespace(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def renamed(message: BagMessage) -> BagMessage:
        if message.topic == '/truth/neighbors':
            message = edited(message, lambda fields: setattr(fields, 'child_frame_id', 'boss'))
        return message._replace(topic=f'/drone1{message.topic}')

    bag = excerpt(tmp_path / 'bag', 0.2, renamed)
    assert main([str(bag), '--output', str(tmp_path), '--namespace', 'drone1']) == 0
    assert "the truth of 'boss' is not used" in capsys.readouterr().err
    assert summary(tmp_path)['distance_rms_m'] is None and summary(tmp_path)['recall'] == 1.0


def refusal(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('error: ')
    return line


INFO = 'sensor_msgs/msg/CameraInfo'


@pytest.mark.parametrize(('types', 'remaps', 'message'), [
    ({'/camera_info': INFO, '/odom': ODOMETRY}, {},
     'no message on /image_raw or /image_raw/compressed; it holds /camera_info, /odom'),
    ({'/image_raw': IMAGE, '/ov/odomimu': ODOMETRY}, {},
     'no message on /camera_info; no message on /odom; it holds /image_raw, /ov/odomimu; '
     '/ov/odomimu has type nav_msgs/msg/Odometry: --remap odom:=/ov/odomimu'),
    ({'/image_raw': ODOMETRY, '/camera_info': INFO, '/odom': ODOMETRY}, {},
     '/image_raw has type nav_msgs/msg/Odometry, not sensor_msgs/msg/Image; '),
    # Images that are named are not replaced by others.
    ({'/image_raw': IMAGE, '/camera_info': INFO, '/odom': ODOMETRY}, {'image_raw': '/cam/image'},
     'no message on /cam/image; it holds /image_raw, /camera_info, /odom; '
     '/image_raw has type sensor_msgs/msg/Image: --remap image_raw:=/image_raw')])
def test_missing_or_mistyped_topics_are_named_with_candidates(
        types: dict[str, str], remaps: dict[str, str], message: str) -> None:
    bag: Any = SimpleNamespace(path='bag', topics={
        name: SimpleNamespace(msgtype=msgtype, count=1) for name, msgtype in types.items()})
    with pytest.raises(BagError, match=f'^bag: {re.escape(message)}'):
        topics_used(bag, '', remaps)


def test_bad_files_are_exit_code_2_and_one_line(
        bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong, output = tmp_path / 'wrong.yaml', ['--output', str(tmp_path / 'out')]
    assert 'nowhere: no such bag' in refusal(['nowhere', *output], capsys)
    wrong.write_text('planner: {ros__parameters: {amax: 1.0}}')
    assert 'wrong.yaml: unknown parameter amax' in refusal(
        [str(bag), '--config', str(wrong), *output], capsys)
    wrong.write_text('recal: {min: 0.9}')
    assert 'recal is no figure of the summary: must be one of recall' in refusal(
        [str(bag), '--expect', str(wrong), *output], capsys)
    assert str(wrong) in refusal([str(bag), '--output', str(wrong)], capsys)


@pytest.mark.usefixtures('undrawn')
def test_black_box_recording_is_judged_by_parameters_flown(
        result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    box = excerpt(tmp_path / 'box')
    (box / 'parameters.yaml').write_text(
        'planner: {ros__parameters: {v_max: 0.75}}\n'
        'relative_pose: {ros__parameters: {neighbors_file: neighbors.yaml}}\n')
    shutil.copy(resource('config/neighbors.yaml'), box)
    assert main([str(box), '--output', str(tmp_path / 'whole')]) == 0
    assert 'warning' not in capsys.readouterr().err
    assert summary(tmp_path / 'whole')['distance_rms_m'] == summary(result)['distance_rms_m']
    assert 'with the parameters flown' in (tmp_path / 'whole' / 'report.html').read_text()
    (last,) = box.glob('*.mcap')
    last.write_bytes(last.read_bytes()[:-1000])
    assert main([str(box), '--output', str(tmp_path / 'cut')]) == 0
    assert f'warning: {box} is incomplete: {last.name} was cut short' in capsys.readouterr().err
    assert summary(result)['frames'] - 15 < summary(tmp_path / 'cut')['frames']


@pytest.mark.usefixtures('undrawn')
def test_topics_of_other_names_are_taken(
        result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = {'/image_raw/compressed': '/cam/infra1/image_mono/compressed',
             '/camera_info': '/cam/infra1/camera_info', '/odom': '/ov_msckf/odomimu'}
    other = excerpt(tmp_path / 'other', change=lambda message: message._replace(
        topic=names.get(message.topic, message.topic)))
    remaps = [word for ours, there in names.items() for word in (
        '--remap', f'{ours.strip("/")}:={there}')]
    assert main([str(other), '--output', str(tmp_path), *remaps]) == 0
    assert without_timings(summary(tmp_path)) == {
        **without_timings(summary(result)), 'bag': 'other'}
    assert (tmp_path / 'result.mcap').read_bytes() == (result / 'result.mcap').read_bytes()
    assert main([str(other), '--output', str(tmp_path), '--remap', 'odometry:=/x']) == 2
    assert 'with a name of ours: one of' in capsys.readouterr().err
