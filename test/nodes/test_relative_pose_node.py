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

"""The perception node: what it publishes, what it waits for, and what it says when it cannot."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
import re
import time
from typing import Any

import cv2
from marker_images import make_camera, render, SIDE
from nav_msgs.msg import Odometry
import numpy as np
from perception_rig import PerceptionRig, START
import pytest
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Range, RegionOfInterest

from flock_follower.geometry import quaternion_from_yaw, quaternion_to_matrix, Transform
from flock_follower.messages import (
    from_odometry,
    MOTION_TOPIC,
    RELATIVE,
    stamp_to_nanoseconds,
)
from flock_follower.nodes import relative_pose
from flock_follower.nodes.relative_pose import main
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry
from flock_follower.perception.edge_fit import marker_corners
from flock_follower.perception.images import GrayImage
from flock_follower.perception.tracker import camera_mounting

CAMERA = make_camera()
TAIL = Transform(np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
                 np.array([-0.2, 0.0, 0.0]))
OWN = Transform.from_quaternion([1.0, 2.0, 3.0], quaternion_from_yaw(2.0))
LEADER = OWN @ Transform.from_quaternion([2.2, 0.3, 0.1], quaternion_from_yaw(0.3))
VELOCITY = np.array([0.5, 0.2, 0.0])  # of both, in odom


@pytest.fixture(scope='module')
def image() -> GrayImage:
    return view(0)


def view(marker_id: int) -> GrayImage:
    T_odom_camera = OWN @ camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    return render(CAMERA, {marker_id: T_odom_camera.inverse() @ LEADER @ TAIL})


class Rig(PerceptionRig):
    """relative_pose with one camera, and odometry that moves."""

    def __init__(self, **parameters: Any) -> None:
        compressed = parameters.get('image_transport') == 'compressed'
        super().__init__({
            'odom': Odometry, MOTION_TOPIC: Odometry, 'camera_info': CameraInfo, 'ranges': Range,
            **({'image_raw/compressed': CompressedImage} if compressed
               else {'image_raw': Image})}, **parameters)

    def odom(self, seconds: float, frame: str = 'odom') -> None:
        stamp = nanoseconds_to_stamp(START + round(seconds * 1e9))
        self.send('odom', to_odometry(
            stamp, frame, 'base_link', OWN.translation + seconds * VELOCITY, OWN.quaternion,
            OWN.rotation.T @ VELOCITY))

    def camera_info(self, **changes: Any) -> None:
        message = CameraInfo(
            width=640, height=480, distortion_model='plumb_bob',
            k=CAMERA.matrix.ravel(), d=CAMERA.distortion.tolist(),
            p=np.hstack([CAMERA.matrix, np.zeros((3, 1))]).ravel())
        for name, value in changes.items():
            setattr(message, name, value)
        self.send('camera_info', message)

    def image(self, seconds: float, pixels: GrayImage, encoding: str = 'mono8') -> None:
        self.send_image('image_raw', seconds, pixels, encoding)

    @property
    def counters(self) -> dict[str, int]:
        return dict(self.perception.diagnostics.counters)

    def problems(self, ahead: float = 0.0) -> str:
        """Return what /diagnostics says, or will say after that many seconds of the same."""
        return '; '.join(text for _, text in
                         self.perception.diagnostics.problems(time.monotonic() + ahead))


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


def test_a_second_print_of_its_marker_is_published_by_another_name_and_told(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    T_odom_camera = OWN @ camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
    wall = LEADER @ Transform(translation=np.array([0.8, -1.0, 0.0]))
    other = render(CAMERA, {0: T_odom_camera.inverse() @ wall @ TAIL})
    both = np.ascontiguousarray(np.where(np.arange(640) < 380, image, other))
    r = rig()
    r.camera_info()
    for k in range(6):
        r.send('odom', to_odometry(
            nanoseconds_to_stamp(START + k * 50_000_000), 'odom', 'base_link', OWN.translation,
            OWN.quaternion, np.zeros(3)))
        r.image(k / 20, both)
    r.wait(lambda: len(r.frames) == 6)
    r.wait(lambda: len(r.found) == 10)  # from the third image on it is no false detection
    assert [m.child_frame_id for m in r.found].count('leader') == 6
    assert r.found[-1].child_frame_id == 'leader/duplicate'
    np.testing.assert_allclose(from_odometry(r.found[-1]).position, wall.translation, atol=0.1)
    x, y, z = wall.translation
    assert re.search(r'the marker of leader is in sight twice: a second one is at \('
                     rf'{x:.1f}, {y:.1f}, {z:.1f}\) m in odom; cover it', r.problems())
    assert 'in sight twice' not in r.problems(ahead=3.0)


def test_an_image_becomes_a_neighbour_in_the_frame_of_odom(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.camera_info()
    for k in range(21):
        r.odom(k / 40, frame='vio_odom')
        if k % 2 == 0:
            r.image(k / 40, image)
    r.wait(lambda: len(r.found) == 11)
    message = r.found[-1]
    assert message.header.frame_id == 'vio_odom'
    assert message.child_frame_id == 'leader'
    state = from_odometry(message)
    assert state.stamp == START + 500_000_000
    np.testing.assert_allclose(state.position, LEADER.translation + 0.5 * VELOCITY, atol=0.02)
    np.testing.assert_allclose(quaternion_to_matrix(state.quaternion), LEADER.rotation, atol=0.06)
    # The twist is in the leader's body: from_odometry turns it into odom.
    np.testing.assert_allclose(state.velocity, VELOCITY, atol=0.1)
    linear = message.twist.twist.linear
    np.testing.assert_allclose([linear.x, linear.y, linear.z], LEADER.rotation.T @ VELOCITY,
                               atol=0.1)
    for covariance in (state.pose_covariance, state.twist_covariance):
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert r.counters == {}
    assert r.problems() == ''


def test_every_image_processed_is_told_with_or_without_a_neighbour_in_it(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(max_wait=0.0)
    r.camera_info()
    r.odom(0.0, frame='vio_odom')
    r.image(0.0, image)
    r.image(0.01, np.full_like(image, 128))
    r.image(5.0, image)  # without odometry nothing is looked for
    r.odom(5.0, frame='vio_odom')
    r.image(5.0, image)
    r.wait(lambda: len(r.frames) == 3)
    assert [stamp_to_nanoseconds(h.stamp) - START for h in r.frames] == [
        0, 10_000_000, 5_000_000_000]
    assert {h.frame_id for h in r.frames} == {'vio_odom'}
    assert len(r.found) == 2


def test_compressed_images_are_taken_where_asked_for(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(image_transport='compressed')
    r.camera_info()
    r.odom(0.0)
    message = CompressedImage(format='jpeg', data=array(
        'B', cv2.imencode('.jpg', image)[1].tobytes()))
    message.header.stamp = nanoseconds_to_stamp(START)
    r.send('image_raw/compressed', message)
    r.wait(lambda: r.found)
    np.testing.assert_allclose(from_odometry(r.found[0]).position, LEADER.translation, atol=0.03)


def test_an_image_waits_for_its_odometry(rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(max_wait=1.0)
    r.camera_info()
    r.odom(0.0)
    r.image(0.012, image)
    r.odom(0.010)
    assert not r.found
    r.odom(0.015)
    r.wait(lambda: r.found)
    assert from_odometry(r.found[0]).stamp == START + 12_000_000
    assert r.counters == {}


def test_an_image_whose_odometry_stays_away_is_extrapolated_or_dropped_in_time(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(max_wait=0.02)
    r.camera_info()
    r.odom(0.0)
    r.image(0.025, image)
    r.wait(lambda: r.found)  # 25 ms are extrapolated
    r.image(0.1, image)
    r.wait(lambda: r.counters)
    assert r.counters == {'odometry has not reached the image stamp': 1}
    assert len(r.found) == 1


def test_time_that_jumps_back_restarts_and_goes_on(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.camera_info()
    for start in (100.0, 0.0):
        r.found.clear()
        r.odom(start)
        r.odom(start + 0.02)
        r.image(start + 0.01, image)
        r.wait(lambda: r.found)
    assert r.counters == {'time jumped back': 1}


def test_without_camera_info_it_says_so(rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.odom(0.0)
    r.image(0.0, image)
    r.wait(lambda: r.counters == {'no usable camera_info': 1})
    assert 'no /camera_info for' in r.problems(ahead=4.0)
    assert 'no image processed for 4 s: no usable camera_info' in r.problems(ahead=4.0)


def test_without_odometry_it_says_so(rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(max_wait=0.0)
    r.camera_info()
    r.image(0.0, image)
    r.wait(lambda: r.counters == {'no odometry yet': 1})
    assert 'no /odom for' in r.problems(ahead=4.0)
    assert 'no image processed for 4 s: no odometry yet' in r.problems(ahead=4.0)


def test_another_image_transport_is_pointed_to(rig: Callable[..., Rig]) -> None:
    rclpy.shutdown()
    rclpy.init(args=['--ros-args', '-r', '__ns:=/alone'])  # topics of no earlier test
    r = rig()
    hint = '/alone/image_raw/compressed is published: set image_transport to compressed'
    assert hint not in r.problems()
    r.node.create_publisher(CompressedImage, 'image_raw/compressed', 1)
    r.wait(lambda: hint in r.problems())


def test_a_wrong_marker_is_named_beside_the_wanted_one(
        rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    r = rig()
    r.camera_info()
    r.odom(0.0)
    wrong = view(7)
    r.image(0.0, wrong)
    assert r.problems() == ''  # not at once: markers come and go
    monkeypatch.setattr(relative_pose, 'UNSEEN_TIMEOUT', 0.2)

    def reported() -> bool:
        r.image(0.0, wrong)
        return r.problems() != ''

    r.wait(reported)
    assert r.problems() == (
        'not in sight: leader (marker 0 of DICT_4X4_50); in sight are markers 7')
    assert not r.found


IMAGE_FAULTS: dict[str, dict[str, Any]] = {
    'must be one of mono8': {'encoding': 'jpeg2000'},
    'step = 639: ': {'step': 639},
    'data has 0 bytes': {'data': array('B')},
    'image = 640x240: camera_info is for 640x480': {'height': 240}}


def test_every_corrupt_image_is_dropped_counted_and_explained(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.camera_info()
    r.odom(0.0)
    for count, (text, changes) in enumerate(IMAGE_FAULTS.items(), start=1):
        message = Image(height=480, width=640, step=640, encoding='mono8',
                        data=array('B', image.tobytes()))
        message.header.stamp = nanoseconds_to_stamp(START)
        for name, value in changes.items():
            setattr(message, name, value)
        r.send('image_raw', message)
        assert r.counters == {'invalid image': count}, text
        assert text in r.problems(ahead=4.0)
    assert not r.found
    r.image(0.0, image)
    r.wait(lambda: r.found)
    assert r.problems() == ''


CAMERA_FAULTS: list[tuple[str, dict[str, Any]]] = [
    ('K = 0: the camera is not calibrated', {'k': np.zeros(9)}),
    ("distortion_model = 'barrel'", {'distortion_model': 'barrel'}),
    ('width = 0: must be an integer in [1, 65535] px', {'binning_x': 2**32 - 1}),
    ('roi = 640x480+600+0', {'roi': RegionOfInterest(x_offset=600, width=640, height=480)})]


def test_every_corrupt_camera_info_is_dropped_counted_and_explained(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(max_wait=0.0)
    r.odom(0.0)
    r.camera_info()
    for count, (text, changes) in enumerate(CAMERA_FAULTS, start=1):
        r.camera_info(**changes)
        r.image(0.0, image)
        assert r.counters == {'invalid camera_info': count, 'no usable camera_info': count}, text
        assert text in r.problems(ahead=4.0)
    assert not r.found
    r.camera_info()
    r.image(0.0, image)
    r.wait(lambda: r.found)


def test_the_debug_image_is_drawn_only_while_someone_looks(
        rig: Callable[..., Rig], image: GrayImage, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    annotate = relative_pose.annotate
    monkeypatch.setattr(relative_pose, 'annotate',
                        lambda *args: calls.append(args) or annotate(*args))
    r = rig()
    r.camera_info()
    for seconds in (0.0, 0.05, 0.1):
        r.odom(seconds)
    r.image(0.0, image)
    r.wait(lambda: r.found)
    assert not calls
    shown: list[Image] = []
    subscription = r.node.create_subscription(
        Image, 'relative_pose/debug_image', shown.append, qos_profile_sensor_data)
    r.wait(lambda: r.node.count_publishers('relative_pose/debug_image')
           and r.perception.count_subscribers('relative_pose/debug_image'))
    r.image(0.05, image)
    r.wait(lambda: shown)
    r.node.destroy_subscription(subscription)
    r.wait(lambda: not r.perception.count_subscribers('relative_pose/debug_image'))
    r.image(0.1, image)
    r.wait(lambda: len(r.found) == 3)
    assert len(calls) == 1

    message = shown[0]
    assert message.header.stamp == nanoseconds_to_stamp(START + 50_000_000)
    assert (message.height, message.width, message.step) == (480, 640, 1920)
    assert message.encoding == 'bgr8'
    drawn = np.frombuffer(message.data, dtype=np.uint8).reshape(480, 640, 3).astype(int)
    # The outline's colour is at the marker's corners.
    T_camera_marker = (OWN @ camera_mounting([0.1, 0.0, 0.0], [0.0, 0.0, 0.0])).inverse() @ (
        LEADER @ TAIL)
    for u, v in np.rint(CAMERA.project(T_camera_marker.apply(marker_corners(SIDE)))).astype(int):
        patch = drawn[v - 2:v + 3, u - 2:u + 3]
        assert (patch.max(axis=2) - patch.min(axis=2)).max() > 60


def test_bad_odometry_is_counted_and_survived(rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.camera_info()
    r.send('odom', to_odometry(nanoseconds_to_stamp(START), 'odom', 'base_link',
                               [np.nan, 0.0, 0.0], OWN.quaternion, np.zeros(3)))
    assert r.counters == {'invalid odom': 1}
    r.odom(0.0)
    r.image(0.0, image)
    r.wait(lambda: r.found)


@pytest.mark.parametrize(('parameter', 'message'), [
    ('neighbors_file:=/nowhere.yaml', 'nowhere.yaml'),
    ('camera_position:=[1.0]', 'camera_position = .*list of 3 finite numbers m'),
    ('image_transport:=theora', "image_transport = 'theora': must be one of raw, compressed"),
    ('acceleration:=0.0', r'acceleration = 0\.0'),
    ('neighbours_file:=x.yaml', 'unknown parameter neighbours_file')])
def test_bad_parameters_are_one_line_and_exit_code_1(
        parameter: str, message: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(['relative_pose', '--ros-args', '-p', parameter]) == 1
    error = capfd.readouterr().err
    assert 'Traceback' not in error
    (line,) = [line for line in error.splitlines() if line.startswith('error:')]
    assert re.search(message, line)


def measure(r: Rig, seconds: float, distance: float, name: str = 'leader',
            **limits: float) -> None:
    message = Range(range=distance, **limits)
    message.header.frame_id = name
    message.header.stamp = nanoseconds_to_stamp(START + round(seconds * 1e9))
    r.send('ranges', message)


def test_out_of_sight_its_distance_goes_on_as_told_by_ranges(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.camera_info()
    true = float(np.linalg.norm(LEADER.translation - OWN.translation))
    for k in range(81):  # 2 s in sight
        r.odom(k / 40)
        if k % 2 == 0:
            r.image(k / 40, image)
            measure(r, k / 40, true + 0.2)
    r.wait(lambda: len(r.found) == 41)
    assert r.counters == {}
    for k in range(81, 161):  # and 2 s not: it stays where it is beside oneself
        r.odom(k / 40)
        if k % 2 == 0:
            measure(r, k / 40, true + 0.2)
    r.wait(lambda: stamp_to_nanoseconds(r.found[-1].header.stamp) == START + 4_000_000_000)
    assert len(r.found) == 41 + 30  # half a second later it begins
    state = from_odometry(r.found[-1])
    sight = state.position - OWN.translation - 4.0 * VELOCITY
    distance = float(np.linalg.norm(sight))
    assert distance == pytest.approx(true, abs=0.05)
    along = sight / distance
    assert along @ state.pose_covariance[:3, :3] @ along < 0.1 ** 2
    assert np.trace(state.pose_covariance[:3, :3]) > 0.5 ** 2
    assert len(r.frames) == 41  # nothing was looked at
    r.perception.diagnostics.problems(time.monotonic())
    values = r.perception.diagnostics.values
    assert float(values['range_bias_leader_m']) == pytest.approx(0.2, abs=0.03)
    assert float(values['range_outliers_leader_percent']) == 0.0
    assert r.perception.diagnostics.rates['ranges_leader_hz'].count == 81


def test_ranges_that_cannot_be_used_are_counted_by_their_reason(
        rig: Callable[..., Rig]) -> None:
    r = rig()
    measure(r, 0.0, 2.0)
    for k in range(6):
        r.odom(k / 5)
    for distance, name in ((2.0, 'nobody'), (float('nan'), 'leader'), (2.0, 'leader'),
                           (2.0, 'leader')):
        measure(r, 1.0, distance, name)
    measure(r, 1.0, 0.1, min_range=0.3, max_range=50.0)
    assert r.counters == {
        'range without odometry': 1, 'range of an unknown neighbour': 1, 'range not finite': 1,
        'range outside min_range and max_range': 1,
        'range stamped as one before, or earlier': 1}
    assert not r.found


def test_the_motion_without_odometry_places_the_neighbour_in_its_own_frame(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.camera_info()
    for k in range(4):
        r.odom(k / 20)
        r.send(MOTION_TOPIC, to_odometry(
            nanoseconds_to_stamp(START + k * 50_000_000), RELATIVE, 'base_link', (9.0, 0.0, 3.0),
            OWN.quaternion, np.zeros(3)))
        r.image(k / 20, image)
    r.wait(lambda: len(r.found) >= 3)
    assert r.found[-1].header.frame_id == RELATIVE
    place = from_odometry(r.found[-1]).position - [9.0, 0.0, 3.0]
    np.testing.assert_allclose(place, LEADER.translation - OWN.translation, atol=0.03)
