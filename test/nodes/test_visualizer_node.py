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

"""The visualizer node: what it draws of a flight, and where."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from driven import Driven, overrides, START, to_odometry
from hypothesis import given, strategies
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.node import Node
from visualization_msgs.msg import Marker

from flock_follower.geometry import IDENTITY_QUATERNION, quaternion_to_matrix
from flock_follower.messages import to_array
from flock_follower.messages.command_writer import trajectory
from flock_follower.messages.commands import Command
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.visualizer import Visualizer
from flock_follower.view.scene import (
    ACCELERATION_SCALE,
    COLORS,
    DEVIATIONS,
    ellipsoid,
    MIN_LENGTH,
)

LEADER, OTHER, OWN = (2.0, 0.0, 1.5), (3.0, 1.0, 1.5), (0.0, 0.0, 1.5)
STILL = (0.0, 0.0, 0.0)
BAND = {'nearest_m': '1.2', 'farthest_m': '3.0'}


class Rig(Driven):
    """The node with a planner's report, odometry, a leader and another neighbor."""

    def __init__(self) -> None:
        super().__init__(Visualizer(
            namespace='one', parameter_overrides=overrides(use_sim_time=True)))
        self.viewers = 1
        self.node._markers.get_subscription_count = lambda: self.viewers
        self.pass_time(START)
        self.state('odom', 'base_link', OWN)
        self.state('neighbors', 'leader', LEADER, (0.5, 0.0, 0.0))
        self.state('neighbors', 'other', OTHER)
        self.give('command/trajectory', trajectory(make, Command(
            np.array([0.0, 1.0, 0.0]), 0.0, frame='odom', stamp=START)))
        self.report('two', state='HOLD')
        self.report('one', state='TRACK', edges='leader', limits='a_max')

    def state(self, topic: str, child: str, position: Any, velocity: Any = STILL) -> None:
        self.give(topic, to_odometry(
            nanoseconds_to_stamp(START), 'odom', child, position, IDENTITY_QUATERNION, velocity,
            STILL, 0.01 * np.eye(6), 0.01 * np.eye(6)))

    def report(self, vehicle: str, **values: str) -> None:
        self.give('/diagnostics', DiagnosticArray(status=[DiagnosticStatus(
            name=f'{vehicle}/planner', values=[
                KeyValue(key=key, value=value) for key, value in {**BAND, **values}.items()])]))

    def draw(self, age: float = 0.0) -> dict[str, Marker]:
        self.pass_time(START + round(age * 1e9))
        self.node._tick()
        return {one.ns: one for one in self.sent['visualizer/markers'][-1].markers}


@pytest.fixture
def rig(ros: None) -> Iterator[Rig]:
    made = Rig()
    yield made
    made.close()


def points(marker: Marker) -> Any:
    return np.array([[p.x, p.y, p.z] for p in marker.points])


def test_vehicles_are_drawn_in_place_with_band_of_followed_one(rig: Rig) -> None:
    drawn = rig.draw()
    assert set(drawn) == {
        'follower', 'state', 'command', 'leader', 'leader name', 'leader velocity',
        'leader covariance', 'leader nearest_m', 'leader farthest_m', 'leader edge',
        'other', 'other name', 'other covariance'}  # what stands still has no arrow
    assert {(one.header.frame_id, one.action) for one in drawn.values()} == {('odom', Marker.ADD)}
    for name, place in (('follower', OWN), ('leader', LEADER), ('other', OTHER)):
        np.testing.assert_allclose(to_array(drawn[name].pose.position), place)
    for name, along in (('leader velocity', [LEADER, (2.5, 0.0, 1.5)]),
                        ('command', [OWN, (0.0, ACCELERATION_SCALE, 1.5)]),
                        ('leader edge', [OWN, LEADER])):
        np.testing.assert_allclose(points(drawn[name]), along)
    for name, radius in (('leader nearest_m', 1.2), ('leader farthest_m', 3.0)):
        np.testing.assert_allclose(
            np.linalg.norm(points(drawn[name]) - LEADER, axis=1), radius)
    assert drawn['state'].text == 'TRACK'


@pytest.mark.parametrize(('limits', 'thick', 'thin'), [
    ('a_max, separation', 'leader nearest_m', 'leader farthest_m'),
    ('cohesion', 'leader farthest_m', 'leader nearest_m')])
def test_the_bound_that_the_guard_holds_is_thick(
        rig: Rig, limits: str, thick: str, thin: str) -> None:
    assert rig.draw()['command'].color.r == pytest.approx(COLORS['command'][0])
    rig.report('one', state='HOLD', reason='why', edges='leader', limits=limits)
    drawn = rig.draw()
    assert drawn[thick].scale.x > 2.0 * drawn[thin].scale.x
    assert drawn['command'].color.r == pytest.approx(COLORS['guarded'][0])
    assert drawn['state'].text == f'HOLD\nguard: {limits.split(", ")[-1]}\nwhy'


def test_old_states_are_marked_drawn_only_for_a_viewer(
        rig: Rig) -> None:
    drawn = rig.draw(age=1.0)
    assert drawn['leader name'].text == 'leader, not seen for 1.0 s' and 'command' not in drawn
    assert set(rig.draw(age=11.0)) == {'follower', 'state'}
    rig.viewers = 0
    rig.sent.clear()
    rig.node._tick()
    assert not rig.sent['visualizer/markers']


def test_without_a_viewer_odometry_that_waits_is_no_silence(ros: None) -> None:
    unseen, other = Driven(Visualizer()), Node('vio')
    assert 'no /odom for 9 s: no publisher' in unseen.problems(ahead=9.0)
    other.create_publisher(Odometry, 'odom', 1)
    unseen.wait(lambda: unseen.problems(ahead=9.0) == '')
    unseen.close()
    other.destroy_node()


@given(strategies.lists(strategies.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_an_ellipsoid_has_the_covariance_it_is_made_of(values: list[float]) -> None:
    root = np.reshape(values, (3, 3))
    shape = ellipsoid('x', np.zeros(3), root @ root.T)
    axes = quaternion_to_matrix(shape.quaternion)
    again = axes @ np.diag(np.square(np.array(shape.size) / (2.0 * DEVIATIONS))) @ axes.T
    np.testing.assert_allclose(again, root @ root.T, atol=max(MIN_LENGTH**2, 1e-6))
