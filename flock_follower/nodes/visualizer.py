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
with its state and command, and each neighbour with its velocity, the ellipsoid of its position and
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

from flock_follower.geometry import Array, IDENTITY_QUATERNION, matrix_to_quaternion
from flock_follower.messages import (
    Command,
    from_odometry,
    from_trajectory,
    NANOSECONDS,
    OdometryState,
    set_quaternion,
    set_vector,
)
from flock_follower.nodes.support.diagnostics import STEADY
from flock_follower.nodes.support.inputs import best_effort
from flock_follower.nodes.support.parameters import RemoteParameters
from flock_follower.nodes.support.runtime import FlockNode, run
from flock_follower.parameters.spec import Spec
from flock_follower.planner.limits import COHESION, REASONS, SEPARATION

SPECS: list[Spec] = []
PERIOD = 0.1  # s between two drawings
ASK_PERIOD = 3.0  # s between two requests for the band, which can be changed in flight
LIFETIME = 0.5  # s after which a viewer drops a marker that is not drawn again
LARGEST = 65536  # bytes of a message on /diagnostics

DEGENERATE = 1e-3  # m: nothing is drawn shorter than this, viewers refuse sizes of zero
DEVIATIONS = 2.0  # of the ellipsoids
VELOCITY_TIME = 1.0  # s: an arrow of velocity ends where it leads in this time
ACCELERATION_SCALE = 0.5  # m of arrow per m/s^2
UNSEEN = 0.25  # s without an image of it after which a neighbour is drawn in grey
FORGOTTEN = 10.0  # s after which it is drawn no more
SILENT = 0.5  # s after which a command is drawn no more
ABOVE = np.array([0.0, 0.0, 0.3])  # m: the place of a label
BODY_SIZE = (0.35, 0.35, 0.1)  # m
TEXT_SIZE = (0.0, 0.0, 0.15)  # m: the height

Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, each in [0, 1]."""

SEEN, GREY, ELLIPSOID = (0.2, 0.5, 1.0, 0.9), (0.7, 0.7, 0.7, 0.9), (0.2, 0.5, 1.0, 0.25)
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
        self._neighbors: dict[str, OdometryState] = {}
        self._command: Command | None = None
        self._report: dict[str, str] = {}
        """The planner's newest values on /diagnostics."""
        self._planner = RemoteParameters(self, 'planner')
        self._polls = [
            self.poll(Odometry, 'odom', self._take_odom, best_effort()),
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
        self.create_timer(ASK_PERIOD, self._ask, clock=STEADY)

    def _take_odom(self, message: Odometry, _: int) -> None:
        self._own = from_odometry(message)

    def _take_neighbor(self, message: Odometry, _: int) -> None:
        state = from_odometry(message)
        self._neighbors[state.child] = state

    def _take_command(self, message: MultiDOFJointTrajectory, _: int) -> None:
        self._command = from_trajectory(message, message.header.frame_id)

    def _take_diagnostics(self, message: DiagnosticArray, _: int) -> None:
        planner = f'{self.get_namespace().strip("/")}/planner'.lstrip('/')
        for status in message.status:
            if status.name == planner:
                self._report = {pair.key: pair.value for pair in status.values}

    def _ask(self) -> None:
        self._planner.ask(['d0', 'd1', 'radius'])

    def _tick(self) -> None:
        """Take the messages that wait and draw them, if a viewer subscribes."""
        if not self._markers.get_subscription_count():
            return
        for poll in self._polls:
            poll()
        now = self.get_clock().now()
        drawn = [marker for state in self._neighbors.values()
                 for marker in self._neighbor(state, now.nanoseconds)]
        if self._own is not None:
            drawn += self._follower(self._own, now.nanoseconds)
        for marker in drawn:
            marker.header.stamp = now.to_msg()
        self._markers.publish(MarkerArray(markers=drawn))

    def _guarded(self) -> list[str]:
        """Return the guard's reasons among the limits of the planner's command."""
        return [reason for reason in REASONS if reason in self._report.get('limits', '')]

    def _neighbor(self, state: OdometryState, now: int) -> list[Marker]:
        """Return a neighbour, its velocity, ellipsoid, edge of the graph, and band."""
        name, frame, at = state.child, state.frame, state.position
        age = (now - state.stamp) / NANOSECONDS
        if age > FORGOTTEN:
            return []
        color, label = (SEEN, name) if age <= UNSEEN else (
            GREY, f'{name}, not seen for {age:.1f} s')
        drawn = [box(frame, name, at, state.quaternion, color),
                 *arrow(frame, f'{name} velocity', at, VELOCITY_TIME * state.velocity, color),
                 text(frame, f'{name} name', at + ABOVE, label, color)]
        if np.all(np.isfinite(state.pose_covariance[:3, :3])):
            drawn.append(ellipsoid(frame, f'{name} covariance', at, state.pose_covariance[:3, :3]))
        band, attended = self._planner.values, name in self._report.get('edges', '').split(', ')
        if attended and self._own is not None:
            drawn.append(lines(frame, f'{name} edge', [self._own.position, at], EDGE, 0.02))
        if attended and band is not None:
            drawn += [circle(frame, f'{name} {edge}', at, math.sqrt(band[edge]) + band['radius'],
                             color, 0.05 if reason in self._guarded() else 0.015)
                      for edge, color, reason in (('d0', INNER, SEPARATION),
                                                  ('d1', OUTER, COHESION))]
        return drawn

    def _follower(self, own: OdometryState, now: int) -> list[Marker]:
        """Return the follower with its state and its command."""
        at, guarded, state = own.position, self._guarded(), self._report.get('state', 'no planner')
        color = STATES.get(state, GREY)
        label = [state, *(f'guard: {reason}' for reason in guarded)]
        if state != 'TRACK':
            label.append(self._report.get('reason', ''))
        drawn = [box(own.frame, 'follower', at, own.quaternion, color),
                 text(own.frame, 'state', at + ABOVE, '\n'.join(filter(None, label)), color)]
        command = self._command
        if command is not None and command.ages(now)[0] <= SILENT:
            drawn += arrow(own.frame, 'command', at, ACCELERATION_SCALE * np.asarray(
                command.acceleration, float), GUARDED if guarded else COMMAND)
        return drawn


def box(frame: str, name: str, position: Array, quaternion: Array, color: Color) -> Marker:
    """Return a vehicle at a pose."""
    return placed(frame, name, Marker.CUBE, position, BODY_SIZE, color, quaternion)


def text(frame: str, name: str, position: Array, label: str, color: Color) -> Marker:
    """Return text that faces the viewer."""
    return placed(frame, name, Marker.TEXT_VIEW_FACING, position, TEXT_SIZE, color, text=label)


def ellipsoid(frame: str, name: str, centre: Array, covariance: Array) -> Marker:
    """Return the ellipsoid of a finite covariance (3, 3), m^2, at ``DEVIATIONS`` sigma."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:  # a mirror is no rotation
        axes[:, 0] = -axes[:, 0]
    size = np.maximum(2.0 * DEVIATIONS * np.sqrt(np.maximum(variances, 0.0)), DEGENERATE)
    return placed(frame, name, Marker.SPHERE, centre, size, ELLIPSOID, matrix_to_quaternion(axes))


def arrow(frame: str, name: str, start: Array, along: Array, color: Color) -> list[Marker]:
    """Return an arrow from a place (3,) along a vector (3,); none if it has no length."""
    if np.linalg.norm(along) <= DEGENERATE:
        return []
    marker = lines(frame, name, [start, start + along], color, 0.04)
    marker.type, marker.scale.y, marker.scale.z = Marker.ARROW, 0.08, 0.1
    return [marker]


def circle(frame: str, name: str, centre: Array, radius: float, color: Color,
           width: float) -> Marker:
    """Return a level circle about a place (3,)."""
    angle = np.linspace(0.0, math.tau, 49)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return lines(frame, name, centre + radius * ring, color, width)


def lines(frame: str, name: str, points: ArrayLike, color: Color, width: float) -> Marker:
    """Return a line through points (n, 3)."""
    marker = placed(frame, name, Marker.LINE_STRIP, np.zeros(3), (width, 0.0, 0.0), color)
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in np.asarray(points, float).tolist()]
    return marker


def placed(frame: str, name: str, kind: int, position: Array, size: ArrayLike, color: Color,
           quaternion: Array = IDENTITY_QUATERNION, text: str = '') -> Marker:
    """Return the message of a shape; its name is the namespace, so that each can be hidden."""
    red, green, blue, opacity = color
    marker = Marker(ns=name, type=kind, action=Marker.ADD, text=text,
                    lifetime=Duration(seconds=LIFETIME).to_msg(),
                    color=ColorRGBA(r=red, g=green, b=blue, a=opacity))
    marker.header.frame_id = frame
    set_vector(marker.pose.position, position)
    set_quaternion(marker.pose.orientation, quaternion)
    set_vector(marker.scale, size)
    return marker


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Visualizer, args)


if __name__ == '__main__':
    sys.exit(main())
