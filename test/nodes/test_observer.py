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

"""The observer of ``check`` beside running nodes; the rules are tested in test/checks."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from flock_follower.checks.collector import POSES
from flock_follower.messages.topic_names import OURS
from flock_follower.nodes.observer import DISCOVERY, find_processes, Observer, SIMULATOR


def test_no_arrival_is_counted_before_the_clock_is_known(ros: None, monkeypatch: Any) -> None:
    observer, now = Observer(1.0, '', {}, ''), time.monotonic()
    for at, clock in ((0.1, None), (DISCOVERY + 0.1, 100), (DISCOVERY + 0.2, 101)):
        monkeypatch.setattr(time, 'monotonic', lambda at=at: now + at)
        if clock is not None:
            observer._take_clock(Clock(clock=Time(sec=clock)))
        observer._take('odom', '/odom', serialize_message(Odometry()),
                       {'received_timestamp': time.time_ns()})
    assert observer.seen.topics['/odom'].arrivals == [100.0, 101.0]
    observer.destroy_node()


def test_invalid_messages_do_not_end_the_observation(ros: None, monkeypatch: Any) -> None:
    observer, now = Observer(1.0, '', {}, ''), time.monotonic()
    monkeypatch.setattr(time, 'monotonic', lambda: now + DISCOVERY + 0.1)
    observer._take('odom', '/odom', b'no message', {'received_timestamp': 1_000_000_000})
    assert observer.seen.topics['/odom'].stamps == [0.0]
    wrong = TransformStamped(child_frame_id='imu')
    wrong.header.frame_id, wrong.transform.rotation.w = 'base_link', 0.0
    observer._static.take_valid(SimpleNamespace(transforms=[wrong]))
    assert observer.seen.static.pose_on_base('imu') is None
    observer.destroy_node()


def test_foreign_poses_are_taken_once_parameters_are_read(
        ros: None, tmp_path: Path, monkeypatch: Any) -> None:
    file = tmp_path / 'neighbors.yaml'
    file.write_text('neighbors: [{name: leader, pose_topic: poses}]')
    observer, now = Observer(1.0, '', {}, ''), time.monotonic()
    published = {'/poses': ['geometry_msgs/msg/PoseStamped']}
    observer._look_for_poses(published)
    assert '/poses' not in [each.topic_name for each in observer.subscriptions]
    observer.seen.parameters['relative_pose'] = {'neighbors_file': str(file)}
    for _ in range(2):
        observer._look_for_poses(published)
    assert [each.topic_name for each in observer.subscriptions].count('/poses') == 1
    monkeypatch.setattr(time, 'monotonic', lambda: now + DISCOVERY + 0.1)
    observer._take(POSES, '/poses', PoseStamped(header=Header(stamp=Time(sec=100))),
                   {'received_timestamp': 100_200_000_000})
    observer._collector.finish(observer._neighbors())
    assert observer.seen.topics['/poses'].stamps == [100.0]
    assert observer.seen.sources['leader'].taken == 1
    observer.destroy_node()


def test_the_simulator_is_no_other_program() -> None:
    with subprocess.Popen([sys.executable, '-', 'flock_desk.simulator_node'],
                          stdin=subprocess.PIPE) as simulator:
        ours, with_simulator = ({process for process, *_ in find_processes(names)}
                                for names in (OURS, (*OURS, *SIMULATOR)))
        assert simulator.stdin is not None
        simulator.stdin.close()
    assert simulator.pid in with_simulator - ours
