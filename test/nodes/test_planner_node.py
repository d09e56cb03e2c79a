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

from collections.abc import Callable, Iterator
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelWithCovarianceStamped, PointStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_follower.geometry import IDENTITY_QUATERNION, quaternion_from_yaw
from flock_follower.messages import MOTION_TOPIC, RELATIVE, stamp_to_nanoseconds, to_array
from flock_follower.nodes.planner import Planner, STATE_QOS
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

START = 1_700_000_000 * 10 ** 9  # ns: where a real bag's clock begins
STEP = 20_000_000  # ns
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
AHEAD = (2.0, 0.0, 2.0)  # m: where the leader is
CAMERA = [610.0, 0.0, 320.0, 0.0, 610.0, 240.0, 0.0, 0.0, 1.0]
INPUTS = {'odom': Odometry, MOTION_TOPIC: Odometry, 'neighbors': Odometry,
          'neighbors/heard': Odometry, 'neighbors/frames': Header, 'camera_info': CameraInfo,
          'neighbors/acceleration': AccelWithCovarianceStamped}
LATCHED = {'mavlink_bridge/state': String, 'mavlink_bridge/armed_at': PointStamped}


class Rig:
    """The node, and a node that plays its surroundings in steps of 20 ms."""

    def __init__(self) -> None:
        self.planner = Planner(parameter_overrides=[
            Parameter('use_sim_time', value=True),
            Parameter('odom_twist_frame', value='child')])  # it stands still and says it moves
        self.node = Node('surroundings')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.planner)
        self.executor.add_node(self.node)
        self.now = START
        self.word = 'INACTIVE'  # what the bridge repeats
        self.clock = self.node.create_publisher(Clock, '/clock', 10)
        self.publishers = {
            topic: self.node.create_publisher(kind, topic, QoSProfile(depth=100))
            for topic, kind in INPUTS.items()} | {
            topic: self.node.create_publisher(kind, topic, STATE_QOS)
            for topic, kind in LATCHED.items()}
        self.client = self.node.create_client(SetBool, 'planner/engage')
        self.commands: list[MultiDOFJointTrajectory] = []
        self.states: list[str] = []
        self.node.create_subscription(
            MultiDOFJointTrajectory, 'command/trajectory', self.commands.append, 10)
        self.node.create_subscription(
            String, 'planner/state', lambda m: self.states.append(m.data), STATE_QOS)
        self.wait(lambda: all(p.get_subscription_count() for p in (
            self.clock, *self.publishers.values())) and self.client.service_is_ready()
            and self.node.count_publishers('command/trajectory'))

    def wait(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, (
                self.states[-5:], self.planner.diagnostics.problems(time.monotonic()))
            self.executor.spin_once(timeout_sec=0.01)

    def send(self, topic: str, message: Any) -> None:
        """Publish a message, and wait until the planner has it."""
        rates = self.planner.diagnostics.rates
        rate = rates[f'{topic}_hz']
        count = rate.count
        self.publishers[topic].publish(message)
        self.wait(lambda: rate.count > count)

    def run(self, seconds: float, leader: tuple[float, float, float] | None = AHEAD, *,
            velocity: tuple[float, float, float] | None = (0.0, 0.0, 0.0), yaw: float = 0.0,
            frame: str = 'odom', looking: bool = True, topic: str = 'neighbors') -> None:
        """Let time pass with odometry of a body velocity and a leader at a place, or without."""
        for _ in range(round(seconds * 1e9) // STEP):
            self.now += STEP
            stamp = nanoseconds_to_stamp(self.now)
            if velocity is not None:
                self.send('odom', to_odometry(
                    stamp, 'odom', 'base_link', (0.0, 0.0, 2.0), quaternion_from_yaw(yaw),
                    velocity))
            if leader is not None:
                self.send(topic, to_odometry(
                    stamp, frame, 'leader' if topic == 'neighbors' else 'follower_2', leader,
                    IDENTITY_QUATERNION, (0.0, 0.0, 0.0)))
            self.send('mavlink_bridge/state', String(data=self.word))
            if looking:
                self.send('neighbors/frames', Header(stamp=stamp, frame_id=frame))
            self.clock.publish(Clock(clock=stamp))
            self.wait(lambda: self.planner.get_clock().now().nanoseconds == self.now)

    def engage(self, value: bool = True) -> str:
        future = self.client.call_async(SetBool.Request(data=value))
        self.wait(future.done)
        assert future.result().success
        return str(future.result().message)

    def fly(self, **options: Any) -> None:
        """Engage with odometry and a leader in view, and forget how it came to that."""
        self.word = 'ACTIVE'
        self.run(0.5, **options)
        self.engage()
        self.run(0.5, **options)
        self.wait(lambda: self.states[-1:] == ['TRACK'] and self.commands)
        self.commands.clear()

    def reports(self, text: str, ahead: float = 0.0) -> bool:
        """Return whether /diagnostics reports it, or will in some seconds of the same."""
        return any(text in problem for _, problem in
                   self.planner.diagnostics.problems(time.monotonic() + ahead))

    def set(self, **values: Any) -> str:
        """Set parameters at once; return why they were refused, or ''."""
        result = self.planner.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()])
        assert result.successful or result.reason
        return str(result.reason)

    def close(self) -> None:
        self.executor.shutdown()
        self.planner.destroy_node()
        self.node.destroy_node()


@pytest.fixture(scope='module')
def one_rig(ros: None) -> Iterator[Rig]:
    made = Rig()
    made.send('camera_info', CameraInfo(width=640, height=480, k=CAMERA))
    yield made
    made.close()


@pytest.fixture
def rig(one_rig: Rig) -> Rig:
    """Return the rig a minute later, not engaged."""
    one_rig.word = 'INACTIVE'
    one_rig.engage(False)
    one_rig.now += 60 * 10 ** 9
    one_rig.run(0.2, None)
    one_rig.wait(lambda: one_rig.states[-1] == 'IDLE')
    one_rig.commands.clear()
    return one_rig


def acceleration(command: MultiDOFJointTrajectory) -> Any:
    return to_array(command.points[0].accelerations[0].linear)


def test_silence_of_neighbors_is_a_fault_only_if_no_image_is_processed(rig: Rig) -> None:
    rig.run(0.1)
    rig.wait(lambda: rig.reports('no /neighbors for '))
    rig.run(0.1, None)  # images without a leader in them
    assert not rig.reports('no /neighbors for ')
    assert rig.reports('no /neighbors for ', ahead=2.6)


def test_commands_begin_and_end_with_the_word_of_the_bridge_and_with_engaging(rig: Rig) -> None:
    message = rig.engage()
    assert message.startswith('engaged; waiting for: the bridge: INACTIVE')
    assert message.endswith('; no neighbor seen yet')
    rig.word = 'READY: waiting for OFFBOARD'
    rig.run(0.3)
    assert rig.engage().startswith('already engaged; waiting for: the bridge: READY')
    rig.wait(lambda: rig.reports('IDLE: engaged, waiting for the bridge'))
    assert (rig.states[-1], rig.commands) == ('IDLE', [])
    rig.word = 'ACTIVE'
    rig.run(0.2)
    rig.wait(lambda: rig.commands and rig.states[-2:] == ['IDLE', 'TRACK'])
    rig.word = 'TAKEN_OVER: the pilot switched to Position'
    rig.run(0.2)
    rig.wait(lambda: rig.states[-1] == 'IDLE')
    rig.wait(lambda: rig.reports('not engaged: the pilot took over'))
    rig.word = 'ACTIVE'
    rig.commands.clear()
    rig.run(0.3)
    assert (rig.states[-1], rig.commands) == ('IDLE', [])
    assert rig.engage() == 'engaged'
    rig.run(0.2)
    rig.wait(lambda: rig.commands and rig.states[-1] == 'TRACK')
    rig.engage(False)
    rig.run(0.2)
    rig.wait(lambda: rig.states[-1] == 'IDLE')


def test_a_command_says_what_it_rests_on_and_points_to_the_leader(rig: Rig) -> None:
    rig.fly(leader=(0.0, 2.7, 2.0), velocity=(0.0, 0.1, 0.0))
    rig.run(1.5, (0.0, 2.7, 2.0), velocity=(0.0, 0.1, 0.0))  # a quarter turn at 1 rad/s
    rig.wait(lambda: len(rig.commands) >= 13)
    command = rig.commands[-1]
    (point,) = command.points
    stamp = stamp_to_nanoseconds(command.header.stamp)
    ahead = stamp_to_nanoseconds(point.time_from_start)
    assert (command.header.frame_id, list(command.joint_names)) == ('odom', ['base_link'])
    assert (stamp - START) % STEP == 0  # to the nanosecond, an estimate's
    assert START < stamp <= stamp + ahead <= rig.now
    assert np.all(np.isnan(to_array(point.transforms[0].translation)))
    assert np.all(np.isnan(to_array(point.velocities[0].linear)))
    assert point.transforms[0].rotation.z == pytest.approx(np.sqrt(0.5), abs=1e-6)
    assert acceleration(command)[1] > 0.1


def test_when_perception_dies_it_brakes_at_once_not_at_the_next_tick(rig: Rig) -> None:
    moving = {'velocity': (0.3, 0.0, 0.0), 'yaw': np.pi / 2}  # forward is north
    north = (0.0, 2.0, 2.0)
    rig.fly(leader=north, **moving)
    rig.run(0.18, None, **moving, looking=False)
    assert rig.states[-1] == 'TRACK'
    rig.commands.clear()
    rig.run(0.02, None, **moving, looking=False)
    rig.wait(lambda: rig.states[-1] == 'HOLD' and rig.commands)
    assert acceleration(rig.commands[-1])[1] < -0.3
    rig.wait(lambda: rig.reports('HOLD: no image processed'))
    rig.run(0.14, north, **moving)
    rig.wait(lambda: rig.states[-1] == 'TRACK')


def test_the_motion_without_odometry_is_flown_on_and_marks_the_commands(rig: Rig) -> None:
    rig.fly()
    for _ in range(40):
        rig.send(MOTION_TOPIC, to_odometry(
            nanoseconds_to_stamp(rig.now + STEP), RELATIVE, 'base_link', (0.0, 0.0, 2.0),
            IDENTITY_QUATERNION, (0.0, 0.0, 0.0)))
        rig.run(0.02, frame=RELATIVE)  # with the odometry that is contradicted
    rig.wait(lambda: rig.states[-1] == 'RELATIVE' and rig.commands)
    assert rig.commands[-1].header.frame_id == RELATIVE
    rig.run(0.6)
    rig.wait(lambda: rig.states[-1] == 'TRACK')
    assert rig.commands[-1].header.frame_id == 'odom'


def test_every_other_input_arrives_and_what_is_no_input_is_counted(rig: Rig) -> None:
    counters, values = rig.planner.diagnostics.counters, rig.planner.diagnostics.values
    rig.run(0.1, frame='map')
    assert counters['invalid neighbors'] > 0
    rig.planner._loop.view = ()
    rig.send('camera_info', CameraInfo(width=640, height=480, k=np.zeros(9)))
    rig.fly()
    assert counters['invalid camera_info'] == 1
    rig.wait(lambda: rig.reports('no /camera_info: flies without bounds'))
    rig.send('camera_info', CameraInfo(width=640, height=480, k=CAMERA))
    place = PointStamped()
    place.point.z = 0.4
    rig.send('mavlink_bridge/armed_at', place)
    push = AccelWithCovarianceStamped()
    push.header.stamp = nanoseconds_to_stamp(rig.now + STEP)
    push.header.frame_id, push.accel.accel.linear.x = 'leader', 0.3
    rig.send('neighbors/acceleration', push)
    rig.run(0.1)
    rig.wait(lambda: not rig.reports('camera_info: flies'))
    assert rig.planner._loop.ground == 0.4
    assert 0.0 < rig.planner._loop.memory.motions['leader'].acceleration[0] <= 0.3  # smoothed
    assert values['leader_is'] == 'leader, seen, edge' and values['edges'] == 'leader'
    rig.run(1.0, topic='neighbors/heard')
    rig.wait(lambda: values.get('follower_2_is') == 'follower, heard, edge')
    assert rig.states[-1] == 'TRACK' and 'leader_is' not in values
    second = rig.node.create_publisher(String, 'mavlink_bridge/state', STATE_QOS)
    rig.wait(lambda: rig.reports('2 publishers say on /mavlink_bridge/state'))
    rig.node.destroy_publisher(second)
    assert rig.reports('is /clock published?', ahead=5.0)


def test_its_diagnostics_are_published(rig: Rig) -> None:
    found: list[DiagnosticArray] = []
    rig.node.create_subscription(DiagnosticArray, '/diagnostics', found.append, 10)
    rig.fly()
    rig.run(0.9, (0.8, 0.0, 2.0))  # half a second of it is taken for a jump
    found.clear()
    rig.wait(lambda: found)
    (status,) = found[-1].status
    values = {v.key: v.value for v in status.values}
    assert (status.name, values['state']) == ('planner', 'TRACK')
    assert values['warnings'].startswith('leader 0.80 m away')
    assert values['warnings'] in status.message and int(values['guarded_commands']) > 0


def test_parameters_are_set_in_flight_or_refused_and_limits_are_only_lowered(rig: Rig) -> None:
    assert 'd1 = 8.0: must be a number in [d0' in rig.set(a_max=1.0, d0=9.0)
    assert rig.planner.get_parameter('a_max').value == 2.5
    rig.fly()
    assert rig.set(require_bridge=False) and rig.set(coast_timeout=0.4)
    assert 'must be at most 2.5, its value at the start' in rig.set(a_max=2.51)
    assert 'cannot be switched off in flight' in rig.set(guard=False)
    assert rig.set(v_max=0.3, a_max=0.1) == ''
    assert 'must be at most 0.3: in flight it can only be lowered' in rig.set(v_max=0.4)
    for distance in (2.7, 1.0):
        rig.run(0.4, (distance, 0.0, 2.0))
        rig.commands.clear()
        rig.run(0.3, (distance, 0.0, 2.0))
        rig.wait(lambda: rig.commands)
        u = acceleration(rig.commands[-1])
        # Too far, it is bounded by the lowered limit; separation keeps the a_max of the start.
        assert np.linalg.norm(u) <= 0.1 if distance > 2.0 else u[0] < -0.5
    rig.word = 'READY'
    rig.run(0.1)
    assert rig.set(v_max=0.5, a_max=2.5, guard=False) == ''


def test_images_that_come_between_two_ticks_keep_the_planner_from_one_more(ros: None) -> None:
    planner, node = Planner(namespace='alone'), Node('surroundings', namespace='alone')
    frames = node.create_publisher(Header, 'neighbors/frames', 10)
    ticks: list[float] = []
    planner._tick = lambda: ticks.append(time.monotonic())  # type: ignore[method-assign]
    rate, end = planner.diagnostics.rates['neighbors/frames_hz'], time.monotonic() + DEADLINE
    while not frames.get_subscription_count():
        assert time.monotonic() < end, 'waited in vain'
    assert planner._silence.is_canceled()
    frames.publish(Header(stamp=planner.get_clock().now().to_msg()))
    while not rate.count:
        assert time.monotonic() < end, 'waited in vain'
        planner._poll_frames()
    # It ends when images have been missing since the last one arrived.
    assert 0 < planner._silence.time_until_next_call() <= 200_000_000
    frames.publish(Header(stamp=planner.get_clock().now().to_msg()))
    time.sleep(0.1)
    planner._on_silence()
    assert not ticks and not planner._silence.is_canceled()
    assert planner._silence.time_until_next_call() <= 110_000_000  # 0.2 s since it arrived
    planner._on_silence()
    assert len(ticks) == 1 and planner._silence.is_canceled()
    planner.destroy_node()
    node.destroy_node()


@pytest.mark.parametrize('step', [-5.0, 5.0])
def test_a_system_clock_that_is_set_does_not_silence_it(
        ros: None, monkeypatch: pytest.MonkeyPatch, step: float) -> None:
    node = Planner(parameter_overrides=[Parameter('require_bridge', value=False)])
    commands: list[MultiDOFJointTrajectory] = []
    monkeypatch.setattr(node._commands, 'publish', commands.append)
    elapsed, shift = 0.0, 0.0
    monkeypatch.setattr(node, 'read_clocks', lambda: (
        START + round((elapsed + shift) * 1e9), 100.0 + elapsed))
    node._loop.engage(True)
    for tick in range(100):
        elapsed = 0.1 * tick
        stamps = [START + round((elapsed + shift - age) * 1e9) for age in (0.01, 0.06)]
        if tick == 50:
            shift = step  # what comes now was stamped before
        arrival = node.read_clocks()[0]
        node._now()
        for take, stamp, child, place in (
                (node._take_odom, stamps[0], 'base_link', (0.0, 0.0, 2.0)),
                (node._take_neighbor, stamps[1], 'leader', AHEAD)):
            take(to_odometry(nanoseconds_to_stamp(stamp), 'odom', child, place,
                             IDENTITY_QUATERNION, (0.0, 0.0, 0.0)), arrival)
        node._tick()
        assert len(commands) == tick + 1
        sent = stamp_to_nanoseconds(commands[-1].header.stamp) + stamp_to_nanoseconds(
            commands[-1].points[0].time_from_start)
        assert abs(sent - arrival) < 1e6
    assert {name: node.diagnostics.counters[name] for name in (
        'system clock was set', 'odom stamped before the system clock was set',
        'neighbors stamped before the system clock was set')} == dict.fromkeys(
            node.diagnostics.counters, 1)
    node.destroy_node()
