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

Publishes ``visualizer/markers`` in the frame of ``odom`` while a viewer subscribes: the follower
with its state and command, and each neighbor with its velocity, the ellipsoid of its position and
the planner's band about it. No other node waits for it.
"""

from __future__ import annotations

import math
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
import numpy as np
from numpy.typing import ArrayLike
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import ColorRGBA
from trajectory_msgs.msg import MultiDOFJointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from flock_follower.command_messages import Command, from_trajectory
from flock_follower.geometry import Array, IDENTITY_QUATERNION, matrix_to_quaternion
from flock_follower.messages import (
    from_odometry,
    NANOSECONDS,
    OdometryState,
    set_quaternion,
    set_vector,
)
from flock_follower.nodes.support.diagnostics import STEADY
from flock_follower.nodes.support.inputs import best_effort
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.spec import Spec
from flock_follower.planner.limits import COHESION, REASONS, SEPARATION

SPECS: list[Spec] = []
PERIOD = 0.1  # s between two drawings
LIFETIME = 0.5  # s after which a viewer drops a marker that is not drawn again
LARGEST = 65536  # bytes of a message on /diagnostics

DEGENERATE = 1e-3  # m: the shortest length drawn, viewers refuse sizes of zero
DEVIATIONS = 2.0  # of the ellipsoids
VELOCITY_TIME = 1.0  # s: an arrow of velocity ends where it leads in this time
ACCELERATION_SCALE = 0.5  # m of arrow per m/s^2
UNSEEN = 0.25  # s without an image of it after which a neighbor is drawn in gray
FORGOTTEN = 10.0  # s after which it is drawn no more
SILENT = 0.5  # s after which a command is drawn no more
ABOVE = np.array([0.0, 0.0, 0.3])  # m: the place of a label
BODY_SIZE = (0.35, 0.35, 0.1)  # m
TEXT_SIZE = (0.0, 0.0, 0.15)  # m: the height
ARROW_SIZE, LINE_SIZE = (0.04, 0.08, 0.1), (0.02, 0.0, 0.0)  # m: widths; length of the head
#: A level circle of radius 1 m, (49, 3).
RING = np.array([[math.cos(a), math.sin(a), 0.0] for a in np.linspace(0.0, math.tau, 49)])

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each in [0, 1]."""

SEEN, GRAY, ELLIPSOID = (0.2, 0.5, 1.0, 0.9), (0.7, 0.7, 0.7, 0.9), (0.2, 0.5, 1.0, 0.25)
EDGE, INNER, OUTER = (1.0, 1.0, 1.0, 0.6), (0.95, 0.3, 0.2, 0.7), (0.2, 0.8, 0.9, 0.7)
COMMAND, GUARDED = (0.3, 0.9, 0.3, 1.0), (1.0, 0.55, 0.0, 1.0)
STATES = {'TRACK': (0.3, 0.9, 0.3, 0.9), 'COAST': (0.95, 0.85, 0.2, 0.9),
          'SEARCH': (1.0, 0.55, 0.0, 0.9), 'HOLD': (1.0, 0.3, 0.2, 0.9),
          'RELATIVE': (0.8, 0.3, 0.9, 0.9)}


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
        drawn: list[Marker] = []
        for state in self._neighbors.values():
            drawn += self._neighbor(state, now.nanoseconds)
        if self._own is not None:
            drawn += self._follower(self._own, now.nanoseconds)
        for marker in drawn:
            marker.header.frame_id, marker.header.stamp = self._frame, now.to_msg()
        self._markers.publish(MarkerArray(markers=drawn))

    def _guarded(self) -> list[str]:
        """Return the guard's reasons among the limits of the planner's command."""
        return [reason for reason in REASONS if reason in self._report.get('limits', '')]

    def _neighbor(self, state: OdometryState, now: int) -> list[Marker]:
        """Return a neighbor, its velocity, ellipsoid, edge of the graph, and band."""
        name, at, velocity = state.child, state.position, VELOCITY_TIME * state.velocity
        age = (now - state.stamp) / NANOSECONDS
        if age > FORGOTTEN:
            return []
        color, label = (SEEN, name) if age <= UNSEEN else (
            GRAY, f'{name}, not seen for {age:.1f} s')
        drawn = [shape(name, Marker.CUBE, color, BODY_SIZE, at, state.quaternion),
                 shape(f'{name} name', Marker.TEXT_VIEW_FACING, color, TEXT_SIZE, at + ABOVE,
                       text=label)]
        if np.linalg.norm(velocity) > DEGENERATE:
            drawn.append(shape(f'{name} velocity', Marker.ARROW, color, ARROW_SIZE,
                               points=[at, at + velocity]))
        if np.all(np.isfinite(state.pose_covariance[:3, :3])):
            drawn.append(ellipsoid(f'{name} covariance', at, state.pose_covariance[:3, :3]))
        if name not in self._report.get('edges', '').split(', '):
            return drawn
        if self._own is not None:
            drawn.append(shape(f'{name} edge', Marker.LINE_STRIP, EDGE, LINE_SIZE,
                               points=[self._own.position, at]))
        return drawn + [
            shape(f'{name} {edge}', Marker.LINE_STRIP, color,
                  (0.05 if reason in self._guarded() else 0.015, 0.0, 0.0),
                  points=at + float(self._report[edge]) * RING)
            for edge, color, reason in (('nearest_m', INNER, SEPARATION),
                                        ('farthest_m', OUTER, COHESION))]

    def _follower(self, own: OdometryState, now: int) -> list[Marker]:
        """Return the follower with its state and its command."""
        guarded, state = self._guarded(), self._report.get('state', 'no planner')
        color, at, command = STATES.get(state, GRAY), own.position, self._command
        label = [state, *(f'guard: {reason}' for reason in guarded)]
        if state != 'TRACK':
            label.append(self._report.get('reason', ''))
        drawn = [shape('follower', Marker.CUBE, color, BODY_SIZE, at, own.quaternion),
                 shape('state', Marker.TEXT_VIEW_FACING, color, TEXT_SIZE, at + ABOVE,
                       text='\n'.join(filter(None, label)))]
        if command is not None and command.ages(now)[0] <= SILENT:
            drawn.append(shape(
                'command', Marker.ARROW, GUARDED if guarded else COMMAND, ARROW_SIZE,
                points=[at, at + ACCELERATION_SCALE * np.asarray(command.acceleration, float)]))
        return drawn


def ellipsoid(name: str, center: Array, covariance: Array) -> Marker:
    """Return the ellipsoid of a finite covariance (3, 3), m^2, at ``DEVIATIONS`` sigma."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:  # a mirror is no rotation
        axes[:, 0] = -axes[:, 0]
    size = np.maximum(2.0 * DEVIATIONS * np.sqrt(np.maximum(variances, 0.0)), DEGENERATE)
    return shape(name, Marker.SPHERE, ELLIPSOID, size, center, matrix_to_quaternion(axes))


def shape(name: str, kind: int, color: Color, size: ArrayLike, position: ArrayLike = (0, 0, 0),
          quaternion: Array = IDENTITY_QUATERNION, points: ArrayLike = (),
          text: str = '') -> Marker:
    """
    Return a marker; its name is the namespace, so that each can be hidden.

    :param size: (3,), m; of lines the first is the width, of text the last the height.
    :param points: of lines and arrows (n, 3), m.
    """
    red, green, blue, opacity = color
    places = np.asarray(points, float).tolist()
    marker = Marker(ns=name, type=kind, action=Marker.ADD, text=text,
                    lifetime=Duration(seconds=LIFETIME).to_msg(),
                    color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
                    points=[Point(x=x, y=y, z=z) for x, y, z in places])
    set_vector(marker.pose.position, position)
    set_quaternion(marker.pose.orientation, quaternion)
    set_vector(marker.scale, size)
    return marker


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Visualizer, args)


if __name__ == '__main__':
    sys.exit(main())
