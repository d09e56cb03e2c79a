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
The recipes of launch/ in the real nodes, with messages as sources send them (docs/sensors.md).

The nodes have the parameters and topics of the launch file. The follower flies a circle with the
leader at the end of a pole before it, which is therefore always at the same place in the image.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from driven import Driven, overrides, START
from launch_files import launched
from launch_files import Node as Started
from marker_images import render
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image

from flock_follower.geometry import (
    Array,
    quaternion_from_rpy,
    quaternion_from_yaw,
    Transform,
)
from flock_follower.messages import from_odometry, stamp_to_nanoseconds
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry
from flock_follower.perception.camera import CameraModel
from flock_follower.perception.tracker import camera_mounting

INFRARED = CameraModel(np.array([[383.0, 0.0, 320.5], [0.0, 383.0, 238.2], [0.0, 0.0, 1.0]]),
                       np.zeros(5), 'plumb_bob', 640, 480)
FISHEYE = CameraModel(np.array([[285.2, 0.0, 421.0], [0.0, 285.3, 400.1], [0.0, 0.0, 1.0]]),
                      np.array([-0.006, 0.043, -0.040, 0.007]), 'equidistant', 848, 800)
WEBCAM = CameraModel(np.array([[640.0, 0.0, 318.0], [0.0, 640.0, 243.0], [0.0, 0.0, 1.0]]),
                     np.array([0.1, -0.2, 0.001, -0.001, 0.0]), 'plumb_bob', 640, 480)
TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))  # the marker in config/neighbors.yaml
POLE = Transform.from_quaternion([1.6, 0.15, 0.05], quaternion_from_yaw(0.3))
RADIUS, RATE = 1.0, 0.5  # m and rad/s of the circle


class Source(NamedTuple):
    """
    What the odometry and the camera of a recipe send, and what is found out about them.

    ``twist`` is the frame of the velocity, or 'none'; ``rate`` in Hz. If it ``lacks`` them there
    are no angular rates and no covariances. Its messages come ``late``, s.
    """

    recipe: str
    frame: str
    child: str
    twist: str
    rate: int
    lacks: bool = False
    late: float = 0.0
    camera: CameraModel = INFRARED
    encoding: str = 'mono8'
    arguments: tuple[tuple[str, str], ...] = ()


SOURCES = {
    'OpenVINS': Source('d435i_openvins', 'global', 'imu', 'child', 200),
    'VINS-Fusion': Source('d435i_vins_fusion', 'world', '', 'odom', 200, lacks=True),
    'VINS-Fusion, /odometry': Source(
        'd435i_vins_fusion', 'world', 'world', 'odom', 20, lacks=True, late=0.1,
        arguments=(('odom', '/odometry'),)),
    'rtabmap': Source('d435i_rtabmap', 'odom', 'camera_link', 'child', 30),
    'T265': Source('t265', 'camera_odom_frame', 'camera_pose_frame', 'child', 200,
                   camera=FISHEYE),
    'as REP-105': Source('usb_camera', 'odom', 'base_link', 'child', 50, camera=WEBCAM,
                         encoding='yuv422_yuy2'),
    'ORB-SLAM3': Source('usb_camera', 'map', 'camera', 'none', 30, lacks=True, camera=WEBCAM,
                        arguments=(('odom', '/orb_slam3/odometry'),)),
    # x left, y up, z ahead, as the quadrotor in docs/sensors.md has it.
    'basalt': Source('usb_camera', 'vision', 'odom', 'odom', 20, lacks=True, late=0.05,
                     camera=WEBCAM, arguments=(('odom_child_rpy', '[1.5708, 0.0, 1.5708]'),)),
}


def own(t: float) -> Transform:
    """Return T_odom_base of the follower at t, s; it flies where it looks."""
    yaw = 2.0 + RATE * t
    return Transform.from_quaternion(
        [1.0 + RADIUS * np.sin(yaw), 2.0 - RADIUS * np.cos(yaw), 1.5], quaternion_from_yaw(yaw))


def velocity(t: float, point: Array) -> Array:
    """Return the velocity (3,) in odom of a point (3,) on the follower."""
    return own(t).rotation @ (np.array([RADIUS * RATE, 0.0, 0.0])
                              + np.cross([0.0, 0.0, RATE], point))


def stamp(t: float) -> Any:
    return nanoseconds_to_stamp(START + round(t * 1e9))


class Rig:
    """The nodes of a recipe, with its camera and its odometry."""

    def __init__(self, source: Source, **arguments: str) -> None:
        nodes, self.topics = launched('camera.launch.py', recipe=source.recipe,
                                      **dict(source.arguments), **arguments)
        given = nodes['relative_pose'].parameters[-1]
        self.source = source
        self.T_base_child = Transform.from_quaternion(
            given.get('odom_child_position', [0.0] * 3),
            quaternion_from_rpy(*given.get('odom_child_rpy', [0.0] * 3)))
        self.perception = start(RelativePose, nodes['relative_pose'])
        self.planner = start(Planner, nodes['planner'], require_bridge=False)
        self.found = self.perception.sent['neighbors']
        mounting = camera_mounting(given['camera_position'], given['camera_rpy'])
        self.image = image(source, render(source.camera, {
            0: mounting.inverse() @ POLE @ TAIL}))
        camera = source.camera
        self.give('camera_info', CameraInfo(
            width=camera.width, height=camera.height, distortion_model=camera.model,
            k=camera.matrix.ravel(), d=camera.distortion.tolist()))

    def give(self, topic: str, message: Any) -> None:
        """Pass a message to the nodes on the topic that the launch file gives them."""
        for node in (self.perception, self.planner)[:1 if topic == 'image' else 2]:
            node.give(self.topics[topic], message)

    def odometry(self, t: float) -> Odometry:
        """Return what the source sends at t, s."""
        source, T_odom_child = self.source, own(t) @ self.T_base_child
        linear = velocity(t, self.T_base_child.translation)
        if source.twist == 'child':
            linear = T_odom_child.rotation.T @ linear
        elif source.twist == 'none':
            linear = np.zeros(3)
        rates = self.T_base_child.rotation.T @ [0.0, 0.0, RATE]
        covariance = 1e-4 * np.eye(6)
        if source.lacks:
            rates, covariance = np.zeros(3), None
        return to_odometry(stamp(t), source.frame, source.child, T_odom_child.translation,
                           T_odom_child.quaternion, linear, rates, covariance, covariance)

    def fly(self, since: float, until: float) -> None:
        """Send what comes between two times, s: all odometry, and ten images per second."""
        rate = self.source.rate
        for k in range(round(since * rate), round(until * rate)):
            t = k / rate
            for node in (self.perception, self.planner):
                node.pass_time(START + round(t * 1e9))
            if t - self.source.late >= since - 1e-9:
                self.give('odom', self.odometry(t - self.source.late))
            if k % (rate // 10) == 0:
                self.image.header.stamp = stamp(t)
                self.give('image', self.image)

    def close(self) -> None:
        self.perception.close()
        self.planner.close()


def start(kind: Callable[..., Any], as_launched: Started, **values: Any) -> Driven:
    """Return a node with the parameters and remappings of its launch file."""
    *files, given = as_launched.parameters
    arguments = [word for file in files for word in ('--params-file', file)] + [
        word for rule in as_launched.remappings for word in ('-r', ':='.join(rule))]
    return Driven(kind(cli_args=['--ros-args', *arguments], parameter_overrides=overrides(
        **{**given, **values, 'use_sim_time': True})))


def image(source: Source, pixels: Any) -> Image:
    """Return a grey image in the encoding of a source."""
    height, width = pixels.shape
    if source.encoding == 'yuv422_yuy2':  # brightness and colour take turns
        pixels = np.stack([pixels, np.full_like(pixels, 128)], axis=-1)
    return Image(height=height, width=width, step=pixels.size // height,
                 encoding=source.encoding, data=array('B', pixels.tobytes()))


@pytest.fixture
def rig(ros: None) -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(source: Source, **arguments: str) -> Rig:
        made.append(Rig(source, **arguments))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.mark.parametrize('name', SOURCES)
def test_neighbours_come_out_where_they_are_and_the_velocity_is_read_rightly(
        rig: Callable[..., Rig], name: str) -> None:
    source = SOURCES[name]
    r, most = rig(source), 0.15 if source.twist == 'none' else 0.1
    r.fly(0.0, 3.0)
    late = [from_odometry(message) for message in r.found if (
        stamp_to_nanoseconds(message.header.stamp) > START + 2_000_000_000)]
    assert len(late) >= 8
    for state in late:
        t = (state.stamp - START) * 1e-9
        np.testing.assert_allclose(state.position, (own(t) @ POLE).translation, atol=0.02)
        np.testing.assert_allclose(state.velocity, velocity(t, POLE.translation), atol=most)
    mine = r.planner.node._loop.memory.own
    np.testing.assert_allclose(mine.velocity, velocity(mine.stamp, np.zeros(3)), atol=most)
    for node in (r.perception, r.planner):
        node.diagnostics.publish()
        values = node.values
        assert values['odom_twist'].startswith(f'auto: {source.twist} by')
        assert ('angular velocity' in values['odom_lacks']) == source.lacks
        assert float(values['odom_latency_s']) == pytest.approx(source.late, abs=1e-6)
        # Of the first sighting nobody knows how fast the leader is.
        assert node.counters.keys() <= {'estimate too uncertain'}
