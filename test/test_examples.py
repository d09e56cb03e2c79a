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

"""The pages of examples/ run as they are, and leave what they say."""

from __future__ import annotations

import json
import os
from pathlib import Path
import runpy
import signal
import subprocess
import sys

from bag_excerpts import excerpt
import pytest
import yaml

from flock_desk.closed_loop import campaign
from flock_desk.closed_loop.metrics import Flights
from flock_desk.runs.processes import private_environment, Processes
from flock_desk.scenarios.scenario import Scenario

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / 'examples'
pytestmark = pytest.mark.ros


def run_here(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run a page in this process, in a folder; return its exit code."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, 'argv', [name, *arguments])
    monkeypatch.setattr(signal, 'signal', lambda *_: None)  # Ctrl-C stays that of the tests
    try:
        runpy.run_path(str(EXAMPLES / name), run_name='__main__')
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def test_the_law_alone_draws_a_flock_that_agrees(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    assert run_here('law_alone.py', tmp_path, monkeypatch) == 0
    assert capsys.readouterr().out.startswith('speeds [0.1075 0.1075 0.1075] m/s')  # the paper's
    assert (tmp_path / 'build' / 'law_alone.png').read_bytes().startswith(b'\x89PNG')


def test_a_scenario_is_flown_and_reported(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    fly = campaign.fly

    def fly_two(scenario: Scenario, runs: range, guard: bool) -> Flights:
        assert runs == range(10)
        return fly(scenario, runs[:2], guard)
    monkeypatch.setattr(campaign, 'fly', fly_two)
    assert run_here('scenario_report.py', tmp_path, monkeypatch, 'out') == 0
    assert capsys.readouterr().out.splitlines()[-1] == 'report: out/report.html'
    figures = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert figures['runs'] == 2 and figures['in_band'] == 1.0
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert 'hides for a second' in page and 'src="data:image/png' in page


def test_a_node_of_ones_own_follows_what_is_replayed(tmp_path: Path) -> None:
    environment = {**private_environment(), 'PYTHONPATH': str(ROOT)}
    remaps = ['-r', 'leader/odom:=truth/neighbors', '-p', 'use_sim_time:=true']
    with Processes(environment, tmp_path) as processes, subprocess.Popen(
            [sys.executable, '-u', str(EXAMPLES / 'own_node.py'), '--ros-args', *remaps],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, text=True) as node:
        processes.start('replay', 'flock_follower.nodes.replay', [
            str(ROOT / 'bags' / 'sample'), '--ros-args', '-p', 'loop:=true'])
        assert node.stdout is not None
        printed = [node.stdout.readline() for _ in range(20)]
        node.kill()
    assert sum('TRACK' in line for line in printed) >= 10, printed


def test_a_pose_becomes_odometry_without_a_velocity() -> None:
    from geometry_msgs.msg import Point, PoseStamped
    pose = PoseStamped()
    pose.header.frame_id, pose.header.stamp.sec = 'map', 7
    pose.pose.position = Point(x=1.0, y=2.0, z=3.0)
    odometry = runpy.run_path(str(EXAMPLES / 'pose_as_odometry.py'))['as_odometry'](pose)
    assert (odometry.header, odometry.pose.pose) == (pose.header, pose.pose)
    assert odometry.child_frame_id == 'base_link'


def test_the_workflow_judges_a_bag(tmp_path: Path) -> None:
    text = (EXAMPLES / 'bag_in_ci.yaml').read_text()
    steps = yaml.safe_load(text)['jobs']['bag']['steps']
    commands = [step['run'] for step in steps if 'run' in step]
    assert commands[0] == 'make -C flock_follower setup'
    (tmp_path / 'flock_follower').symlink_to(ROOT)
    environment = {**os.environ, 'PYTHON': sys.executable, 'PYTHONPATH': str(ROOT),
                   'BAG': str(excerpt(tmp_path / 'bag', 1.0)),
                   'CONFIG': str(ROOT / 'config' / 'follower.yaml')}
    assert set(yaml.safe_load(text)['env']) == {'PYTHON', 'BAG', 'CONFIG'}
    evaluated, judged = (subprocess.run(
        ['bash', '-ec', command], cwd=tmp_path, env=environment, capture_output=True, text=True,
        timeout=60.0) for command in commands[1:])
    assert evaluated.returncode == 0, evaluated.stderr
    # Of one second, what the tracker needs to begin is too much.
    assert judged.stderr == ''
    verdicts = {line.split(maxsplit=2)[2]: line.split()[0] for line in judged.stdout.splitlines()}
    assert verdicts['share of images in which the leader was found: at least 0.95'] == 'ok'
    assert judged.returncode == ('BROKEN' in verdicts.values())


def test_the_other_detector_finds_the_leader_and_is_short(ros: None) -> None:
    page = EXAMPLES / 'other_detector.py'
    text = page.read_text().partition('limitations under the License.\n\n')[2]
    assert 0 < len(text.splitlines()) <= 60
    pytest.importorskip('pupil_apriltags')
    from sensor_msgs.msg import CameraInfo, Image

    from flock_desk.camera.renderer import T_BODY_OPTICAL
    from flock_desk.closed_loop.real_time_flight import calibration, real_time_camera
    from flock_follower.geometry import quaternion_from_yaw, Transform
    from flock_follower.messages.poses import from_pose
    camera = real_time_camera(0, dictionary='DICT_APRILTAG_36h11')
    leader = Transform.from_quaternion([2.0, 0.2, 1.0], quaternion_from_yaw(0.4))
    own = Transform.from_quaternion([0.0, 0.0, 1.0], quaternion_from_yaw(0.0)) @ T_BODY_OPTICAL
    pixels = camera.image(0, [own], [leader])
    node, sent = runpy.run_path(str(page))['OtherDetector'](), []
    node.poses.publish = sent.append
    node.calibrate(CameraInfo(**calibration(camera.camera)))
    node.detect(Image(height=pixels.shape[0], width=pixels.shape[1], step=pixels.shape[1],
                      encoding='mono8', data=pixels.tobytes()))
    node.destroy_node()
    [found] = [from_pose(message) for message in sent]
    true = own.inverse() @ leader
    assert abs(found.position - true.translation).max() < 0.05
    assert abs(found.quaternion @ true.quaternion) > 0.99
