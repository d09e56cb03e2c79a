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

"""The bridge node as a process, with everything it talks to: topics, services, an autopilot."""

from __future__ import annotations

from collections.abc import Callable
import math
import select
import socket
import struct
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Transform, Twist
from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import all as mavlink
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from flock_desk.runs.processes import free_udp_port
from flock_follower.geometry import quaternion_enu_flu_to_ned_frd, quaternion_from_yaw
from flock_follower.messages import set_quaternion, set_vector
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

SO_TIMESTAMPNS = 35  # of Linux; the socket module does not name it
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
COMMAND = MultiDOFJointTrajectory
OFFBOARD = 6 << 16  # of PX4


def make_command(stamp: int, acceleration: tuple[float, ...],
                 yaw: float = 0.0) -> MultiDOFJointTrajectory:
    message = MultiDOFJointTrajectory(joint_names=['base_link'])
    message.header.stamp, message.header.frame_id = nanoseconds_to_stamp(stamp), 'odom'
    point = MultiDOFJointTrajectoryPoint(
        transforms=[Transform()], accelerations=[Twist()], velocities=[Twist()])
    set_quaternion(point.transforms[0].rotation, quaternion_from_yaw(yaw))
    set_vector(point.accelerations[0].linear, acceleration)
    message.points = [point]
    return message


class Rig:
    """The node's process, its ROS surroundings, and an autopilot in OFFBOARD at the wire's end."""

    def __init__(self) -> None:
        self.wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.wire.bind(('127.0.0.1', 0))
        self.wire.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.address = ('127.0.0.1', free_udp_port())
        self.codec = mavlink.MAVLink(None, 1, 1)
        # A port was another process's before: what still comes for that one is no message.
        self.codec.robust_parsing = True
        self.node = Node('planner', namespace='rig')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.commands = self.node.create_publisher(COMMAND, 'command/trajectory', 1)
        self.odom = self.node.create_publisher(Odometry, 'odom', 1)
        self.status = DiagnosticStatus()
        self.states: list[str] = []
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._told, 10)
        self.node.create_subscription(
            String, 'mavlink_bridge/state', lambda message: self.states.append(message.data),
            QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self.received: list[tuple[float, Any]] = []
        self._odom_ned: tuple[float, ...] = (0.0, 0.0, 0.0)
        self.yaw = 0.0
        self._due: dict[str, float] = {}
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args',
             '-r', '__ns:=/rig', '-p', f'connection:=udpin:127.0.0.1:{self.address[1]}',
             # It stands still and says that it moves.
             '-p', 'odom_twist_frame:=child', '-p', 'wind_compensation:=never'],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def _told(self, message: DiagnosticArray) -> None:
        if message.status[0].name == 'rig/mavlink_bridge':
            self.status = message.status[0]

    @property
    def values(self) -> dict[str, str]:
        return {v.key: v.value for v in self.status.values}

    def send(self, message: Any) -> None:
        self.wire.sendto(message.pack(self.codec), self.address)

    def _is_due(self, name: str, period: float) -> bool:
        now = time.monotonic()
        if now < self._due.get(name, 0.0):
            return False
        self._due[name] = now + period
        return True

    def _fly(self) -> None:
        if self._is_due('heartbeat', 1.0):
            self.send(mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 129, OFFBOARD,
                mavlink.MAV_STATE_ACTIVE, 3))
        if self._is_due('height', 0.05):  # 3 m above home, in the air
            self.send(mavlink.MAVLink_extended_sys_state_message(
                0, mavlink.MAV_LANDED_STATE_IN_AIR))
            self.send(mavlink.MAVLink_scaled_pressure_message(0, 955.5, 0.0, 1500))
            self.send(mavlink.MAVLink_home_position_message(
                0, 0, 488_000, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0))
            self.send(mavlink.MAVLink_global_position_int_message(
                0, 0, 0, 491_000, 3_000, 0, 0, 0, 0))
        if self._is_due('position', 0.02):
            x, y, z, w = quaternion_enu_flu_to_ned_frd(quaternion_from_yaw(self.yaw)).tolist()
            self.send(mavlink.MAVLink_attitude_quaternion_message(0, w, x, y, z, 0.0, 0.0, 0.1))
            self.send(mavlink.MAVLink_local_position_ned_message(
                0, 1.0, 2.0, -3.0, *self._odom_ned))

    def run(self, seconds: float, acceleration: tuple[float, ...] | None = None, *,
            forward: float = 0.0, age: float = 0.0,
            until: Callable[[], object] = lambda: False) -> None:
        """Publish commands at 10 Hz and odometry of a forward speed at 50 Hz, and listen."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            self._fly()
            stamp = self.node.get_clock().now().nanoseconds
            if self._is_due('odom', 0.02):
                self._odom_ned = (
                    math.sin(self.yaw) * forward, math.cos(self.yaw) * forward, 0.0)
                self.odom.publish(to_odometry(
                    nanoseconds_to_stamp(stamp), 'odom', 'base_link', (0, 0, 2),
                    quaternion_from_yaw(self.yaw), (forward, 0.0, 0.0)))
            if acceleration is not None and self._is_due('command', 0.1):
                self.commands.publish(make_command(
                    stamp - round(age * 1e9), acceleration, self.yaw))
            self.executor.spin_once(timeout_sec=0.0)
            if select.select([self.wire], [], [], 0.002)[0]:
                data, ancillary, _, _ = self.wire.recvmsg(4096, 64)
                # When it reached this machine's socket, not when this loop came round to it.
                seconds, nanoseconds = struct.unpack('qq', ancillary[0][2])
                ago = time.time() - seconds - nanoseconds * 1e-9
                arrived = time.monotonic() - ago  # a pause in between makes it no earlier
                for message in self.codec.parse_buffer(data) or []:
                    self.received.append((arrived, message))
                    self.answer(message)

    def answer(self, message: Any) -> None:
        """Tell how long the last setpoint is flown: without it offboard is refused."""
        if message.get_type() == 'PARAM_REQUEST_READ' and message.param_id in (
                'COM_OF_LOSS_T', 'COM_OBL_RC_ACT'):
            self.send(mavlink.MAVLink_param_value_message(
                message.param_id.encode(), 0.5, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0))

    def wait(self, condition: Callable[[], object], *arguments: Any, **options: Any) -> None:
        self.run(DEADLINE, *arguments, **options,
                 until=lambda: condition() or self.process.poll() is not None)
        if not condition():
            self.process.terminate()
            pytest.fail(f'waited in vain; {self.status.message}; {self.values}; '
                        f'{self.process.communicate(timeout=5.0)[0]}')

    def permit(self) -> None:
        """Ask for offboard mode, and wait until the bridge says that it flies the vehicle."""
        self.wait(lambda: self.values.get('link') == 'alive')
        answer = self.call(SetBool, 'mavlink_bridge/offboard', SetBool.Request(data=True))
        assert answer.success, answer.message
        self.wait(lambda: self.states[-1:] == ['ACTIVE'])

    def setpoints(self, since: float = 0.0) -> list[Any]:
        return [m for t, m in self.received
                if t >= since and m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED']

    def wait_for_setpoint(self, east: float, north: float, *arguments: Any,
                          **options: Any) -> Any:
        """Return the setpoint once it is this; how hard it brakes depends on its inputs' age."""
        def arrived() -> bool:
            last = self.setpoints()[-1:]
            return bool(last) and [last[0].afy, last[0].afx, last[0].afz] == pytest.approx(
                [east, north, 0.0], abs=1e-6)
        self.wait(arrived, *arguments, **options)
        return self.setpoints()[-1]

    def call(self, kind: Any, service: str, request: Any) -> Any:
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready)
        future = client.call_async(request)
        self.wait(future.done)
        return future.result()

    def set_parameter(self, name: str, value: float) -> Any:
        return self.call(SetParameters, 'mavlink_bridge/set_parameters', SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()])).results[0]

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        self.executor.shutdown()
        self.node.destroy_node()
        self.wire.close()
