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

"""The perception node with another detector: its poses become neighbors, or are refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from driven import START
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Quaternion
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo
from test_relative_pose_node import AHEAD, calibration, LEADER, Rig, VELOCITY

from flock_follower.messages.poses import pose_with_covariance
from flock_follower.messages.state_reader import from_odometry
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.support.pose_inputs import INVALID_FRAME
from flock_follower.perception.pose_sources import (
    INVALID,
    INVALID_COVARIANCE,
    NO_ATTITUDE,
    NO_COVARIANCE,
    TWO_PUBLISHERS,
    UNKNOWN_FRAME,
    UNTIMELY,
)
from flock_follower.perception.tracker import camera_mounting

IN_CAMERA = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0]).inverse() @ AHEAD
FILE = """
frames_topic: camera_info
neighbors:
  - {name: leader, pose_topic: poses}
"""


@pytest.fixture
def ends() -> dict[str, list[str]]:
    """Return the types under which topics are published."""
    return {'/poses': ['geometry_msgs/msg/PoseWithCovarianceStamped'],
            '/camera_info': ['sensor_msgs/msg/CameraInfo']}


@pytest.fixture
def rig(ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        ends: dict[str, list[str]]) -> Iterator[Callable[..., Rig]]:
    monkeypatch.setattr(
        RelativePose, 'get_publishers_info_by_topic',
        lambda _, topic: [SimpleNamespace(topic_type=each) for each in ends.get(topic, [])])
    made: list[Rig] = []

    def make_rig(text: str = FILE, **parameters: Any) -> Rig:
        path = tmp_path / 'neighbors.yaml'
        path.write_text(text)
        made.append(Rig(neighbors_file=str(path), **parameters))
        made[-1].give('camera_info', info(0.0))
        return made[-1]

    yield make_rig
    for one in made:
        one.close()


def info(seconds: float) -> CameraInfo:
    message = calibration()
    message.header.frame_id = 'optical'
    message.header.stamp = nanoseconds_to_stamp(START + round(seconds * 1e9))
    return message


def pose(seconds: float) -> PoseWithCovarianceStamped:
    return pose_with_covariance(make, START + round(seconds * 1e9), 'optical', IN_CAMERA,
                                np.diag([0.01**2] * 3 + [0.03**2] * 3))


def test_poses_in_the_frame_of_the_camera_become_the_neighbor(rig: Callable[..., Rig]) -> None:
    r = rig()
    for k in range(21):
        r.odom(k / 40, frame='vio_odom')
        if k % 2 == 0:
            r.give('camera_info', info(k / 40))
            r.give('poses', pose(k / 40))
    assert len(r.found) == 11
    state = from_odometry(r.found[-1])
    assert (state.frame, state.child, state.stamp) == ('vio_odom', 'leader', START + 500_000_000)
    np.testing.assert_allclose(state.position, LEADER.translation + 0.5 * VELOCITY, atol=0.01)
    np.testing.assert_allclose(state.velocity, VELOCITY, atol=0.1)
    assert [from_stamp(frame) for frame in r.frames] == [k * 50_000_000 for k in range(11)]
    assert 'image_raw' not in [s.topic_name.lstrip('/') for s in r.node.subscriptions]


def from_stamp(header: Any) -> int:
    return int(header.stamp.sec * 10**9 + header.stamp.nanosec) - START


def test_two_publishers_are_refused_until_one_is_left(
        rig: Callable[..., Rig], ends: dict[str, list[str]]) -> None:
    r = rig()
    r.odom(0.0)
    r.odom(0.1)
    ends['/poses'] *= 2
    r.node._sources.subscribe_available()
    r.give('poses', pose(0.05))
    assert not r.found and r.counters[TWO_PUBLISHERS] == 1
    assert '2 publishers' in r.problems()
    del ends['/poses'][1]
    r.node._sources.subscribe_available()
    r.give('poses', pose(0.06))
    assert len(r.found) == 1
    ends['/poses'].clear()  # a publisher that has just begun again is not found yet
    r.node._sources.subscribe_available()
    r.give('poses', pose(0.07))
    assert len(r.found) == 2 and r.counters[TWO_PUBLISHERS] == 1


@pytest.mark.parametrize(('change', 'reason'), [
    (lambda sent: setattr(sent.header, 'frame_id', 'map'), UNKNOWN_FRAME),
    (lambda sent: setattr(sent.header.stamp, 'sec', 5), UNTIMELY),
    (lambda sent: setattr(sent.header.stamp, 'nanosec', 2_000_000_000), 'invalid /poses'),
    (lambda sent: setattr(sent.pose.pose.position, 'x', math.nan), INVALID),
    (lambda sent: setattr(sent.pose.pose, 'orientation', Quaternion(w=0.0)), NO_ATTITUDE),
    (lambda sent: setattr(sent.pose, 'covariance', np.zeros(36)), NO_COVARIANCE),
    (lambda sent: setattr(sent.pose, 'covariance', -np.eye(6).ravel()), INVALID_COVARIANCE)])
def test_of_bad_poses_nothing_is_published(
        rig: Callable[..., Rig], change: Callable[[Any], Any], reason: str) -> None:
    r = rig()
    r.odom(0.0)
    r.odom(0.1)
    sent = pose(0.05)
    change(sent)
    r.give('poses', sent)
    assert not r.found and r.counters == {reason: 1}


def test_a_frame_with_an_invalid_stamp_is_counted(rig: Callable[..., Rig]) -> None:
    r = rig()
    r.odom(0.0)
    r.odom(0.1)
    bad = info(0.05)
    bad.header.stamp.nanosec = 2_000_000_000
    r.give('camera_info', bad)
    assert r.frames == [] and r.counters == {INVALID_FRAME: 1}


def test_a_pose_without_covariance_needs_deviations(
        rig: Callable[..., Rig], ends: dict[str, list[str]]) -> None:
    ends['/poses'] = ['geometry_msgs/msg/PoseStamped']
    for text, number in ((FILE, 0), (FILE.replace(
            'poses}', 'poses, position_std: 0.05, attitude_std: 0.1}'), 1)):
        r = rig(text)
        r.odom(0.0)
        r.odom(0.1)
        given = pose(0.05)
        r.give('poses', PoseStamped(header=given.header, pose=given.pose.pose))
        assert len(r.found) == number
        assert r.counters[NO_COVARIANCE] == 1 - number


@pytest.mark.parametrize('text', [
    FILE.replace('frames_topic: camera_info', 'frames_topic: /poses'),
    'neighbors: [{name: leader, pose_topic: poses}, {name: other, pose_topic: /poses}]'])
def test_topic_with_two_uses_is_refused(rig: Callable[..., Rig], text: str) -> None:
    with pytest.raises(ValueError, match='/poses is the topic of two neighbors'):
        rig(text)


def test_a_topic_of_another_type_is_reported(
        rig: Callable[..., Rig], ends: dict[str, list[str]]) -> None:
    ends['/poses'] = ['std_msgs/msg/String']
    assert 'has type std_msgs/msg/String' in rig().problems()


def test_topic_of_frames_without_a_header_is_reported(
        rig: Callable[..., Rig], ends: dict[str, list[str]]) -> None:
    ends['/camera_info'] = ['std_msgs/msg/String']
    assert 'frames_topic /camera_info has type std_msgs/msg/String' in rig().problems()


def test_a_transform_needs_tf2_msgs(rig: Callable[..., Rig]) -> None:
    try:
        import tf2_msgs.msg  # type: ignore[import-not-found]  # noqa: F401
        pytest.skip('tf2_msgs is installed')
    except ImportError:
        with pytest.raises(ValueError, match='tf2_msgs'):
            rig('neighbors: [{name: leader, tf_frame: x, position_std: 0.1, attitude_std: 0.1}]')
