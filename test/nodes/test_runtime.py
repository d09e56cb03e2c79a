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

"""Any exception of a callback is counted and reported, and the node lives; its diagnostics."""

from collections import Counter
import time

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
import pytest
import rclpy
from rclpy.clock import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from flock_desk.runs.processes import free_udp_port, wait_until
from flock_follower.nodes.flock import SharingNode
from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support import runtime
from flock_follower.nodes.support.diagnostics import ERROR, Latency, Rate, WARN
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.nodes.visualizer import Visualizer
from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range


@pytest.fixture
def bench():
    """Give what makes a tested node, another one beside it, and what spins both."""
    context = rclpy.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    other = rclpy.create_node('other', context=context)
    executor.add_node(other)
    nodes = [other]
    lines = []

    class Logger:
        """Keeps what is logged."""

        def info(self, message):
            lines.append(message)

        warning = error = info

    def make(kind=FlockNode, *args, **kwargs):
        node = kind(*args, context=context, **kwargs)
        node.get_logger = Logger
        nodes.append(node)
        executor.add_node(node)
        return node

    def until(condition, what):
        def look():
            executor.spin_once(timeout_sec=0.01)
            return condition()
        wait_until(look, 10.0, what)

    def call(kind, name, request):
        client = other.create_client(kind, name)
        until(client.service_is_ready, name)
        future = client.call_async(request)
        until(future.done, f'an answer of {name}')
        return future.result()

    make.until, make.call, make.other, make.lines = until, call, other, lines
    yield make
    executor.shutdown()
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


def oops(*_):
    raise IndexError('oops')


def test_a_timer_that_raises_goes_on_counted_and_logged_once(bench):
    node = bench(FlockNode, 'tested')
    node.create_timer(0.01, oops)
    counters = node.diagnostics.counters
    bench.until(lambda: counters['internal error in timer oops'] >= 20, 'twenty failures')
    assert len([line for line in bench.lines if 'IndexError: oops (oops, line' in line]) == 1
    found = node.diagnostics.problems(0.0)
    assert found[0][0] == ERROR
    assert found[0][1].startswith('internal error in timer oops: IndexError: oops (oops, line ')


async def fail_later(request, response):
    future = Future()
    future.set_result(None)
    await future
    raise IndexError('oops')


def return_nothing(request, response):
    response.success = True


@pytest.mark.parametrize(('callback', 'said'), [
    (oops, 'internal error: IndexError: oops'), (fail_later, 'internal error: IndexError: oops'),
    (return_nothing, 'internal error: TypeError: NoneType returned, not SetBool_Response')])
def test_a_service_that_raises_answers_with_the_error(bench, callback, said):
    node = bench(FlockNode, 'tested')
    node.create_service(SetBool, 'serve', callback)
    for asked in (1, 2):
        answer = bench.call(SetBool, 'serve', SetBool.Request(data=True))
        assert not answer.success and answer.message == said
        assert node.diagnostics.counters == {'internal error in service serve': asked}


def test_a_check_that_raises_hides_no_other(bench):
    node = bench(FlockNode, 'tested')
    node.diagnostics.checks += [lambda now: (WARN, 'first'), oops, lambda now: (ERROR, 'last')]
    messages = [message for _, message in node.diagnostics.problems(0.0)]
    assert 'first' in messages and 'last' in messages
    assert any(message.startswith('internal error in check oops: ') for message in messages)
    node.diagnostics.publish()
    assert node.diagnostics.counters['internal error in check oops'] == 2


@pytest.mark.parametrize('way', ['create_subscription', 'subscribe', 'poll'])
def test_a_message_whose_callback_raises_is_counted(bench, way):
    node = bench(FlockNode, 'tested')
    poll = getattr(node, way)(String, 'words', oops, QoSProfile(depth=10))
    publisher = bench.other.create_publisher(String, 'words', 1)

    def counted():
        publisher.publish(String())
        if way == 'poll':
            poll()
        return node.diagnostics.counters['internal error on words']
    bench.until(counted, 'the error')


def test_a_subscription_of_rclpy_itself_is_guarded(bench):
    node = bench(FlockNode, 'tested', parameter_overrides=[Parameter('use_sim_time', value=True)])
    clock = next(s for s in node.subscriptions if s.msg_type is Clock)
    clock.callback('no clock')
    assert node.diagnostics.counters == Counter({'internal error on /clock': 1})


def test_an_invalid_message_is_counted_under_its_topic_and_logged_once(bench):
    def invalid(_):
        raise ValueError('position = nan: must be finite')
    node = bench(FlockNode, 'tested')
    node.subscribe(String, 'words', invalid, QoSProfile(depth=10))
    node.subscribe(String, 'bytes', oops, QoSProfile(depth=10))
    publishers = [bench.other.create_publisher(String, topic, 10) for topic in ('words', 'bytes')]

    def counted():
        for publisher in publishers:  # as bytes: 16 characters announced, 4 sent
            publisher.publish(String() if publisher is publishers[0] else
                              b'\x00\x01\x00\x00\x10\x00\x00\x00abcd')
        return min(node.diagnostics.counters[f'invalid {name}'] for name in ('words', 'bytes')) > 2
    bench.until(counted, 'the rejections')
    assert bench.lines.count('invalid words: position = nan: must be finite') == 1


@pytest.mark.parametrize(('publish', 'expected'), [
    (None, 'no /silent/odom for 9 s: no publisher'),
    (String, 'published as std_msgs/msg/String, wanted nav_msgs/msg/Odometry'),
    (Odometry, 'QoS mismatch with elsewhere')])
def test_the_silence_of_a_required_input_is_explained(bench, publish, expected):
    node = bench(FlockNode, 'tested')  # a topic that no node of an earlier test has
    node.subscribe(Odometry, 'silent/odom', oops, QoSProfile(depth=1))
    node.subscribe(Odometry, 'optional', oops, QoSProfile(depth=1), required=False)
    context = rclpy.Context()  # DDS has one type for each topic of a participant
    rclpy.init(context=context)
    elsewhere = rclpy.create_node('elsewhere', context=context)
    if publish is not None:
        elsewhere.create_publisher(
            publish, 'silent/odom', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
        bench.until(lambda: [end.node_name for end in node.get_publishers_info_by_topic(
            '/silent/odom')] == ['elsewhere'], 'the publisher')
    assert node.diagnostics.problems(time.monotonic() + 1.0) == []
    ((level, message),) = node.diagnostics.problems(time.monotonic() + 9.0)
    assert level == ERROR and expected in message
    elsewhere.destroy_node()
    context.try_shutdown()


def test_status_rates_and_counters_are_published(bench):
    node, statuses = bench(FlockNode, 'tested'), []
    bench.other.create_subscription(
        DiagnosticArray, '/diagnostics', lambda m: statuses.append(m.status[0]), 10)
    node.diagnostics.reject('too old', 'by 3 s')
    node.diagnostics.checks.append(lambda now: (WARN, 'low'))
    node.diagnostics.rate('tick').tick(time.monotonic())
    bench.until(lambda: statuses, 'a status')
    values = {pair.key: pair.value for pair in statuses[-1].values}
    assert (statuses[-1].name, statuses[-1].level, statuses[-1].message) == ('tested', WARN, 'low')
    assert values['rejected: too old'] == '1' and 'tick_hz' in values


def test_a_rate_is_the_mean_over_the_window_and_falls_to_zero_in_silence():
    rate = Rate(window=5.0)
    for i in range(100):
        rate.tick(i * 0.1)
    assert rate.count == 100
    assert rate.hertz(9.9) == pytest.approx(10.0)
    assert rate.hertz(20.0) == 0.0


def test_latency_percentiles_are_in_milliseconds():
    latency = Latency()
    assert latency.values('x') == {}
    for i in range(101):
        latency.add(i * 1e-3)
    assert latency.values('x') == {'x_p50_ms': '50.0', 'x_p95_ms': '95.0', 'x_p99_ms': '99.0'}


@pytest.mark.parametrize('kind', [Planner, MavlinkBridge, RelativePose, SharingNode, Visualizer])
def test_no_timer_stops_when_the_system_clock_is_set_back(kind):
    rclpy.init()
    overrides = {MavlinkBridge: [Parameter('connection', value='udpin:127.0.0.1:0')],
                 SharingNode: [Parameter('vehicle_name', value='one')]}.get(kind, [])
    node = kind(parameter_overrides=overrides)
    try:
        clocks = {timer.clock.clock_type for timer in node.timers}
        assert clocks == {ClockType.STEADY_TIME}
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_with_use_sim_time_a_timer_is_of_that_time(bench):
    node = bench(FlockNode, 'tested', parameter_overrides=[Parameter('use_sim_time', value=True)])
    assert node.create_timer(1.0, oops).clock.clock_type == ClockType.ROS_TIME
    steady = rclpy.clock.Clock(clock_type=ClockType.STEADY_TIME)
    assert node.create_timer(1.0, oops, clock=steady).clock is steady


def test_what_is_polled_comes_by_itself_while_it_is_awaited(bench):
    node, taken, awaited = bench(FlockNode, 'tested'), [], []
    publisher = bench.other.create_publisher(Odometry, 'odom', 10)
    poll = node.poll(Odometry, 'odom', lambda message, at: taken.append(
        (message.child_frame_id, node.get_clock().now().nanoseconds - at)), QoSProfile(depth=10),
        awaited=lambda: bool(awaited))
    bench.until(lambda: publisher.get_subscription_count(), 'the subscription')
    publisher.publish(Odometry(child_frame_id='first'))
    begin = time.monotonic()
    bench.until(lambda: time.monotonic() - begin > 0.3, 'time')
    assert taken == []
    awaited.append('from now on')
    bench.until(lambda: taken, 'the first')
    publisher.publish(Odometry(child_frame_id='second'))
    bench.until(lambda: len(taken) == 2, 'the second')
    awaited.clear()
    publisher.publish(Odometry(child_frame_id='third'))
    bench.until(lambda: poll() or len(taken) == 3, 'the third')
    assert [child for child, _ in taken] == ['first', 'second', 'third']
    assert taken[0][1] > 0.3e9  # since it arrived, though it came by a callback


def test_a_publisher_that_does_not_fit_is_told_within_seconds(bench):
    node = bench(FlockNode, 'tested')
    reported = []
    subscription = node.create_subscription(
        String, 'words', print, QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE),
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=reported.append))
    assert subscription.event_handlers
    begin = time.monotonic()
    bench.until(lambda: time.monotonic() - begin > 0.2, 'time')  # waits for no events by now
    bench.other.create_publisher(
        String, 'words', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    bench.until(lambda: reported, 'the event')
    assert reported[0].total_count == 1


@pytest.mark.parametrize('polled', [True, False])
def test_a_message_over_its_size_bound_is_refused_unread_and_counted(bench, polled, monkeypatch):
    node, taken, read = bench(FlockNode, 'tested'), [], []
    monkeypatch.setattr(runtime, 'deserialize_message', lambda data, kind: (
        read.append(len(data)), deserialize_message(data, kind))[1])
    publisher = bench.other.create_publisher(String, 'words', 10)
    if polled:
        poll = node.poll(String, 'words', lambda message, _: taken.append(message.data),
                         QoSProfile(depth=10), largest=100)
    else:
        node.subscribe(String, 'words', lambda message: taken.append(message.data),
                       QoSProfile(depth=10), largest=100)
        poll = bool
    bench.until(lambda: publisher.get_subscription_count(), 'the subscription')
    # 4 bytes of header, 4 of length, the text and its closing zero.
    for text in ('x' * 91, 'x' * 96, 'last'):
        publisher.publish(String(data=text))
    bench.until(lambda: poll() or 'last' in taken, 'the last')
    assert taken == ['x' * 91, 'last'] and max(read) == 100
    assert node.diagnostics.counters == {'too large words': 1}
    assert any('too large words: ' in line and ' bytes, at most 100' in line
               for line in bench.lines)


def test_every_small_message_that_a_flight_node_takes_has_a_size_bound(monkeypatch):
    bounds = {}
    original = FlockNode._watched

    def watched(self, msg_type, topic, *args, largest, **kwargs):
        bounds[msg_type.__name__] = largest
        return original(self, msg_type, topic, *args, largest=largest, **kwargs)
    monkeypatch.setattr(FlockNode, '_watched', watched)
    rclpy.init()
    try:
        for kind, overrides in (
                (Planner, []), (RelativePose, []),
                (MavlinkBridge, [Parameter('connection', value='udpin:127.0.0.1:0')]),
                (SharingNode, [Parameter('vehicle_name', value='one')])):
            kind(parameter_overrides=overrides).destroy_node()
    finally:
        rclpy.shutdown()
    assert bounds.pop('Image') is None
    bounds.pop('TFMessage', None)
    assert len(bounds) >= 7 and set(bounds.values()) == {4096}


def test_a_parameter_callback_that_raises_refuses_the_change(bench):
    node = bench(FlockNode, 'tested')
    built = []

    def build(values):
        built.append(values['x'])
        if len(built) > 1:
            oops()
        return values
    node.declare([Spec('x', 1.0, 'x', Range(0.0, 9.0), live=True)], build)
    result = node.set_parameters([Parameter('x', value=2.0)])[0]
    assert (result.successful, result.reason) == (False, 'internal error: IndexError: oops')
    assert node.get_parameter('x').value == 1.0
    assert node.diagnostics.counters['internal error on parameters'] == 1


def test_what_a_shutdown_makes_a_callback_raise_is_no_error_of_its_own(bench):
    node = bench(FlockNode, 'tested')
    timer = node.create_timer(60.0, oops)
    node.context.try_shutdown()
    with pytest.raises(IndexError):
        timer.callback()
    assert not node.diagnostics.counters


def test_the_bridge_goes_on_where_a_request_fails(bench, monkeypatch):
    node = bench(MavlinkBridge, parameter_overrides=[
        Parameter('connection', value=f'udpin:127.0.0.1:{free_udp_port()}')])
    monkeypatch.setattr(node._bridge.requests, 'land', oops)
    answer = bench.call(Trigger, 'mavlink_bridge/land', Trigger.Request())
    assert not answer.success and answer.message == 'internal error: IndexError: oops'
    assert node._stream._thread.is_alive()
