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
The visualizer node: the flight as markers and transforms for RViz and Foxglove.

Publishes ``visualizer/markers`` (leader, band, command, field of view, guard), and, if tf2_msgs is
installed, ``odom -> base_link -> camera`` and ``odom -> leader`` on ``/tf``. It works only while a
viewer subscribes, and no other node waits for it. ``nodes.shapes`` has the shapes;
the band and the cameras are parameters of planner and relative_pose.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import math
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
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
    set_stamp,
    set_vector,
)
from flock_follower.nodes.shapes import (
    Band,
    CameraSight,
    image_corners,
    PlannerReport,
    Shape,
    shapes,
    Snapshot,
)
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp
from flock_follower.nodes.support.diagnostics import publishers, STEADY
from flock_follower.nodes.support.inputs import (
    BASE,
    best_effort,
    LATCHED_QOS,
    StaticChild,
    TF_STATIC,
    transform_message,
)
from flock_follower.nodes.support.parameters import RemoteParameters
from flock_follower.nodes.support.runtime import FlockNode, run, Waiting
from flock_follower.parameters.cameras_table import CAMERA_SPECS, cameras, CameraValues
from flock_follower.parameters.spec import check_values, NAMES, Spec
from flock_follower.ranges import Range

MARKERS_TOPIC = 'visualizer/markers'
TF = '/tf'
#: Whether to broadcast odom -> base_link.
AUTO, ALWAYS, NEVER = ODOM_TF = 'auto', 'always', 'never'
ASK_PERIOD = 3.0  # s between two requests for parameters of planner and relative_pose
SETTLING = 2.0  # s in which tf_static is received before a camera's frame is taken as unknown
LIFETIME = 0.5  # s after which a viewer drops a marker that is not drawn again
IDLE_PERIOD = 0.2  # s between two looks for a viewer
ODOMETRY = ('odom_child_position', 'odom_child_rpy')
PLANNER = ('d0', 'd1', 'radius')

SPECS = [
    Spec('rate', 10.0, 'rate of markers and transforms, while a '
                       'viewer subscribes', Range(1.0, 50.0, 'Hz')),
    Spec('odom_tf', AUTO,
         'whether to broadcast odom -> base_link: auto, while no other node publishes on /tf (an '
         'odometry normally does); always; never', ODOM_TF),
]


class Visualizer(FlockNode):
    """
    Draws the messages of the other nodes while a viewer subscribes.

    Its inputs are subscribed to only then, and wait until a tick takes them: 200 messages per
    second cost 2 % of a core even if no callback takes them.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('visualizer', **kwargs)
        values = self.declare(SPECS, lambda checked: checked).values
        self._period = 1.0 / values['rate']
        self._own: OdometryState | None = None
        self._neighbors: dict[str, OdometryState] = {}
        self._command: Command | None = None
        self._report = PlannerReport()
        self._cameras: dict[str, CameraSight] = {}
        self._frames: dict[str, str] = {}
        self._asked, self._started = -math.inf, time.monotonic()
        self._perception = RemoteParameters(self, 'relative_pose', self._take_perception)
        self._planner = RemoteParameters(self, 'planner')
        self._inputs: list[tuple[Any, str, Callable[[Any], None], QoSProfile]] = [
            (Odometry, 'odom', self._take_odom, best_effort()),
            (Odometry, 'neighbors', self._take_neighbor, best_effort(10)),
            (Odometry, 'neighbors/heard', self._take_neighbor, best_effort(10)),
            (MultiDOFJointTrajectory, 'command/trajectory', self._take_command, best_effort()),
            (String, 'planner/state', self._take_state, LATCHED_QOS),
            (DiagnosticArray, '/diagnostics', self._take_diagnostics, best_effort(10))]
        self._open: list[Subscription] = []
        self._static = StaticChild(self)
        self._transforms = TransformBroadcaster(self, self._static, values['odom_tf'])
        self._markers = self.create_publisher(MarkerArray, MARKERS_TOPIC, 1)
        self._timer = self.create_timer(IDLE_PERIOD, self._tick, clock=STEADY)

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
                reported = {pair.key: pair.value for pair in status.values}
                self._report = PlannerReport(
                    reported.get('state', ''), reported.get('reason', ''),
                    reported.get('limits', ''),
                    tuple(filter(None, reported.get('edges', '').split(', '))))

    def _take_perception(self, values: dict[str, Any]) -> None:
        """Take the parameters of relative_pose; subscribe to the calibration of each camera."""
        given = check_values(CAMERA_SPECS, {
            name: value for name, value in values.items()
            if name.startswith(('camera.', NAMES))})
        for camera in cameras({**values, **given}):
            self._inputs.append((CameraInfo, camera.camera_info,
                                 partial(self._take_camera_info, camera), best_effort()))

    def _take_camera_info(self, camera: CameraValues, message: CameraInfo) -> None:
        link = Transform.from_quaternion(camera.position, quaternion_from_rpy(*camera.rpy))
        self._cameras[camera.name] = CameraSight(
            link @ Transform(R_FLU_OPTICAL), image_corners(
                message.width, message.height, message.k,
                message.distortion_model == 'equidistant'))
        self._frames[camera.name] = message.header.frame_id or (
            f'camera_{camera.name}' if camera.name else 'camera')

    def _tick(self) -> None:
        """Take the messages that wait and draw them, if a viewer subscribes."""
        drawn = self._markers.get_subscription_count() > 0
        listened = self._transforms.wanted
        self.diagnostics.values['watched'] = drawn or listened
        period = round(1e9 * (self._period if drawn or listened else IDLE_PERIOD))
        if self._timer.timer_period_ns != period:
            self._timer.timer_period_ns = period
        if not (drawn or listened):
            self._forget()
            return
        self._ask()
        self._take_inputs()
        known = self._known()
        if listened:
            self._broadcast(known)
        if drawn:
            stamp = nanoseconds_to_stamp(known.now)
            self._markers.publish(MarkerArray(
                markers=[marker(shape, self._frame, stamp) for shape in shapes(known)]))
            self.diagnostics.rate('drawn').tick(time.monotonic())

    def _forget(self) -> None:
        """Unsubscribe: a viewer that comes later is to see no old state."""
        for subscription in self._open:
            self.destroy_subscription(subscription)
        self._open.clear()
        self._own = self._command = None
        self._neighbors.clear()

    def _take_inputs(self) -> None:
        """Subscribe, if that is not yet done, and take the messages that wait."""
        for kind, topic, _, qos in self._inputs[len(self._open):]:
            self._open.append(self.create_subscription(
                kind, topic, lambda _: None, qos, callback_group=Waiting()))
        for (kind, topic, callback, _), subscription in zip(self._inputs, self._open):
            while (taken := subscription.handle.take_message(kind, False)) is not None:
                try:
                    callback(taken[0])
                except ValueError as error:
                    self.diagnostics.reject(f'invalid {topic}', str(error))

    def _ask(self) -> None:
        """Ask the other nodes for their parameters: the band can be changed in flight."""
        now = time.monotonic()
        if now - self._asked >= ASK_PERIOD:
            self._asked = now
            self._planner.ask(PLANNER)
            if self._perception.values is None:
                self._perception.ask()

    @property
    def _frame(self) -> str:
        """Return the frame of the odometry, which all else is in."""
        if self._own is not None:
            return self._own.frame
        return next((state.frame for state in self._neighbors.values()), '')

    def _known(self) -> Snapshot:
        band = self._planner.values
        return Snapshot(
            self.get_clock().now().nanoseconds, self._pose(), tuple(self._neighbors.values()),
            self._command, self._report,
            None if band is None else Band(*(band[name] for name in PLANNER)), self._cameras)

    def _pose(self) -> tuple[int, Transform] | None:
        """Return the stamp of the newest odometry, ns, and where base_link is by it."""
        state = self._own
        if state is None:
            return None
        T_base_child = self._static.transform(state.child) or Transform()
        values = self._perception.values or {}
        position, rpy = (values.get(name, ()) for name in ODOMETRY)
        if any(position) or any(rpy):
            T_base_child = Transform.from_quaternion(position, quaternion_from_rpy(*rpy))
        T_odom_child = Transform.from_quaternion(state.position, state.quaternion)
        return state.stamp, T_odom_child @ T_base_child.inverse()

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
                self.diagnostics.values[f'frame {frame}'] = (
                    'published on /tf_static by another node')


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


class TransformBroadcaster:
    """
    Broadcasts the frames that a follower knows; nothing if tf2_msgs is not installed.

    A frame has one parent: it jumps if two nodes broadcast its transform. So ``odom -> base_link``
    is left to the odometry, which normally broadcasts it (REP-105), and the frame of a camera to
    the node that broadcasts it on ``/tf_static``.

    :param odom_tf: one of ``ODOM_TF``.
    """

    def __init__(self, node: Node, static: StaticChild, odom_tf: str) -> None:
        self._node, self._static, self._odom_tf = node, static, odom_tf
        self._type = transform_message()
        self._stamps: dict[str, int] = {}
        self._fixed: dict[str, TransformStamped] = {}
        if self._type is not None:
            self._moving = node.create_publisher(self._type, TF, QoSProfile(depth=100))
            self._still = node.create_publisher(self._type, TF_STATIC, LATCHED_QOS)

    @property
    def wanted(self) -> bool:
        """Return whether a node subscribes to moving frames."""
        return self._type is not None and self._moving.get_subscription_count() > 0

    @property
    def owns_odometry(self) -> bool:
        """Return whether to broadcast odom -> base_link here."""
        others = set(publishers(self._node, TF)) - {self._node.get_fully_qualified_name()}
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


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Visualizer, args)


if __name__ == '__main__':
    sys.exit(main())
