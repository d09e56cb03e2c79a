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

"""The planner node on a simulated clock: what it subscribes, serves, publishes and tells."""

from __future__ import annotations

from collections.abc import Iterator
import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import AccelWithCovarianceStamped, PointStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header, String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_follower.geometry import Array, IDENTITY_QUATERNION, quaternion_from_yaw
from flock_follower.messages import stamp_to_nanoseconds, to_array
from flock_follower.nodes.planner import main, Planner, STATE_QOS
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

START = 1_700_000_000 * 10 ** 9  # ns: where a real bag's clock begins
STEP = 20_000_000  # ns
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
CAMERA = np.array([610.0, 0.0, 320.0, 0.0, 610.0, 240.0, 0.0, 0.0, 1.0])


class Rig:
    """The node, and a node that plays its surroundings in steps of 20 ms."""

    def __init__(self, require_bridge: bool = False, camera: bool = True) -> None:
        self.planner = Planner(parameter_overrides=[
            Parameter('use_sim_time', value=True),
            Parameter('odom_twist_frame', value='child'),  # it stands still and says it moves
            Parameter('require_bridge', value=require_bridge)])
        self.node = Node('surroundings')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.planner)
        self.executor.add_node(self.node)
        self.now = START
        self.word: str | None = None  # what the bridge repeats
        self.clock = self.node.create_publisher(Clock, '/clock', 10)
        self.odom = self.node.create_publisher(Odometry, 'odom', qos_profile_sensor_data)
        self.neighbors = self.node.create_publisher(Odometry, 'neighbors', 10)
        self.frames = self.node.create_publisher(Header, 'neighbors/frames', 10)
        self.cameras = self.node.create_publisher(
            CameraInfo, 'camera_info', qos_profile_sensor_data)
        self.bridge = self.node.create_publisher(String, 'mavlink_bridge/state', QoSProfile(
            depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self.engage_client = self.node.create_client(SetBool, 'planner/engage')
        self.commands: list[MultiDOFJointTrajectory] = []
        self.states: list[str] = []
        self.diagnostics: dict[str, str] = {}
        self.node.create_subscription(
            MultiDOFJointTrajectory, 'command/trajectory', self.commands.append, 10)
        self.node.create_subscription(
            String, 'planner/state', lambda m: self.states.append(m.data), STATE_QOS)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._told, 10)
        self.wait(lambda: self.clock.get_subscription_count() and
                  self.odom.get_subscription_count() and
                  self.neighbors.get_subscription_count() and
                  self.frames.get_subscription_count() and
                  self.bridge.get_subscription_count() and
                  self.node.count_publishers('command/trajectory') and
                  self.engage_client.service_is_ready() and
                  self.cameras.get_subscription_count())
        if camera:
            self.cameras.publish(CameraInfo(width=640, height=480, k=CAMERA))
            self.wait(lambda: self.planner._loop.view is not None)

    def _told(self, message: DiagnosticArray) -> None:
        (status,) = message.status
        self.diagnostics = {'message': status.message, **{v.key: v.value for v in status.values}}

    def wait(self, condition: object) -> None:
        assert callable(condition)
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, 'waited in vain'
            self.executor.spin_once(timeout_sec=0.01)

    def received(self) -> int:
        rates = self.planner.diagnostics.rates
        return sum(rates[f'{topic}_hz'].count
                   for topic in ('odom', 'neighbors', 'neighbors/frames'))

    def run(self, seconds: float, velocity: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
            leader: tuple[float, float, float] | None = None, yaw: float = 0.0,
            frame: str = 'odom', looking: bool = False) -> None:
        """Let time pass with odometry of a body velocity and a leader at a place, or without."""
        for _ in range(round(seconds * 1e9) // STEP):
            self.now += STEP
            stamp = nanoseconds_to_stamp(self.now)
            expected = self.received() + sum(
                (velocity is not None, leader is not None, looking))
            if velocity is not None:
                self.odom.publish(to_odometry(
                    stamp, 'odom', 'base_link', (0.0, 0.0, 2.0), quaternion_from_yaw(yaw),
                    velocity))
            if leader is not None:
                self.neighbors.publish(to_odometry(
                    stamp, frame, 'leader', leader, IDENTITY_QUATERNION, (0.0, 0.0, 0.0)))
            if self.word is not None:
                self.bridge.publish(String(data=self.word))
            if looking:
                self.frames.publish(Header(stamp=stamp, frame_id=frame))
            self.wait(lambda expected=expected: self.received() >= expected)
            self.clock.publish(Clock(clock=stamp))
            self.wait(lambda: self.planner.get_clock().now().nanoseconds == self.now)

    def say(self, state: str) -> None:
        """Say as the bridge what its state is, wait until it is heard, and go on saying it."""
        self.word = state
        heard = self.planner.diagnostics.rates['mavlink_bridge/state_hz']
        count = heard.count
        self.bridge.publish(String(data=state))
        self.wait(lambda: heard.count > count)

    def engage(self, value: bool = True) -> SetBool.Response:
        future = self.engage_client.call_async(SetBool.Request(data=value))
        self.wait(future.done)
        return future.result()

    def flying(self) -> None:
        """Engage with odometry and a leader in view, and forget how it came to that."""
        self.run(0.5, leader=(2.0, 0.0, 2.0))
        assert self.engage().success
        self.run(0.5, leader=(2.0, 0.0, 2.0))
        self.wait(lambda: self.states[-1:] == ['TRACK'] and self.commands)
        self.commands.clear()

    def close(self) -> None:
        self.executor.shutdown()
        self.planner.destroy_node()
        self.node.destroy_node()


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """Yield a rig whose planner flies alone, or, by the indirect parameter, beside a bridge."""
    rclpy.init()
    rig = Rig(*getattr(request, 'param', ()))
    yield rig
    rig.close()
    rclpy.shutdown()


beside_a_bridge = pytest.mark.parametrize('rig', [(True,)], indirect=True, ids=['bridge'])


def acceleration(command: MultiDOFJointTrajectory) -> Array:
    return to_array(command.points[0].accelerations[0].linear)


def test_engaging_says_what_is_missing_and_nothing_is_commanded_before(rig: Rig) -> None:
    rig.run(0.5, velocity=None)
    answer = rig.engage()
    assert answer.success
    assert answer.message.startswith('engaged; waiting for: no odometry on /odom')
    assert answer.message.endswith('; no neighbor seen yet')
    assert rig.engage(False).success
    rig.run(0.5, leader=(2.0, 0.0, 2.0))
    assert rig.commands == []
    assert set(rig.states) <= {'IDLE', 'SEARCH'}
    assert rig.engage().message == 'engaged'
    assert rig.engage().message == 'already engaged'
    rig.run(0.5, leader=(2.0, 0.0, 2.0))
    rig.wait(lambda: rig.commands and rig.states[-2:] == ['IDLE', 'TRACK'])
    assert rig.engage(False).success
    rig.run(0.2, leader=(2.0, 0.0, 2.0))
    rig.wait(lambda: rig.states[-1] == 'IDLE')
    rig.commands.clear()
    rig.run(0.5, leader=(2.0, 0.0, 2.0))
    assert rig.commands == []


def test_a_command_says_what_it_rests_on_and_points_to_the_leader(rig: Rig) -> None:
    rig.run(0.5, leader=(0.0, 2.7, 2.0), velocity=(0.0, 0.1, 0.0))
    rig.engage()
    rig.run(2.0, leader=(0.0, 2.7, 2.0), velocity=(0.0, 0.1, 0.0))  # a quarter turn at 1 rad/s
    rig.wait(lambda: len(rig.commands) >= 18)
    command = rig.commands[-1]
    (point,) = command.points
    stamp = stamp_to_nanoseconds(command.header.stamp)
    ahead = point.time_from_start.sec * 10 ** 9 + point.time_from_start.nanosec
    assert command.header.frame_id == 'odom'
    assert list(command.joint_names) == ['base_link']
    assert (stamp - START) % STEP == 0  # to the nanosecond, an estimate's
    assert START < stamp <= stamp + ahead <= rig.now
    assert np.all(np.isnan(to_array(point.transforms[0].translation)))
    assert np.all(np.isnan(to_array(point.velocities[0].linear)))
    assert point.transforms[0].rotation.z == pytest.approx(math.sin(math.pi / 4), abs=1e-6)
    assert acceleration(command)[1] > 0.1


def test_velocity_of_the_odometry_is_turned_from_the_body_into_the_world(rig: Rig) -> None:
    rig.run(0.5, yaw=math.pi / 2, velocity=(0.3, 0.0, 0.0))
    assert rig.engage().message == 'engaged; waiting for: no neighbor seen yet'
    rig.run(0.5, yaw=math.pi / 2, velocity=(0.3, 0.0, 0.0))
    rig.wait(lambda: rig.states[-1:] == ['SEARCH'] and rig.commands)
    # Forward is north; the brake acts southwards.
    braking = acceleration(rig.commands[-1])
    assert braking[[0, 2]] == pytest.approx(np.zeros(2), abs=1e-6) and braking[1] < -0.3


@beside_a_bridge
def test_commands_begin_and_end_with_the_word_of_the_bridge(rig: Rig) -> None:
    def told(text: str) -> None:
        rig.planner.diagnostics.publish()
        rig.wait(lambda: rig.diagnostics.get('message', '') == text)

    leader = (2.0, 0.0, 2.0)
    rig.run(0.3, leader=leader)
    assert rig.engage().message == (
        'engaged; waiting for: the bridge: NO_AUTOPILOT: nothing heard on mavlink_bridge/state '
        '(where somebody else flies the commands, require_bridge:=false)')
    rig.say('INACTIVE: offboard not requested')
    assert rig.engage().message == ('already engaged; waiting for: the bridge: INACTIVE: offboard '
                                    'not requested')
    rig.say('READY: waiting for OFFBOARD')
    rig.run(0.3, leader=leader)
    told('IDLE: engaged, waiting for the bridge: READY: waiting for OFFBOARD')
    assert (rig.states, rig.commands) == (['IDLE'], [])
    rig.say('ACTIVE')
    rig.run(0.1, leader=leader)
    rig.wait(lambda: rig.commands and rig.states == ['IDLE', 'TRACK'])
    told('running')
    rig.say('TAKEN_OVER: the pilot switched to Position')
    rig.commands.clear()
    rig.run(0.3, leader=leader)
    rig.wait(lambda: rig.states[-1] == 'IDLE')
    assert rig.commands == []
    told('IDLE: not engaged: the pilot took over (the pilot switched to Position): call '
         'planner/engage to follow again')
    rig.say('ACTIVE')
    rig.run(0.3, leader=leader)
    assert (rig.states[-1], rig.commands) == ('IDLE', [])
    assert rig.engage().message == 'engaged'
    rig.run(0.1, leader=leader)
    rig.wait(lambda: rig.commands and rig.states[-1] == 'TRACK')


@beside_a_bridge
def test_a_bridge_that_is_silent_for_a_second_of_wall_time_counts_as_none(rig: Rig) -> None:
    leader, heard = (2.0, 0.0, 2.0), time.monotonic()
    rig.say('ACTIVE')
    rig.engage()
    rig.run(0.3, leader=leader)
    rig.wait(lambda: rig.states[-1] == 'TRACK')
    rig.wait(lambda: time.monotonic() > heard + 0.5)
    rig.say('ACTIVE')
    rig.word = None
    since = time.monotonic()
    while rig.states[-1] == 'TRACK':  # the clock of ROS may run as it likes
        assert time.monotonic() < since + DEADLINE
        rig.run(0.02, leader=leader)
    assert rig.states[-1] == 'IDLE'
    assert time.monotonic() - since > 1.0
    rig.commands.clear()
    rig.run(0.3, leader=leader)
    assert rig.commands == []
    rig.planner.diagnostics.publish()
    rig.wait(lambda: 'NO_AUTOPILOT: nothing heard on mavlink_bridge/state for' in
             rig.diagnostics.get('message', ''))


@beside_a_bridge
def test_a_second_bridge_that_says_whether_it_flies_is_told(rig: Rig) -> None:
    rig.planner.diagnostics.publish()
    rig.wait(lambda: rig.diagnostics and 'publishers' not in rig.diagnostics['message'])
    second = rig.node.create_publisher(String, 'mavlink_bridge/state', STATE_QOS)
    name = f'/{rig.node.get_name()}'
    expected = (f'2 publishers say on /mavlink_bridge/state whether it flies: {name} (2 times); '
                'only one may')
    rig.wait(lambda: expected in rig.diagnostics['message'])
    rig.node.destroy_publisher(second)


@beside_a_bridge
def test_a_bridge_that_spoke_before_the_planner_started_is_heard(rig: Rig) -> None:
    rig.say('ACTIVE')
    late = Planner(parameter_overrides=[Parameter('use_sim_time', value=True)],
                   namespace='late', cli_args=[
                       '--ros-args', '-r', 'mavlink_bridge/state:=/mavlink_bridge/state'])
    rig.executor.add_node(late)
    try:
        rig.wait(lambda: late._bridge is not None)
        assert late._loop.waiting(late._bridge_age()) == ''
    finally:
        rig.executor.remove_node(late)
        late.destroy_node()


def test_losing_the_leader_coasts_then_holds_and_regains_it(rig: Rig) -> None:
    rig.flying()
    rig.run(2.5)
    rig.wait(lambda: rig.states[-1] == 'HOLD')
    rig.run(0.2, leader=(2.0, 0.0, 2.0))
    rig.wait(lambda: rig.states[-4:] == ['TRACK', 'COAST', 'HOLD', 'TRACK'])


def test_when_perception_dies_it_brakes_at_once_not_at_the_next_tick(rig: Rig) -> None:
    velocity = (0.3, 0.0, 0.0)
    rig.run(0.5, leader=(2.0, 0.0, 2.0), velocity=velocity, looking=True)
    assert rig.engage().success
    rig.run(1.0, leader=(2.0, 0.0, 2.0), velocity=velocity, looking=True)
    # A leader that is covered is another matter: images are being looked at.
    rig.run(0.4, velocity=velocity, looking=True)
    rig.planner.diagnostics.publish()
    rig.wait(lambda: rig.diagnostics.get('message', '').startswith('HOLD: neighbor occluded'))
    rig.run(0.3, leader=(2.0, 0.0, 2.0), velocity=velocity, looking=True)
    rig.wait(lambda: rig.states[-1] == 'TRACK')
    rig.run(0.04, leader=(2.0, 0.0, 2.0), velocity=velocity, looking=True)
    rig.run(0.18, velocity=velocity)
    assert rig.states[-1] == 'TRACK'
    rig.commands.clear()
    rig.run(0.02, velocity=velocity)
    rig.wait(lambda: rig.states[-1] == 'HOLD' and rig.commands)
    braking = acceleration(rig.commands[-1])
    assert braking[1:] == pytest.approx(np.zeros(2), abs=1e-6) and braking[0] < -0.3
    rig.planner.diagnostics.publish()
    rig.wait(lambda: rig.diagnostics.get('message', '').startswith('HOLD: no image processed'))
    rig.run(0.04, leader=(2.0, 0.0, 2.0), velocity=velocity, looking=True)
    rig.run(0.1, leader=(2.0, 0.0, 2.0), velocity=velocity, looking=True)
    rig.wait(lambda: rig.states[-1] == 'TRACK')


def test_losing_the_odometry_stops_the_commands_and_is_told(rig: Rig) -> None:
    rig.flying()
    rig.run(0.5, velocity=None, leader=(2.0, 0.0, 2.0))
    rig.wait(lambda: rig.states[-1] == 'HOLD')
    rig.commands.clear()
    rig.run(0.5, velocity=None, leader=(2.0, 0.0, 2.0))
    assert rig.commands == []
    rig.planner.diagnostics.publish()
    rig.wait(lambda: 'HOLD: odometry too old' in rig.diagnostics.get('message', ''))
    assert rig.diagnostics['state'] == 'HOLD'


def test_a_leader_beyond_the_followers_means_is_told_as_what_it_is(rig: Rig) -> None:
    rig.flying()
    rig.run(0.9, leader=(0.8, 0.0, 2.0))  # half a second of it is taken for a jump
    rig.planner.diagnostics.publish()
    rig.wait(lambda: 'too close' in rig.diagnostics.get('message', ''))
    assert rig.diagnostics['warnings'].startswith('leader 0.80 m away, the band begins at 1.00 m')
    assert int(rig.diagnostics['guarded_commands']) > 0


def test_a_jump_back_of_the_clock_forgets_and_goes_on(rig: Rig) -> None:
    rig.flying()
    rig.now -= 10 ** 9
    rig.run(0.3, velocity=None)
    rig.wait(lambda: rig.states[-1] == 'SEARCH')
    rig.commands.clear()
    rig.run(0.9, velocity=None)  # past the stamps of before the jump
    assert rig.commands == []
    rig.now -= 10 ** 9 * 30
    rig.run(0.2)
    rig.wait(lambda: rig.states[-1] == 'SEARCH')
    rig.run(0.3, leader=(2.0, 0.0, 2.0))
    rig.wait(lambda: rig.states[-1] == 'TRACK')


def test_a_neighbor_in_another_frame_is_refused_and_counted(rig: Rig) -> None:
    rig.run(0.3)
    rig.run(0.2, leader=(2.0, 0.0, 2.0), frame='map')
    rig.planner.diagnostics.publish()
    rig.wait(lambda: int(rig.diagnostics.get('rejected: invalid neighbors', 0)) > 0)
    rig.engage()
    rig.run(0.3, leader=(2.0, 0.0, 2.0), frame='map')
    rig.wait(lambda: rig.states[-1] == 'SEARCH')


def test_what_is_heard_is_followed_where_nobody_is_seen_and_told_as_that(rig: Rig) -> None:
    rig.flying()
    rig.wait(lambda: rig.diagnostics.get('leader_is') == 'leader, seen, edge')
    assert (rig.diagnostics['edges'], rig.diagnostics['known']) == ('leader', '1')
    words = rig.node.create_publisher(Odometry, 'neighbors/heard', 10)
    rig.wait(words.get_subscription_count)
    for _ in range(50):  # the eyes see nobody any more
        rig.run(0.02)
        words.publish(to_odometry(
            nanoseconds_to_stamp(rig.now), 'odom', 'follower_2', (2.0, 0.0, 2.0),
            IDENTITY_QUATERNION, (0.0, 0.0, 0.0)))
    rig.wait(lambda: rig.diagnostics.get('follower_2_is') == 'follower, heard, edge')
    assert rig.states[-1] == 'TRACK' and rig.diagnostics['edges'] == 'follower_2'
    assert 'nobody seen: flies by what others tell' in rig.diagnostics['message']
    assert 'leader_is' not in rig.diagnostics


def test_parameters_are_set_while_flying_or_refused_together_with_the_reason(rig: Rig) -> None:
    rig.flying()
    refused = rig.planner.set_parameters_atomically([Parameter('a_max', value=1.0),
                                                     Parameter('d0', value=9.0)])
    assert not refused.successful
    assert 'd1 = 8.0: must be a number in [d0' in refused.reason
    assert rig.planner.get_parameter('a_max').value == 2.5
    assert rig.planner.set_parameters_atomically([
        Parameter('a_max', value=0.1), Parameter('d1', value=7.5)]).successful
    for distance, expected in ((2.7, 0.1), (1.8, None), (1.0, -0.5)):
        rig.run(0.4, leader=(distance, 0.0, 2.0))
        rig.commands.clear()
        rig.run(0.3, leader=(distance, 0.0, 2.0))
        rig.wait(lambda: rig.commands)
        u = acceleration(rig.commands[-1])
        if distance > 2.0:  # 7.29 m^2 is now too far, and a_max lower
            assert u[0] == pytest.approx(expected, abs=0.01)
            assert np.linalg.norm(u) <= 0.1
    assert u[0] < expected  # too near: separation keeps the a_max of the start


@beside_a_bridge
def test_limits_are_only_lowered_in_flight_and_never_raised_above_the_start(rig: Rig) -> None:
    def refused(name: str, value: float | bool) -> str:
        return str(rig.planner.set_parameters([Parameter(name, value=value)])[0].reason)

    for word in ('READY', 'ACTIVE'):
        rig.say(word)
        assert refused('a_max', 2.51) == ('a_max = 2.51: must be at most 2.5, its value at the '
                                          'start: restart the node to raise it')
        assert refused('v_max', 20.0).startswith('v_max = 20.0: must be at most 0.5, its value')
        assert refused('v_max', 0.3) == ''
    assert refused('v_max', 0.4) == ('v_max = 0.4: must be at most 0.3: in flight it can only be '
                                     'lowered')
    assert refused('guard', False) == ('guard = False: must be true: it cannot be switched off in '
                                       'flight')
    params = rig.planner._settings.current
    assert (params.v_max, params.fastest, params.strongest) == (0.3, 0.5, 2.5)
    rig.say('READY')
    assert refused('v_max', 0.5) == refused('guard', False) == ''


def test_what_does_not_fit_or_is_fixed_at_start_is_refused_while_flying(rig: Rig) -> None:
    rig.flying()
    for name, value in (('coast_timeout', 0.4), ('d1', 0.5), ('require_bridge', True)):
        result = rig.planner.set_parameters_atomically([Parameter(name, value=value)])
        assert not result.successful and result.reason
    assert rig.planner.set_parameters_atomically(
        [Parameter('coast_timeout', value=0.6)]).successful


def test_missing_inputs_are_named(rig: Rig) -> None:
    problems = ' '.join(
        message for _, message in rig.planner.diagnostics.problems(time.monotonic() + 5.0))
    for expected in ('no /odom for', 'no /neighbors for', 'is /clock published?'):
        assert expected in problems


def test_a_bad_parameter_ends_the_node_with_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(['--ros-args', '-p', 'a_max:=-1.0']) == 1
    error = capfd.readouterr().err
    assert error.splitlines() == ['error: a_max = -1.0: must be a number in [0.1, 20] m/s^2']


@pytest.mark.parametrize('rig', [(False, False)], indirect=True, ids=['no camera'])
def test_without_a_camera_it_flies_and_warns_until_there_is_one(rig: Rig) -> None:
    def told() -> str:
        return rig.diagnostics.get('message', '')

    rig.flying()
    rig.wait(lambda: 'no /camera_info: flies without regard' in told())
    taken = rig.planner.diagnostics.rates['camera_info_hz']
    for k in (np.zeros(9), CAMERA):
        count = taken.count
        rig.cameras.publish(CameraInfo(width=640, height=480, k=k))
        rig.wait(lambda count=count: taken.count > count)
    rig.run(0.2, leader=(2.0, 0.0, 2.0))
    rig.wait(lambda: 'camera_info: flies' not in told())
    assert rig.diagnostics['rejected: invalid camera_info'] == '1'


def test_it_hears_where_the_vehicle_was_armed_and_how_the_leader_accelerates(rig: Rig) -> None:
    armed = rig.node.create_publisher(PointStamped, 'mavlink_bridge/armed_at', STATE_QOS)
    pushes = rig.node.create_publisher(AccelWithCovarianceStamped, 'neighbors/acceleration', 10)
    place = PointStamped()
    place.point.z = 0.4
    armed.publish(place)
    rig.flying()
    rig.wait(lambda: rig.planner._loop.ground == 0.4)
    push = AccelWithCovarianceStamped()
    push.header.frame_id, push.accel.accel.linear.x = 'leader', 0.3
    taken = rig.planner.diagnostics.rates['neighbors/acceleration_hz']
    for _ in range(3):
        push.header.stamp = nanoseconds_to_stamp(rig.now + STEP)
        count = taken.count
        rig.wait(pushes.get_subscription_count)
        pushes.publish(push)
        rig.wait(lambda count=count: taken.count > count)
        rig.run(0.1, leader=(2.0, 0.0, 2.0))
    assert rig.planner._loop.memory.motions['leader'].acceleration == pytest.approx([0.3, 0, 0])


def test_images_that_come_between_two_ticks_keep_the_planner_from_one_more():
    rclpy.init()
    planner, node = Planner(), Node('surroundings')
    frames = node.create_publisher(Header, 'neighbors/frames', 10)
    ticks: list[float] = []
    tick = planner._tick
    planner._tick = lambda: (ticks.append(time.monotonic()), tick())  # type: ignore[method-assign]

    def until(condition: object) -> None:
        assert callable(condition)
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, 'waited in vain'

    def look(count: int) -> None:
        frames.publish(Header(stamp=planner.get_clock().now().to_msg()))
        rate = planner.diagnostics.rates['neighbors/frames_hz']
        until(lambda: planner._poll_frames() or rate.count >= count)

    until(lambda: frames.get_subscription_count())
    assert planner._silence.is_canceled()
    look(1)
    assert not planner._silence.is_canceled()
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
    rclpy.shutdown()


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
        node._take_odom(to_odometry(
            nanoseconds_to_stamp(stamps[0]), 'odom', 'base_link', (0.0, 0.0, 2.0),
            IDENTITY_QUATERNION, (0.0, 0.0, 0.0)), arrival)
        node._take_neighbor(to_odometry(
            nanoseconds_to_stamp(stamps[1]), 'odom', 'leader', (2.0, 0.0, 2.0),
            IDENTITY_QUATERNION, (0.0, 0.0, 0.0)), arrival)
        node._tick()
        assert len(commands) == tick + 1
        command = commands[-1]
        sent = stamp_to_nanoseconds(command.header.stamp) + stamp_to_nanoseconds(
            command.points[0].time_from_start)
        assert abs(sent - arrival) < 1e6
    counters = node.diagnostics.counters
    assert counters['system clock was set'] == 1
    assert counters['odom stamped before the system clock was set'] == 1
    assert counters['neighbors stamped before the system clock was set'] == 1
    node.destroy_node()
