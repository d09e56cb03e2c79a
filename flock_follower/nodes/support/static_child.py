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

"""Where ``tf_static`` puts the child frame of the odometry."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from flock_follower.geometry import Transform
from flock_follower.messages import to_array
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.odometry.buffer import StaticFrames

BASE = 'base_link'
LARGEST = 65536  # bytes: about 500 transforms
STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class StaticChild:
    """
    Hears ``/tf_static``; nothing where tf2_msgs is not installed, as in the PyPI runtime.

    :param changed: is called when something was heard.
    """

    def __init__(self, node: Node, changed: Callable[[], None] = lambda: None) -> None:
        self._frames = StaticFrames()
        self._changed = changed
        try:
            from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]
        except ImportError:
            return
        subscribe = (partial(node.subscribe, required=False, largest=LARGEST)
                     if isinstance(node, FlockNode) else node.create_subscription)
        subscribe(TFMessage, '/tf_static', self.take, STATIC_QOS)

    def take(self, message: Any) -> None:
        """Take a TFMessage."""
        for stamped in message.transforms:
            turn = stamped.transform.rotation
            self._frames.add(
                stamped.header.frame_id, stamped.child_frame_id, Transform.from_quaternion(
                    to_array(stamped.transform.translation), [turn.x, turn.y, turn.z, turn.w]))
        self._changed()

    def transform(self, child: str) -> Transform | None:
        """Return ``T_base_child``; None where it is unknown, or base_link itself."""
        return None if child == BASE else self._frames.pose(child, BASE)

    def knows(self, frame: str) -> bool:
        """Return whether somebody says where a frame is."""
        return self._frames.knows(frame)
