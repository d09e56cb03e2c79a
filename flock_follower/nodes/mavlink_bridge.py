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
The MAVLink bridge node: commands and odometry in, a 20 Hz stream of setpoints out.

Subscribes ``command/trajectory`` and ``odom``, publishes ``mavlink/odom``, ``mavlink/battery`` and
``mavlink_bridge/state``, serves ``mavlink_bridge/arm``, ``offboard``, ``takeoff`` and ``land``.
The stream runs in a thread of its own, on the monotonic clock: it waits for neither the executor
nor ``/clock``. What is sent is decided in ``flock_follower.mavlink``.
"""

from __future__ import annotations

from collections import deque
import math
import os
import sys
import time
from typing import Any

from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import common as mavlink
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import BatteryState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_follower.geometry import quaternion_to_matrix, yaw_from_quaternion
from flock_follower.mavlink.bridge import Bridge, Cycle
from flock_follower.mavlink.commands import Request
from flock_follower.mavlink.gate import GateLimits
from flock_follower.mavlink.link import Link, Signing
from flock_follower.mavlink.odometry import OdometryForwarder, OdometrySample
from flock_follower.mavlink.setpoint_gate import SetpointGate
from flock_follower.mavlink.stream import Stream
from flock_follower.mavlink.telemetry import Attitude, Battery, LocalPosition
from flock_follower.mavlink.transport import open_transport
from flock_follower.messages import from_odometry, from_trajectory, OdometryState, stamp_age
from flock_follower.nodes.bridge_report import BridgeReport
from flock_follower.nodes.conversions import to_odometry
from flock_follower.nodes.middleware import avoid_shared_memory, shares_memory
from flock_follower.nodes.runtime import FlockNode, never_block_output, run
from flock_follower.parameters.mavlink_bridge import build, origin, recommendations, SPECS

# Best effort takes what reliable and best-effort publishers send alike; only the newest counts.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

STATE_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

STATE_PERIOD = 0.5  # s: a dead bridge leaves its last state latched, so who listens wants repeats
ATTITUDE_TIMEOUT = 0.1  # s: an older one is no part of the odometry of now


class MavlinkBridge(FlockNode):
    """Feeds the bridge from topics and services, and tells what it does."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('mavlink_bridge', **kwargs)
        self._settings = self.declare(SPECS, build)
        values = self._settings.values
        if values['forward_odometry'] and (
                self.resolve_topic_name('odom') == self.resolve_topic_name('mavlink/odom')):
            raise ValueError('forward_odometry = true: odom is the estimate of the autopilot, '
                             'which must not be fed back to it')
        signing = (Signing.from_file(values['signing_key_file'], time.time())
                   if values['signing_key_file'] else None)
        link = Link(open_transport(values['connection']), autopilot=values['autopilot'],
                    signing=signing, **{name: values[name] for name in (
                        'target_system', 'target_component', 'source_system',
                        'source_component')})
        self._bridge = Bridge(
            link, SetpointGate(velocity_source=values['velocity_source']), now=time.monotonic(),
            setpoint_mode=values['setpoint_mode'],
            forwarder=(OdometryForwarder(values['odometry_rate']) if values['forward_odometry']
                       else None),
            recommendations=(recommendations(values['forward_odometry'])
                             if values['check_parameters'] else {}),
            estimate_rate=values['telemetry_rate'], origin=origin(values['global_origin']))
        self._applied: GateLimits | None = None
        self._odom_frame = 'odom'
        self._mode = ''
        self._pending: deque[tuple[Request, Future]] = deque()
        self._stream = Stream(self._bridge, 1.0 / values['stream_rate'], self._heard, self._cycled,
                              lambda error: self._report.fault(error))
        self._report = BridgeReport(self, self.diagnostics, self._bridge, self._stream)

        self.subscribe(MultiDOFJointTrajectory, 'command/trajectory', self._take_command, NEWEST,
                       required=False)
        self.subscribe(Odometry, 'odom', self._take_odom, NEWEST, required=(
            values['velocity_source'] == 'odom' or values['forward_odometry']))
        self._odometry = self.create_publisher(Odometry, 'mavlink/odom', 10)
        self._battery = self.create_publisher(BatteryState, 'mavlink/battery', 10)
        self._states = self.create_publisher(String, 'mavlink_bridge/state', STATE_QOS)
        self._announced = ('', -math.inf)
        # A group of their own: they wait for the autopilot while everything else goes on.
        waiting = ReentrantCallbackGroup()
        for kind, name, callback in (
                (SetBool, 'arm', self._serve_arm), (SetBool, 'offboard', self._serve_offboard),
                (Trigger, 'takeoff', self._serve_takeoff), (Trigger, 'land', self._serve_land)):
            self.create_service(kind, f'mavlink_bridge/{name}', callback, callback_group=waiting)
        self._apply()
        self._stream.start()
        self.get_logger().info(f'waiting for system id {values["target_system"]} on '
                               f'{values["connection"]}')
        if shares_memory():
            self.get_logger().warning(
                'Fast DDS shares memory with other processes here: to begin to talk to one can '
                'stop the setpoints for up to 1 s; config/fastdds_udp.xml keeps it from that')

    def destroy_node(self) -> None:
        """Brake, end the stream, release the port."""
        self._stream.stop()
        self._bridge.link.close()
        super().destroy_node()

    # The executor's side.

    def _take_command(self, message: MultiDOFJointTrajectory) -> None:
        now = time.monotonic()
        command = from_trajectory(message, self._odom_frame)
        age, source_age = command.ages(self.get_clock().now().nanoseconds)
        if command.stamp > 0:
            self._report.stamped('command/trajectory', source_age)
        refused = self._bridge.on_command(
            command.acceleration, command.yaw, age, now, source_age=source_age,
            yaw_rate=command.yaw_rate)
        if refused:
            self.diagnostics.reject(f'command {refused}', f'stamp {age:.3f} s old')

    def _take_odom(self, message: Odometry) -> None:
        now = time.monotonic()
        state = from_odometry(message, self._settings.values['odom_twist_frame'])
        age = stamp_age(state.stamp, self.get_clock().now().nanoseconds)
        if state.stamp > 0:
            self._report.stamped('odom', age)
        self._odom_frame = state.frame
        refused = self._bridge.on_odometry(
            state.velocity, yaw_from_quaternion(state.quaternion), age, now)
        if refused:
            self.diagnostics.reject(f'odom {refused}', f'stamp {age:.3f} s old')
        if self._settings.values['forward_odometry']:
            self._forward(state, now, age)

    def _forward(self, state: OdometryState, now: float, age: float) -> None:
        refused = self._bridge.forward(OdometrySample(
            now - age, state.position, state.quaternion, state.velocity, state.angular_velocity,
            state.pose_covariance, state.velocity_covariance, state.twist_covariance[3:, 3:]), now)
        if refused:
            self.diagnostics.reject(f'odom {refused}', f'stamp {age:.3f} s old')
        else:
            self._stream.wake()

    async def _serve_arm(self, request: SetBool.Request,
                         response: SetBool.Response) -> SetBool.Response:
        return await self._serve(self._bridge.arm(request.data, time.monotonic()), response)

    async def _serve_offboard(self, request: SetBool.Request,
                              response: SetBool.Response) -> SetBool.Response:
        return await self._serve(self._bridge.offboard(request.data, time.monotonic()), response)

    async def _serve_takeoff(self, _: Trigger.Request,
                             response: Trigger.Response) -> Trigger.Response:
        height = self._settings.values['takeoff_height']
        return await self._serve(self._bridge.takeoff(height, time.monotonic()), response)

    async def _serve_land(self, _: Trigger.Request,
                          response: Trigger.Response) -> Trigger.Response:
        return await self._serve(self._bridge.land(time.monotonic()), response)

    async def _serve(self, request: Request, response: Any) -> Any:
        if request.outcome is None:
            answered = Future()
            self._pending.append((request, answered))
            await answered
        assert request.outcome is not None
        response.success, response.message = request.outcome
        log = self.get_logger()
        if response.success:
            log.info(response.message)
        else:
            log.warning(response.message)
        return response

    # The stream's side.

    def _heard(self, messages: list[Any], now: float) -> None:
        if not self.context.ok():
            return
        telemetry = self._bridge.telemetry
        position, attitude, battery = (
            telemetry.local_position, telemetry.attitude, telemetry.battery)
        if position is not None and position.time == now and attitude is not None and (
                now - attitude.time <= ATTITUDE_TIMEOUT):
            self._publish_odometry(position, attitude)
        if battery is not None and battery.time == now:
            self._publish_battery(battery)
        self._announce(now)
        self._tell(messages)

    def _announce(self, now: float) -> None:
        """Publish whether we are flying, where that changed or was last said a while ago."""
        state, (before, told) = self._bridge.state(now), self._announced
        if state != before or now - told >= STATE_PERIOD - 1e-3:
            self._announced = state, now
            self._states.publish(String(data=state))
            if state != before:
                self.get_logger().info(f'state: {state}')

    def _tell(self, messages: list[Any]) -> None:
        log = self.get_logger()
        for message in messages:
            if message.get_type() == 'STATUSTEXT':
                if message.severity <= mavlink.MAV_SEVERITY_WARNING:
                    log.warning(f'autopilot: {message.text.strip()}')
                else:
                    log.info(f'autopilot: {message.text.strip()}')
        status, dialect = self._bridge.telemetry.status, self._bridge.dialect
        if status is not None and dialect is not None:
            mode = (f'autopilot: {dialect.title}, {status.mode}, '
                    f'{"armed" if status.armed else "disarmed"}')
            if mode != self._mode:
                log.info(mode)
            self._mode = mode

    def _cycled(self, cycle: Cycle, now: float) -> None:
        self._report.cycle(cycle, now)
        self._announce(now)
        self._apply()
        for _ in range(len(self._pending)):
            request, answered = self._pending.popleft()
            if request.outcome is None:
                self._pending.append((request, answered))
                continue
            answered.set_result(None)
            if self.executor is not None:
                self.executor.wake()

    def _apply(self) -> None:
        limits = self._settings.current
        if limits is not self._applied:
            self._bridge.set_limits(limits)
            self._applied = limits

    def _publish_odometry(self, position: LocalPosition, attitude: Attitude) -> None:
        rotation = quaternion_to_matrix(attitude.quaternion)
        self._odometry.publish(to_odometry(
            self.get_clock().now().to_msg(), 'odom', 'base_link', position.position,
            attitude.quaternion, rotation.T @ position.velocity, attitude.angular_velocity))

    def _publish_battery(self, battery: Battery) -> None:
        message = BatteryState(
            voltage=battery.voltage, percentage=battery.remaining, present=True,
            # In ROS a current that discharges is negative.
            current=-battery.current, temperature=battery.temperature,
            charge=math.nan, capacity=math.nan, design_capacity=math.nan,
            cell_voltage=list(battery.cell_voltages))
        message.header.stamp = self.get_clock().now().to_msg()
        if battery.current > 0.0:
            message.power_supply_status = BatteryState.POWER_SUPPLY_STATUS_DISCHARGING
        self._battery.publish(message)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    never_block_output()  # the setpoints flow from this process
    avoid_shared_memory(os.environ)
    return run(MavlinkBridge, args)


if __name__ == '__main__':
    sys.exit(main())
