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

"""Which topic of a driver is offered for which of ours, and what a remap may be."""

from __future__ import annotations

import pytest

from flock_follower.messages.state_writer import ODOMETRY
from flock_follower.messages.topic_names import (
    COMPRESSED,
    full_name,
    IMAGE,
    images_by_type,
    INFO,
    names_there,
    offer,
    parse_remaps,
    POSES,
)

D435I = {
    '/camera/camera/color/image_raw': IMAGE, '/camera/camera/color/camera_info': INFO,
    '/camera/camera/depth/image_rect_raw': IMAGE, '/camera/camera/depth/camera_info': INFO,
    '/camera/camera/infra1/image_rect_raw': IMAGE, '/camera/camera/infra1/camera_info': INFO,
    '/camera/camera/infra2/image_rect_raw': IMAGE, '/camera/camera/infra2/camera_info': INFO,
    '/ov_msckf/odomimu': ODOMETRY, '/ov_msckf/loop_odometry': ODOMETRY,
    '/mavlink/odom': ODOMETRY, '/neighbors': ODOMETRY}


@pytest.mark.parametrize(('name', 'there'), [
    ('image_raw', '/camera/camera/infra1/image_rect_raw'),
    ('camera_info', '/camera/camera/infra1/camera_info'), ('odom', '/ov_msckf/odomimu')])
def test_of_a_drivers_topics_the_likeliest_is_offered_first(name: str, there: str) -> None:
    reported = offer(name, D435I, ['/mavlink/odom', '/neighbors'])
    assert f': --remap {name}:={there}' in reported
    assert 'depth' not in reported and 'mavlink' not in reported


def test_compressed_images_are_offered_and_depth_never() -> None:
    assert offer('image_raw', {'/cam/image/compressed': COMPRESSED}).endswith(
        ': --remap image_raw/compressed:=/cam/image/compressed')
    assert offer('image_raw', {'/camera/depth/image': IMAGE}) == ''


@pytest.mark.parametrize('better', ['/cam/image/compressed', '/cam/some_long_name/compressed'])
@pytest.mark.parametrize('worse', [
    '/cam/image/zstd', '/cam/image/compressedDepth', '/relative_pose/debug_image'])
def test_images_that_cannot_be_used_are_not_offered(better: str, worse: str) -> None:
    kind = IMAGE if worse.endswith('debug_image') else COMPRESSED
    assert offer('image_raw', {worse: kind}) == ''
    assert worse not in offer('image_raw', {worse: kind, better: COMPRESSED})


def test_running_nodes_are_connected_by_arguments_of_the_launch() -> None:
    assert ': launch with image:=/cam/image;' in offer(
        'image_raw', {'/cam/image': IMAGE}, live=True)
    assert ': launch with image:=/cam/image image_transport:=compressed;' in offer(
        'image_raw', {'/cam/image/compressed': COMPRESSED}, live=True)
    assert ': launch with odom:=/vio/odom;' in offer('odom', {'/vio/odom': ODOMETRY}, live=True)


@pytest.mark.parametrize('msgtype', POSES)
def test_a_pose_is_named_if_there_is_no_odometry(msgtype: str) -> None:
    poses = {'/goal_pose': POSES[0], '/vio/pose': msgtype, '/scan': 'sensor_msgs/msg/LaserScan'}
    assert offer('odom', poses).startswith(f'/vio/pose has type {msgtype}')
    assert '/vio/odom' in offer('odom', {**poses, '/vio/odom': ODOMETRY})
    for other in ('/goal_pose', '/drone1/neighbors/leader/pose'):
        assert offer('odom', {other: POSES[0]}) == '', other


def test_remaps_are_ours_first_as_in_ros() -> None:
    assert parse_remaps(['/odom:=/vio/odom', 'camera_info := info ']) == {
        'odom': '/vio/odom', 'camera_info': 'info'}
    for wrong in ('odom', 'odom:=', '/vio/odom:=odom', 'imu:=/imu'):
        with pytest.raises(ValueError, match=r'--remap .*: must be NAME:=TOPIC, .* image_raw, '):
            parse_remaps([wrong])


def test_names_are_in_namespace_unless_absolute() -> None:
    names = names_there('drone1', {'odom': '/vio/odom', 'camera_info': 'cam/info'})
    assert names['odom'] == '/vio/odom' and names['camera_info'] == '/drone1/cam/info'
    assert names['image_raw'] == full_name('image_raw', '/drone1/') == '/drone1/image_raw'
    names = names_there('', {'image_raw': '/cam/image'})
    images_by_type(names, {'/cam/image': COMPRESSED})
    assert names['image_raw/compressed'] == '/cam/image'
