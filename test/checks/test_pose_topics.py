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

"""Poses of another detector in ``check``: latency, outliers, refusals and axes have their rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.checks.collector import Collector, POSES
from flock_follower.checks.findings import ERROR, OK, UNMEASURED, WARNING
from flock_follower.checks.observations import Observations, TopicEnd, TopicSeen
from flock_follower.checks.pose_topics import check_poses
from flock_follower.geometry import Array, quaternion_from_rpy, quaternion_to_matrix, Transform
from flock_follower.messages import to_nanoseconds
from flock_follower.messages.poses import POSE, pose_with_covariance
from flock_follower.messages.state_writer import odometry
from flock_follower.messages.topic_names import names_there
from flock_follower.parameters.neighbors_file import parse
from flock_follower.perception.pose_sources import NO_ATTITUDE, UNKNOWN_FRAME, UNPLACED
from flock_follower.perception.tracker import camera_mounting

START = 1_700_000_000.0  # s
MOUNTING = camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
IN_CAMERA = MOUNTING.inverse() @ Transform(
    translation=np.array([2.0, 0.2, 0.1]))
COVARIANCE = np.diag([0.03**2] * 3 + [0.1**2] * 3)
#: The body's axes as REP-103 has them, in a message that names the optical frame.
FLU = Transform(translation=np.array([1.9, 0.2, 0.1]))
TURNED = Transform(IN_CAMERA.rotation @ quaternion_to_matrix(
    quaternion_from_rpy(1.5, 0.0, 0.0)), IN_CAMERA.translation)
Change = Callable[[Any, int], Any]


def levels(change: Change = lambda message, k: message, latency: float = 0.03,
           pose: Transform = IN_CAMERA, frames_topic: str = '', max_wait: float = 0.35,
           gap: range = range(0), yaw: float = 0.0, offset: float = 0.0, noise: float = 0.03,
           frame: str = 'optical') -> tuple[Observations, dict[str, str]]:
    """
    Return the observations of a hovering pair, and the level of each row.

    :param gap: numbers of the messages of odometry that are missing.
    :param yaw: amplitude of the own yaw, rad. :param offset: of the exposures after the stamps, s.
    """
    random = np.random.default_rng(2)
    seen = Observations(live=False, names=names_there('', {}), topics={
        '/odom': TopicSeen(), '/poses': TopicSeen([TopicEnd('', POSE)])},
        parameters={'relative_pose': {'camera_position': [0.1, 0.0, 0.0],
                                      'max_wait': max_wait}})
    collector = Collector(seen, 6.0)
    info = empty('sensor_msgs/msg/CameraInfo')
    info.header.frame_id = 'optical'
    seen.calibration = info
    for k in range(300):
        stamp = START + k / 50.0
        if k not in gap:
            collector.take('odom', '/odom', odometry(
                empty, to_nanoseconds(stamp), 'odom', 'base_link', [0.0, 0.0, 1.0],
                own_attitude(yaw, k / 50.0), [0.0, 0.0, 0.0]), stamp)
        if k % 5 == 0:
            error: Array = random.normal(0.0, noise, 3)
            turn = Transform(quaternion_to_matrix(own_attitude(yaw, k / 50.0 + offset)))
            seen_there = MOUNTING.inverse() @ turn.inverse() @ MOUNTING @ pose
            if frame == 'odom':
                seen_there = Transform(translation=np.array([2.0, 0.2, 1.1]))
            message = change(pose_with_covariance(
                empty, to_nanoseconds(stamp), frame,
                Transform(seen_there.rotation, seen_there.translation + error), COVARIANCE),
                k // 5)
            if message is not None:
                collector.take(POSES, '/poses', message, stamp + latency)
    collector.finish(parse({'neighbors': [{'name': 'leader', 'pose_topic': 'poses'}],
                            **({'frames_topic': frames_topic} if frames_topic else {})}))
    return seen, {finding.what.removeprefix('poses of leader').strip(): finding.level
                  for finding in check_poses(seen)}


def own_attitude(yaw: float, t: float) -> list[float]:
    """Return the own attitude: it yaws back and forth, and does not tilt."""
    return quaternion_from_rpy(0.0, 0.0, yaw * np.sin(2.0 * t)).tolist()


def outlier(message: Any, k: int, size: float = 1.0) -> Any:
    if k % 20 == 7:
        message.pose.pose.position.z += size
    return message


def small_outlier(message: Any, k: int) -> Any:
    return outlier(message, k, 0.3)


def with_bursts_missing(message: Any, k: int) -> Any:
    """Lack five poses of each twenty."""
    return None if k % 20 < 5 else message


def in_frame(message: Any, k: int) -> Any:
    message.header.frame_id = 'map'
    return message


def without_attitude(message: Any, k: int) -> Any:
    if k % 10 == 0:
        message.pose.pose.orientation.w = message.pose.pose.orientation.x = 0.0
        message.pose.pose.orientation.y = message.pose.pose.orientation.z = 0.0
    return message


def test_poses_that_are_well_have_no_fault() -> None:
    seen, rows = levels()
    assert rows == {'': OK, 'rate': OK, 'latency': OK, 'gaps': OK, 'used': OK,
                    'outliers': OK, 'stamps': UNMEASURED, 'axes': OK}
    assert seen.sources['leader'].taken == 60


@pytest.mark.parametrize(('options', 'faults'), [
    ({'latency': 0.15}, {'latency': WARNING}),
    ({'latency': 0.5}, {'latency': ERROR, 'gaps': WARNING}),
    ({'change': with_bursts_missing}, {'gaps': WARNING}),
    ({'change': outlier}, {'outliers': WARNING}),
    ({'change': small_outlier}, {'outliers': WARNING}),
    ({'noise': 0.1}, {'outliers': UNMEASURED, 'stamps': UNMEASURED}),
    ({'offset': 0.05}, {'stamps': WARNING}),
    ({'offset': -0.05}, {'stamps': WARNING}),
    ({'offset': 0.05, 'yaw': 0.0}, {'stamps': UNMEASURED}),
    ({'frame': 'odom'}, {'stamps': UNMEASURED}),
    ({'change': outlier, 'latency': 0.15}, {'outliers': WARNING, 'latency': WARNING}),
    ({'change': in_frame}, {
        'used': ERROR, 'outliers': UNMEASURED, 'stamps': UNMEASURED, 'axes': UNMEASURED}),
    ({'change': without_attitude}, {'used': WARNING}),
    ({'pose': FLU}, {'axes': ERROR}),
    ({'pose': TURNED}, {'axes': WARNING}),
    ({'frames_topic': 'none'}, {'frames_topic': ERROR})])
def test_each_fault_of_poses_has_its_row(options: dict[str, Any], faults: dict[str, str]) -> None:
    _, rows = levels(**{'yaw': 0.3, **options})
    assert {what: level for what, level in rows.items() if level != OK} == faults


def test_refused_poses_are_counted_by_their_reasons() -> None:
    assert levels(in_frame)[0].sources['leader'].refused == {UNKNOWN_FRAME: 60}
    assert levels(without_attitude)[0].sources['leader'].refused == {NO_ATTITUDE: 6}


def test_a_pose_waits_for_odometry_as_long_as_in_the_node() -> None:
    """Odometry lacks 0.2 s: the pose in it waits for 0.2 s, or is refused before."""
    gap = range(99, 109)
    patient, hasty = (levels(max_wait=max_wait, gap=gap)[0].sources['leader']
                      for max_wait in (0.35, 0.05))
    assert patient.used == patient.taken and not patient.refused
    assert hasty.refused[UNPLACED] and hasty.used + hasty.refused.total() == hasty.taken
