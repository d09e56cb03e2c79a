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
Transforms on ``/tf`` and ``/tf_static``, where tf2_msgs is installed; the PyPI runtime has none.

A frame has one parent: two nodes that broadcast one transform make it jump. So ``odom ->
base_link``, which an odometry normally broadcasts (REP-105), is left to it, and a camera's frame
that ``/tf_static`` knows already to whoever told it.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from flock_follower.geometry import Transform
from flock_follower.messages import set_quaternion, set_stamp, set_vector
from flock_follower.nodes.support.static_child import StaticChild

#: Whether to broadcast odom -> base_link.
AUTO, ALWAYS, NEVER = ODOM_TF = 'auto', 'always', 'never'
TF, TF_STATIC = '/tf', '/tf_static'
TF_QOS = QoSProfile(depth=100)
STATIC_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def message_type() -> Any:
    """Return the type of the messages on /tf, None where it is not installed."""
    try:
        from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]
    except ImportError:
        return None
    return TFMessage


class TransformBroadcaster:
    """
    Broadcasts what a follower knows of frames; nothing where tf2_msgs is not installed.

    :param odom_tf: one of ``ODOM_TF``.
    """

    def __init__(self, node: Node, static: StaticChild, odom_tf: str) -> None:
        self._node, self._static, self._odom_tf = node, static, odom_tf
        self._type = message_type()
        self._told: dict[str, int] = {}
        self._fixed: dict[str, TransformStamped] = {}
        if self._type is not None:
            self._moving = node.create_publisher(self._type, TF, TF_QOS)
            self._still = node.create_publisher(self._type, TF_STATIC, STATIC_QOS)

    @property
    def wanted(self) -> bool:
        """Return whether someone listens to what moves."""
        return self._type is not None and self._moving.get_subscription_count() > 0

    def others(self) -> list[str]:
        """Return the full names of other nodes that publish on /tf."""
        return sorted({f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                       for info in self._node.get_publishers_info_by_topic(TF)}
                      - {self._node.get_fully_qualified_name()})

    @property
    def owns_odometry(self) -> bool:
        """Return whether odom -> base_link is to be broadcast here."""
        return self._odom_tf == ALWAYS or (self._odom_tf == AUTO and not self.others())

    def move(self, stamp: int, frame: str, child: str, pose: Transform) -> None:
        """Broadcast where a frame is, ``T_frame_child`` at a stamp, ns; a stamp counts once."""
        if not frame or not child or self._told.get(child) == stamp or not self.wanted:
            return
        self._told[child] = stamp
        self._moving.publish(self._type(transforms=[_stamped(stamp, frame, child, pose)]))

    def fix(self, stamp: int, frame: str, child: str, pose: Transform) -> bool:
        """
        Broadcast where a frame is for good; return False where another node tells of it.

        :param stamp: ns, of no meaning to listeners.
        """
        if self._type is None:
            return True
        if child not in self._fixed and self._static.knows(child):
            return False
        told = _stamped(stamp, frame, child, pose)
        before = self._fixed.get(child)
        if before is None or before.transform != told.transform:
            self._fixed[child] = told
            # All of them: of a latched topic only the last message is kept.
            self._still.publish(self._type(transforms=list(self._fixed.values())))
        return True


def _stamped(stamp: int, frame: str, child: str, pose: Transform) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = frame
    set_stamp(message.header.stamp, stamp)
    set_vector(message.transform.translation, pose.translation)
    set_quaternion(message.transform.rotation, pose.quaternion)
    return message
