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

"""The parameters of relative_pose, and the tracker built from their values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from flock_follower.geometry import Transform
from flock_follower.odometry.reader import SourceParams
from flock_follower.parameters.cameras import (
    ANGLES,
    CAMERA_SPECS,
    cameras,
    DEFAULT_POSITION,
    DEFAULT_RPY,
    PLACES,
)
from flock_follower.parameters.spec import filled, Spec, specs_of
from flock_follower.perception.markers import load
from flock_follower.perception.neighbor_filter import FilterParams
from flock_follower.perception.observed_wait import MAX_WAIT
from flock_follower.perception.range_tracking import RangingParams
from flock_follower.perception.time_offset import MountedCamera, TimeOffset
from flock_follower.perception.tracker import camera_mounting, Tracker
from flock_follower.ranges import MAX_OFFSET, Range
from flock_follower.system.files import resource

#: Of a neighbor as seen from a camera in a hand: the rotation of the camera moves it sideways.
HAND_ACCELERATION = 4.0  # m/s^2
HAND_ANGULAR_NOISE = 8.0  # rad/s^2/sqrt(Hz)

RELATIVE_POSE = [
    Spec('neighbors_file', '',
         'YAML file of the neighbors and their markers; empty: config/neighbors.yaml of this '
         'package'),
    Spec('camera_position', list(DEFAULT_POSITION),
         'place of the camera on the body, FLU', PLACES, fixed_length=True),
    Spec('camera_rpy', list(DEFAULT_RPY),
         'roll, pitch, yaw of the camera on the body; zeros look ahead',
         ANGLES, fixed_length=True),
    Spec('image_transport', 'raw',
         'subscribe image_raw or image_raw/compressed', ('raw', 'compressed')),
    Spec('rectified', False, 'the images are undistorted already: use P of camera_info'),
    *CAMERA_SPECS,
    Spec('time_offset', 0.0,
         'an image of stamp t was exposed at t + time_offset on the clock of odom (as '
         'timeshift_cam_imu of Kalibr)', Range(-MAX_OFFSET, MAX_OFFSET, 's')),
    Spec('time_offset_mode', 'auto',
         'auto: time_offset is the initial value, the true offset is estimated, and applied once '
         'certain; fixed: time_offset is exact', ('auto', 'fixed')),
    Spec('readout_time', 0.0,
         'rolling shutter: time from the exposure of the first row, at the stamp, to that of the '
         'last row; 0: global shutter', Range(0.0, 0.2, 's')),
    Spec('max_wait', MAX_WAIT,
         'longest time for which an image waits for odometry of its stamp; less if odometry '
         'usually comes sooner', Range(0.0, 1.0, 's')),
    Spec('odometry', 'odom',
         'none: a detector alone, of a camera whose motion is unknown: neighbors are in its '
         'optical frame, velocities relative to it', ('odom', 'none')),
    Spec('publish_tf', True,
         "publish each neighbor's pose on /tf, from the frame of odom to its name, if tf2_msgs is "
         'installed'),
    *specs_of(FilterParams()),
    *specs_of(RangingParams()),
    *specs_of(SourceParams(), 'odom_'),
]


def tracker(values: Mapping[str, Any]) -> Tracker:
    """
    Return the tracker of the parameters of relative_pose.

    :raises ValueError: if the parameters, or the neighbors' file, are wrong.
    :raises OSError: if the file cannot be read.
    """
    path = values['neighbors_file'] or resource('config/neighbors.yaml')
    fixed = values['time_offset_mode'] == 'fixed'
    params, alone = filled(FilterParams(), values), values['odometry'] == 'none'
    if alone:
        if any(values['cameras']):
            raise ValueError('odometry = none: not with cameras: neighbors are in the frame of '
                             'one')
        params = replace(params, acceleration=max(params.acceleration, HAND_ACCELERATION),
                         angular_noise=max(params.angular_noise, HAND_ANGULAR_NOISE))
    mounted = {camera.name: MountedCamera(
        Transform() if alone else camera_mounting(camera.position, camera.rpy),
        TimeOffset(0.0, True) if alone else TimeOffset(camera.time_offset, fixed),
        camera.readout_time, params.attitude_noise, camera.rectified)
        for camera in cameras(values)}
    return Tracker(load(path), mounted, params, ranging_params=filled(RangingParams(), values),
                   alone=alone)
