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

"""What a node says about itself, judged from what arrives on /diagnostics."""

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from flock_desk.runs.processes import wait_until
from flock_follower.nodes.support.diagnostics import Diagnostics, ERROR, Latency, OK, Rate
from flock_follower.nodes.support.runtime import FlockNode


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


@pytest.fixture
def bench():
    """Two nodes with a DDS participant each: one tested, one that publishes to it and listens."""
    contexts = [rclpy.Context(), rclpy.Context()]
    for context in contexts:
        rclpy.init(context=context)
    executors = [SingleThreadedExecutor(context=context) for context in contexts]
    tested = FlockNode('tested', context=contexts[0])
    other = rclpy.create_node('other', context=contexts[1])
    for executor, node in zip(executors, (tested, other)):
        executor.add_node(node)
    statuses = []
    other.create_subscription(
        DiagnosticArray, '/diagnostics', lambda m: statuses.append(m.status[0]), 10)

    def spin_until(condition, what):
        def look():
            for executor in executors:
                executor.spin_once(timeout_sec=0.01)
            return condition()
        wait_until(look, 10.0, what)

    yield tested, other, statuses, spin_until
    for executor, node, context in zip(executors, (tested, other), contexts):
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def fail(_):
    raise ValueError('position = nan: must be finite')


def test_a_message_that_raises_is_counted_and_the_node_lives_on(bench):
    tested, other, statuses, spin_until = bench
    seen = []

    def callback(message):
        seen.append(message)
        if len(seen) == 1:
            fail(message)
        if len(seen) == 2:
            raise RuntimeError('unforeseen')

    tested.subscribe(String, 'words', callback, QoSProfile(depth=10))
    publisher = other.create_publisher(String, 'words', 10)
    other.create_timer(0.05, lambda: publisher.publish(String(data='x')))
    spin_until(lambda: len(seen) >= 3, 'three messages')
    spin_until(lambda: statuses and any(
        v.key == 'rejected: internal error on words' for v in statuses[-1].values), 'counters')
    values = {v.key: v.value for v in statuses[-1].values}
    assert values['rejected: invalid words'] == '1'
    assert values['rejected: internal error on words'] == '1'
    assert statuses[-1].level == ERROR
    assert statuses[-1].message.startswith('internal error on words: RuntimeError: unforeseen (')


@pytest.mark.parametrize('publish, expected', [
    (None, 'no /odom for'),
    (String, 'published as std_msgs/msg/String, wanted nav_msgs/msg/Odometry'),
    (Odometry, 'QoS mismatch with other'),
])
def test_silence_is_explained_within_five_seconds(bench, publish, expected):
    tested, other, statuses, spin_until = bench
    tested.subscribe(Odometry, 'odom', fail, QoSProfile(depth=1))
    if publish is not None:
        other.create_publisher(
            publish, 'odom', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    spin_until(lambda: statuses and statuses[-1].level == ERROR, 'an error status')
    assert expected in statuses[-1].message


def test_an_optional_input_may_be_silent(bench):
    tested, _, statuses, spin_until = bench
    tested.subscribe(Odometry, 'odom', fail, QoSProfile(depth=1), required=False, timeout=0.0)
    spin_until(lambda: len(statuses) >= 2, 'two statuses')
    assert statuses[-1].level == OK


def test_each_reason_is_logged_at_most_once_per_five_seconds(bench):
    tested, *_ = bench
    lines = []

    class Logger:
        def warning(self, message):
            lines.append(message)

    tested.get_logger = Logger
    diagnostics = Diagnostics(tested)
    for _ in range(100):
        diagnostics.reject('too old', 'by 3 s')
        diagnostics.reject('not finite')
    assert lines == ['too old: by 3 s', 'not finite']
    assert diagnostics.counters == {'too old': 100, 'not finite': 100}
