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

"""
Replay a bag: ``replay BAG [--ros-args -p rate:=2.0 -p loop:=true ...]``.

The node plays ROS 1, ROS 2 sqlite3 and MCAP bags at the recorded times, with ``/clock``; gaps of
more than 5 s are reported and skipped. Absolute topics of a bag are published under relative names
(``/odom`` as ``odom``), so namespaces and remaps apply. The service ``replay/pause``
(std_srvs/SetBool) stops and resumes messages and clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import sys
import time
from typing import Any

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from flock_follower.bags.bag import BagError, BagMessage, open_bag, Topic
from flock_follower.bags.live_line import bar, LiveLine
from flock_follower.bags.schedule import Gaps, NS_PER_S, section, Timeline
from flock_follower.nodes.support.conversions import message_class, nanoseconds_to_stamp
from flock_follower.nodes.support.diagnostics import percentiles
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range

CLOCK_PERIOD = 0.005         # s of bag time between clock ticks, if no message is nearer
SHORTEST_CLOCK_PERIOD = 0.001  # s of wall time between them
SERVICE_PERIOD = 0.02        # s between looks at services, parameters and the diagnostics timer
LEAD_IN = 0.1                # s from a jump of the clock to the first message that follows it
MAX_LATENESS = 0.5           # s of backlog kept; what a stall adds beyond it delays the rest
LARGE_TYPES = frozenset(
    f'sensor_msgs/msg/{name}' for name in ('Image', 'CompressedImage', 'PointCloud2'))
#: Topics of the recorded system itself; played only if named.
INFRASTRUCTURE = frozenset({'/clock', '/diagnostics', '/parameter_events', '/rosout'})
#: Commands of a recorded flight, in any namespace; played only if named: a bridge could not
#: distinguish them from those of a planner.
COMMANDS = '/command/trajectory'

SPECS = [
    Spec('bag', '', 'bag to play: .bag, .mcap, .db3 or a ROS 2 bag folder'),
    Spec('rate', 1.0, 'speed of playback', Range(0.1, 100.0), live=True),
    Spec('start', 0.0, 'start of the playback, from the start of the bag', Range(0.0, 1e9, 's')),
    Spec('duration', 0.0, 'duration of the playback; 0: to the end of the bag',
         Range(0.0, 1e9, 's')),
    Spec('loop', False, 'repeat the bag', live=True),
    Spec('clock', True, 'publish /clock'),
    Spec('topics', [''], 'topics of the bag to play; empty: all'),
    # Discovery takes DDS up to 2.5 s; a later subscriber misses the first messages.
    Spec('wait_for_subscribers', 3.0,
         'longest time to wait for a subscriber of each topic', Range(0.0, 3600.0, 's')),
]


class Replay(FlockNode):
    """
    Publish the messages of a bag when they fall due.

    :raises ValueError: for a bad parameter, or a bag that cannot be played (BagError).
    """

    def __init__(self, bag: str = '') -> None:
        overrides = [Parameter('bag', value=bag)] if bag else []
        super().__init__('replay', parameter_overrides=overrides)
        self._settings = self.declare(SPECS, dict)
        values = self._settings.values
        if not values['bag']:
            raise ValueError('no bag given; usage: replay BAG [--ros-args -p rate:=2.0 ...]')
        self.bag = open_bag(values['bag'])
        if self.bag.incomplete:
            self.get_logger().warning(f'{self.bag.path} is incomplete: {self.bag.incomplete}')
        self._section = section(
            self.bag.start_ns, self.bag.end_ns, values['start'], values['duration'])
        self._outputs = {
            topic: self._create_output(self.bag.topics[topic]) for topic in self._choose_topics()}
        self._clock_output = (
            self.create_publisher(Clock, '/clock', 10) if values['clock'] else None)
        self._timeline = Timeline(self._section.start_ns, values['rate'], time.monotonic())
        self._clock_ns = -1
        self._next_service = 0.0
        self._sent: Counter[str] = Counter()
        self._lateness = self.diagnostics.latency('lateness')
        self._line = LiveLine()
        self.diagnostics.sources.append(self._values)
        self.create_service(SetBool, 'replay/pause', self._on_pause)

    def play(self) -> int:
        """Play to the end and return the exit code."""
        if not self.context.ok():
            return 0
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        began = time.monotonic()
        try:
            self._wait_for_subscribers(executor)
            while self._settings.values['loop'] or not self._sent:
                self._begin()
                gaps = Gaps(self._section.start_ns)
                for message in self._messages():
                    if step := gaps.take(message.stamp_ns):
                        self._play_over(step, message.stamp_ns)
                    self._wait_until_due(message.stamp_ns, executor)
                    self._send(message)
                if not self._sent:
                    raise BagError(f'{self.bag.path}: no message of {", ".join(self._outputs)} '
                                   'between start and end')
            # Reliable subscribers receive the last messages.
            for output in self._outputs.values():
                output.wait_for_all_acked(Duration(seconds=1.0))
            self._line.print_above(
                f'replayed {self._sent.total()} messages of {len(self._outputs)} topics '
                f'in {time.monotonic() - began:.1f} s, p99 '
                f'{percentiles("late", self._lateness)["late_p99_ms"]} ms late')
            return 0
        except BagError as error:
            self._line.end()
            print(f'error: {error}', file=sys.stderr)
            return 1
        finally:
            executor.shutdown(timeout_sec=0.5)
            self.bag.close()

    def _choose_topics(self) -> list[str]:
        for name, reason in self.bag.skipped.items():
            self.get_logger().warning(f'topic {name} is not played: {reason}')
        named = [name for name in self._settings.values['topics'] if name]
        topics = self.bag.select(named)
        if named and '/clock' in topics and self._settings.values['clock']:
            raise ValueError('topics: the recorded /clock can only be played with clock:=false')
        left_out = [] if named else [topic for topic in topics if topic in INFRASTRUCTURE
                                     or topic.endswith(COMMANDS)]
        if left_out:
            self.get_logger().info(f'not played unless named: {", ".join(left_out)}')
        topics = [topic for topic in topics if topic not in left_out]
        if not topics:
            raise BagError(f'{self.bag.path}: nothing to play but {", ".join(self.bag.topics)}')
        return topics

    def _create_output(self, topic: Topic) -> Publisher:
        """Return a publisher; its name is relative, so that namespaces and remaps apply."""
        # Reliable, because only that reaches reliable and best-effort subscribers alike. A latched
        # topic keeps what it holds for late joiners; images are few and large, the rest small.
        qos = QoSProfile(
            depth=5 if topic.msgtype in LARGE_TYPES else 100, durability=(
                DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE))
        try:
            return self.create_publisher(
                message_class(topic.msgtype), topic.name.lstrip('/'), qos)
        except (ValueError, InvalidTopicNameException, RuntimeError) as error:
            reason = ' '.join(str(error).split())
            raise BagError(f'{self.bag.path}: topic {topic.name} cannot be published: {reason}; '
                           'choose others with -p topics:="[...]"') from error

    def _wait_for_subscribers(self, executor: SingleThreadedExecutor) -> None:
        deadline = time.monotonic() + self._settings.values['wait_for_subscribers']
        while time.monotonic() < deadline and not all(
                output.get_subscription_count() for output in self._outputs.values()):
            executor.spin_once(timeout_sec=SERVICE_PERIOD)

    def _begin(self) -> None:
        """Go to the start; publish the clock before any message."""
        start_ns = self._section.start_ns
        self._timeline.jump(start_ns, time.monotonic() + LEAD_IN)
        self._clock_ns = -1  # the clock may go back
        self._publish_clock(start_ns)
        latched = [topic for topic in self._outputs if self.bag.topics[topic].latched]
        if latched and start_ns > self.bag.start_ns:
            for message in self.bag.messages(latched, stop_ns=start_ns):
                self._outputs[message.topic].publish(message.data)

    def _messages(self) -> Iterator[BagMessage]:
        if self._section == (self.bag.start_ns, self.bag.end_ns + 1):
            return self.bag.messages([*self._outputs])  # unbounded, so that losses are noticed
        return self.bag.messages([*self._outputs], *self._section)

    def _play_over(self, step: float, stamp_ns: int) -> None:
        """Continue at the message after a gap in the bag's times, s, without waiting."""
        before = stamp_ns / NS_PER_S - step - self.bag.start_ns / NS_PER_S
        self._line.print_above(
            f'warning: the times in the bag jump by {step:+.1f} s at {before:.1f} s: the clock '
            'was set, or nothing was recorded; played without this gap')
        self._timeline.jump(stamp_ns, time.monotonic() + LEAD_IN)
        if step < 0.0:
            self._clock_ns = -1
        self._publish_clock(stamp_ns)

    def _wait_until_due(self, stamp_ns: int, executor: SingleThreadedExecutor) -> None:
        """Wait until a stamp is due; serve the clock and the services meanwhile."""
        while True:
            now = time.monotonic()
            if now >= self._next_service:
                self._next_service = now + SERVICE_PERIOD
                executor.spin_once(timeout_sec=0.0)
                rate = self._settings.values['rate']
                if rate != self._timeline.rate:
                    self._timeline.change(now, rate, self._timeline.paused)
                if self._line.due(now):
                    self._show_progress(now)
                now = time.monotonic()
            due = self._timeline.due(stamp_ns)
            if now >= due:
                break
            position = self._timeline.position(now)
            if position - self._clock_ns >= CLOCK_PERIOD * NS_PER_S:
                self._publish_clock(position)
            tick = max(CLOCK_PERIOD / self._timeline.rate, SHORTEST_CLOCK_PERIOD)
            time.sleep(max(0.0, min(due, self._next_service, now + tick) - time.monotonic()))
        self._lateness.append(now - due)
        self._timeline.limit_lateness(stamp_ns, now, MAX_LATENESS)

    def _publish_clock(self, stamp_ns: int) -> None:
        if self._clock_output is not None and stamp_ns > self._clock_ns:
            self._clock_ns = stamp_ns
            self._clock_output.publish(Clock(clock=nanoseconds_to_stamp(stamp_ns)))

    def _send(self, message: BagMessage) -> None:
        self._publish_clock(message.stamp_ns)  # first: a subscriber finds the message's time
        self._outputs[message.topic].publish(message.data)
        self._sent[message.topic] += 1
        self.diagnostics.rate(message.topic).tick(time.monotonic())

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        now = time.monotonic()
        self._timeline.change(now, self._timeline.rate, bool(request.data))
        response.success = True
        response.message = (f'{"paused" if request.data else "playing"} at '
                            f'{self._seconds(now):.2f} s')
        return response

    def _seconds(self, now: float) -> float:
        """Return the bag time reached, s from the start of the bag."""
        position = min(self._timeline.position(now), self._section.stop_ns - 1)
        return (position - self.bag.start_ns) / NS_PER_S

    def _show_progress(self, now: float) -> None:
        start_ns, stop_ns = self._section
        end = (stop_ns - 1 - self.bag.start_ns) / NS_PER_S
        share = (self._timeline.position(now) - start_ns) / (stop_ns - start_ns)
        self._line.show(
            f'{bar(share) + " " if self._line.on_terminal else ""}{self._seconds(now):.1f} of '
            f'{end:.1f} s, {self._sent.total()} messages'
            f'{", paused" if self._timeline.paused else ""}')

    def _values(self, now: float) -> dict[str, Any]:
        return {'position_s': f'{self._seconds(now):.2f}', 'paused': self._timeline.paused,
                'duration_s': f'{self.bag.duration_ns / NS_PER_S:.2f}'}


def bag_argument(args: list[str]) -> str:
    """
    Return the bag given as a plain argument, or ''.

    :raises ValueError: if there is more than one plain argument.
    """
    plain = remove_ros_args(args)
    if len(plain) > 1:
        raise ValueError(f'one bag expected, not {" ".join(plain)}')
    return plain[0] if plain else ''


def main(args: list[str] | None = None) -> int:
    """Run the node; exit code 0 at the end of the bag, 1 for a bag that cannot be played."""
    args = sys.argv[1:] if args is None else args
    return run(lambda: Replay(bag_argument(args)), args, Replay.play)


if __name__ == '__main__':
    sys.exit(main())
