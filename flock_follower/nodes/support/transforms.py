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
Transforms on ``/tf`` and ``/tf_static``, if tf2_msgs is installed; the PyPI runtime has none.

A frame has one parent: it jumps if two nodes broadcast its transform. So the visualizer leaves
``odom -> base_link`` to the odometry, which normally broadcasts it (REP-105), and the frame of a
camera to the node that broadcasts it on ``/tf_static``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from flock_follower.geometry import Transform
from flock_follower.messages import set_quaternion, set_stamp, set_vector, to_array
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.odometry.buffer import StaticFrames

#: Whether to broadcast odom -> base_link.
AUTO, ALWAYS, NEVER = ODOM_TF = 'auto', 'always', 'never'
BASE = 'base_link'
TF, TF_STATIC = '/tf', '/tf_static'
LARGEST = 65536  # bytes: about 500 transforms


def message_type() -> Any:
    """Return the type of the messages on /tf, None if it is not installed."""
    try:
        from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]
    except ImportError:
        return None
    return TFMessage


class StaticChild:
    """
    The frames of ``/tf_static``; none if tf2_msgs is not installed.

    :param changed: is called after each message.
    """

    def __init__(self, node: Node, changed: Callable[[], None] = lambda: None) -> None:
        self._frames = StaticFrames()
        self._changed = changed
        if (kind := message_type()) is not None:
            subscribe = (partial(node.subscribe, required=False, largest=LARGEST)
                         if isinstance(node, FlockNode) else node.create_subscription)
            subscribe(kind, TF_STATIC, self.take, QoSProfile(
                depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def take(self, message: Any) -> None:
        """Take a TFMessage."""
        for stamped in message.transforms:
            turn = stamped.transform.rotation
            self._frames.add(
                stamped.header.frame_id, stamped.child_frame_id, Transform.from_quaternion(
                    to_array(stamped.transform.translation), [turn.x, turn.y, turn.z, turn.w]))
        self._changed()

    def transform(self, child: str) -> Transform | None:
        """Return ``T_base_child``; None if it is unknown, or base_link itself."""
        return None if child == BASE else self._frames.pose(child, BASE)

    def knows(self, frame: str) -> bool:
        """Return whether a frame has a parent on ``/tf_static``."""
        return self._frames.knows(frame)


class TransformBroadcaster:
    """
    Broadcasts the frames that a follower knows; nothing if tf2_msgs is not installed.

    :param odom_tf: one of ``ODOM_TF``.
    """

    def __init__(self, node: Node, static: StaticChild, odom_tf: str) -> None:
        self._node, self._static, self._odom_tf = node, static, odom_tf
        self._type = message_type()
        self._stamps: dict[str, int] = {}
        self._fixed: dict[str, TransformStamped] = {}
        if self._type is not None:
            self._moving = node.create_publisher(self._type, TF, QoSProfile(depth=100))
            self._still = node.create_publisher(self._type, TF_STATIC, QoSProfile(
                depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    @property
    def wanted(self) -> bool:
        """Return whether a node subscribes to moving frames."""
        return self._type is not None and self._moving.get_subscription_count() > 0

    @property
    def owns_odometry(self) -> bool:
        """Return whether to broadcast odom -> base_link here."""
        others = {f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                  for info in self._node.get_publishers_info_by_topic(TF)
                  } - {self._node.get_fully_qualified_name()}
        return self._odom_tf == ALWAYS or (self._odom_tf == AUTO and not others)

    def move(self, stamp: int, frame: str, child: str, pose: Transform) -> None:
        """Broadcast the pose of a frame, ``T_frame_child``, once for each stamp, ns."""
        if not frame or not child or self._stamps.get(child) == stamp or not self.wanted:
            return
        self._stamps[child] = stamp
        self._moving.publish(self._type(transforms=[_stamped(stamp, frame, child, pose)]))

    def fix(self, stamp: int, frame: str, child: str, pose: Transform) -> bool:
        """
        Broadcast the pose of a static frame; return False if another node broadcasts it.

        :param stamp: ns, without meaning for listeners.
        """
        if self._type is None:
            return True
        if child not in self._fixed and self._static.knows(child):
            return False
        stamped = _stamped(stamp, frame, child, pose)
        before = self._fixed.get(child)
        if before is None or before.transform != stamped.transform:
            self._fixed[child] = stamped
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
