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
The visualizer node: what the follower knows, as markers and transforms for RViz and Foxglove.

Publishes ``visualizer/markers`` (leader, band, command, field of view, guard), and, where
tf2_msgs is installed, ``odom -> base_link -> camera`` and ``odom -> leader`` on ``/tf``. It works
only while someone subscribes, and no other node waits for it. What is drawn is in
``flock_follower.visualization``; the band and the cameras are what planner and relative_pose say.
"""

from __future__ import annotations

from functools import partial
import math
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import ColorRGBA, String
from trajectory_msgs.msg import MultiDOFJointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from flock_follower.geometry import quaternion_from_rpy, R_FLU_OPTICAL, Transform
from flock_follower.messages import (
    Command,
    from_odometry,
    from_trajectory,
    OdometryState,
    set_quaternion,
    set_vector,
)
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp
from flock_follower.nodes.support.passing_inputs import PassingInputs
from flock_follower.nodes.support.remote_parameters import RemoteParameters
from flock_follower.nodes.support.runtime import FlockNode, run
from flock_follower.nodes.support.static_child import BASE, StaticChild
from flock_follower.nodes.support.transforms import AUTO, ODOM_TF, TransformBroadcaster
from flock_follower.parameters.cameras_table import CAMERA_SPECS, cameras, CameraValues
from flock_follower.parameters.spec import check_values, EACH, NAMES, Spec
from flock_follower.ranges import Range
from flock_follower.visualization.follower_shapes import (
    Band,
    CameraSight,
    image_corners,
    PlannerReport,
    shapes,
    Snapshot,
)
from flock_follower.visualization.shapes import Shape

MARKERS_TOPIC = 'visualizer/markers'
NEWEST_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
NEIGHBORS_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
DIAGNOSTICS_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MARKERS_QOS = QoSProfile(depth=1)

ASK_PERIOD = 3.0  # s between two questions to planner and relative_pose
SETTLING = 2.0  # s in which tf_static is heard before a camera's frame is taken to be unknown
LIFETIME = 0.5  # s after which a viewer drops a marker that is not drawn again
IDLE_PERIOD = 0.2  # s between two looks whether someone looks
ODOMETRY = ('odom_child_position', 'odom_child_rpy')
PLANNER = ('d0', 'd1', 'radius')

SPECS = [
    Spec('rate', 10.0, 'of markers and transforms, while someone looks', Range(1.0, 50.0, 'Hz')),
    Spec('odom_tf', AUTO,
         'whether to broadcast odom -> base_link: auto, while no other node publishes on /tf (an '
         'odometry normally does); always; never', ODOM_TF),
]


class Visualizer(FlockNode):
    """Takes what the other nodes publish, while someone looks, and draws it."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('visualizer', **kwargs)
        values = self.declare(SPECS, lambda checked: checked).values
        self._period = 1.0 / values['rate']
        self._own: OdometryState | None = None
        self._neighbors: dict[str, OdometryState] = {}
        self._command: Command | None = None
        self._report = PlannerReport()
        self._cameras: dict[str, CameraSight] = {}
        self._told_cameras: list[CameraValues] = []
        self._frames: dict[str, str] = {}
        self._asked, self._started = -math.inf, time.monotonic()
        self._perception = RemoteParameters(self, 'relative_pose', self._take_perception)
        self._planner = RemoteParameters(self, 'planner')
        self._names = [*ODOMETRY, NAMES, 'camera_position', 'camera_rpy']

        self._inputs = PassingInputs(self)
        for msg_type, topic, callback, qos in (
                (Odometry, 'odom', self._take_odom, NEWEST_QOS),
                (Odometry, 'neighbors', self._take_neighbor, NEIGHBORS_QOS),
                (Odometry, 'neighbors/heard', self._take_neighbor, NEIGHBORS_QOS),
                (MultiDOFJointTrajectory, 'command/trajectory', self._take_command, NEWEST_QOS),
                (String, 'planner/state', self._take_state, LATCHED_QOS),
                (DiagnosticArray, '/diagnostics', self._take_diagnostics, DIAGNOSTICS_QOS)):
            self._inputs.add(msg_type, topic, callback, qos)
        self._static = StaticChild(self)
        self._transforms = TransformBroadcaster(self, self._static, values['odom_tf'])
        self._markers = self.create_publisher(MarkerArray, MARKERS_TOPIC, MARKERS_QOS)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(IDLE_PERIOD, self._tick, clock=steady)

    def _take_odom(self, message: Odometry) -> None:
        self._own = from_odometry(message)

    def _take_neighbor(self, message: Odometry) -> None:
        state = from_odometry(message)
        before = self._neighbors.get(state.child)
        if before is None or state.stamp >= before.stamp or state.stamp < before.stamp - 10**9:
            self._neighbors[state.child] = state

    def _take_command(self, message: MultiDOFJointTrajectory) -> None:
        self._command = from_trajectory(message, self._frame or message.header.frame_id)

    def _take_state(self, message: String) -> None:
        if message.data != self._report.state:  # why, and the rest, come with /diagnostics
            self._report = PlannerReport(message.data)

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        planner = f'{self.get_namespace().strip("/")}/planner'.lstrip('/')
        for status in message.status:
            if status.name == planner:
                said = {pair.key: pair.value for pair in status.values}
                self._report = PlannerReport(
                    said.get('state', ''), said.get('reason', ''), said.get('limits', ''),
                    tuple(filter(None, said.get('edges', '').split(', '))))

    def _take_perception(self, values: dict[str, Any]) -> None:
        """Take what relative_pose says of its cameras, and subscribe to their calibrations."""
        names = [name for name in values.get(NAMES) or [] if name]
        wanted = [spec.name.replace(EACH, name) for name in names
                  for spec in CAMERA_SPECS if EACH in spec.name]
        if any(name not in values for name in wanted):
            self._names += wanted
            self._perception.ask(self._names)
            return
        if self._told_cameras:
            return  # what is settable at start only
        given = check_values(CAMERA_SPECS, {
            name: value for name, value in values.items() if value is not None
            and name.startswith(('camera.', NAMES))})
        given |= {name: values[name] for name in ('camera_position', 'camera_rpy')
                  if values.get(name) is not None and not names}
        self._told_cameras = cameras(given)
        for told in self._told_cameras:
            self._inputs.add(
                CameraInfo, told.camera_info, partial(self._take_camera_info, told), NEWEST_QOS)

    def _take_camera_info(self, told: CameraValues, message: CameraInfo) -> None:
        link = Transform.from_quaternion(told.position, quaternion_from_rpy(*told.rpy))
        self._cameras[told.name] = CameraSight(
            link @ Transform(R_FLU_OPTICAL), image_corners(
                message.width, message.height, message.k,
                message.distortion_model == 'equidistant'))
        self._frames[told.name] = message.header.frame_id or (
            f'camera_{told.name}' if told.name else 'camera')

    def _tick(self) -> None:
        """Look whether someone looks; if so, take what waits and draw it."""
        drawn = self._markers.get_subscription_count() > 0
        listened = self._transforms.wanted
        self.diagnostics.values['watched'] = drawn or listened
        wanted = self._period if drawn or listened else IDLE_PERIOD
        if self._timer.timer_period_ns != round(wanted * 1e9):
            self._timer.timer_period_ns = round(wanted * 1e9)
        if not (drawn or listened):
            self._forget()
            return
        self._ask()
        self._inputs.take()
        known = self._known()
        if listened:
            self._broadcast(known)
        if drawn:
            self._markers.publish(self._message(known))
            self.diagnostics.rate('drawn').tick(time.monotonic())

    def _forget(self) -> None:
        """Unsubscribe: what is old by then is not to be drawn when someone looks again."""
        self._inputs.close()
        self._own = self._command = None
        self._neighbors.clear()

    def _ask(self) -> None:
        """Ask the other nodes for their parameters, now and then: the band can be changed."""
        now = time.monotonic()
        if now - self._asked >= ASK_PERIOD:
            self._asked = now
            self._planner.ask(PLANNER)
            if self._perception.values is None:
                self._perception.ask(self._names)

    @property
    def _frame(self) -> str:
        """Return the frame of the odometry, which all else is in."""
        if self._own is not None:
            return self._own.frame
        return next((state.frame for state in self._neighbors.values()), '')

    def _known(self) -> Snapshot:
        now = self.get_clock().now().nanoseconds
        return Snapshot(now, self._pose(), tuple(self._neighbors.values()), self._command,
                        self._report, self._band(), self._cameras)

    def _pose(self) -> tuple[int, Transform] | None:
        """Return the stamp of the newest odometry, ns, and where base_link is by it."""
        state = self._own
        if state is None:
            return None
        T_base_child = self._static.transform(state.child) or Transform()
        told = self._perception.values or {}
        if any(told.get(ODOMETRY[0]) or ()) or any(told.get(ODOMETRY[1]) or ()):
            T_base_child = Transform.from_quaternion(
                told[ODOMETRY[0]], quaternion_from_rpy(*told[ODOMETRY[1]]))
        T_odom_child = Transform.from_quaternion(state.position, state.quaternion)
        return state.stamp, T_odom_child @ T_base_child.inverse()

    def _band(self) -> Band | None:
        told = self._planner.values
        if told is None or None in told.values():
            return None
        return Band(told['d0'], told['d1'], told['radius'])

    def _broadcast(self, known: Snapshot) -> None:
        if known.own is not None and self._transforms.owns_odometry:
            stamp, pose = known.own
            self._transforms.move(stamp, self._frame, BASE, pose)
        for state in known.neighbors:
            self._transforms.move(state.stamp, state.frame, state.child, Transform.from_quaternion(
                state.position, state.quaternion))
        if time.monotonic() - self._started < SETTLING:
            return
        for name, camera in self._cameras.items():
            frame = self._frames[name]
            if not self._transforms.fix(known.now, BASE, frame, camera.T_body_optical):
                self.diagnostics.values[f'frame {frame}'] = 'told on /tf_static by another node'

    def _message(self, known: Snapshot) -> MarkerArray:
        stamp = nanoseconds_to_stamp(known.now)
        return MarkerArray(markers=[marker(shape, self._frame, stamp) for shape in shapes(known)])


def marker(shape: Shape, frame: str, stamp: Any) -> Marker:
    """Return the message of a shape; its name is the namespace, so that each can be hidden."""
    message = Marker(ns=shape.name, type=getattr(Marker, shape.kind), action=Marker.ADD,
                     text=shape.text, lifetime=Duration(seconds=LIFETIME).to_msg())
    message.header.frame_id, message.header.stamp = frame, stamp
    set_vector(message.pose.position, shape.position)
    set_quaternion(message.pose.orientation, shape.quaternion)
    set_vector(message.scale, shape.size)
    red, green, blue, opacity = shape.color
    message.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)
    message.points = [Point(x=x, y=y, z=z) for x, y, z in shape.points.tolist()]
    return message


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Visualizer, args)


if __name__ == '__main__':
    sys.exit(main())
