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

"""Two vehicles that exchange messages: the one in front learns of the one behind."""

from __future__ import annotations

from collections.abc import Iterator
import math

from driven import Driven, overrides, to_odometry
import numpy as np
import pytest

from flock_follower.flock.alignment import yaw_rotation
from flock_follower.geometry import Array, quaternion_from_yaw
from flock_follower.messages import to_array
from flock_follower.nodes.flock import SHARED_TOPIC, SharingNode
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp

STEP = 50_000_000  # ns
#: How the odometry of each is turned, rad, and where it begins, m.
FRAMES = {'front': (0.4, np.array([5.0, 0.0, 0.0])), 'rear': (-2.0, np.array([0.0, -3.0, 0.2]))}
TRUE = {'front': np.array([2.0, 0.0, 2.0]), 'rear': np.array([0.0, 0.0, 2.0])}
KNOWN = 1e-4 * np.eye(6)


def place(name: str, of: str) -> Array:
    """Return where a vehicle is in the odometry of another, or in its own."""
    yaw, origin = FRAMES[name]
    return yaw_rotation(yaw) @ TRUE[of] + origin


class Flock:
    """The nodes of both, in steps of 50 ms; what each shares reaches both."""

    def __init__(self) -> None:
        self.nodes = {name: Driven(SharingNode(
            namespace=f'/{name}', parameter_overrides=overrides(
                use_sim_time=True, odom_twist_frame='child'))) for name in FRAMES}
        self.front, self.rear = self.nodes['front'], self.nodes['rear']

    def run(self, seconds: float, seeing: bool = True) -> None:
        for _ in range(round(seconds * 1e9) // STEP):
            now = self.front.now + STEP
            stamp = nanoseconds_to_stamp(now)
            for name, node in self.nodes.items():
                node.give('odom', to_odometry(
                    stamp, 'odom', 'base_link', place(name, name),
                    quaternion_from_yaw(FRAMES[name][0]), np.zeros(3)))
            if seeing:
                self.rear.give('neighbors', to_odometry(
                    stamp, 'odom', 'front', place('rear', 'front'),
                    quaternion_from_yaw(FRAMES['rear'][0]), np.zeros(3), np.zeros(3), KNOWN,
                    KNOWN))
            for node in self.nodes.values():
                node.pass_time(now)
            for sender in self.nodes.values():
                for message in sender.sent[SHARED_TOPIC[1:]]:
                    for node in self.nodes.values():
                        node.give(SHARED_TOPIC, message)
                sender.sent[SHARED_TOPIC[1:]].clear()


@pytest.fixture
def flock(ros: None) -> Iterator[Flock]:
    flock = Flock()
    yield flock
    for node in flock.nodes.values():
        node.close()


def test_who_is_in_front_is_told_of_who_is_behind(flock: Flock) -> None:
    front, heard = flock.front, flock.front.sent['neighbors/heard']
    assert 'no own odometry' in front.problems()
    flock.run(0.3, seeing=False)
    assert 'not aligned with rear' in front.problems()
    flock.run(2.5)
    word = heard[-1]
    assert (word.header.frame_id, word.child_frame_id) == ('odom', 'rear')
    assert to_array(word.pose.pose.position) == pytest.approx(place('front', 'rear'), abs=0.05)
    q = word.pose.pose.orientation
    assert 2.0 * math.atan2(q.z, q.w) == pytest.approx(FRAMES['front'][0], abs=0.05)
    assert 0.0 < np.trace(np.array(word.pose.covariance).reshape(6, 6)[:3, :3]) < 0.3 ** 2
    assert flock.rear.sent['neighbors/heard'] == []  # it sees who is in front
    assert 'nothing received' not in front.problems()
    assert front.values['frame of rear'].startswith('known to 0.')
    assert front.counters['not aligned with rear'] > 0

    bad = to_odometry(nanoseconds_to_stamp(front.now), 'front/odom', 'front', np.zeros(3),
                      quaternion_from_yaw(0.0), np.zeros(3))
    front.give(SHARED_TOPIC, bad)
    bad.header.frame_id, bad.pose.pose.position.x = 'rear/odom', math.nan
    front.give(SHARED_TOPIC, bad)
    flock.run(0.2)
    assert front.counters[f'invalid {SHARED_TOPIC}'] == 1
    assert front.counters['another vehicle uses this name'] == 1


def test_a_namespace_is_a_name(ros: None) -> None:
    node = SharingNode(namespace='/flock/f1')
    assert node._sharing.name == 'flock_f1'
    node.destroy_node()
