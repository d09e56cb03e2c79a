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
The visualizer node: the flight as markers for RViz and Foxglove.

While a viewer subscribes, the node publishes ``visualizer/markers`` in the frame of ``odom``: the
follower with its state and command, and each neighbor with its velocity, the ellipsoid of its
position, and the planner's band about it. No other node waits for this node.
"""

from __future__ import annotations

import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import ColorRGBA
from trajectory_msgs.msg import MultiDOFJointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from flock_follower.messages import NANOSECONDS, OdometryState, set_quaternion, set_vector
from flock_follower.messages.command_reader import from_trajectory
from flock_follower.messages.commands import Command
from flock_follower.messages.state_reader import from_odometry
from flock_follower.nodes.support.diagnostics import STEADY
from flock_follower.nodes.support.inputs import best_effort
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.spec import Spec
from flock_follower.view.scene import ARROW, BOX, COLORS, draw, ELLIPSOID, LINE, Shape, TEXT

SPECS: list[Spec] = []
PERIOD = 0.1  # s between two drawings
LIFETIME = 0.5  # s after which a viewer drops a marker that is not drawn again
LARGEST = 65536  # bytes of a message on /diagnostics
KINDS = {BOX: Marker.CUBE, ARROW: Marker.ARROW, LINE: Marker.LINE_STRIP,
         ELLIPSOID: Marker.SPHERE, TEXT: Marker.TEXT_VIEW_FACING}


class Visualizer(FlockNode):
    """Draws the newest messages of the other nodes; without a viewer it takes none."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('visualizer', **kwargs)
        self.declare(SPECS, dict)
        self._own: OdometryState | None = None
        self._frame = ''
        self._neighbors: dict[str, OdometryState] = {}
        self._command: Command | None = None
        self._report: dict[str, str] = {}
        """The planner's newest values on /diagnostics."""
        self._polls = [
            # Without a viewer no message is taken; the topic is not silent then.
            self.poll(Odometry, 'odom', self._take_odom, best_effort(), sporadic=True),
            self.poll(Odometry, 'neighbors', self._take_neighbor, best_effort(10), required=False),
            self.poll(Odometry, 'neighbors/heard', self._take_neighbor, best_effort(10),
                      required=False),
            self.poll(MultiDOFJointTrajectory, 'command/trajectory', self._take_command,
                      best_effort(), required=False),
            self.poll(DiagnosticArray, '/diagnostics', self._take_diagnostics, best_effort(10),
                      required=False, largest=LARGEST)]
        self._markers = self.create_publisher(MarkerArray, 'visualizer/markers', QoSProfile(
            depth=1))
        self.create_timer(PERIOD, self._tick, clock=STEADY)

    def _take_odom(self, message: Odometry, _: int) -> None:
        self._own = from_odometry(message)
        self._frame = self._own.frame

    def _take_neighbor(self, message: Odometry, _: int) -> None:
        state = from_odometry(message)
        self._neighbors[state.child], self._frame = state, state.frame

    def _take_command(self, message: MultiDOFJointTrajectory, _: int) -> None:
        self._command = from_trajectory(message, message.header.frame_id)

    def _take_diagnostics(self, message: DiagnosticArray, _: int) -> None:
        planner = f'{self.get_namespace().strip("/")}/planner'.lstrip('/')
        for status in message.status:
            if status.name == planner:
                self._report = {pair.key: pair.value for pair in status.values}

    def _tick(self) -> None:
        """Take the messages that wait and draw them, if a viewer subscribes."""
        if not self._markers.get_subscription_count():
            return
        for poll in self._polls:
            poll()
        now = self.get_clock().now()
        command = None if self._command is None else (
            self._command, self._command.ages(now.nanoseconds)[0])
        drawn = [to_marker(shape) for shape in draw(self._own, [
            (state, (now.nanoseconds - state.stamp) / NANOSECONDS)
            for state in self._neighbors.values()], command, self._report)]
        for marker in drawn:
            marker.header.frame_id, marker.header.stamp = self._frame, now.to_msg()
        self._markers.publish(MarkerArray(markers=drawn))


def to_marker(shape: Shape) -> Marker:
    """Return the marker of a shape; its namespace is the shape's name, so each can be hidden."""
    red, green, blue, opacity = COLORS[shape.paint]
    marker = Marker(ns=shape.name, type=KINDS[shape.kind], action=Marker.ADD, text=shape.text,
                    lifetime=Duration(seconds=LIFETIME).to_msg(),
                    color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
                    points=[Point(x=x, y=y, z=z)
                            for x, y, z in np.asarray(shape.points, float).tolist()])
    set_vector(marker.pose.position, shape.position)
    set_quaternion(marker.pose.orientation, shape.quaternion)
    set_vector(marker.scale, shape.size)
    return marker


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Visualizer, args)


if __name__ == '__main__':
    sys.exit(main())
