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

"""Where tf_static puts the child frame of the odometry, for the node that only listens."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from geometry_msgs.msg import TransformStamped
import pytest
import rclpy

from flock_follower.nodes.support.static_child import StaticChild


def stamped(parent: str, child: str, x: float, quarter: bool) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.transform.translation.x = x
    message.transform.rotation.z = 0.5**0.5 if quarter else 0.0
    message.transform.rotation.w = 0.5**0.5 if quarter else 1.0
    return message


def test_the_pose_is_put_together_from_the_frames_between(ros: Any) -> None:
    node = rclpy.create_node('listens')
    static = StaticChild(node)
    assert static.pose('imu') == []
    static.take(SimpleNamespace(transforms=[
        stamped('base_link', 'camera', 0.1, True), stamped('camera', 'imu', 0.02, False)]))
    assert static.pose('imu') == pytest.approx([0.1, 0.02, 0.0, 0.0, 0.0, 0.5**0.5, 0.5**0.5])
    assert static.pose('base_link') == static.pose('elsewhere') == []
    node.destroy_node()
