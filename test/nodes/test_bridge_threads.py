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


"""The bridge node in this process: the stream's thread owns the bridge, and waits for nobody."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
import socket
import threading
import time
from typing import Any

from bridge_rig import make_command
from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import all as mavlink
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from flock_follower.geometry import IDENTITY_QUATERNION
from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
OWNED = ('arm', 'offboard', 'takeoff', 'land', 'take_command', 'on_odometry', 'forward',
         '_apply', 'receive', 'cycle', 'stop')


class Bench:
    """The node, an autopilot that it hears, and the threads in which its bridge was called."""

    def __init__(self, **parameters: Any) -> None:
        self.node = MavlinkBridge(parameter_overrides=[
            Parameter(name, value=value)
            for name, value in {'connection': 'udpin:127.0.0.1:0', **parameters}.items()])
        self.bridge = self.node._bridge
        self.calls: list[tuple[str, str]] = []
        owners = self.bridge, self.bridge.requests, self.bridge.gate, self.node
        for name in OWNED:
            owner = next(owner for owner in owners if hasattr(owner, name))
            setattr(owner, name, partial(self._note, name, getattr(owner, name)))
        self.codec = mavlink.MAVLink(None, 1, 1)
        self.wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.closed = False

    def _note(self, name: str, function: Callable[..., Any], *arguments: Any,
              **options: Any) -> Any:
        self.calls.append((name, threading.current_thread().name))
        return function(*arguments, **options)

    def count(self, name: str) -> int:
        return sum(called == name for called, _ in self.calls)

    def wait(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, self.calls[-50:]
            time.sleep(0.002)

    def hear(self) -> None:
        """Have the autopilot say what makes the node publish and log."""
        for message in (
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 129, 6 << 16,
                    mavlink.MAV_STATE_ACTIVE, 3),
                mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 15200, 1850, 81, *[0] * 6),
                mavlink.MAVLink_statustext_message(
                    mavlink.MAV_SEVERITY_WARNING, b'words', 0, 0),
                mavlink.MAVLink_attitude_quaternion_message(0, 1.0, *[0.0] * 6),
                mavlink.MAVLink_local_position_ned_message(0, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0)):
            self.wire.sendto(message.pack(self.codec), self.bridge.link.transport.address)

    def call(self, service: Callable[..., Any], request: Any, response: Any) -> Any:
        """Await a service as an executor does."""
        answer, end = service(request, response), time.monotonic() + DEADLINE
        while time.monotonic() < end:
            try:
                answer.send(None)
            except StopIteration as stopped:
                return stopped.value
            time.sleep(0.002)
        raise AssertionError('never answered')

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.node.destroy_node()
            self.wire.close()


@pytest.fixture
def make_bench(ros: None) -> Iterator[Callable[..., Bench]]:
    benches: list[Bench] = []

    def make(**parameters: Any) -> Bench:
        benches.append(Bench(**parameters))
        return benches[-1]
    yield make
    for bench in benches:
        bench.close()


def test_only_the_thread_of_the_stream_calls_what_changes_the_bridge(make_bench):
    bench = make_bench(forward_odometry=True)
    node = bench.node
    bench.hear()
    bench.wait(lambda: bench.bridge.telemetry.local_position is not None)
    now = node.get_clock().now().nanoseconds
    odom = Odometry()
    odom.header.frame_id, odom.pose.pose.orientation.w = 'odom', 1.0
    node._take_odom(odom, now)
    node._hand_over_odom()
    node._on_command((make_command(now, (0.3, 0.0, 0.0)), {
        'publication_sequence_number': 1, 'received_timestamp': 0}))
    for service, request, response in (
            (partial(node._serve, 'offboard'), SetBool.Request(data=False), SetBool.Response()),
            (partial(node._serve, 'arm'), SetBool.Request(data=True), SetBool.Response()),
            (partial(node._serve, 'takeoff'), Trigger.Request(), Trigger.Response()),
            (partial(node._serve, 'land'), Trigger.Request(), Trigger.Response())):
        assert bench.call(service, request, response).message
    assert node.set_parameters([Parameter('a_max', value=1.5)])[0].successful
    bench.wait(lambda: bench.bridge.gate.limits.a_max == 1.5)
    bench.close()
    assert {name for name, _ in bench.calls} == set(OWNED)
    assert {thread for _, thread in bench.calls} == {'stream'}


def test_odometry_is_as_old_as_it_was_on_arrival_however_long_it_waited(make_bench):
    bench = make_bench(odom_twist_frame='child')
    player = Node('player')
    publisher = player.create_publisher(Odometry, 'odom', 10)
    bench.wait(publisher.get_subscription_count)
    sent = []
    for k in range(3):
        stamp = player.get_clock().now().nanoseconds
        publisher.publish(to_odometry(nanoseconds_to_stamp(stamp), 'odom', 'base_link',
                                      (0.0, 0.0, 2.0), IDENTITY_QUATERNION, (0.1 * k, 0.0, 0.0)))
        sent.append(time.monotonic())
        time.sleep(0.02)
    time.sleep(0.15)
    bench.node._hand_over_odom()
    bench.wait(lambda: bench.count('on_odometry') == 3)
    known = bench.bridge.gate._sources['odom']
    assert known.velocity[0] == pytest.approx(0.2)
    # Both the velocity and the yaw: what was lost brakes no later for having been polled.
    assert known.velocity_time == pytest.approx(sent[-1], abs=0.05)
    assert known.newest_yaw[1] == pytest.approx(sent[-1], abs=0.05)
    assert bench.node.diagnostics.rates['odom_hz'].count == 3
    player.destroy_node()


def test_a_request_that_fails_inside_is_answered_and_told(make_bench):
    bench = make_bench()
    bench.bridge.requests.land = lambda now: 1 / 0
    answer = bench.call(partial(bench.node._serve, 'land'), Trigger.Request(), Trigger.Response())
    assert (answer.success, answer.message) == (
        False, 'internal error: ZeroDivisionError: division by zero')
    bench.node.diagnostics.publish()
    assert bench.node.diagnostics.counters['internal error in the stream'] == 1


def test_after_the_stream_has_ended_a_service_says_so(make_bench):
    bench = make_bench()
    bench.node._stream.stop()
    answer = bench.call(partial(bench.node._serve, 'land'), Trigger.Request(), Trigger.Response())
    assert (answer.success, answer.message) == (
        False, 'refused: the setpoint thread has ended or takes no more')


class Stuck:
    """A publisher, or a logger, that waits until it is released."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.released = threading.Event()

    def publish(self, *_: Any) -> None:
        self.calls.append(threading.current_thread().name)
        assert self.released.wait(2.0 * DEADLINE)

    info = warning = publish

    def get_subscription_count(self) -> int:
        return 1


@pytest.mark.parametrize('what', ['_odometry', '_battery', 'get_logger'])
def test_neither_a_publisher_nor_a_log_that_waits_holds_the_setpoints_up(make_bench, what):
    bench = make_bench(stream_rate=50.0)
    stuck = Stuck()
    if what == 'get_logger':
        bench.node.get_logger = lambda: stuck
    else:
        setattr(bench.node._outputs, what, stuck)
    bench.hear()
    bench.wait(lambda: stuck.calls)
    cycles, received = bench.count('cycle'), bench.count('receive')
    bench.hear()
    bench.wait(lambda: bench.count('cycle') >= cycles + 10)
    assert bench.count('receive') > received
    assert set(stuck.calls) == {'publisher'}
    for _ in range(100):
        bench.hear()
        time.sleep(0.001)
    bench.wait(lambda: bench.node._publisher.dropped)
    bench.node.get_logger = lambda: stuck  # so that this thread logs nothing for real
    stuck.released.set()
    bench.node.diagnostics.publish()
    assert bench.node.diagnostics.values['dropped: publishing took too long'] > 0


def test_a_service_that_waits_when_the_bridge_stops_is_answered(make_bench):
    bench = make_bench()
    bench.hear()
    bench.wait(lambda: bench.bridge.telemetry.status is not None)
    waiting = [bench.node._serve('arm', SetBool.Request(data=False), SetBool.Response())
               for _ in range(2)]
    waiting[0].send(None)
    bench.wait(lambda: bench.node._pending)  # the autopilot never acknowledges
    finish = bench.bridge.finish

    def submit_last(now):
        waiting[1].send(None)  # nothing runs after this
        finish(now)
    bench.bridge.finish = submit_last
    bench.close()
    for service in waiting:
        with pytest.raises(StopIteration) as answered:
            service.send(None)
        response = answered.value.value
        assert not response.success and response.message == 'refused: the bridge is stopping'
