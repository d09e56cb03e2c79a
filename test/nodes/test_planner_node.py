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

"""The planner node on a simulated clock: what it subscribes, serves, publishes and reports."""

from __future__ import annotations

from collections.abc import Iterator
import math
import time
from types import SimpleNamespace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from driven import Driven, overrides, START, to_odometry
from geometry_msgs.msg import AccelWithCovarianceStamped, Point, PointStamped
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header, String
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_follower.geometry import IDENTITY_QUATERNION, quaternion_from_yaw
from flock_follower.messages import MOTION_TOPIC, RELATIVE, stamp_to_nanoseconds, to_array
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.support import even_clock
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp
from flock_follower.nodes.support.sole_publisher import SEVERAL
from flock_follower.parameters.sections import PARAMETER_FILES

STEP = 20_000_000  # ns
AHEAD = (2.0, 0.0, 2.0)  # m: where the leader is
CAMERA = [610.0, 0.0, 320.0, 0.0, 610.0, 240.0, 0.0, 0.0, 1.0]


class Rig(Driven):
    """The node, and its surroundings in steps of 20 ms."""

    def __init__(self) -> None:
        super().__init__(Planner(parameter_overrides=overrides(
            use_sim_time=True, odom_twist_frame='child')))  # it stands still and reports a motion
        self.bridge_state = 'INACTIVE'  # repeated by the bridge
        self.commands = self.sent['command/trajectory']
        self.give('camera_info', CameraInfo(width=640, height=480, k=CAMERA))
        self.run(0.2, None)

    @property
    def state(self) -> str:
        return str(self.sent['planner/state'][-1].data)

    def run(self, seconds: float, leader: tuple[float, float, float] | None = AHEAD, *,
            velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw: float = 0.0,
            frame: str = 'odom', looking: bool = True, topic: str = 'neighbors') -> None:
        """Let time pass with odometry of a body velocity and a leader at a place, or without."""
        for _ in range(round(seconds * 1e9) // STEP):
            stamp = nanoseconds_to_stamp(self.now + STEP)
            self.give('odom', to_odometry(stamp, 'odom', 'base_link', (0.0, 0.0, 2.0),
                                          quaternion_from_yaw(yaw), velocity))
            if leader is not None:
                self.give(topic, to_odometry(
                    stamp, frame, 'leader' if topic == 'neighbors' else 'follower_2', leader,
                    IDENTITY_QUATERNION, (0.0, 0.0, 0.0)))
            self.give('mavlink_bridge/state', String(data=self.bridge_state))
            if looking:
                self.give('neighbors/frames', Header(stamp=stamp, frame_id=frame))
            self.pass_time(self.now + STEP)

    def engage(self, value: bool = True) -> str:
        return str(self.call('engage', data=value).message)

    def fly(self, **options: Any) -> None:
        """Engage with odometry and a leader in view, and forget how it came to that."""
        self.bridge_state = 'ACTIVE'
        self.run(0.5, **options)
        self.engage()
        self.run(0.5, **options)
        assert self.state == 'TRACK' and self.commands
        self.commands.clear()

    def acceleration(self) -> Any:
        return to_array(self.commands[-1].points[0].accelerations[0].linear)


@pytest.fixture
def rig(ros: None) -> Iterator[Rig]:
    made = Rig()
    yield made
    made.close()


def test_commands_begin_and_end_with_bridge_state_and_engaging(rig: Rig) -> None:
    message = rig.engage()
    assert message.startswith('engaged; waiting for: the bridge: INACTIVE')
    assert message.endswith('; no neighbor seen yet')
    rig.bridge_state = 'READY: waiting for OFFBOARD'
    rig.run(0.3)
    assert rig.engage().startswith('already engaged; waiting for: the bridge: READY')
    assert 'IDLE: engaged, waiting for the bridge' in rig.problems()
    assert (rig.state, rig.commands) == ('IDLE', [])
    rig.bridge_state = 'ACTIVE'
    rig.run(0.2)
    assert rig.commands and rig.state == 'TRACK'
    rig.bridge_state = 'TAKEN_OVER: the pilot switched to Position'
    rig.run(0.2)
    assert rig.state == 'IDLE' and 'not engaged: taken over' in rig.values['reason']
    rig.bridge_state = 'ACTIVE'
    rig.commands.clear()
    rig.run(0.3)
    assert (rig.state, rig.commands) == ('IDLE', [])
    assert rig.engage() == 'engaged'
    rig.run(0.2)
    assert rig.commands and rig.state == 'TRACK'
    rig.engage(False)
    rig.run(0.2)
    assert rig.state == 'IDLE'


def test_command_names_its_image_and_points_to_leader(rig: Rig) -> None:
    # A quarter turn at 1 rad/s.
    rig.fly(leader=(0.0, 2.7, 2.0), velocity=(0.0, 0.1, 0.0))
    rig.run(1.5, (0.0, 2.7, 2.0), velocity=(0.0, 0.1, 0.0))
    assert len(rig.commands) == 15
    command = rig.commands[-1]
    (point,) = command.points
    stamp = stamp_to_nanoseconds(command.header.stamp)
    ahead = stamp_to_nanoseconds(point.time_from_start)
    assert (command.header.frame_id, list(command.joint_names)) == (
        'odom', ['base_link', 'altitude'])
    assert point.transforms[1].translation.z == pytest.approx(2.0)
    assert (stamp - START) % STEP == 0  # to the nanosecond, an estimate's
    assert START < stamp <= stamp + ahead <= rig.now
    assert np.all(np.isnan(to_array(point.transforms[0].translation)))
    assert np.all(np.isnan(to_array(point.velocities[0].linear)))
    assert point.transforms[0].rotation.z == pytest.approx(np.sqrt(0.5), abs=1e-6)
    assert rig.acceleration()[1] > 0.1


def test_dead_perception_brakes_at_once_not_at_next_tick(rig: Rig) -> None:
    moving = {'velocity': (0.3, 0.0, 0.0), 'yaw': np.pi / 2}  # forward is north
    north = (0.0, 2.0, 2.0)
    rig.fly(leader=north, **moving)
    rig.run(0.16, None, **moving, looking=False)
    assert rig.state == 'TRACK'
    rig.commands.clear()
    rig.run(0.04, None, **moving, looking=False)
    assert rig.state == 'HOLD' and rig.acceleration()[1] < -0.3
    assert 'HOLD: no image processed' in rig.problems()
    rig.run(0.14, north, **moving)
    assert rig.state == 'TRACK'


def test_motion_without_odometry_is_flown_and_marks_commands(rig: Rig) -> None:
    rig.fly()
    for _ in range(40):
        rig.give(MOTION_TOPIC, to_odometry(
            nanoseconds_to_stamp(rig.now + STEP), RELATIVE, 'base_link', (0.0, 0.0, 2.0),
            IDENTITY_QUATERNION, (0.0, 0.0, 0.0)))
        rig.run(0.02, frame=RELATIVE)  # with the odometry that is contradicted
    assert rig.state == 'RELATIVE' and rig.commands[-1].header.frame_id == RELATIVE
    rig.run(0.6)
    assert rig.state == 'TRACK' and rig.commands[-1].header.frame_id == 'odom'


def test_every_other_input_arrives_unknown_ones_are_counted(rig: Rig) -> None:
    rig.run(0.1, frame='map')
    assert rig.counters['invalid neighbors'] > 0
    rig.node._loop.view = ()
    rig.give('camera_info', CameraInfo(width=640, height=480, k=np.zeros(9)))
    rig.fly()
    assert rig.counters['invalid camera_info'] == 1
    assert 'no /camera_info: flies without bounds' in rig.problems()
    place, push = PointStamped(), AccelWithCovarianceStamped()
    place.point.z = 0.4
    rig.give('mavlink_bridge/armed_at', place)
    push.header.stamp = nanoseconds_to_stamp(rig.now + STEP)
    push.header.frame_id, push.accel.accel.linear.x = 'leader', 0.3
    rig.give('neighbors/acceleration', push)
    rig.run(0.1)
    assert rig.node._loop.ground == 0.4
    rig.give('mavlink_bridge/armed_at', PointStamped(point=Point(z=math.nan)))
    assert rig.node._loop.ground is None
    assert 0.0 < rig.node._loop.memory.motions['leader'].acceleration[0] <= 0.3  # smoothed
    assert rig.values['leader_is'] == 'leader, seen' and rig.values['edges'] == 'leader'
    assert (rig.values['nearest_m'], rig.values['farthest_m']) == ('1.000', '2.828')
    rig.run(0.9, (0.8, 0.0, 2.0))  # half a second of it is taken for a jump
    assert rig.values['warnings'].startswith('leader is too close: 0.80 m')
    assert rig.values['warnings'] in rig.problems()
    rig.run(1.1, topic='neighbors/heard')
    assert rig.values['follower_2_is'] == 'follower, heard'
    assert rig.state == 'TRACK' and 'leader_is' not in rig.values
    assert 'is /clock published?' in rig.problems(ahead=5.0)


def test_parameters_are_set_in_flight_or_refused_limits_fall(rig: Rig) -> None:
    assert 'd1 = 8.0: must be a number in [d0' in rig.set(a_max=2.0, d0=9.0)
    assert 'd1 = 1.2: must be at least 2.11 m^2' in rig.set(d1=1.2)
    assert rig.node.get_parameter('a_max').value == 2.5
    assert 'must be at most 2.5: its value at the start' in rig.set(a_max=2.51)
    rig.fly()
    assert rig.set(require_bridge=False) and rig.set(coast_timeout=0.4)
    assert 'cannot be switched off in flight' in rig.set(guard=False)
    assert 'a_max = 0.1: must be a number in [1.5, 20]' in rig.set(a_max=0.1)
    assert rig.set(v_max=0.1, a_max=1.5) == ''
    assert 'must be at most 0.1: in flight it can only be lowered' in rig.set(v_max=0.4)
    for distance in (2.7, 1.0):
        rig.run(0.7, (distance, 0.0, 2.0))
        u = rig.acceleration()
        # Too far, it is bounded by the lowered limit; separation keeps the v_max of the start.
        assert np.linalg.norm(u) <= 0.1 / 0.3 + 1e-6 if distance > 2.0 else u[0] < -0.5
    rig.bridge_state = 'READY'
    rig.run(0.1)
    assert rig.set(v_max=0.5, a_max=2.5, guard=False) == ''


def test_the_frame_of_the_velocity_is_logged_when_it_is_found(rig: Rig) -> None:
    lines: list[str] = []
    rig.node.get_logger = lambda: SimpleNamespace(info=lines.append, warning=lines.append)
    rig.node._own.source.twist.found = 'odom'
    rig.run(0.2)
    text = 'velocity of odom: child: odom by the positions'
    assert lines == [text] and text in rig.problems()


def test_motion_without_odometry_keeps_its_age_on_arrival(ros: None) -> None:
    rig = Driven(Planner(parameter_overrides=overrides(require_bridge=False)))
    for late in (60, 40):  # ms; both wait for the tick
        now = rig.node.get_clock().now().nanoseconds
        rig.give(MOTION_TOPIC, to_odometry(
            nanoseconds_to_stamp(now - late * 10**6), RELATIVE, 'base_link', (0.0, 0.0, 2.0),
            IDENTITY_QUATERNION, (0.0, 0.0, 0.0)), received=time.time_ns() - late * 10**6)
    assert [*rig.node._loop._ages] == [pytest.approx(0.02, abs=0.01)]
    rig.close()


@pytest.mark.parametrize('step', [-5.0, 5.0])
def test_a_system_clock_that_is_set_does_not_silence_it(
        ros: None, monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    rig = Driven(Planner(parameter_overrides=overrides(require_bridge=False)))
    commands: list[MultiDOFJointTrajectory] = rig.sent['command/trajectory']
    elapsed, shift = 0.0, 0.0
    monkeypatch.setattr(even_clock, 'read_clocks', lambda _: (
        START + round((elapsed + shift) * 1e9), 100.0 + elapsed))
    monkeypatch.setattr(rig.node, 'get_clock', lambda: SimpleNamespace(
        now=lambda: SimpleNamespace(nanoseconds=even_clock.read_clocks(rig.node)[0])))
    rig.give('camera_info', CameraInfo(width=640, height=480, k=CAMERA))
    rig.call('engage', data=True)
    for tick in range(104):
        elapsed = 0.1 * tick
        stamps = [START + round((elapsed + shift - age) * 1e9) for age in (0.01, 0.06)]
        if tick == 50:
            shift = step  # what comes now was stamped before
        arrival = even_clock.read_clocks(rig.node)[0]
        rig.node._even_clock.now()
        for topic, stamp, child, place in (('odom', stamps[0], 'base_link', (0.0, 0.0, 2.0)),
                                           ('neighbors', stamps[1], 'leader', AHEAD)):
            if topic == 'odom' or tick < 100:  # then it is covered by an obstacle
                rig.give(topic, to_odometry(nanoseconds_to_stamp(stamp), 'odom', child, place,
                                            IDENTITY_QUATERNION, (0.0, 0.0, 0.0)))
        rig.give('neighbors/frames', Header(stamp=nanoseconds_to_stamp(stamps[1])))
        rig.node._tick()
        state, reason = rig.node._decision[:2]
        assert state == ('HOLD' if tick >= 102 else 'TRACK'), reason
        assert len(commands) == tick + 1
        sent = stamp_to_nanoseconds(commands[-1].header.stamp) + stamp_to_nanoseconds(
            commands[-1].points[0].time_from_start)
        assert abs(sent - arrival) < 1e6
    assert rig.counters == dict.fromkeys((
        'system clock was set', 'odom stamped before the system clock was set',
        'neighbors stamped before the system clock was set'), 1)
    rig.close()


def test_two_bridges_are_named_with_their_parameter_files(rig):
    ends = [SimpleNamespace(node_name='mavlink_bridge', node_namespace='/')]
    rig.node.get_publishers_info_by_topic = (
        lambda topic: ends if topic == '/mavlink_bridge/state' else [])
    assert SEVERAL not in rig.problems()
    ends *= 2
    assert SEVERAL in rig.problems()
    for file in ('a.yaml', 'b.yaml'):
        rig.give('/diagnostics', DiagnosticArray(status=[DiagnosticStatus(
            name='mavlink_bridge', values=[KeyValue(key=PARAMETER_FILES, value=file)])]))
    assert ('/mavlink_bridge (2 times) with a.yaml and with b.yaml on /mavlink_bridge/state' in
            rig.problems())


def test_bridge_restarted_in_flight_with_other_file_is_named(rig):
    bridge = rig.node._bridge_parameters
    bridge.take({'altitude_max': 3.0})
    bridge.take({'altitude_max': 4.0})  # on the ground
    assert 'changed in flight' not in rig.problems()
    rig.bridge_state = 'ACTIVE'
    rig.run(0.2)
    rig.engage()
    rig.run(0.2)
    rig.bridge_state = 'INACTIVE'
    bridge.take({'altitude_max': 9.0})
    rig.run(0.2)
    assert 'parameters of mavlink_bridge changed in flight: altitude_max 4.0 -> 9.0' in (
        rig.problems())
