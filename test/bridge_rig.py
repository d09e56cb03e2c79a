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

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import itertools
import math
from pathlib import Path
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
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import BatteryState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from flock_desk.runs.processes import free_udp_port
from flock_follower.geometry import quaternion_enu_flu_to_ned_frd, quaternion_from_yaw
from flock_follower.messages import set_quaternion, set_vector
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

ROOT = Path(__file__).parents[1]
SO_TIMESTAMPNS = 35  # of Linux; the socket module does not name it
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
COMMAND = MultiDOFJointTrajectory
NUMBERS = itertools.count()


def make_command(stamp: int, acceleration: tuple[float, ...], yaw: float = 0.0,
                 frame: str = 'odom', offset: int = 0) -> MultiDOFJointTrajectory:
    message = MultiDOFJointTrajectory(joint_names=['base_link'])
    message.header.stamp, message.header.frame_id = nanoseconds_to_stamp(stamp), frame
    point = MultiDOFJointTrajectoryPoint(
        transforms=[Transform()], accelerations=[Twist()], velocities=[Twist()])
    set_quaternion(point.transforms[0].rotation, quaternion_from_yaw(yaw))
    set_vector(point.accelerations[0].linear, acceleration)
    point.time_from_start.nanosec = offset
    message.points = [point]
    return message


class Rig:
    """The node's process, its ROS surroundings, and an autopilot's end of the wire."""

    def __init__(self, *parameters: str) -> None:
        # A namespace of its own: several rigs may live side by side.
        self.namespace = f'rig{next(NUMBERS)}'
        self.wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.wire.bind(('127.0.0.1', 0))
        self.wire.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.address = ('127.0.0.1', free_udp_port())
        self.url = f'udpin:127.0.0.1:{self.address[1]}'
        self.codec = mavlink.MAVLink(None, 1, 1)
        # A port was another process's before: what still comes for that one is no message.
        self.codec.robust_parsing = True
        self.node = Node('surroundings', namespace=self.namespace)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.commands = self.node.create_publisher(COMMAND, 'command/trajectory', 1)
        self.odom = self.node.create_publisher(Odometry, 'odom', 1)
        self.status = DiagnosticStatus()
        self.odometry: list[Odometry] = []
        self.batteries: list[BatteryState] = []
        self.states: list[str] = []
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._told, 10)
        self.node.create_subscription(Odometry, 'mavlink/odom', self.odometry.append, 10)
        self.node.create_subscription(
            BatteryState, 'mavlink/battery', self.batteries.append, 10)
        self.node.create_subscription(
            String, 'mavlink_bridge/state', lambda message: self.states.append(message.data),
            QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self.received: list[tuple[float, Any]] = []
        self.flies = True
        self.heartbeats = True
        self.airborne = True
        self.firmware = mavlink.MAV_AUTOPILOT_PX4
        self.custom_mode = 6 << 16
        self.velocity_ned: tuple[float, ...] | None = None
        """What the autopilot tells; None: the velocity of the odometry."""
        self._odom_ned: tuple[float, ...] = (0.0, 0.0, 0.0)
        self.yaw = 0.0
        self._due: dict[str, float] = {}
        self.processes: list[subprocess.Popen[str]] = []
        self.process = self.start('-m', 'flock_follower.nodes.mavlink_bridge', '--ros-args',
                                  '-r', f'__ns:=/{self.namespace}',
                                  '-p', f'connection:={self.url}',
                                  # It stands still and says that it moves.
                                  '-p', 'odom_twist_frame:=child',
                                  '-p', 'wind_compensation:=never', *parameters)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE,
                                   stderr=subprocess.STDOUT, text=True, cwd=ROOT)
        self.processes.append(process)
        return process

    def _told(self, message: DiagnosticArray) -> None:
        if message.status[0].name == f'{self.namespace}/mavlink_bridge':
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
        if self.heartbeats and self._is_due('heartbeat', 1.0):
            self.send(mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, self.firmware, 129, self.custom_mode,
                mavlink.MAV_STATE_ACTIVE, 3))
            self.send(mavlink.MAVLink_sys_status_message(
                0, 0, 0, 0, 15200, 1850, 81, 0, 0, 0, 0, 0, 0))
        if self._is_due('height', 0.05):  # 3 m above home, in the air
            self.send(mavlink.MAVLink_extended_sys_state_message(
                0, mavlink.MAV_LANDED_STATE_IN_AIR if self.airborne else
                mavlink.MAV_LANDED_STATE_ON_GROUND))
            self.send(mavlink.MAVLink_scaled_pressure_message(0, 955.5, 0.0, 1500))
            self.send(mavlink.MAVLink_home_position_message(
                0, 0, 488_000, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0))
            self.send(mavlink.MAVLink_global_position_int_message(
                0, 0, 0, 491_000, 3_000, 0, 0, 0, 0))
        if self._is_due('position', 0.02):
            x, y, z, w = quaternion_enu_flu_to_ned_frd(quaternion_from_yaw(self.yaw)).tolist()
            self.send(mavlink.MAVLink_attitude_quaternion_message(0, w, x, y, z, 0.0, 0.0, 0.1))
            self.send(mavlink.MAVLink_local_position_ned_message(
                0, 1.0, 2.0, -3.0, *(self.velocity_ned or self._odom_ned)))

    def run(self, seconds: float, acceleration: tuple[float, ...] | None = None, *,
            velocity: tuple[float, float, float] | None = (0.0, 0.0, 0.0), yaw: float = 0.0,
            until: Callable[[], object] = lambda: False, **options: Any) -> None:
        """Publish commands at 10 Hz and odometry of a body velocity at 50 Hz, and listen."""
        end = time.monotonic() + seconds
        age = round(options.pop('age', 0.0) * 1e9)
        while time.monotonic() < end and not until():
            if self.flies:
                self._fly()
            stamp = self.node.get_clock().now().nanoseconds
            if velocity is not None and self._is_due('odom', 0.02):
                self._odom_ned = (
                    math.sin(yaw) * velocity[0] + math.cos(yaw) * velocity[1],
                    math.cos(yaw) * velocity[0] - math.sin(yaw) * velocity[1], -velocity[2])
                self.odom.publish(to_odometry(
                    nanoseconds_to_stamp(stamp), 'odom', 'base_link', (0, 0, 2),
                    quaternion_from_yaw(yaw), velocity))
            if acceleration is not None and self._is_due('command', 0.1):
                self.commands.publish(make_command(stamp - age, acceleration, yaw, **options))
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
                'COM_OF_LOSS_T', 'COM_OBL_RC_ACT', 'GUID_TIMEOUT'):
            self.send(mavlink.MAVLink_param_value_message(
                message.param_id.encode(), 0.5, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0))

    def wait(self, condition: Callable[[], object], *arguments: Any, **options: Any) -> None:
        self.run(DEADLINE, *arguments, **options,
                 until=lambda: condition() or self.process.poll() is not None)
        if not condition():
            self.process.terminate()
            pytest.fail(f'waited in vain; {self.status.message}; {self.values}; '
                        f'{self.process.communicate(timeout=5.0)[0]}')

    def permit(self, **options: Any) -> None:
        """Ask for offboard mode, and wait until the bridge says that it flies the vehicle."""
        self.wait(lambda: self.values.get('link') == 'alive', **options)
        answer = self.call('mavlink_bridge/offboard', True, **options)
        assert answer.success, answer.message
        self.wait(lambda: self.states[-1:] == ['ACTIVE'], **options)

    def setpoints(self, since: float = 0.0) -> list[Any]:
        return [m for t, m in self.received
                if t >= since and m.get_type() == 'SET_POSITION_TARGET_LOCAL_NED']

    def wait_for_setpoint(self, east: float, north: float, up: float, *arguments: Any,
                          **options: Any) -> Any:
        """Return the setpoint once it is this; how hard it brakes depends on its inputs' age."""
        def arrived() -> bool:
            last = self.setpoints()[-1:]
            return bool(last) and [last[0].afy, last[0].afx, -last[0].afz] == pytest.approx(
                [east, north, up], abs=1e-6)
        self.wait(arrived, *arguments, **options)
        return self.setpoints()[-1]

    def hears_odometry(self) -> bool:
        # Until it has heard any, the node rightly judges by the velocity of the autopilot.
        return float(self.values.get('odom_hz', 0.0)) > 20.0

    def commanded(self) -> bool:
        last = self.setpoints()[-1:]
        return bool(last) and math.hypot(last[0].afx, last[0].afy) > 0.2

    def call(self, service: str, value: bool | None = None, **options: Any) -> Any:
        """Call a SetBool, or without a value a Trigger, and return its response."""
        kind, request = (Trigger, Trigger.Request()) if value is None else (
            SetBool, SetBool.Request(data=value))
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready, **options)
        future = client.call_async(request)
        self.wait(future.done, **options)
        return future.result()

    def set_parameter(self, name: str, value: float) -> Any:
        client = self.node.create_client(SetParameters, 'mavlink_bridge/set_parameters')
        self.wait(client.service_is_ready)
        future = client.call_async(SetParameters.Request(parameters=[Parameter(
            name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE,
                                            double_value=value))]))
        self.wait(future.done)
        return future.result().results[0]

    def close(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                process.kill()
            process.communicate()
        self.executor.shutdown()
        self.node.destroy_node()
        self.wire.close()


@contextmanager
def made_rigs() -> Iterator[Callable[..., Rig]]:
    """Return what makes rigs, all of which end with it."""
    rigs: list[Rig] = []

    def make(*parameters: str) -> Rig:
        rigs.append(Rig(*parameters))
        return rigs[-1]
    yield make
    for rig in rigs:
        rig.close()


def start_autopilot(rig: Rig, *arguments: str, recommended: bool = True
                    ) -> subprocess.Popen[str]:
    """Start an embedded autopilot, as a user sets it: ArduPilot's own GUID_TIMEOUT is refused."""
    rig.flies = False
    if recommended and 'arducopter' in arguments:
        arguments = ('--param-file', 'config/ardupilot.parm', *arguments)
    return rig.start('-m', 'flock_desk.autopilot', '--connect',
                     f'127.0.0.1:{rig.address[1]}', *arguments)
