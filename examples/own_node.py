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
The planner in a node of your own, for a vehicle that takes accelerations in another way.

    python examples/own_node.py --ros-args -p use_sim_time:=true -r leader/odom:=truth/neighbors
    python -m flock_follower.nodes.replay bags/sample      # beside it: a leader to follow
"""

from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
import rclpy.node
from rclpy.qos import qos_profile_sensor_data as sensor_qos

from flock_follower.messages.state_reader import from_odometry
from flock_follower.planner.loop import PlannerLoop
from flock_follower.planner.params import PlannerParams


class OwnNode(rclpy.node.Node):
    def __init__(self):
        super().__init__('own_node')
        self.loop, self.params = PlannerLoop(require_bridge=False), PlannerParams(v_max=2.0)
        self.loop.engage(True)  # without our bridge, whether it is flown is up to your vehicle
        self.commands = self.create_publisher(Vector3, 'acceleration', 1)
        self.create_subscription(Odometry, 'odom', self.take_own, sensor_qos)
        self.create_subscription(Odometry, 'leader/odom', self.take_leader, sensor_qos)
        self.create_timer(self.params.period, self.tick)

    def take_own(self, message):
        self.loop.take_odometry(from_odometry(message), self.get_clock().now().nanoseconds)

    def take_leader(self, message):  # in the frame of odom
        leader = from_odometry(message)
        self.loop.take_neighbor(leader)
        # It brakes where nothing looks for the leader any more: this says that something does.
        self.loop.take_frame(self.get_clock().now().nanoseconds, leader.stamp)

    def tick(self):
        decision, command = self.loop.tick(self.get_clock().now().nanoseconds, self.params)
        print(decision.state.value, decision.reason, flush=True)
        if command is not None:  # m/s^2 in the frame of odom, z upwards; None: hold by yourself
            self.commands.publish(Vector3(**dict(zip('xyz', command.acceleration))))


try:
    rclpy.init()
    rclpy.spin(OwnNode())
except (KeyboardInterrupt, ExternalShutdownException):
    pass
