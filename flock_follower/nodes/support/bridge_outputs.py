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

"""Topics and log of the bridge node: state, place of arming, estimate, battery, texts."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any

from geometry_msgs.msg import PointStamped
from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import all as mavlink
from rclpy.publisher import Publisher
from sensor_msgs.msg import BatteryState
from std_msgs.msg import String

from flock_follower.mavlink.bridge import Bridge
from flock_follower.mavlink.telemetry import Battery, estimate
from flock_follower.messages import from_state, MOTION_TOPIC, OdometryState, set_vector
from flock_follower.nodes.support.bridge_report import BridgeReport
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.support.inputs import LATCHED_QOS
from flock_follower.nodes.support.publisher_thread import PublisherThread
from flock_follower.nodes.support.runtime import FlockNode

PLACE_TIMEOUT = 1.0  # s: with odometry older than this the place of arming is unknown
STATE_PERIOD = 0.5  # s: a dead bridge leaves its last state latched, so it has to be repeated


class BridgeOutputs:
    """
    Publishes in the publisher thread; the setpoint thread calls ``on_messages`` and ``on_cycle``.

    Both decide from the bridge's state, and submit functions that create a message.
    """

    def __init__(self, node: FlockNode, bridge: Bridge, report: BridgeReport,
                 publisher: PublisherThread) -> None:
        self._node = node
        self._bridge = bridge
        self._report = report
        self._publisher = publisher
        self._mode = ''
        self._last_estimate = -math.inf
        self._odometry = node.create_publisher(Odometry, 'mavlink/odom', 10)
        self._motions = node.create_publisher(Odometry, MOTION_TOPIC, 10) if (
            bridge.gate.limits.relative_flight) else None
        self._battery = node.create_publisher(BatteryState, 'mavlink/battery', 10)
        self._states = node.create_publisher(String, 'mavlink_bridge/state', LATCHED_QOS)
        self._armed_at = node.create_publisher(
            PointStamped, 'mavlink_bridge/armed_at', LATCHED_QOS)
        self._announced = ('', -math.inf)
        self._armed: bool | None = None
        self.place: tuple[OdometryState, float] | None = None
        """The newest odometry, and when it came by the monotonic clock, s."""

    # The setpoint thread.

    def on_messages(self, now: float) -> None:
        """Publish what has just arrived from the autopilot."""
        self.on_cycle(now)
        telemetry = self._bridge.telemetry
        position, attitude, battery = (
            telemetry.local_position, telemetry.attitude, telemetry.battery)
        if position is not None and position.time == now and attitude is not None:
            timesync = self._bridge.housekeeping.timesync
            age = timesync.age(position.time_boot_ms, round(now * 1e9))
            if distrusted := self._bridge.distrusted(now):
                self._report.refused('mavlink/odom not published', f'its velocity {distrusted}')
            elif known := estimate(position, attitude, age):
                self._send_estimate(*known)
        motion = self._bridge.motion
        if motion is not None and attitude is not None and attitude.time == now and self._motions:
            self._publish(self._motions, lambda: self._odometry_message(*motion))
        if battery is not None and battery.time == now:
            self._publish(self._battery, lambda: self._battery_state(battery))
        self._send_arming(now)

    def on_cycle(self, now: float) -> None:
        """Publish the state; log the autopilot's texts, and state and mode if they changed."""
        state, (before, announced) = self._bridge.state(now), self._announced
        if state != before or now - announced >= STATE_PERIOD - 1e-3:
            self._announced = state, now
            self._publish(self._states, lambda: String(data=state))
        if state != before:
            self._log(f'state: {state}')
        for text in self._bridge.texts.new():
            self._log(f'autopilot: {text.text}',
                      warning=text.severity <= mavlink.MAV_SEVERITY_WARNING)
        status, dialect = self._bridge.telemetry.status, self._bridge.telemetry.dialect
        if status is not None and dialect is not None:
            armed = 'armed' if status.armed else 'disarmed'
            mode = f'autopilot: {dialect.title}, {status.mode}, {armed}'
            if mode != self._mode:
                self._mode = mode
                self._log(mode)

    def _send_arming(self, now: float) -> None:
        """Publish the place of arming by the odometry, if there is any."""
        status, place = self._bridge.telemetry.status, self.place
        if status is None or status.armed == self._armed:
            return
        begun, self._armed = self._armed is False and status.armed, status.armed
        if begun and place is not None and now - place[1] <= PLACE_TIMEOUT:
            self._publish(self._armed_at, lambda: _point(place[0]))

    def _send_estimate(self, state: OdometryState, valid: float) -> None:
        if valid <= self._last_estimate:
            # TIMESYNC has just corrected the age of messages, so the stamp steps back.
            self._report.refused('mavlink/odom not newer', 'a stamp before that of the last one')
            return
        self._last_estimate = valid
        self._publish(self._odometry, lambda: self._odometry_message(state, valid))

    def _publish(self, publisher: Publisher, make: Callable[[], Any]) -> None:
        """Have the publisher thread make a message and publish it; odometry if subscribed."""
        def publish() -> None:
            if self._node.context.ok() and (
                    publisher is not self._odometry or publisher.get_subscription_count()):
                publisher.publish(make())
        self._publisher.submit(publish)

    def _log(self, text: str, warning: bool = False) -> None:
        """Have the publisher thread log a text."""
        def log() -> None:
            if warning:
                self._node.get_logger().warning(text)
            else:
                self._node.get_logger().info(text)
        self._publisher.submit(log)

    # The publisher thread.

    def _odometry_message(self, state: OdometryState, valid: float) -> Any:
        """Return the message of a state of a time, s, on the monotonic clock."""
        return from_state(make, state._replace(stamp=self._stamp(valid)))

    def _stamp(self, valid: float) -> int:
        """Return the ROS time, ns, of a time on the monotonic clock, s, never in the future."""
        system, monotonic = self._node.read_clocks()
        return max(0, system - max(0, round((monotonic - valid) * 1e9)))

    def _battery_state(self, battery: Battery) -> BatteryState:
        message = BatteryState(
            voltage=battery.voltage, percentage=battery.remaining, present=True,
            # In ROS a current that discharges is negative.
            current=-battery.current, temperature=math.nan,
            charge=math.nan, capacity=math.nan, design_capacity=math.nan)
        message.header.stamp = self._node.get_clock().now().to_msg()
        if battery.current > 0.0:
            message.power_supply_status = BatteryState.POWER_SUPPLY_STATUS_DISCHARGING
        return message


def _point(state: OdometryState) -> PointStamped:
    message = PointStamped()
    message.header.stamp = nanoseconds_to_stamp(state.stamp)
    message.header.frame_id = state.frame
    set_vector(message.point, state.position)
    return message
