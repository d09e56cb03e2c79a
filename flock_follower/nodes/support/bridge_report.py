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
Topics and log of the MAVLink bridge; its diagnostics are in ``bridge_problems``.

The setpoint thread calls ``on_messages`` and ``on_cycle``. They decide from the bridge's state,
and pass functions to the publisher thread; the executor's thread takes the events for the
diagnostics.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
import math
from typing import Any

from geometry_msgs.msg import Point, PointStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from sensor_msgs.msg import BatteryState
from std_msgs.msg import String

from flock_follower.gate.permission import Phase
from flock_follower.mavlink.bridge import Bridge, Cycle
from flock_follower.mavlink.parameter_check import ASK
from flock_follower.mavlink.status_texts import WARNING
from flock_follower.mavlink.telemetry import Battery, estimate
from flock_follower.messages import (
    bridge_state,
    FUTURE_TOLERANCE,
    MOTION_TOPIC,
    NANOSECONDS,
    OdometryState,
    set_vector,
    to_nanoseconds,
)
from flock_follower.messages.jumps import jump, ODOMETRY_JUMP
from flock_follower.messages.state_writer import from_state
from flock_follower.nodes.support.bridge_problems import BridgeProblems
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.support.diagnostics import Problem
from flock_follower.nodes.support.even_clock import read_clocks
from flock_follower.nodes.support.inputs import LATCHED_QOS
from flock_follower.nodes.support.publisher_thread import PublisherThread
from flock_follower.nodes.support.runtime import FlockNode

PLACE_TIMEOUT = 1.0  # s: with odometry older than this the place of arming is unknown
STATE_PERIOD = 0.5  # s: a dead bridge leaves its last state latched, so the state is repeated


class BridgeReport:
    """Publishes the data of the bridge, and reports its problems."""

    def __init__(self, node: FlockNode, bridge: Bridge, publisher: PublisherThread) -> None:
        self._node, self._diagnostics = node, node.diagnostics
        self._bridge, self._publisher = bridge, publisher
        self._place: tuple[OdometryState, float, int] | None = None
        """The newest odometry, its time of arrival on the monotonic clock, s, and by how many
        jumps its frame differs from the first."""
        self._events: deque[Callable[[], None]] = deque(maxlen=10_000)
        self._announced = ('', -math.inf)
        self._armed: bool | None = None
        self._armed_frame: int | None = None  # of the place of arming; None: it is unknown
        self._active = False
        self._last_estimate = -math.inf
        self._lines: set[str] = set()  # that were logged
        self._odometry = node.create_publisher(Odometry, 'mavlink/odom', 10)
        self._motions = node.create_publisher(Odometry, MOTION_TOPIC, 10) if (
            bridge.gate.limits.relative_flight) else None
        self._battery = node.create_publisher(BatteryState, 'mavlink/battery', 10)
        self._states = node.create_publisher(String, bridge_state.TOPIC, LATCHED_QOS)
        self._armed_at = node.create_publisher(
            PointStamped, bridge_state.ARMED_AT_TOPIC, LATCHED_QOS)
        self._diagnostics.checks.append(self._collect)
        self.problems = BridgeProblems(node, bridge, lambda: publisher.dropped)

    # From any thread.

    def fault(self, where: str, error: Exception) -> None:
        """Record an exception."""
        self._events.append(lambda: self._diagnostics.internal_error(where, error))

    def refused(self, reason: str, detail: str) -> None:
        """Record a dropped input."""
        self._events.append(lambda: self._diagnostics.reject(reason, detail))

    # The executor's thread.

    def take_odometry(self, state: OdometryState, now: float) -> None:
        """Take the newest odometry, received at ``now``, s, monotonic."""
        before, _, frame = self._place or (state, now, 0)
        self._place = state, now, frame + _changes_frame(before, state)

    # The setpoint thread.

    def on_cycle(self, cycle: Cycle, now: float) -> None:
        """Record a cycle, and publish the state."""
        shown, first = self._diagnostics, cycle.first
        if cycle.sent:
            self._events.append(lambda: shown.rate('stream').tick(now))
        if first is not None:
            self._events.append(lambda: shown.latency('latency').append(now - first.source_time))
        self.problems.take(cycle, now)
        self._announce(now)

    def on_messages(self, messages: list[Any], now: float) -> None:
        """Publish the data of messages that have just arrived from the autopilot."""
        self._announce(now)
        bridge, telemetry = self._bridge, self._bridge.telemetry
        position, attitude, battery = (
            telemetry.local_position, telemetry.attitude, telemetry.battery)
        if position is not None and position.time == now and attitude is not None:
            age = bridge.housekeeping.timesync.age(position.time_boot_ms, to_nanoseconds(now))
            if distrusted := bridge.velocity_fault(now):
                self.refused('mavlink/odom not published', f'its velocity {distrusted}')
            elif known := estimate(position, attitude, age):
                self._send_estimate(*known)
        motion = bridge.motion
        if motion is not None and attitude is not None and attitude.time == now and self._motions:
            self._publish(self._motions, lambda: self._odometry_message(*motion))
        if battery is not None and battery.time == now:
            self._publish(self._battery, lambda: self._battery_message(battery))
        self._publish_arming_place(now)

    def _announce(self, now: float) -> None:
        """Publish the state; log its changes, what ended a flight, and the autopilot's texts."""
        state, (before, announced) = self._bridge.state(now), self._announced
        if state != before or now - announced >= STATE_PERIOD - 1e-3:
            self._announced = state, now
            self._publish(self._states, lambda: String(data=state))
        if state != before:
            self._publisher.submit(lambda: self._info(f'state: {state}'))
        active, situation = self._bridge.gate.permission.phase is Phase.ACTIVE, (
            self._bridge.gate.situation)
        if self._active and not active and situation is not None:
            self._publisher.submit(
                lambda: self._info(f'situation of the last decision: {situation.to_json()}'))
        self._active = active
        for text in self._bridge.texts.new(now):
            log = self._warn if text.severity <= WARNING else self._info
            self._publisher.submit(partial(log, f'autopilot: {text.text}'))

    def _publish_arming_place(self, now: float) -> None:
        """Publish the place of arming by the odometry; NaN if it is not, or no longer, known."""
        status, place = self._bridge.telemetry.status, self._place
        if status is None:
            return
        begun, self._armed = self._armed is False and status.armed, status.armed
        if begun and place is not None and now - place[1] <= PLACE_TIMEOUT:
            self._armed_frame = place[2]
            self._publish(self._armed_at, lambda: _point(place[0]))
        elif begun or (place is not None and self._armed_frame not in (None, place[2])):
            # The topic is latched: a planner that starts later must not take the old height.
            self._armed_frame = None
            self._publish(self._armed_at, lambda: PointStamped(point=Point(
                x=math.nan, y=math.nan, z=math.nan)))

    def _send_estimate(self, state: OdometryState, valid: float) -> None:
        if valid <= self._last_estimate:
            # TIMESYNC has just corrected the age of messages, so the stamp steps back.
            self.refused('mavlink/odom not newer', 'a stamp before that of the last one')
            return
        self._last_estimate = valid
        self._publish(self._odometry, lambda: self._odometry_message(state, valid))

    def _publish(self, publisher: Publisher, make: Callable[[], Any]) -> None:
        """Make a message in the publisher thread and publish it; odometry if subscribed."""
        def publish() -> None:
            if self._node.context.ok() and (
                    publisher is not self._odometry or publisher.get_subscription_count()):
                publisher.publish(make())
        self._publisher.submit(publish)

    # The publisher thread.

    def _info(self, text: str) -> None:
        self._node.get_logger().info(text)

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text)

    def _odometry_message(self, state: OdometryState, valid: float) -> Any:
        """Return the message of a state that was valid at a time, s, on the monotonic clock."""
        system, monotonic = read_clocks(self._node)
        waited = max(0, to_nanoseconds(monotonic - valid))
        return from_state(make, state._replace(stamp=max(0, system - waited)))

    def _battery_message(self, battery: Battery) -> BatteryState:
        message = BatteryState(
            voltage=battery.voltage, percentage=battery.remaining, present=True,
            # In ROS a current that discharges is negative.
            current=-battery.current, temperature=math.nan,
            charge=math.nan, capacity=math.nan, design_capacity=math.nan)
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message

    # The executor's thread.

    def _collect(self, now: float) -> Problem | None:
        """Run the events; log once each parameter that differs from its recommended value."""
        while self._events:
            self._events.popleft()()
        result = self._bridge.housekeeping.parameters.result()
        # While some are unanswered, more lines may follow.
        lines = () if result is None else (
            *(f'parameter {line}' for line in (*result.lines, *result.missing)),
            *filter(None, (result.unproven, f'no answer about {", ".join(result.unread)}: {ASK}'
                           if result.unread else '')))
        good = result is not None and not (lines or result.unanswered)
        if result is not None and good:
            lines = (f'{result.answered} parameters of the autopilot are as recommended',)
        for line in lines:
            if line not in self._lines:
                (self._info if good else self._warn)(line)
        self._lines |= {*lines}
        return None


def _changes_frame(before: OdometryState, after: OdometryState) -> bool:
    """
    Return whether odometry has another frame than before, by ODOMETRY_JUMP.

    A message that is slightly out of order does not count as another frame.
    """
    elapsed = (after.stamp - before.stamp) / NANOSECONDS
    return after.frame != before.frame or elapsed < -FUTURE_TOLERANCE or (
        jump(before, after, elapsed, ODOMETRY_JUMP) > 0.0)


def _point(state: OdometryState) -> PointStamped:
    message = PointStamped()
    message.header.stamp = nanoseconds_to_stamp(state.stamp)
    message.header.frame_id = state.frame
    set_vector(message.point, state.position)
    return message
