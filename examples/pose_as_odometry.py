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
Poses without odometry (PoseStamped) as odom: all three nodes derive the velocity from them.

    python examples/pose_as_odometry.py --ros-args -r pose:=/mavros/local_position/pose

Give the nodes ``odom_twist_frame: none``. Poses are those of base_link, in a frame with z up.
For PoseWithCovarianceStamped, take its type in both places and ``pose=message.pose`` below.
"""

from geometry_msgs.msg import PoseStamped, PoseWithCovariance
from nav_msgs.msg import Odometry
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data as sensor_qos


def as_odometry(message: PoseStamped) -> Odometry:
    """Return a pose as Odometry without a velocity; the stamp is that of the pose."""
    return Odometry(header=message.header, child_frame_id='base_link',
                    pose=PoseWithCovariance(pose=message.pose))


def main() -> None:
    """Run the node."""
    try:
        rclpy.init()
        node = Node('pose_as_odometry')
        odom = node.create_publisher(Odometry, 'odom', sensor_qos)
        node.create_subscription(
            PoseStamped, 'pose', lambda message: odom.publish(as_odometry(message)), sensor_qos)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == '__main__':
    main()
