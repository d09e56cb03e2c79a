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


"""Shared by the nodes that take ``odom``: the own state from it, and its diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from nav_msgs.msg import Odometry

from flock_follower.messages import OdometryState
from flock_follower.nodes.support.diagnostics import Problem, WARN
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.nodes.support.transforms import BASE, StaticChild
from flock_follower.odometry.derivation import NONE
from flock_follower.odometry.reader import OdometrySource, SourceParams
from flock_follower.parameters.spec import filled


class OwnOdometry:
    """
    Reads a node's ``odom``; counts dropped messages, and reports the frames in use.

    :param values: the node's parameters, see ``odometry.reader.SourceParams``.
    :param report: counts dropped messages, as (reason, detail).
    :raises ValueError: if a parameter is out of range.
    """

    def __init__(self, node: FlockNode, values: Mapping[str, Any],
                 report: Callable[[str, str], None] | None = None) -> None:
        self.source = OdometrySource(filled(SourceParams(), values, 'odom_'))
        self._node = node
        self._report = report or node.diagnostics.reject
        self._described = ''
        node.diagnostics.checks += [self._problem, self._axes_problem]
        self._child = self._placed = ''
        configured = any(values['odom_child_position']) or any(values['odom_child_rpy'])
        self._static = None if configured else StaticChild(node, self._place)

    def _place(self) -> None:
        """Pass the pose of the child frame from tf_static to the source, if published."""
        pose = self._static.transform(self._child) if self._static and self._child else None
        if pose is not None and self._placed != self._child:
            self._placed = self._child  # a static transform is passed once
            self.source.place_child(pose)
            self._node.get_logger().info(
                f'{self._child} is at {pose.translation.round(3).tolist()} m on {BASE} by '
                'tf_static')

    def take(self, message: Odometry, arrival: int | None = None,
             shift: int = 0) -> OdometryState | None:
        """
        Return the own state, of base_link; None if the message repeats the last one.

        :param arrival: when it came, ns of the node's clock; None: now.
        :param shift: by how much the system clock was set, ns: the stamps of messages are on it,
            ``arrival`` and the stamp returned are on one that goes on evenly
            (``planner.clock_watch``).
        :raises ValueError: if the message is invalid.
        """
        source = self.source
        if message.child_frame_id != self._child:
            self._child = message.child_frame_id
            self._place()
        if arrival is None:
            arrival = self._node.get_clock().now().nanoseconds - shift
        state = source.take(message, arrival, shift)
        for event in source.new_events():
            self._report(*event)
        described = source.twist.describe
        if described != self._described:
            self._node.get_logger().info(f'velocity of odom: {described}')
            self._described = described
            self._node.diagnostics.values['odom_twist'] = described
        return state

    def _problem(self, now: float) -> Problem | None:
        source = self.source
        values = self._node.diagnostics.values
        values['odom_latency_s'] = f'{source.latency:.3f}'
        values['odom_lacks'] = '; '.join(
            f'{what}: {instead}' for what, instead in sorted(source.missing.items()))
        twist = source.twist
        if twist.wanted in (twist.found, NONE) or not twist.found:
            return None
        if twist.found == NONE or twist.wanted in ('child', 'odom'):
            return WARN, f'velocity of odom: {twist.describe}'
        return None

    def _axes_problem(self, now: float) -> Problem | None:
        fault = self.source.up.fault
        return (WARN, f'axes of odom: {fault}') if fault else None
