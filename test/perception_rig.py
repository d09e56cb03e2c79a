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

"""The node relative_pose in this process, and a node that plays cameras and odometry."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
import time
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp
from flock_follower.perception.images import GrayImage

START = 1_700_000_000 * 10**9  # ns: where a real bag's clock begins
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time


class PerceptionRig:
    """
    Talks to the node; ``found`` and ``frames`` are what it published.

    :param inputs: the topics that it gets, with their types.
    :param parameters: of the node.
    """

    def __init__(self, inputs: Mapping[str, Any], **parameters: Any) -> None:
        self.perception = RelativePose(parameter_overrides=[
            Parameter(name, value=value) for name, value in parameters.items()])
        self.node = Node('surroundings')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.perception)
        self.executor.add_node(self.node)
        self.found: list[Odometry] = []
        self.frames: list[Header] = []
        self.node.create_subscription(Odometry, 'neighbors', self.found.append, 10)
        self.node.create_subscription(Header, 'neighbors/frames', self.frames.append, 10)
        self.outputs = {topic: self.node.create_publisher(msgtype, topic, qos_profile_sensor_data)
                        for topic, msgtype in inputs.items()}
        self.wait(lambda: self.node.count_publishers('neighbors') and (
            self.node.count_publishers('neighbors/frames')) and all(
            output.get_subscription_count() for output in self.outputs.values()))

    def wait(self, condition: Callable[[], Any]) -> None:
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, 'waited in vain'
            self.executor.spin_once(timeout_sec=0.01)

    def send(self, topic: str, message: Any) -> None:
        """Publish a message and wait until the node has taken it in."""
        rate = self.perception.diagnostics.rates[f'{topic}_hz']
        count = rate.count
        self.outputs[topic].publish(message)
        # Odometry that nothing waits for is taken with the next image: here at once.
        self.wait(lambda: self.perception.poll_odom() or rate.count > count)

    def send_image(self, topic: str, seconds: float, pixels: GrayImage, encoding: str) -> None:
        message = Image(height=480, width=640, step=640, encoding=encoding,
                        data=array('B', pixels.tobytes()))
        message.header.stamp = nanoseconds_to_stamp(START + round(seconds * 1e9))
        self.send(topic, message)

    def close(self) -> None:
        self.executor.shutdown()
        self.perception.destroy_node()
        self.node.destroy_node()
