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

Plays ROS 1, ROS 2 sqlite3 and MCAP bags on their recorded schedule, with ``/clock``. A bag's
absolute topics are published under relative names (``/odom`` as ``odom``), so namespaces and
remaps apply. The service ``replay/pause`` (std_srvs/SetBool) stops and resumes, clock included.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import math
import shutil
import sys
import time
from typing import TextIO

from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from flock_follower.bags.bag import BagError, BagMessage, open_bag, Topic
from flock_follower.bags.live_line import LiveLine
from flock_follower.bags.schedule import NANOSECONDS, progress, published_names, section, Timeline
from flock_follower.nodes.support.conversions import message_class, nanoseconds_to_stamp
from flock_follower.nodes.support.runtime import FlockNode, run
from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range

CLOCK_PERIOD_NS = 5_000_000  # bag time between clock ticks, where no message is nearer
CLOCK_PERIOD = 0.001         # s of wall time between ticks at the least, for rates above 5
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
    Spec('duration', 0.0, 'duration of the playback; 0: to the end of '
                          'the bag', Range(0.0, 1e9, 's')),
    Spec('loop', False, 'repeat the bag', live=True),
    Spec('paused', False, 'start paused, until the service replay/pause resumes'),
    Spec('clock', True, 'publish /clock'),
    Spec('topics', [''], 'topics of the bag to play; empty: all'),
    Spec('remap', [''], 'from:=to for topics of the bag, besides remaps of ROS'),
    # Discovery takes DDS up to 2.5 s; a later subscriber misses the first messages.
    Spec('wait_for_subscribers', 3.0,
         'longest time to wait for a subscriber of each topic', Range(0.0, 3600.0, 's')),
    Spec('wait_for', [''], 'topics of the bag to which wait_for_subscribers applies; empty: all'),
]


class Replay(FlockNode):
    """
    Publish the messages of a bag when they fall due.

    :raises ValueError: a bad parameter, or a bag that cannot be played (BagError).
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
        self._topics = self._choose_topics()
        self._outputs = {
            topic: self._create_output(self.bag.topics[topic], name)
            for topic, name in published_names(self._topics, self._names_in('remap')).items()}
        self._clock_output = (
            self.create_publisher(Clock, '/clock', 10) if values['clock'] else None)
        self._timeline = Timeline(
            self._section.start_ns, values['rate'], time.monotonic(), values['paused'])
        self._clock_ns = -1
        self._clock_wall = 0.0
        self._next_service = 0.0
        self._sent: Counter[str] = Counter()
        self._loops = 0
        self._slipped = 0.0
        self._lateness = self.diagnostics.latency('lateness')
        self._line = LiveLine()
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
            while True:
                self._begin()
                for message in self._messages():
                    self._wait_until_due(message.stamp_ns, executor)
                    self._send(message)
                if not self._sent:
                    raise BagError(f'{self.bag.path}: no message of {", ".join(self._topics)} '
                                   'between start and end')
                if not self._settings.values['loop']:
                    break
                self._loops += 1
            self._finish(time.monotonic() - began)
            return 0
        except BagError as error:
            self._say(f'error: {error}', sys.stderr)
            return 1
        finally:
            executor.shutdown(timeout_sec=0.5)
            self.bag.close()

    def _names_in(self, parameter: str) -> list[str]:
        return [name for name in self._settings.values[parameter] if name]

    def _choose_topics(self) -> list[str]:
        for name, reason in self.bag.skipped.items():
            self.get_logger().warning(f'topic {name} is not played: {reason}')
        named = self._names_in('topics')
        topics = self.bag.select(named)
        if named and self._settings.values['clock'] and '/clock' in topics:
            raise ValueError('topics: the recorded /clock can only be played with clock:=false')
        left_out = [] if named else [topic for topic in topics if topic in INFRASTRUCTURE
                                     or topic.endswith(COMMANDS)]
        if left_out:
            self.get_logger().info(f'not played unless named: {", ".join(left_out)}')
            topics = [topic for topic in topics if topic not in left_out]
        if not topics:
            raise BagError(f'{self.bag.path}: nothing to play but {", ".join(self.bag.topics)}')
        return topics

    def _create_output(self, topic: Topic, name: str) -> Publisher:
        try:
            message_type = message_class(topic.msgtype)
        except ValueError as error:
            raise BagError(f'{self.bag.path}: topic {topic.name}: {error}; '
                           'choose others with -p topics:="[...]"') from error
        # Reliable, because only that reaches reliable and best-effort subscribers alike. A latched
        # topic keeps what it holds for late joiners; images are few and large, the rest small.
        depth = 5 if topic.msgtype in LARGE_TYPES else 100
        durability = (
            DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE)
        try:
            return self.create_publisher(message_type, name, QoSProfile(
                depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability))
        except (InvalidTopicNameException, RuntimeError) as error:
            reason = ' '.join(str(error).split())
            raise BagError(f'{self.bag.path}: topic {topic.name} cannot be published as {name!r}: '
                           f'{reason}') from error

    def _wait_for_subscribers(self, executor: SingleThreadedExecutor) -> None:
        timeout = self._settings.values['wait_for_subscribers']
        named = self._names_in('wait_for')
        awaited = self.bag.select(named) if named else self._topics
        deadline = time.monotonic() + timeout
        while lonely := [output.topic_name for topic, output in self._outputs.items()
                         if topic in awaited and output.get_subscription_count() == 0]:
            if time.monotonic() >= deadline:
                if timeout > 0.0:
                    self.get_logger().info(f'nobody subscribes to {", ".join(lonely)} so far')
                return
            executor.spin_once(timeout_sec=SERVICE_PERIOD)

    def _begin(self) -> None:
        """Go to the start of the section; publish the clock before any message."""
        start_ns = self._section.start_ns
        self._timeline.jump(start_ns, time.monotonic() + LEAD_IN)
        self._clock_ns = -1  # the one place where the clock may go back
        self._publish_clock(start_ns)
        latched = [topic for topic in self._topics if self.bag.topics[topic].latched]
        if latched and start_ns > self.bag.start_ns:
            for message in self.bag.messages(latched, stop_ns=start_ns):
                self._outputs[message.topic].publish(message.data)

    def _messages(self) -> Iterator[BagMessage]:
        if self._section == (self.bag.start_ns, self.bag.end_ns + 1):
            return self.bag.messages(self._topics)  # unbounded, so that losses are noticed
        return self.bag.messages(self._topics, *self._section)

    def _wait_until_due(self, stamp_ns: int, executor: SingleThreadedExecutor) -> None:
        """Wait until a stamp is due; serve the clock and the services meanwhile."""
        while True:
            now = time.monotonic()
            if now >= self._next_service:
                self._serve(executor)
                now = time.monotonic()
                self._next_service = now + SERVICE_PERIOD
            due = self._timeline.due(stamp_ns)
            if now >= due:
                break
            if now >= self._next_tick():
                self._publish_clock(self._timeline.position(now))
            wake = min(due, self._next_service, self._next_tick())
            time.sleep(max(0.0, wake - time.monotonic()))
        self._lateness.add(now - due)
        self._slipped += self._timeline.limit_lateness(stamp_ns, now, MAX_LATENESS)

    def _serve(self, executor: SingleThreadedExecutor) -> None:
        """Answer services, apply parameter changes, report the position."""
        executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        if self._timeline.rate != self._settings.values['rate']:
            self._timeline.set_rate(self._settings.values['rate'], now)
        self.diagnostics.values.update({
            'position_s': f'{self._seconds(self._position(now)):.2f}',
            'duration_s': f'{self.bag.duration_ns / NANOSECONDS:.2f}',
            'rate': self._timeline.rate, 'paused': self._timeline.paused, 'loops': self._loops,
            'dropped_backlog_s': f'{self._slipped:.2f}',
            **{f'published {topic}': count for topic, count in self._sent.items()}})
        if self._line.due(now):
            self._show_progress(self._position(now))

    def _next_tick(self) -> float:
        """Return the wall time of the next clock tick between messages."""
        if self._clock_output is None:
            return math.inf
        return max(self._timeline.due(self._clock_ns + CLOCK_PERIOD_NS),
                   self._clock_wall + CLOCK_PERIOD)

    def _publish_clock(self, stamp_ns: int) -> None:
        if self._clock_output is not None and stamp_ns > self._clock_ns:
            self._clock_ns, self._clock_wall = stamp_ns, time.monotonic()
            self._clock_output.publish(Clock(clock=nanoseconds_to_stamp(stamp_ns)))

    def _send(self, message: BagMessage) -> None:
        self._publish_clock(message.stamp_ns)  # first: a subscriber finds the message's time
        self._outputs[message.topic].publish(message.data)
        self._sent[message.topic] += 1
        self.diagnostics.rate(message.topic).tick(time.monotonic())

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        now = time.monotonic()
        if request.data:
            self._timeline.pause(now)
        else:
            self._timeline.resume(now)
        position = self._seconds(self._timeline.position(now))
        response.success = True
        response.message = f'{"paused" if request.data else "playing"} at {position:.2f} s'
        return response

    def _position(self, now: float) -> int:
        """Return the bag time reached, ns; the timeline itself runs on beyond the section."""
        return min(self._timeline.position(now), self._section.stop_ns - 1)

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self.bag.start_ns) / NANOSECONDS

    def _show_progress(self, position_ns: int) -> None:
        start_ns, end_ns = self._section.start_ns, self._section.stop_ns - 1
        width = shutil.get_terminal_size().columns - 1 if self._line.on_terminal else 0
        self._line.show(progress(
            self._seconds(position_ns), self._seconds(end_ns),
            (position_ns - start_ns) / max(end_ns - start_ns, 1), self._timeline.rate,
            self._sent.total(), self._timeline.paused, width))

    def _finish(self, elapsed: float) -> None:
        """Wait for reliable subscribers to receive the last messages, and print a summary."""
        deadline = time.monotonic() + 1.0
        for output in self._outputs.values():
            output.wait_for_all_acked(Duration(seconds=max(0.0, deadline - time.monotonic())))
        self._show_progress(self._section.stop_ns - 1)
        lateness = self._lateness.values('late')['late_p99_ms']
        slipped = f', {self._slipped:.1f} s behind schedule' if self._slipped else ''
        self._say(f'replayed {self._sent.total()} messages of {len(self._topics)} topics '
                  f'in {elapsed:.1f} s, p99 {lateness} ms late{slipped}')

    def _say(self, text: str, stream: TextIO | None = None) -> None:
        self._line.end()
        print(text, file=stream or sys.stdout, flush=True)


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
    """Run the node; exit code 0 at the end of the bag, 1 for what cannot be played."""
    args = sys.argv[1:] if args is None else args
    return run(lambda: Replay(bag_argument(args)), args, Replay.play)


if __name__ == '__main__':
    sys.exit(main())
