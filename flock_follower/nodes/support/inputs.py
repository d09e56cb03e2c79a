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

"""Inputs of the nodes: the ego state from ``odom``, and static frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from flock_follower.geometry import Transform
from flock_follower.messages import OdometryState, stamp_to_nanoseconds, to_array
from flock_follower.nodes.support.diagnostics import Problem, WARN
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.odometry.derivation import AUTO, NONE
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.odometry.static_frames import StaticFrames
from flock_follower.parameters.spec import filled

TRANSFORMS_BYTES_MAX = 65536  # bytes of a message on /tf_static: about 500 transforms
#: Reliable, and the last message is kept for subscribers that start later. Never KEEP_ALL: a
#: stopped subscriber would block the publisher.
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def best_effort(depth: int = 1) -> QoSProfile:
    """Return the QoS that receives from reliable and from best-effort publishers."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def for_each(messages: Iterable[Any], take: Callable[[Any], None]) -> None:
    """
    Take each of several messages.

    :raises ValueError: the first error of ``take``; all other messages are taken.
    """
    invalid: ValueError | None = None
    for message in messages:
        try:
            take(message)
        except ValueError as error:
            invalid = invalid or error
    if invalid is not None:
        raise invalid


class NodeClock(Protocol):
    """A clock of a node that does not jump if the system clock is set: ``EvenClock``."""

    clock_shift: int

    def now(self) -> int:
        """Return the time, ns."""

    def fresh(self, topic: str, stamp: int) -> bool:
        """Return whether a stamp, ns, can be used."""


class StaticTransforms:
    """The frames of ``/tf_static``; empty without tf2_msgs, as in the PyPI runtime."""

    def __init__(self, node: Any) -> None:
        self.frames = StaticFrames()
        try:
            from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]
        except ImportError:
            return
        self._subscribe(node, TFMessage, QoSProfile(
            depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def _subscribe(self, node: Any, kind: Any, qos: QoSProfile) -> None:
        node.subscribe(kind, '/tf_static', self.take, qos, required=False,
                       largest=TRANSFORMS_BYTES_MAX)

    def take(self, message: Any) -> None:
        """
        Take a TFMessage.

        :raises ValueError: if a transform is invalid; the others are taken.
        """
        for_each(message.transforms, self._add)

    def _add(self, stamped: Any) -> None:
        turn = stamped.transform.rotation
        self.frames.add(
            stamped.header.frame_id, stamped.child_frame_id, Transform.from_quaternion(
                to_array(stamped.transform.translation), [turn.x, turn.y, turn.z, turn.w]))


class OwnOdometry:
    """
    Subscribes ``odom``; counts dropped messages, and reports the frames in use.

    :param values: the node's parameters, see ``odometry.reader.SourceParams``.
    :param use: is called with the ego state, of base_link, and the time of arrival of its message,
        ns; both times are on the node's clock, or on ``clock`` if given.
    :raises ValueError: if a parameter is out of range.
    """

    def __init__(self, node: FlockNode, values: Mapping[str, Any],
                 use: Callable[[OdometryState, int], None], clock: NodeClock | None = None,
                 depth: int = 200, **options: Any) -> None:
        self._node, self._use, self._clock, self._static = node, use, clock, StaticTransforms(node)
        self.source = OdometrySource(
            filled(SourceParams(), values, 'odom_'), self._static.frames)
        self._found = self._placement = ''  # of the velocity and the child, as logged
        node.diagnostics.checks.append(self._problem)
        node.diagnostics.sources.append(self._values)
        self.poll = node.poll(Odometry, 'odom', self._take, best_effort(depth), **options)
        """Takes the messages that wait, see ``FlockNode.poll``."""

    def _take(self, message: Odometry, arrival: int) -> None:
        clock_shift = 0
        if self._clock is not None:
            self._clock.now()
            clock_shift = self._clock.clock_shift
            if not self._clock.fresh('odom', stamp_to_nanoseconds(message.header.stamp)):
                return
        state = self.source.take(message, arrival - clock_shift, clock_shift)
        for event in self.source.new_events():
            self._node.diagnostics.reject(*event)
        if self.source.placement != self._placement:
            self._placement = self.source.placement
            self._node.get_logger().info(self._placement)
        if self.source.twist.found != self._found:
            self._found = self.source.twist.found
            self._node.get_logger().info(f'velocity of odom: {self.source.twist.describe}')
        if state is not None:
            self._use(state, arrival - clock_shift)

    def _values(self, now: float) -> dict[str, str]:
        source = self.source
        return {'odom_twist': source.twist.describe, 'odom_latency_s': f'{source.latency:.3f}',
                'odom_lacks': '; '.join(
                    f'{what}: {instead}' for what, instead in sorted(source.missing.items()))}

    def _problem(self, now: float) -> Problem | None:
        twist = self.source.twist
        if twist.found not in ('', twist.wanted) and twist.wanted != NONE and (
                twist.found == NONE or twist.wanted != AUTO):
            return WARN, f'velocity of odom: {twist.describe}'
        return None
