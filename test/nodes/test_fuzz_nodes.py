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

"""Malformed messages into every callback of the nodes; ``make fuzz`` sends more."""

import math
import sys

import cv2
from fuzz_messages import MessageFuzzer
from fuzz_nodes import fuzz_node, FuzzError, node_under_fire, NODES, silent_decoders
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

# Overflows and NaN in the middle of a calculation are no errors where its result is thrown away.
from flock_follower.perception.images import decode_compressed

pytestmark = [pytest.mark.filterwarnings('ignore::RuntimeWarning'), pytest.mark.usefixtures('ros')]
COUNT = 2000
#: What shows that the messages reached the depths of a node, by what it published.
REACHED = {'planner': {'MultiDOFJointTrajectory': 200}, 'mavlink_bridge': {},
           'relative_pose': {'Odometry': 5}, 'relative_pose compressed': {'Odometry': 5},
           'sharing': {'Odometry': 50}}


@pytest.mark.parametrize('kind', NODES)
def test_no_message_breaks_a_node_or_gets_a_bad_command_out_of_it(kind):
    under_fire = fuzz_node(kind, COUNT, 1)
    for name, least in REACHED[kind].items():
        assert under_fire.published[name] >= least
    counters = under_fire.node.diagnostics.counters
    assert sum(counters.values()) > COUNT // 10
    if kind == 'mavlink_bridge':
        assert min(under_fire.sent[kind] for kind in (
            'SET_POSITION_TARGET_LOCAL_NED', 'ODOMETRY')) > 10
        wrong = [f'command {why}' for why in ('not finite', 'too old', 'from the future')]
        for seed in range(2, 6):  # a vehicle that is starved of time leaves the mode early
            if min(counters[why] for why in wrong) > 0:
                break
            counters += fuzz_node(kind, COUNT, seed).node.diagnostics.counters
        assert min(counters[why] for why in wrong) > 0  # they reached the gate


def test_broken_images_leave_nothing_in_the_log(capfd):
    whole = bytearray(cv2.imencode('.png', np.arange(6400, dtype=np.uint8).reshape(80, 80))[1])
    whole[100] ^= 0x55  # its checksum is wrong then
    with pytest.raises(ValueError, match='cannot be decoded'):
        decode_compressed(bytes(whole))
    assert 'libpng' in capfd.readouterr().err
    with silent_decoders(), pytest.raises(ValueError, match='cannot be decoded'):
        decode_compressed(bytes(whole))
    print('heard again', file=sys.stderr, flush=True)
    assert capfd.readouterr().err == 'heard again\n'


def test_equal_seeds_make_equal_messages():
    makers = [MessageFuzzer(seed) for seed in (1, 1, 2)]
    messages = [[str(maker.any_message(kind)) for kind in (Odometry, Image, CameraInfo)]
                for maker in makers]
    assert messages[0] == messages[1] != messages[2]


def test_spoiling_changes_a_few_fields_and_reaches_every_depth():
    fuzzer, changed = MessageFuzzer(3), set()
    for _ in range(600):
        message = fuzzer.spoil(MultiDOFJointTrajectory(points=[MultiDOFJointTrajectoryPoint()]))
        clean = MultiDOFJointTrajectory(points=[MultiDOFJointTrajectoryPoint()])
        changed |= {name for name in ('header', 'joint_names', 'points')
                    if getattr(message, name) != getattr(clean, name)}
        if message.points and message.points[0].time_from_start.sec:
            changed.add('time_from_start')
    assert changed == {'header', 'joint_names', 'points', 'time_from_start'}


@pytest.mark.parametrize('kind', ['planner', 'relative_pose', 'sharing'])
def test_one_impossible_odometry_does_no_lasting_damage(kind):
    def spoil(message):
        if isinstance(message, Odometry):
            message.twist.twist.linear.z = 1.7e308
    with node_under_fire(kind, 1) as under_fire:
        for _ in range(20):
            under_fire.tick()
        before = under_fire.published['Odometry']
        assert before > 0 or kind == 'planner'
        under_fire.tick(spoil)
        assert under_fire.published['Odometry'] <= before + 1
        assert under_fire.recovers()


def test_a_command_beyond_the_limits_would_be_found():
    with node_under_fire('planner', 1) as under_fire:
        publisher = next(p for p in under_fire.node.publishers
                         if p.topic_name.endswith('command/trajectory'))
        command = under_fire.good(MultiDOFJointTrajectory)
        for bad in (3.0, math.nan):
            command.points[0].accelerations[0].linear.y = bad
            with pytest.raises(FuzzError, match='m/s'):
                publisher.publish(command)


def test_an_exception_in_a_callback_would_be_found(monkeypatch):
    def broken(message, twist_frame='child'):
        raise IndexError('oops')
    monkeypatch.setattr('flock_follower.nodes.planner.from_odometry', broken)
    with pytest.raises(FuzzError, match=r'on (odom|neighbors): IndexError: oops \(in broken'):
        fuzz_node('planner', 50, 1)
