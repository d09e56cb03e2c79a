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

"""The base class of the nodes: guarded callbacks, polling, diagnostics, bounds of messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import time
from typing import Any

from driven import Driven, overrides
from nav_msgs.msg import Odometry
import pytest
from rcl_interfaces.msg import ParameterEvent
import rclpy
from rclpy.clock import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool

from flock_desk.runs.processes import wait_until
from flock_follower.nodes.flock import SharingNode
from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support import runtime
from flock_follower.nodes.support.diagnostics import ERROR, percentiles, Rate, WARN
from flock_follower.nodes.support.inputs import best_effort
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.nodes.visualizer import Visualizer
from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range

TEN = QoSProfile(depth=10)


class Tested(Driven):
    """A node, and the lines that it logs."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(FlockNode('tested', parameter_overrides=overrides(**parameters)))
        self.lines: list[str] = []
        log = type('Log', (), dict.fromkeys(('info', 'warning', 'error'), self.lines.append))
        self.node.get_logger = lambda: log


@pytest.fixture
def tested(ros: None) -> Iterator[Tested]:
    made = Tested()
    yield made
    made.close()


def oops(*_: Any) -> None:
    raise IndexError('oops')


async def fail_later(request: Any, response: Any) -> None:
    raise IndexError('oops')


def test_a_timer_that_raises_goes_on_counted_and_logged_once(tested: Tested) -> None:
    tested.node.create_timer(0.001, oops)
    tested.wait(lambda: tested.counters['internal error in timer oops'] >= 20)
    assert len([line for line in tested.lines if 'IndexError: oops (oops, line' in line]) == 1
    ((level, message),) = tested.diagnostics.problems(0.0)
    assert level == ERROR
    assert message.startswith('internal error in timer oops: IndexError: oops (oops, line ')


@pytest.mark.parametrize('callback', [oops, fail_later])
def test_a_service_that_raises_answers_with_the_error(tested: Tested, callback: Any) -> None:
    tested.node.create_service(SetBool, 'serve', callback)
    answer = tested.call('serve', data=True)
    if callback is fail_later:
        with pytest.raises(StopIteration) as ended:
            answer.send(None)
        answer = ended.value.value
    assert not answer.success and answer.message == 'internal error: IndexError: oops'
    assert tested.counters == {'internal error in service serve': 1}


def test_check_that_raises_hides_no_other_status_is_published(tested: Tested) -> None:
    tested.diagnostics.checks += [lambda now: (WARN, 'first'), oops, lambda now: (ERROR, 'last')]
    tested.diagnostics.sources += [oops, lambda now: {'one': 1}]
    tested.diagnostics.reject('too old', 'by 3 s')
    tested.diagnostics.rate('tick').tick(time.monotonic())
    tested.diagnostics.publish()
    (status,) = tested.sent['diagnostics'][-1].status
    values = {pair.key: pair.value for pair in status.values}
    assert (status.name, status.level) == ('tested', ERROR)
    assert 'first' in status.message and 'last' in status.message
    assert 'internal error in oops: ' in status.message
    assert values['rejected: too old'] == '1' and values['one'] == '1' and 'tick_hz' in values


@pytest.mark.parametrize('way', ['create_subscription', 'subscribe', 'poll'])
def test_a_message_whose_callback_raises_is_counted(tested: Tested, way: str) -> None:
    getattr(tested.node, way)(String, 'words', oops, TEN)
    tested.give('words', String())
    assert tested.counters == {'internal error on words': 1}


def test_a_subscription_of_rclpy_itself_is_guarded(ros: None) -> None:
    tested = Tested(use_sim_time=True)
    tested.give('/clock', 'no clock')
    assert tested.counters == {'internal error on /clock': 1}
    assert tested.node.create_timer(1.0, oops).clock.clock_type == ClockType.ROS_TIME
    tested.close()


def test_invalid_and_large_messages_are_counted_large_unread(
        tested: Tested, monkeypatch: pytest.MonkeyPatch) -> None:
    taken, read = [], []
    monkeypatch.setattr(runtime, 'deserialize_message', lambda data, kind: (
        read.append(len(data)), deserialize_message(data, kind))[1])

    def take(message: String) -> None:
        if not message.data:
            raise ValueError('position = nan: must be finite')
        taken.append(message.data)
    tested.node.subscribe(String, 'words', take, TEN, largest=100)
    # 4 bytes of header, 4 of length, the text and its closing zero.
    for text in ('x' * 91, 'x' * 96, '', '', 'last'):
        tested.give('words', String(data=text))
    subscription = next(s for s in tested.node.subscriptions if s.topic_name == '/words')
    subscription.callback(b'\x00\x01\x00\x00\x10\x00\x00\x00abcd', {})  # announces 16 characters
    assert taken == ['x' * 91, 'last'] and max(read) == 100
    assert tested.counters == {'too large words': 1, 'invalid words': 3}
    assert tested.lines.count('invalid words: position = nan: must be finite') == 1


@pytest.mark.parametrize(('publish', 'sporadic', 'expected'), [
    (None, True, 'no /silent/odom for 9 s: no publisher'),
    (Odometry, False, 'QoS mismatch with elsewhere'),
    (String, False, 'published as std_msgs/msg/String, wanted nav_msgs/msg/Odometry')])
def test_the_silence_of_a_required_input_is_explained(
        tested: Tested, publish: Any, sporadic: bool, expected: str) -> None:
    tested.node.poll(Odometry, 'silent/odom', oops, QoSProfile(depth=1), sporadic=sporadic)
    tested.node.subscribe(Odometry, 'optional', oops, QoSProfile(depth=1), required=False)
    context = rclpy.Context()  # DDS has one type for each topic of a participant
    rclpy.init(context=context)
    elsewhere = rclpy.create_node('elsewhere', context=context)
    if publish is not None:
        elsewhere.create_publisher(publish, 'silent/odom', best_effort())
        wait_until(lambda: [end.node_name for end in tested.node.get_publishers_info_by_topic(
            '/silent/odom')] == ['elsewhere'], 20.0, 'the publisher')
    assert tested.problems(ahead=1.0) == ''
    assert expected in tested.problems(ahead=9.0) and 'optional' not in tested.problems(ahead=9.0)
    elsewhere.destroy_node()
    context.try_shutdown()


def test_rates_are_window_means_latencies_percentiles_in_ms() -> None:
    rate = Rate()
    for i in range(101):
        rate.tick(i * 0.1)
    assert (rate.count, rate.hertz(10.0), rate.hertz(20.0)) == (101, pytest.approx(10.0), 0.0)
    assert percentiles('x', []) == {}
    assert percentiles('x', [i * 1e-3 for i in range(101)]) == {
        'x_p50_ms': '50.0', 'x_p95_ms': '95.0', 'x_p99_ms': '99.0'}


@pytest.mark.parametrize('kind', [Planner, MavlinkBridge, RelativePose, SharingNode, Visualizer])
def test_no_timer_stops_if_clock_is_set_messages_are_bounded(
        ros: None, kind: Any) -> None:
    node = kind(parameter_overrides=overrides(**{
        MavlinkBridge: {'connection': 'udpin:127.0.0.1:0'},
        SharingNode: {'vehicle_name': 'one'}}.get(kind, {})))
    assert {timer.clock.clock_type for timer in node.timers} == {ClockType.STEADY_TIME}
    # Taken as bytes, a message is measured before it is read.
    assert {s.msg_type for s in node.subscriptions if not s.raw} <= {Image, ParameterEvent}
    node.destroy_node()


def test_what_is_polled_comes_by_itself_while_it_is_awaited(tested: Tested) -> None:
    other, executor = Node('other'), SingleThreadedExecutor()
    executor.add_node(tested.node)

    def until(condition: Callable[[], object], what: str) -> None:
        wait_until(lambda: executor.spin_once(timeout_sec=0.01) or condition(), 20.0, what)
    taken, awaited = [], []
    publisher = other.create_publisher(Odometry, 'odom', 10)
    poll = tested.node.poll(Odometry, 'odom', lambda message, at: taken.append(
        (message.child_frame_id, tested.node.get_clock().now().nanoseconds - at)), TEN,
        awaited=lambda: bool(awaited))
    until(publisher.get_subscription_count, 'the subscription')
    publisher.publish(Odometry(child_frame_id='first'))
    begin = time.monotonic()
    until(lambda: time.monotonic() - begin > 0.3, 'time')
    assert taken == []
    awaited.append('from now on')
    until(lambda: taken, 'the first')
    assert taken[0][1] > 0.3e9  # since it arrived, though it came by a callback
    awaited.clear()
    publisher.publish(Odometry(child_frame_id='second'))
    until(lambda: poll() or len(taken) == 2, 'the second')
    assert [child for child, _ in taken] == ['first', 'second']
    executor.shutdown()
    other.destroy_node()


def test_a_parameter_callback_that_raises_refuses_the_change(tested: Tested) -> None:
    built = []

    def build(values: dict[str, Any]) -> dict[str, Any]:
        built.append(values['x'])
        if len(built) > 1:
            oops()
        return values
    tested.node.declare([Spec('x', 1.0, 'x', Range(0.0, 9.0), live=True)], build)
    result = tested.node.set_parameters([Parameter('x', value=2.0)])[0]
    assert (result.successful, result.reason) == (False, 'internal error: IndexError: oops')
    assert tested.node.get_parameter('x').value == 1.0
    assert tested.counters['internal error on parameters'] == 1


def test_exception_by_shutdown_in_callback_is_no_error() -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    node = FlockNode('tested', context=context)
    timer = node.create_timer(60.0, oops)
    context.try_shutdown()
    with pytest.raises(IndexError):
        timer.callback()
    assert not node.diagnostics.counters
