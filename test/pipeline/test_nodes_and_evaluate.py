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

"""What the nodes make of a bag is what ``evaluate`` makes of it."""

from __future__ import annotations

import math
from pathlib import Path
import time
from types import SimpleNamespace
from typing import Any

from bag_excerpts import excerpt
from driven import Driven, overrides
from geometry_msgs.msg import AccelWithCovarianceStamped
from memory_line import MemoryLine
from nav_msgs.msg import Odometry
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_desk.runs.evaluation import evaluate
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.bags.message_types import empty
from flock_follower.gate.permission import Permission
from flock_follower.mavlink.setpoint_thread import SetpointThread
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.messages.command_writer import trajectory
from flock_follower.messages.commands import Command
from flock_follower.messages.state_reader import from_odometry
from flock_follower.nodes import mavlink_bridge
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.parameters.files import parse_parameters
from flock_follower.parameters.flight_parameters import TABLE

PATIENT = {'max_wait': 1.0}  # s: on a busy machine odometry may come late to the node
PLAYED = {'/odom': Odometry, '/camera_info': CameraInfo, '/image_raw/compressed': CompressedImage,
          '/neighbors': Odometry, '/neighbors/acceleration': AccelWithCovarianceStamped,
          '/command/trajectory': MultiDOFJointTrajectory}


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return excerpt(tmp_path_factory.mktemp('bags') / 'short', 2.0)


@pytest.fixture(scope='module')
def result(bag: Path) -> Path:
    path = bag.parent / 'result.mcap'
    evaluate(bag, parse_parameters({'/**': {'ros__parameters': PATIENT}}, TABLE), path)
    return path


def published(path: Path, topic: str) -> list[tuple[int, Any]]:
    with open_bag(path) as result:
        return [(m.stamp_ns, deserialize(m.data, m.msgtype)) for m in result.messages([topic])]


def test_relative_pose_publishes_the_same_neighbors(ros: None, bag: Path, result: Path) -> None:
    node = Driven(RelativePose(parameter_overrides=overrides(
        image_transport='compressed', **PATIENT)))
    for _, topic, message in messages_of(
            (bag, ['/camera_info', '/odom', '/image_raw/compressed'])):
        node.give(topic, message)
    node.wait(lambda: len(node.sent['neighbors']) == 60)  # the last image waits for odometry
    node.close()
    for mine, (_, theirs) in zip(node.sent['neighbors'], published(result, '/neighbors'),
                                 strict=True):
        for a, b in zip(from_odometry(mine), from_odometry(theirs)):
            assert np.array_equal(a, b)


def messages_of(*sources: tuple[Path, list[str]]) -> list[tuple[int, str, Any]]:
    """Return stamps, ns, topics and messages in order; of one stamp in the order of the topics."""
    found = []
    for path, topics in sources:
        with open_bag(path) as bag:
            found += [(m.stamp_ns, topic, deserialize_message(m.data, PLAYED[topic]))
                      for topic in topics for m in bag.messages([topic])]
    return sorted(found, key=lambda each: each[0])


class BagClock:
    """Stands in for the node's clock."""

    nanoseconds = 0

    def now(self) -> BagClock:
        return self


def test_planner_gives_the_same_commands_at_the_same_ticks(
        ros: None, bag: Path, result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = Driven(Planner(parameter_overrides=overrides(
        require_bridge=False, use_sim_time=True)))
    clock, sent = BagClock(), node.sent['command/trajectory']
    monkeypatch.setattr(node.node, 'get_clock', lambda: clock)
    node.call('engage', data=True)
    expected = published(result, '/command/trajectory')
    events = messages_of((bag, ['/camera_info', '/odom']),
                         (result, ['/neighbors/acceleration', '/neighbors']))
    for tick, _ in expected:
        while events and events[0][0] < tick:
            clock.nanoseconds, topic, message = events.pop(0)
            node.give(topic, message)
        clock.nanoseconds = tick
        node.node._tick()
    node.close()

    assert len(sent) == len(expected) == 19
    for mine, (_, theirs) in zip(sent, expected):
        decoded = deserialize(serialize_message(mine),
                              'trajectory_msgs/msg/MultiDOFJointTrajectory')
        for a, b in zip(from_trajectory(decoded, 'odom'), from_trajectory(theirs, 'odom')):
            assert np.array_equal(a, b)


def test_the_bridge_sends_the_same_setpoints_at_the_same_cycles(
        ros: None, bag: Path, result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_bag(bag) as messages:
        start = messages.start_ns
    clock, line = BagClock(), MemoryLine()
    clock.nanoseconds = start

    def seconds() -> float:
        return (clock.nanoseconds - start) * 1e-9
    # One thread does everything here, by the bag's clock.
    monkeypatch.setattr(mavlink_bridge, 'time', SimpleNamespace(monotonic=seconds, time=time.time))
    monkeypatch.setattr(mavlink_bridge, 'open_transport', lambda _: line)
    monkeypatch.setattr(SetpointThread, 'start', lambda self: None)
    monkeypatch.setattr(SetpointThread, 'stop', lambda self: None)
    monkeypatch.setattr(SetpointThread, 'submit', lambda self, action: action() or True)
    # As evaluate: the vehicle of a bag does not obey, so no wind can be told from that.
    node = mavlink_bridge.MavlinkBridge(parameter_overrides=overrides(wind_compensation='never'))
    driven = Driven(node)
    node._even_clock.simulated = True
    monkeypatch.setattr(node, 'get_clock', lambda: clock)
    vehicle = mavlink.MAVLink(None, 1, 1)
    in_air = mavlink.MAVLink_extended_sys_state_message(
        0, mavlink.MAV_LANDED_STATE_IN_AIR).pack(vehicle)

    def beat() -> None:
        line.arrived += [mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 129, 6 << 16,
            mavlink.MAV_STATE_ACTIVE, 3).pack(vehicle), in_air]
        node._bridge.receive(seconds())
    node._bridge.gate.permit(Permission().request(-math.inf))
    beat()

    expected = published(result, '/setpoint')
    events = messages_of((result, ['/command/trajectory']), (bag, ['/odom']))
    sent = []
    for cycle, _ in expected:
        # A command is taken at its tick, before an odometry.
        while events and (events[0][0], events[0][1] == '/odom') < (cycle, True):
            clock.nanoseconds, topic, message = events.pop(0)
            driven.give(topic, message)
        node._hand_over_odom()
        clock.nanoseconds = cycle
        if (cycle - start) % 500_000_000 == 0:
            beat()
        sent.append(node._bridge.cycle(seconds()))
    node.destroy_node()

    assert len(sent) == len(expected) == 39 and all(cycle.sent for cycle in sent)
    assert {cycle.setpoint.kind for cycle in sent} == {'brake', 'command'}
    for mine, (_, theirs) in zip(sent, expected):
        command = from_trajectory(theirs, 'odom')
        assert np.array_equal(mine.setpoint.acceleration, command.acceleration)
        if mine.setpoint.yaw is not None:
            # As a quaternion and back, as evaluate publishes it.
            there = trajectory(empty, Command(mine.setpoint.acceleration, mine.setpoint.yaw))
            assert from_trajectory(there, 'odom').yaw == command.yaw
