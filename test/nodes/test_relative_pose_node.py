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

"""The perception node: outputs, waiting for odometry, and reports; with one or several cameras."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
import re
from types import SimpleNamespace
from typing import Any

from driven import Driven, overrides, START, to_odometry
from geometry_msgs.msg import TransformStamped
from marker_images import make_camera, render, TAIL
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image, Range, RegionOfInterest
from std_msgs.msg import Header

from flock_follower.geometry import (
    quaternion_from_rpy,
    quaternion_from_yaw,
    quaternion_to_matrix,
    Transform,
)
from flock_follower.messages import (
    MOTION_TOPIC,
    RELATIVE,
    set_quaternion,
    set_vector,
    stamp_to_nanoseconds,
)
from flock_follower.messages.poses import from_pose
from flock_follower.messages.state_reader import from_odometry
from flock_follower.nodes import relative_pose
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp
from flock_follower.perception.images import GrayImage
from flock_follower.perception.tracker import camera_mounting

CAMERA = make_camera()
OWN = Transform.from_quaternion([1.0, 2.0, 3.0], quaternion_from_yaw(2.0))
AHEAD = Transform.from_quaternion([2.2, 0.3, 0.1], quaternion_from_yaw(0.3))
LEADER = OWN @ AHEAD
VELOCITY = np.array([0.5, 0.2, 0.0])  # of both, in odom
RPY = {'front': [0.0, 0.0, 0.0], 'left': [0.0, 0.0, 0.7]}
TWO = {'cameras': ['front', 'left'], 'camera.left.rpy': RPY['left'],
       'camera.left.position': [0.1, 0.0, 0.0]}
EMPTY = np.full((480, 640), 128, np.uint8)


def view(marker_id: int = 0, leader: Transform = AHEAD, camera: str = 'front') -> GrayImage:
    """Return the image of a leader at a pose on the body of the follower."""
    mounting = camera_mounting([0.1, 0.0, 0.0], RPY[camera])
    return render(CAMERA, {marker_id: mounting.inverse() @ leader @ TAIL})


@pytest.fixture(scope='module')
def image() -> GrayImage:
    return view()


def calibration(**changes: Any) -> CameraInfo:
    message = CameraInfo(
        width=640, height=480, distortion_model='plumb_bob',
        k=CAMERA.matrix.ravel(), d=CAMERA.distortion.tolist(),
        p=np.hstack([CAMERA.matrix, np.zeros((3, 1))]).ravel())
    for name, value in changes.items():
        setattr(message, name, value)
    return message


class Rig(Driven):
    """relative_pose, and odometry that moves."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(RelativePose(parameter_overrides=overrides(**parameters)))
        self.found, self.frames = self.sent['neighbors'], self.sent['neighbors/frames']

    def odom(self, seconds: float, frame: str = 'odom', velocity: Any = VELOCITY) -> None:
        self.give('odom', to_odometry(
            nanoseconds_to_stamp(START + round(seconds * 1e9)), frame, 'base_link',
            OWN.translation + seconds * velocity, OWN.quaternion, OWN.rotation.T @ velocity))

    def image(self, seconds: float, pixels: GrayImage, topic: str = 'image_raw',
              **changes: Any) -> None:
        message = Image(height=480, width=640, step=640, encoding='mono8',
                        data=array('B', pixels.tobytes()))
        message.header.stamp = nanoseconds_to_stamp(START + round(seconds * 1e9))
        for name, value in changes.items():
            setattr(message, name, value)
        self.give(topic, message)

    def range(self, seconds: float, distance: float, name: str = 'leader',
              **limits: float) -> None:
        message = Range(range=distance, **limits)
        message.header.frame_id = name
        message.header.stamp = nanoseconds_to_stamp(START + round(seconds * 1e9))
        self.give('ranges', message)

    def watch(self, topic: str) -> list[Any]:
        """Subscribe to a debug image, or to poses; return what is sent."""
        publisher = next(p for p in self.node.publishers if p.topic_name.endswith(topic))
        publisher.get_subscription_count = lambda: 1
        return self.sent[publisher.topic_name.lstrip('/')]


@pytest.fixture
def rig(ros: None) -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(**parameters: Any) -> Rig:
        made.append(Rig(**parameters))
        for topic in (f'{name}/camera_info' for name in parameters.get('cameras', [])):
            made[-1].give(topic, calibration())
        if 'cameras' not in parameters:
            made[-1].give('camera_info', calibration())
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_an_image_becomes_a_neighbor_in_the_frame_of_odom(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    for k in range(21):
        r.odom(k / 40, frame='vio_odom')
        if k % 2 == 0:
            r.image(k / 40, image)
    assert len(r.found) == len(r.sent['neighbors/acceleration']) == 11
    message = r.found[-1]
    assert (message.header.frame_id, message.child_frame_id) == ('vio_odom', 'leader')
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


def test_measured_pose_is_in_the_frame_of_the_image(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    for k in range(5):
        if k == 1:  # nobody subscribed to the first one
            assert not r.sent['neighbors/leader/pose']
            r.watch('neighbors/leader/pose')
        r.odom(k / 40)
        r.image(k / 40, image if k < 3 else EMPTY, header=Header(
            frame_id='optical', stamp=nanoseconds_to_stamp(START + round(k / 40 * 1e9))))
    assert len(r.frames) == 5
    poses = [from_pose(message) for message in r.sent['neighbors/leader/pose']]
    # None is repeated while the neighbor is out of sight.
    assert [pose.stamp - START for pose in poses] == [25_000_000, 50_000_000]
    true = camera_mounting([0.1, 0.0, 0.0], RPY['front']).inverse() @ AHEAD
    assert poses[-1].frame == 'optical' and poses[-1].covariance is not None
    np.testing.assert_allclose(poses[-1].position, true.translation, atol=0.02)
    np.testing.assert_allclose(
        quaternion_to_matrix(poses[-1].quaternion), true.rotation, atol=0.06)
    assert np.linalg.eigvalsh(poses[-1].covariance).min() > 0.0
    assert r.counters == {} and r.problems() == ''


def test_second_print_is_published_by_another_name_and_reported(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    other = AHEAD @ Transform(translation=np.array([0.8, -1.0, 0.0]))
    both = np.ascontiguousarray(
        np.where(np.arange(640) < 380, image, view(leader=other)))
    r = rig()
    for k in range(6):
        r.odom(k / 20, velocity=np.zeros(3))
        r.image(k / 20, both)
    assert len(r.frames) == 6 and len(r.found) == 10  # from the third image on no false detection
    assert [m.child_frame_id for m in r.found].count('leader') == 6
    assert r.found[-1].child_frame_id == 'leader/duplicate'
    place = (OWN @ other).translation
    np.testing.assert_allclose(from_odometry(r.found[-1]).position, place, atol=0.1)
    x, y, z = place
    assert re.search(r'the marker of leader is in sight twice: a second one is at \('
                     rf'{x:.1f}, {y:.1f}, {z:.1f}\) m in odom; cover it', r.problems())
    assert 'in sight twice' not in r.problems(ahead=3.0)


def test_every_processed_image_is_reported_with_or_without_hit(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(max_wait=0.0)
    r.image(0.0, image)  # without odometry nothing is looked for
    assert re.search(r'no image processed for \d s: no odometry yet', r.problems(ahead=4.0))
    r.odom(0.0, frame='vio_odom')
    r.image(0.0, image)
    r.image(0.01, EMPTY)
    r.image(5.0, image)
    r.odom(5.0, frame='vio_odom')
    r.image(5.0, image)
    assert [stamp_to_nanoseconds(h.stamp) - START for h in r.frames] == [
        0, 10_000_000, 5_000_000_000]
    assert {h.frame_id for h in r.frames} == {'vio_odom'} and len(r.found) == 2
    assert r.counters['no odometry yet'] == 1 and 'no /odom for' in r.problems(ahead=4.0)


def test_image_without_odometry_is_extrapolated_or_dropped(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig(max_wait=0.05)
    r.odom(0.0)
    r.image(0.015, image)
    assert not r.found
    r.wait(lambda: r.found)  # 15 ms are extrapolated
    r.image(0.1, image)
    r.wait(lambda: r.counters)
    assert r.counters == {'odometry has not reached the image stamp': 1} and len(r.found) == 1


def test_a_wrong_marker_is_named_beside_the_wanted_one(
        rig: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    r, wrong = rig(), view(7)
    r.odom(0.0)
    r.image(0.0, wrong)
    assert r.problems() == ''  # not at once: markers come and go
    monkeypatch.setattr(relative_pose, 'UNSEEN_TIMEOUT', 0.2)
    r.wait(lambda: r.image(0.0, wrong) or r.problems())
    assert r.problems() == (
        'not in sight: leader (marker 0 of DICT_4X4_50); in sight are markers 7')
    assert not r.found


@pytest.mark.parametrize(('text', 'changes', 'counters'), [
    ('must be one of mono8', {'encoding': 'jpeg2000'}, {'invalid image': 1}),
    ('image = 640x240: camera_info is for 640x480', {'height': 240}, {'invalid image': 1}),
    ('K = 0: the camera is not calibrated', {'k': np.zeros(9)},
     {'invalid camera_info': 1, 'no usable camera_info': 1}),
    ('K is for another image', {'k': np.array([
        1200.0, 0.0, 640.0, 0.0, 1200.0, 480.0, 0.0, 0.0, 1.0])},
     {'invalid camera_info': 1, 'no usable camera_info': 1}),
    ('roi = 640x480+600+0', {'roi': RegionOfInterest(x_offset=600, width=640, height=480)},
     {'invalid camera_info': 1, 'no usable camera_info': 1})])
def test_what_is_corrupt_is_dropped_counted_and_explained(
        rig: Callable[..., Rig], image: GrayImage, text: str, changes: dict[str, Any],
        counters: dict[str, int]) -> None:
    r = rig(max_wait=0.0)
    r.odom(0.0)
    if 'invalid image' in counters:
        r.image(0.0, image, **changes)
    else:
        r.give('camera_info', calibration(**changes))
        r.image(0.0, image)
    assert r.counters == counters and not r.found
    assert text in r.problems(ahead=4.0)
    r.give('camera_info', calibration())
    r.image(0.0, image)
    assert r.found and r.problems() == ''


def test_distorted_images_of_a_rectified_topic_are_named(rig: Callable[..., Rig]) -> None:
    images = {'camera.left.image': 'left/image_rect', 'image_transport': 'compressed'}
    assert 'rectified:=true' in rig(**TWO, **images).problems()
    assert 'rectified:=true' not in rig(
        **TWO, **images, **{'camera.left.rectified': True}).problems()
    assert 'rectified:=true' not in rig(**TWO).problems()


def test_the_debug_image_is_drawn_only_while_someone_looks(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    r.odom(0.0)
    r.odom(0.05)
    r.image(0.0, image)
    assert r.found and not r.sent['relative_pose/debug_image']
    shown = r.watch('debug_image')
    r.image(0.05, image)
    (message,) = shown
    assert message.header.stamp == nanoseconds_to_stamp(START + 50_000_000)
    assert (message.height, message.width, message.step, message.encoding) == (
        480, 640, 1920, 'bgr8')
    pixels = np.frombuffer(message.data, dtype=np.uint8).reshape(-1, 3)
    assert np.ptp(pixels, axis=1).max() > 60  # it is drawn in color


def test_out_of_sight_the_neighbor_goes_on_by_ranges(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    true = float(np.linalg.norm(AHEAD.translation))
    for k in range(161):  # 2 s in sight, and 2 s not: it stays where it is beside oneself
        r.odom(k / 40)
        if k % 2 == 0:
            if k <= 80:
                r.image(k / 40, image)
            r.range(k / 40, true + 0.2)
    assert r.counters == {} and len(r.frames) == 41 and len(r.found) == 41 + 30
    state = from_odometry(r.found[-1])
    assert state.stamp == START + 4_000_000_000
    assert np.linalg.norm(state.position - OWN.translation - 4.0 * VELOCITY) == pytest.approx(
        true, abs=0.05)
    assert float(r.values['range_bias_leader_m']) == pytest.approx(0.2, abs=0.03)


def test_inputs_that_cannot_be_used_are_counted_by_their_reason(rig: Callable[..., Rig]) -> None:
    r = rig()
    r.range(0.0, 2.0)
    for k in range(6):
        r.odom(k / 5)
    for distance, name in ((2.0, 'nobody'), (float('nan'), 'leader'), (0.0, 'leader'),
                           (1e9, 'leader'), (2.0, 'leader'), (2.0, 'leader')):
        r.range(1.0, distance, name)
    r.range(1.0, 0.1, min_range=0.3, max_range=50.0)
    r.odom(1.1, velocity=np.full(3, np.nan))
    assert r.counters == {
        'range without odometry': 1, 'range of an unknown neighbor': 1,
        'range outside its limits': 4, 'invalid odom': 1,
        'range stamp repeated, too old or ahead of the odometry': 1}
    assert not r.found


def test_the_child_frame_of_odom_is_placed_by_tf_static(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r, imu = rig(), TransformStamped(child_frame_id='imu')
    T_base_imu = Transform.from_quaternion([0.1, 0.0, -0.05], quaternion_from_rpy(
        np.pi / 2.0, 0.0, 0.0))
    imu.header.frame_id = 'base_link'
    set_vector(imu.transform.translation, T_base_imu.translation)
    set_quaternion(imu.transform.rotation, T_base_imu.quaternion)
    wrong = TransformStamped(child_frame_id='lidar')  # it does not cost the other
    wrong.transform.rotation.w = 0.0
    with pytest.raises(ValueError, match='quaternion'):
        r.node._own._static.take(SimpleNamespace(transforms=[wrong, imu]))
    T_odom_imu = OWN @ T_base_imu
    r.give('odom', to_odometry(nanoseconds_to_stamp(START), 'odom', 'imu', T_odom_imu.translation,
                               T_odom_imu.quaternion, np.zeros(3)))
    r.image(0.0, image)
    np.testing.assert_allclose(from_odometry(r.found[0]).position, LEADER.translation, atol=0.03)
    r.odom(0.1, velocity=np.zeros(3))  # of base_link: the source was replaced
    r.image(0.1, image)
    np.testing.assert_allclose(from_odometry(r.found[1]).position, LEADER.translation, atol=0.03)


def test_two_calibrations_of_one_camera_are_named(rig: Callable[..., Rig]) -> None:
    node, counts = rig().node, {'/camera_info': 2}
    node.count_publishers = lambda topic: counts.get(topic, 0)

    def named() -> list[tuple[int, str]]:
        return [found for check in node.diagnostics.checks
                if (found := check(0.0)) is not None and 'publishers on' in found[1]]

    ((level, text),) = named()
    assert level == relative_pose.ERROR and text.startswith('2 publishers on /camera_info: ')
    counts['/camera_info'] = 1
    assert not named()


def test_motion_without_odometry_places_neighbor_in_own_frame(
        rig: Callable[..., Rig], image: GrayImage) -> None:
    r = rig()
    for k in range(4):
        r.odom(k / 20)
        r.give(MOTION_TOPIC, to_odometry(
            nanoseconds_to_stamp(START + k * 50_000_000), RELATIVE, 'base_link', (9.0, 0.0, 3.0),
            OWN.quaternion, np.zeros(3)))
        r.image(k / 20, image)
    assert len(r.found) >= 3 and r.found[-1].header.frame_id == RELATIVE
    place = from_odometry(r.found[-1]).position - [9.0, 0.0, 3.0]
    np.testing.assert_allclose(place, LEADER.translation - OWN.translation, atol=0.03)


def test_stopped_or_uncalibrated_camera_is_named_other_goes_on(
        ros: None) -> None:
    r = Rig(max_wait=0.0, **TWO)
    shown = r.watch('debug_image/left')
    r.give('front/camera_info', calibration())
    r.odom(0.0)
    r.image(0.0, EMPTY, 'left/image_raw')
    for k in range(1, 4):
        r.odom(0.05 * k)
        r.image(0.05 * k, view(), 'front/image_raw')
    assert len(r.found) == 3
    assert r.counters == {'no usable camera_info of camera left': 1}
    reported = r.problems(ahead=4.0)
    for silent in ('/left/camera_info for', '/left/image_raw for',
                   'image of camera left processed for'):
        assert re.search(rf'no {silent} \d s', reported)
    assert 's: no usable camera_info' in reported
    assert 'no image of camera front processed' not in reported
    assert r.values['camera front'] == '640x480 plumb_bob' and 'camera left' not in r.values
    assert {'time_offset front', 'time_offset left'} <= r.values.keys()
    r.give('left/camera_info', calibration())
    r.odom(0.2)
    r.image(0.2, view(leader=AHEAD @ Transform(translation=np.array([0.0, 1.5, 0.0])),
                      camera='left'), 'left/image_raw')
    assert len(r.frames) == 4 and len(shown) == 1
    r.close()


def test_the_planner_sees_with_all_cameras(ros: None) -> None:
    planner = Driven(Planner(parameter_overrides=overrides(**TWO)))
    for name in RPY:
        planner.give(f'{name}/camera_info', calibration())
    assert sorted(field.heading for field in planner.node._loop.view) == pytest.approx([0.0, 0.7])
    planner.close()
