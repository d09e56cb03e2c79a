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

"""A bag with the poses of another detector in place of images: judged as one with markers."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from bag_excerpts import SAMPLE
import numpy as np
import pytest

from flock_desk.runs.evaluation import evaluate, Evaluation
from flock_follower.bags.bag import deserialize, open_bag, serialize
from flock_follower.bags.message_types import empty
from flock_follower.bags.writer import BagWriter
from flock_follower.checks.findings import ERROR, OK, WARNING
from flock_follower.checks.recorded_system import check_bag
from flock_follower.geometry import Array, Transform
from flock_follower.geometry.rotation_vectors import rotation_vector_to_matrix
from flock_follower.messages.poses import POSE, pose_with_covariance
from flock_follower.messages.state_reader import from_odometry
from flock_follower.parameters.files import parse_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.perception.neighbor_filter import UpdateOutcome
from flock_follower.perception.tracker import camera_mounting

MOUNTING = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
SECONDS = 8.0
NOISE = np.array([0.03] * 3 + [0.05] * 3)


class Faults(NamedTuple):
    """
    Faults of a detector: period in truth messages, share missing, of outliers, latency, s.

    ``size``: of the outliers, m. ``early``: of the stamps before the exposures, s.
    """

    every: int = 1  # of 30 per second
    missing: float = 0.0
    outliers: float = 0.0
    latency: float = 0.02
    size: float = 1.0
    early: float = 0.0


def recorded(folder: Path, faults: Faults) -> Path:
    """Return a bag: the sample's odometry and truth, poses made of its truth, and no image."""
    random, messages, own, count = np.random.default_rng(1), [], None, 0
    with open_bag(SAMPLE) as bag:
        end = bag.start_ns + round(SECONDS * 1e9)
        for message in bag.messages(stop_ns=end):
            if message.topic == '/image_raw/compressed':
                continue
            messages.append(message)
            if message.topic == '/truth/odom':
                own = from_odometry(deserialize(message.data, message.msgtype))
            if message.topic != '/truth/neighbors':
                continue
            leader = from_odometry(deserialize(message.data, message.msgtype))
            count += 1
            if own is None or own.stamp != leader.stamp or count % faults.every:
                continue
            frame = empty('std_msgs/msg/Header')
            frame.stamp = deserialize(message.data, message.msgtype).header.stamp
            messages.append(message._replace(
                topic='/frames', msgtype='std_msgs/msg/Header',
                data=serialize(frame, 'std_msgs/msg/Header')))
            if random.random() < faults.missing:
                continue
            error = NOISE * random.normal(size=6)
            if random.random() < faults.outliers:
                away: Array = random.normal(size=3)
                error[:3] += faults.size * away / np.linalg.norm(away)
            pose = (place(own) @ MOUNTING).inverse() @ place(leader)
            pose = Transform(rotation_vector_to_matrix(error[3:]) @ pose.rotation,
                             pose.translation + error[:3])
            sent = pose_with_covariance(
                empty, leader.stamp - round(1e9 * faults.early), 'camera_optical_frame', pose,
                np.diag(NOISE**2))
            messages.append(message._replace(
                topic='/poses', msgtype=POSE, data=serialize(sent, POSE),
                stamp_ns=leader.stamp + round(1e9 * faults.latency)))
    with BagWriter(folder / 'bag') as writer:
        for each in sorted(messages, key=lambda each: each.stamp_ns):
            writer.write(*each)
    return folder / 'bag'


def place(state: Any) -> Transform:
    return Transform.from_quaternion(state.position, state.quaternion)


def values(folder: Path, more: str = '') -> dict[str, dict[str, Any]]:
    path = folder / 'neighbors.yaml'
    path.write_text('frames_topic: frames\n'
                    f'neighbors: [{{name: leader, pose_topic: poses{more}}}]')
    return parse_parameters({'/**': {'ros__parameters': {'neighbors_file': str(path)}}}, TABLE)


def judged(folder: Path, faults: Faults, more: str = '') -> tuple[Evaluation, dict[str, float]]:
    evaluation = evaluate(recorded(folder, faults), values(folder, more), folder / 'result.mcap',
                          with_check=False)
    table = evaluation.tables['leader']
    seen = np.isfinite(table['nees_position']) & (table['time'] > 1.0)
    figures = {
        'position_rms': float(np.sqrt(np.mean(np.square(table['position'][seen])))),
        'velocity_rms': float(np.sqrt(np.mean(np.square(table['velocity'][seen])))),
        'nees_position': float(table['nees_position'][seen].mean()),
        'nees_velocity': float(table['nees_velocity'][seen].mean()),
        'largest_m': float(np.abs(table['position'][seen]).max()),
        'track_share': sum(state == 'TRACK' for state in states(evaluation))
        / max(len(states(evaluation)), 1),
        'acceleration_max': float(np.nanmax(np.linalg.norm(
            evaluation.setpoints[:, 1:4], axis=1)))}
    print(faults, more, figures, evaluation.reasons[-5:])  # shown with -s
    return evaluation, figures


def states(evaluation: Evaluation) -> list[str]:
    """Return the planner's state at each tick after the first second."""
    from flock_desk.runs.evaluation import STATES
    return [STATES[int(row[1])] for row in evaluation.ticks if row[0] > 1.0]


@pytest.mark.parametrize('more', ['', ', position_only: true'])
def test_evaluate_judges_the_poses_of_another_detector(tmp_path: Path, more: str) -> None:
    _, figures = judged(tmp_path, Faults(), more)
    assert figures['position_rms'] < 0.03 and figures['velocity_rms'] < 0.12
    assert 1.0 < figures['nees_position'] < 5.0 and figures['nees_velocity'] < 6.0
    assert figures['track_share'] == 1.0


def test_late_slow_poses_with_outliers_are_followed_in_limits(
        tmp_path: Path) -> None:
    evaluation, figures = judged(tmp_path, Faults(3, 0.2, 0.05, 0.15))
    assert figures['track_share'] > 0.9 and figures['largest_m'] < 0.4
    assert figures['acceleration_max'] <= evaluation.params.a_max + 1e-9
    assert evaluation.rejections[UpdateOutcome.OUTLIER.value] > 0


def test_check_judges_the_topic_of_the_poses(tmp_path: Path) -> None:
    bag = recorded(tmp_path, Faults())
    for name, level in (('poses', OK), ('odom', ERROR), ('none', ERROR)):
        found = values(tmp_path)
        path = tmp_path / 'neighbors.yaml'
        path.write_text(path.read_text().replace('pose_topic: poses', f'pose_topic: {name}')
                        if name != 'odom' else
                        'neighbors: [{name: leader, pose_topic: camera_info}]')
        _, findings = check_bag(bag, found)
        rows = {finding.what: finding for finding in findings}
        assert rows['poses of leader'].level == level
        assert 'images' not in rows and 'calibration' not in rows


def test_check_names_latency_and_outliers_of_the_poses(tmp_path: Path) -> None:
    bag = recorded(tmp_path, Faults(3, 0.2, 0.05, 0.15))
    _, findings = check_bag(bag, values(tmp_path))
    rows = {finding.what.removeprefix('poses of leader '): finding.level for finding in findings}
    assert (rows['latency'], rows['outliers'], rows['used'], rows['axes'], rows['frames_topic']
            ) == (WARNING, WARNING, OK, OK, OK)


@pytest.mark.parametrize(('faults', 'row', 'measured'), [
    (Faults(outliers=0.05, size=0.3), 'outliers', 'from the path of the others'),
    (Faults(latency=0.02, early=0.05), 'stamps', 'before the exposure'),
    (Faults(latency=0.06, early=-0.05), 'stamps', 'after the exposure')])
def test_check_names_small_faults_of_the_poses(
        tmp_path: Path, faults: Faults, row: str, measured: str) -> None:
    _, findings = check_bag(recorded(tmp_path, faults), values(tmp_path))
    rows = {finding.what.removeprefix('poses of leader '): finding for finding in findings
            if finding.what.startswith('poses of leader')}
    rows.pop('used')  # the first exposures are stamped before the odometry begins
    assert [what for what, finding in rows.items() if finding.level == WARNING] == [row]
    assert measured in rows[row].measured
