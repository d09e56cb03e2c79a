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

"""The nodes with several cameras: topics, parameters, and what they tell of each camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import time
from typing import Any

from marker_images import make_camera, render
from nav_msgs.msg import Odometry
import numpy as np
from perception_rig import DEADLINE, PerceptionRig, START
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from flock_follower.geometry import IDENTITY_QUATERNION, Transform
from flock_follower.messages import from_odometry, stamp_to_nanoseconds
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry
from flock_follower.perception.images import GrayImage
from flock_follower.perception.tracker import camera_mounting

CAMERA = make_camera()
TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
POSITION = [0.1, 0.0, 0.0]
RPY = {'front': [0.0, 0.0, 0.0], 'left': [0.0, 0.0, 0.7]}
PARAMETERS = {'cameras': ['front', 'left'], 'camera.left.rpy': RPY['left'],
              'camera.left.position': POSITION}
EMPTY = render(CAMERA, {})


def leader(left: float) -> Transform:
    return Transform(np.eye(3), np.array([2.2, left, 0.1]))


def view(camera: str, left: float) -> GrayImage:
    mounting = camera_mounting(POSITION, RPY[camera])
    return render(CAMERA, {0: mounting.inverse() @ leader(left) @ TAIL}, rays=3)


class Rig(PerceptionRig):
    """relative_pose with two cameras, and odometry at rest."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__({'odom': Odometry, **{
            f'{camera}/{topic}': msgtype for camera in RPY
            for topic, msgtype in (('camera_info', CameraInfo), ('image_raw', Image))}},
            **{**PARAMETERS, **parameters})

    def odom(self, seconds: float) -> None:
        stamp = nanoseconds_to_stamp(START + round(seconds * 1e9))
        self.send('odom', to_odometry(stamp, 'odom', 'base_link', np.zeros(3),
                                      IDENTITY_QUATERNION, np.zeros(3)))

    def camera_info(self, camera: str) -> None:
        self.send(f'{camera}/camera_info', calibration())

    def image(self, camera: str, seconds: float, pixels: GrayImage) -> None:
        self.send_image(f'{camera}/image_raw', seconds, pixels, 'mono8')

    def problems(self, ahead: float = 0.0) -> str:
        """Return what /diagnostics says, or will say after that many seconds of the same."""
        return '; '.join(text for _, text in
                         self.perception.diagnostics.problems(time.monotonic() + ahead))


def calibration() -> CameraInfo:
    return CameraInfo(
        width=640, height=480, distortion_model='plumb_bob', k=CAMERA.matrix.ravel(),
        d=CAMERA.distortion.tolist(), p=np.hstack([CAMERA.matrix, np.zeros((3, 1))]).ravel())


@pytest.fixture
def rig() -> Iterator[Callable[..., Rig]]:
    rclpy.init()
    made: list[Rig] = []

    def make(**parameters: Any) -> Rig:
        made.append(Rig(**parameters))
        return made[-1]

    yield make
    for one in made:
        one.close()
    rclpy.shutdown()


def test_a_neighbour_is_told_from_either_image_and_every_image_counts(
        rig: Callable[..., Rig]) -> None:
    r = rig()
    for camera in RPY:
        r.camera_info(camera)
    for k in range(4):
        r.odom(0.05 * k)
        r.image('front', 0.05 * k, view('front', 0.0))
        r.image('left', 0.05 * k, EMPTY)
    r.wait(lambda: len(r.found) == 4 and len(r.frames) == 8)
    for k in range(4, 60):  # it is in no image, and then in that to the left
        r.odom(0.05 * k)
        if k > 52:
            r.image('front', 0.05 * k, EMPTY)
            r.image('left', 0.05 * k, view('left', 1.8))
    r.wait(lambda: len(r.frames) == 22)
    assert len(r.found) > 5
    np.testing.assert_allclose(from_odometry(r.found[0]).position, leader(0.0).translation,
                               atol=0.02)
    np.testing.assert_allclose(from_odometry(r.found[-1]).position, leader(1.8).translation,
                               atol=0.03)
    stamps = [stamp_to_nanoseconds(h.stamp) - START for h in r.frames]
    assert stamps[:4] == [0, 0, 50_000_000, 50_000_000]
    assert dict(r.perception.diagnostics.counters) == {}


def test_a_camera_that_stops_or_is_not_calibrated_is_named_while_the_other_goes_on(
        rig: Callable[..., Rig]) -> None:
    r = rig(max_wait=0.0)
    r.camera_info('front')
    r.odom(0.0)
    r.image('left', 0.0, EMPTY)
    for k in range(1, 4):
        r.odom(0.05 * k)
        r.image('front', 0.05 * k, view('front', 0.0))
    r.wait(lambda: len(r.found) == 3)
    assert dict(r.perception.diagnostics.counters) == {'no usable camera_info of camera left': 1}
    reported = r.problems(ahead=4.0)
    assert 'no /left/camera_info of camera left for 4 s' in reported
    assert 'no /left/image_raw of camera left for 4 s' in reported
    assert 'no image of camera left processed for 4 s: no usable camera_info' in reported
    assert 'no image of camera front processed' not in reported
    values = r.perception.diagnostics.values
    assert values['camera front'] == '640x480 plumb_bob' and 'camera left' not in values
    r.problems()
    assert values['time_offset front'].startswith('0.0 +- ') and 'time_offset left' in values


def test_each_camera_has_a_debug_image(rig: Callable[..., Rig]) -> None:
    r = rig()
    for camera in RPY:
        r.camera_info(camera)
    shown: list[Image] = []
    r.node.create_subscription(Image, 'relative_pose/debug_image/left', shown.append,
                               qos_profile_sensor_data)
    r.wait(lambda: r.perception.count_subscribers('relative_pose/debug_image/left'))
    for k in range(3):  # in the last one nobody is looked for: it is shown all the same
        r.odom(0.05 * k)
        r.image('front', 0.05 * k, view('front', -0.3))
        r.image('left', 0.05 * k, EMPTY)
        r.wait(lambda count=k + 1: len(shown) == count)
    assert {(image.width, image.height, image.encoding) for image in shown} == {
        (640, 480, 'bgr8')}


def test_a_camera_that_is_not_listed_is_refused() -> None:
    rclpy.init()
    try:
        with pytest.raises(ValueError, match=r"cameras = \['front', 'left'\]: must list back"):
            RelativePose(parameter_overrides=[
                Parameter(name, value=value) for name, value in {
                    **PARAMETERS, 'camera.back.rpy': [0.0, 0.0, 3.1]}.items()])
    finally:
        rclpy.shutdown()


def test_the_planner_sees_with_all_of_them() -> None:
    rclpy.init()
    planner = Planner(parameter_overrides=[
        Parameter(name, value=value) for name, value in PARAMETERS.items()])
    node, executor = Node('surroundings'), SingleThreadedExecutor()
    try:
        executor.add_node(planner)
        publishers = [node.create_publisher(CameraInfo, f'{name}/camera_info',
                                            qos_profile_sensor_data) for name in RPY]
        end = time.monotonic() + DEADLINE
        while len(planner._loop.view) != 2:
            assert time.monotonic() < end, 'waited in vain'
            for publisher in publishers:
                publisher.publish(calibration())
            executor.spin_once(timeout_sec=0.02)
        headings = [field.heading for field in planner._loop.view]
        assert sorted(headings) == pytest.approx([0.0, 0.7])
    finally:
        executor.shutdown()
        planner.destroy_node()
        node.destroy_node()
        rclpy.shutdown()
