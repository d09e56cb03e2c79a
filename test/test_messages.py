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

"""Messages to numpy and back, in rclpy's classes and in the type store's."""

from __future__ import annotations

from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.geometry import Array, quaternion_from_rpy, quaternion_to_matrix
from flock_follower.messages import Make, RELATIVE, SANE, stamp_age
from flock_follower.messages.accelerations import from_acceleration
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.messages.command_writer import trajectory
from flock_follower.messages.commands import Command
from flock_follower.messages.jumps import jump
from flock_follower.messages.poses import acceleration
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import from_state, odometry
from flock_follower.odometry.reader import OdometrySource


def rclpys(msgtype: str) -> Any:
    from flock_follower.nodes.support.conversions import make
    return make(msgtype)


BOTH = pytest.mark.parametrize('new', [pytest.param(rclpys, marks=pytest.mark.ros), empty])
SECOND = 10**9
COMMAND = Command(np.array([0.5, -1.0, 0.25]), -2.0, 0.3, np.array([0.6, 0.0, 0.8]), 'odom',
                  3 * SECOND + 7, SECOND // 4, 0.4)


class Placed(NamedTuple):
    position: Array
    velocity: Array


@pytest.mark.parametrize('elapsed', [-0.1, 0.0, 0.02, 3.0])
def test_a_jump_is_a_distance_beyond_the_tolerance(elapsed: float) -> None:
    v, a = np.array([1.0, -2.0, 0.5]), np.array([0.3, 3.0, -1.0])
    before = Placed(np.array([4.0, 5.0, 6.0]), v)
    there = before.position + elapsed * v + 0.5 * elapsed ** 2 * a
    for step, distance in ((0.24, 0.0), (0.26, 0.26), (0.0, 0.0), (np.nan, 0.0)):
        after = Placed(there + step * np.array([0.6, 0.0, -0.8]), v + elapsed * a)
        assert jump(before, after, elapsed, 0.25) == pytest.approx(distance)


@BOTH
def test_a_command_survives_the_round_trip(new: Make) -> None:
    back = from_trajectory(trajectory(new, COMMAND), 'odom')
    for a, b in zip(back, COMMAND):
        assert b == pytest.approx(a)
    point = trajectory(new, COMMAND).points[0]
    assert np.isnan(point.transforms[0].translation.x) and np.isnan(point.velocities[0].linear.z)


@BOTH
def test_an_acceleration_survives_the_round_trip(new: Make) -> None:
    message = acceleration(new, 5 * SECOND + 3, 'leader', [0.1, -0.2, 0.3], 0.04 * np.eye(3))
    back = from_acceleration(message)
    assert (back.stamp, back.child) == (5 * SECOND + 3, 'leader')
    assert back.vector == pytest.approx([0.1, -0.2, 0.3])
    covariance = np.reshape(message.accel.covariance, (6, 6))
    assert covariance[:3, :3] == pytest.approx(0.04 * np.eye(3))
    message.accel.accel.linear.y = float('nan')
    with pytest.raises(ValueError, match='acceleration of leader: '):
        from_acceleration(message)


@BOTH
def test_odometry_survives_the_round_trip(new: Make) -> None:
    q = quaternion_from_rpy(0.1, -0.2, 2.0)
    pose_covariance, twist_covariance = np.arange(36.0).reshape(6, 6), np.diag(np.arange(1.0, 7.0))
    message = odometry(new, 5 * SECOND + 1, 'odom', 'leader', [1, 2, 3], -q, [0.5, 0.0, 0.1],
                       [0.0, 0.1, 0.2], pose_covariance, twist_covariance)
    state = from_odometry(message)
    R = quaternion_to_matrix(q)
    assert (state.stamp, state.frame, state.child) == (5 * SECOND + 1, 'odom', 'leader')
    np.testing.assert_allclose(state.quaternion, q)
    np.testing.assert_allclose(state.velocity, R @ [0.5, 0.0, 0.1])
    np.testing.assert_array_equal(state.pose_covariance, pose_covariance)
    np.testing.assert_allclose(state.velocity_covariance, R @ np.diag([1.0, 2.0, 3.0]) @ R.T)
    np.testing.assert_allclose(from_odometry(message, 'odom').velocity, [0.5, 0.0, 0.1])


@BOTH
@pytest.mark.parametrize('twist_frame', ['child', 'odom'])
def test_state_becomes_message_with_twist_in_child_frame(
        new: Make, twist_frame: str) -> None:
    q = quaternion_from_rpy(0.1, -0.2, 2.0)
    state = from_odometry(odometry(
        new, 5 * SECOND + 1, 'f1/odom', 'f1', [1, 2, 3], q, [0.5, 0.0, 0.1], [0.0, 0.1, 0.2],
        np.eye(6), np.diag(np.arange(1.0, 7.0))), twist_frame)
    back = from_odometry(from_state(new, state))
    assert back[:3] == state[:3]
    for name in ('position', 'quaternion', 'velocity', 'angular_velocity', 'pose_covariance',
                 'velocity_covariance'):
        np.testing.assert_allclose(getattr(back, name), getattr(state, name), atol=1e-12)


@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf, 1.7e308, -1.01 * SANE])
@pytest.mark.parametrize(('field', 'name'), [
    ('pose.pose.position', 'position'), ('twist.twist.linear', 'linear velocity'),
    ('twist.twist.angular', 'angular velocity')])
def test_odometry_of_nobodys_motion_is_refused(field: str, name: str, bad: float) -> None:
    message = odometry(empty, SECOND, 'odom', 'base_link', [1, 2, 3], [0, 0, 0, 1], [0, 0, 0])
    vector = attrgetter(field)(message)
    for number in (SANE, -SANE):
        vector.y = number
        from_odometry(message)
    vector.y = bad
    with pytest.raises(ValueError, match=f'{name} = .* must be finite, and within 1e'):
        from_odometry(message)


def test_a_stamp_whose_nanoseconds_are_none_is_refused() -> None:
    message = odometry(empty, SECOND, 'odom', 'base_link', [1, 2, 3], [0, 0, 0, 1], [0, 0, 0])
    message.header.stamp.nanosec = SECOND - 1
    assert from_odometry(message).stamp == 2 * SECOND - 1
    # Carried over into seconds the first would fit into no stamp: `make fuzz SEED=977`.
    for seconds, nanosec in ((2**31 - 1, SECOND), (1, 2**32 - 1)):
        message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanosec
        with pytest.raises(ValueError, match=rf'stamp: nanosec = {nanosec}: must be an integer'):
            from_odometry(message)
        with pytest.raises(ValueError, match=r'nanosec'):
            OdometrySource().take(message, SECOND)


def test_the_age_of_a_command_is_from_when_it_applies() -> None:
    age, source_age = COMMAND.ages(COMMAND.stamp + SECOND)
    assert source_age == 1.0 and age == 0.75
    now = COMMAND._replace(stamp=0)
    assert now.ages(10 * SECOND) == (0.0, 0.0)
    assert stamp_age(0, SECOND) == 0.0


@BOTH
def test_the_velocity_of_a_retreat_survives_the_round_trip(new: Make) -> None:
    command = Command((1.0, 0.0, 0.0), 0.5, retreat=np.array([-0.5, 0.25, 0.0]), altitude=2.0)
    back = from_trajectory(trajectory(new, command), 'odom')
    assert back.retreat is not None and back.retreat.tolist() == [-0.5, 0.25, 0.0]
    assert back.altitude == 2.0 and back.separation_axis is None
    assert from_trajectory(trajectory(new, command._replace(retreat=None)), 'odom').retreat is None


def test_a_command_on_the_marker_alone_is_marked_by_its_frame():
    message = trajectory(empty, COMMAND._replace(relative=True))
    assert message.header.frame_id == RELATIVE
    assert from_trajectory(message, 'odom').relative
    assert not from_trajectory(trajectory(empty, COMMAND), 'odom').relative


def test_a_command_that_cannot_be_used_is_refused() -> None:
    message = trajectory(empty, COMMAND)
    with pytest.raises(ValueError, match="frame 'odom': must be that of odom, 'map'"):
        from_trajectory(message, 'map')
    message.points = []
    with pytest.raises(ValueError, match='no point with an acceleration'):
        from_trajectory(message, 'odom')
