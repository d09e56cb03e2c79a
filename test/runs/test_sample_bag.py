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

"""The sample bag: its contents, and that it can be made again."""

import dataclasses

import cv2
import numpy as np
import pytest

from flock_desk import sample_bag as sample
from flock_desk.camera.leader import SIDE_LENGTH, T_BODY_MARKER, T_BODY_OPTICAL
from flock_desk.camera.lens import Camera
from flock_desk.camera.renderer import Sensor
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.files import resource
from flock_follower.geometry import Transform
from flock_follower.perception import markers as neighbors
from flock_follower.perception.markers import detect

pytestmark = pytest.mark.slow
TOPICS = {'/image_raw/compressed': 360, '/camera_info': 360, '/odom': 2401,
          '/truth/odom': 360, '/truth/neighbors': 360}


@pytest.fixture(scope='module')
def bag():
    """Return the raw messages of every topic."""
    messages = {topic: [] for topic in TOPICS}
    with open_bag(resource('bags/sample')) as opened:
        for message in opened.messages():
            messages[message.topic].append(message)
    return messages


@pytest.fixture(scope='module')
def recording():
    return sample.Recording(sample.VARIANTS['sample'])


def decoded(bag, topic):
    return [deserialize(m.data, m.msgtype) for m in bag[topic]]


def vector(v):
    return np.array([v.x, v.y, v.z])


def poses(messages):
    return [Transform.from_quaternion(
        vector(m.pose.pose.position), [getattr(m.pose.pose.orientation, c) for c in 'xyzw'])
        for m in messages]


def test_the_bag_is_small_and_holds_what_it_should(bag):
    size = sum(file.stat().st_size for file in resource('bags/sample').iterdir())
    assert size <= 12_000_000
    assert {topic: len(messages) for topic, messages in bag.items()} == TOPICS
    assert {bag[topic][0].msgtype for topic in TOPICS if 'odom' in topic or 'truth' in topic} == {
        'nav_msgs/msg/Odometry'}


def test_the_marker_is_mounted_as_the_default_configuration_says():
    [leader] = neighbors.load(resource('config/neighbors.yaml')).neighbors
    [marker] = leader.markers
    assert marker.side_length == SIDE_LENGTH
    np.testing.assert_allclose(marker.T_body_marker.translation, T_BODY_MARKER.translation)
    np.testing.assert_allclose(marker.T_body_marker.rotation, T_BODY_MARKER.rotation, atol=1e-7)


@pytest.mark.parametrize('k', [0, 181])
def test_an_image_made_again_shows_the_marker_at_the_same_place(bag, recording, k):
    recorded = cv2.imdecode(deserialize(
        bag['/image_raw/compressed'][k].data, 'sensor_msgs/msg/CompressedImage').data, 0)
    corners = [detect(image, 'DICT_4X4_50').corners[0]
               for image in (recorded, recording.pixels(k))]
    assert np.abs(corners[0] - corners[1]).max() < 1.5  # px


def test_everything_else_made_again_is_the_same_byte_for_byte(bag, recording):
    assert recording.odom() == bag['/odom']
    assert [recording.camera_info(k) for k in range(360)] == bag['/camera_info']
    truth = [recording.truth(k) for k in range(360)]
    assert [t[0] for t in truth] == bag['/truth/odom']
    assert [t[1] for t in truth] == bag['/truth/neighbors']


def test_the_marker_is_detected_where_the_truth_projects(bag):
    info = decoded(bag, '/camera_info')[0]
    h = SIDE_LENGTH / 2
    corners = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    pairs = zip(decoded(bag, '/image_raw/compressed'), poses(decoded(bag, '/truth/odom')),
                poses(decoded(bag, '/truth/neighbors')))
    for message, body, leader in list(pairs)[::24]:
        image = cv2.imdecode(np.asarray(message.data), cv2.IMREAD_GRAYSCALE)
        found = detect(image, 'DICT_4X4_50')
        seen = (body @ T_BODY_OPTICAL).inverse() @ leader @ T_BODY_MARKER
        pixels, _ = cv2.projectPoints(seen.apply(corners), np.zeros(3), np.zeros(3),
                                      info.k.reshape(3, 3), info.d)
        assert list(found.ids) == [0]
        refined = cv2.cornerSubPix(image, found.corners[0].astype(np.float32), (4, 4), (-1, -1),
                                   (cv2.TERM_CRITERIA_COUNT, 30, 0.0))
        assert np.abs(refined - pixels.reshape(4, 2)).max() < 1.0  # px


def test_a_bag_does_not_depend_on_how_many_processes_render_it(tmp_path):
    tiny = sample.Variant('', 0.1, Camera(width=64, height=48), Sensor(sub_poses=1), None)
    for jobs in (1, 2):
        sample.write(tiny, 1, tmp_path / str(jobs) / 'tiny', jobs)
    files = [(tmp_path / str(jobs) / 'tiny' / 'tiny.mcap').read_bytes() for jobs in (1, 2)]
    assert files[0] == files[1]
    with open_bag(tmp_path / '1' / 'tiny') as opened:
        assert opened.topics['/image_raw'].count == 3


@pytest.mark.parametrize('name', sample.VARIANTS)
def test_every_exposure_of_every_variant_is_within_its_flight(name):
    variant = sample.VARIANTS[name]
    recording = sample.Recording(dataclasses.replace(variant, duration=0.2))
    for stamp in (recording.image_stamps_ns[0], recording.image_stamps_ns[-1]):
        for time in variant.sensor.times((stamp - sample.START_NS) * 1e-9):
            recording.flight.leader.pose(time)  # raises outside


@pytest.mark.parametrize('name', sample.VARIANTS)
def test_the_marker_is_in_view_of_every_variant_from_its_front(name):
    recording = sample.Recording(sample.VARIANTS[name])
    camera, h = recording.variant.camera, SIDE_LENGTH / 6 * 4  # with its quiet zone
    corners = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    for stamp in recording.image_stamps_ns[::6]:
        time = (stamp - sample.START_NS) * 1e-9
        flight = recording.flight
        seen = ((flight.follower.pose(time) @ T_BODY_OPTICAL).inverse()
                @ flight.leader.pose(time) @ T_BODY_MARKER)
        u, v = project(camera, seen.apply(corners)).T
        assert u.min() > 0 and u.max() < camera.width - 1
        assert v.min() > 0 and v.max() < camera.height - 1
        line = seen.translation / np.linalg.norm(seen.translation)
        assert -seen.rotation[:, 2] @ line > np.cos(np.deg2rad(65))


def project(camera, points):
    """Return pixels (N, 2) of points (N, 3) in the optical frame, by OpenCV."""
    matrix = np.array([[camera.focal_x, 0, camera.centre_x], [0, camera.focal_y, camera.centre_y],
                       [0, 0, 1.0]])
    lens = cv2.fisheye if camera.model == 'equidistant' else cv2
    pixels, _ = lens.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix,
                                   np.array(camera.distortion))
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize(('name', 'size'), [('hd', (1280, 720)), ('full_hd', (1920, 1080))])
def test_finer_cameras_see_as_much_from_left_to_right_as_the_samples(name, size):
    camera, plain = sample.VARIANTS[name].camera, Camera()
    assert (camera.width, camera.height) == size
    for there, here in ((-0.5, -0.5), (camera.width - 0.5, plain.width - 0.5)):
        x, y = camera.rays(np.array(there), np.array(camera.centre_y))
        assert project(plain, np.array([[x, y, 1.0]]))[0, 0] == pytest.approx(here, abs=0.5)


def test_a_folder_that_is_no_bag_is_not_replaced(tmp_path, capsys):
    (tmp_path / 'sample').mkdir()
    (tmp_path / 'sample' / 'notes.txt').write_text('mine')
    assert sample.main(['--out', str(tmp_path)]) == 1
    assert 'exists and is not a bag: not replaced' in capsys.readouterr().err
    assert (tmp_path / 'sample' / 'notes.txt').read_text() == 'mine'
