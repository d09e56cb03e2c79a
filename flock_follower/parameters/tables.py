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
The parameters of the nodes, and the objects that a node builds from its values.

One camera needs no name. Several are listed in ``cameras``, and each has parameters of its own
below ``camera.NAME``; planner, relative_pose and black_box take the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import combinations
import math
from pathlib import Path
from typing import Any, Final, NamedTuple

from flock_follower.files import resource
from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.flight_end import EndParams
from flock_follower.gate.gate import VELOCITY_SOURCES
from flock_follower.mavlink.bridge import BLIND_ACTIONS, WIND_COMPENSATIONS
from flock_follower.mavlink.dialects import AUTOPILOTS, DIALECTS
from flock_follower.mavlink.link import IDS
from flock_follower.mavlink.parameter_check import read_recommendations, Recommendation
from flock_follower.odometry.reader import SourceParams
from flock_follower.parameters.spec import filled, NAMES, Spec, specs_of
from flock_follower.perception.markers import load
from flock_follower.perception.neighbor_filter import FilterParams
from flock_follower.perception.range_tracking import RangingParams
from flock_follower.perception.time_offset import MAX_OFFSET, MountedCamera, TimeOffset
from flock_follower.perception.tracker import camera_mounting, Tracker
from flock_follower.planner.params import Member, PlannerParams
from flock_follower.ranges import Range
from flock_follower.settings import refuse

#: Default pose of a camera: in front of the middle of the vehicle, looking ahead.
POSITION: Final = (0.10, 0.0, 0.0)
AHEAD: Final = (0.0, 0.0, 0.0)

CAMERA_SPECS = [
    Spec(NAMES, [''],
         'names of several cameras, each with parameters camera.NAME...; empty: a single camera, '
         'with camera_rpy'),
    Spec('camera.NAME.image', 'NAME/image_raw',
         "topic of the camera's images; of compressed images without /compressed"),
    Spec('camera.NAME.camera_info', 'NAME/camera_info', "topic of the camera's calibration"),
    Spec('camera.NAME.position', list(POSITION),
         'place of the camera on the body, FLU', Range(unit='m'), fixed_length=True),
    Spec('camera.NAME.rpy', list(AHEAD),
         'roll, pitch, yaw of the camera on the body; zeros look ahead, [0, 0, 1.5708] to the '
         'left',
         Range(unit='rad'), fixed_length=True),
    Spec('camera.NAME.rectified', False, 'whether the images are undistorted already'),
    Spec('camera.NAME.time_offset', 0.0, 'time_offset of this camera',
         Range(-MAX_OFFSET, MAX_OFFSET, 's')),
    Spec('camera.NAME.readout_time', 0.0, 'readout_time of this camera',
         Range(0.0, 0.2, 's')),
]
#: The parameters of one camera that has no name: their key below camera.NAME, and the default.
ALONE: Final[Mapping[str, tuple[str, Any]]] = {
    'camera_position': ('position', list(POSITION)), 'camera_rpy': ('rpy', list(AHEAD)),
    'rectified': ('rectified', False), 'time_offset': ('time_offset', 0.0),
    'readout_time': ('readout_time', 0.0)}

RELATIVE_POSE = [
    Spec('neighbors_file', '',
         'YAML file of the neighbours and their markers; empty: config/neighbors.yaml of this '
         'package'),
    Spec('camera_position', list(POSITION),
         'place of the camera on the body, FLU', Range(unit='m'), fixed_length=True),
    Spec('camera_rpy', list(AHEAD),
         'roll, pitch, yaw of the camera on the body; zeros look ahead',
         Range(unit='rad'), fixed_length=True),
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
    Spec('max_wait', 0.35,
         'longest time for which an image waits for odometry of its stamp; less if odometry '
         'usually comes sooner', Range(0.0, 1.0, 's')),
    *specs_of(FilterParams()),
    *specs_of(RangingParams()),
    *specs_of(SourceParams(), 'odom_'),
]

PLANNER = [
    Spec('require_bridge', True,
         'command only while mavlink_bridge/state is ACTIVE; false if another program flies the '
         'commands, such as MAVROS'),
    *specs_of(PlannerParams()),
    Spec('neighbors_file', '',
         'YAML file of the neighbors, the same as for relative_pose: roles and radii; empty: '
         'every vehicle seen is a leader of radius 0'),
    Spec('camera_rpy', list(AHEAD),
         'roll, pitch, yaw of the camera on the body, the same as for relative_pose',
         Range(unit='rad'), fixed_length=True),
    Spec('rectified', False,
         'the images are undistorted already, the same as for relative_pose'),
    *CAMERA_SPECS,
    *specs_of(SourceParams(), 'odom_'),
]

ORIGIN = {'latitude': Range(-90.0, 90.0, 'deg'), 'longitude': Range(-180.0, 180.0, 'deg'),
          'height': Range(-10_000.0, 10_000.0, 'm')}
MAVLINK_BRIDGE = [
    Spec('connection', 'udpin:127.0.0.1:14540',
         'connection to the autopilot: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or '
         '/dev/DEVICE[,BAUD]'),
    Spec('autopilot', 'auto', 'firmware of the autopilot; auto: by its HEARTBEAT', AUTOPILOTS),
    Spec('target_system', 1,
         'MAVLink system id of the autopilot; others are ignored', IDS),
    Spec('source_system', 0,
         'own MAVLink system id; 0: that of target_system, as MAVLink requires of the companion '
         'computer of a vehicle', replace(IDS, low=0)),
    Spec('announce_as_gcs', False,
         'send the HEARTBEAT of a ground station, so that PX4 sends its STATUSTEXTs on this '
         'link, too. While the bridge runs, PX4 then counts a ground station as connected: the '
         'failsafe for the loss of the real one (NAV_DLL_ACT, COM_DL_LOSS_T) acts only when the '
         'bridge ends. ArduPilot checks the system id, and sends them anyway'),
    Spec('report_to_gcs', True,
         "send the planner's state as STATUSTEXT, at most one per 2 s, and the distance as "
         'NAMED_VALUE_FLOAT flock_dist, 1 Hz; PX4 forwards them with MAV_n_FORWARD 1'),
    Spec('signing_key_file', '',
         'file with the 32-byte MAVLink 2 signing key; none: unsigned'),
    Spec('stream_rate', 20.0,
         'rate of setpoints between new commands', Range(5.0, 100.0, 'Hz')),
    Spec('telemetry_rate', 50.0,
         "requested rate of the autopilot's position and attitude; 20 for 57600 baud",
         Range(5.0, 200.0, 'Hz')),
    Spec('forward_odometry', False,
         'send odom to the autopilot as ODOMETRY, for flight without GPS'),
    Spec('odometry_rate', 30.0,
         'largest rate of ODOMETRY messages, of 247 bytes each; 10 for 57600 baud',
         Range(10.0, 100.0, 'Hz')),
    Spec('global_origin', [0.0, 0.0, 0.0],
         'latitude, longitude (deg) and height (m) sent to an estimator without an origin (no '
         'GPS); PX4 receives no height. Zeros: not set; PX4 then receives one near Zurich if '
         'odometry is forwarded and GPS off', fixed_length=True),
    Spec('require_failsafe', True,
         'refuse offboard while the autopilot would fly the last setpoint for over 1 s if the '
         'bridge died (COM_OF_LOSS_T, GUID_TIMEOUT), or stop its motors (COM_OBL_RC_ACT), or '
         'does not fuse the odometry that is forwarded to it (EKF2_EV_CTRL; VISO_TYPE, '
         'EK3_SRC1_POSXY, EK3_SRC1_VELXY), or does not answer'),
    Spec('takeoff_height', 2.5,
         'climb of the takeoff service', Range(0.5, 30.0, 'm'), live=True),
    Spec('velocity_source', 'auto',
         'velocity for v_max and braking; auto: odom once received', VELOCITY_SOURCES),
    Spec('blind_action', 'land',
         'action after 2 s without any velocity, when the stream stops: land requests a landing; '
         'silence requests nothing: PX4 starts its failsafe, ArduPilot stays in GUIDED',
         BLIND_ACTIONS),
    Spec('wind_compensation', 'auto',
         'offset the steady acceleration of the wind, up to 1 m/s^2; auto: only for PX4, which '
         'has no such correction', WIND_COMPENSATIONS),
    *specs_of(GateLimits()),
    *specs_of(EndParams()),
    *specs_of(SourceParams(), 'odom_'),
]

BLACK_BOX = [
    Spec('record_folder', '',
         'folder of the recordings, each in its own subfolder; empty: flock_follower/black_box in '
         '$ROS_HOME (~/.ros), with a subfolder for the namespace'),
    Spec('record_images', 'compressed',
         'compressed: grey JPEG images, or those of the camera if it compresses itself; none: no '
         'images, so evaluate cannot use the recording', ('compressed', 'none')),
    Spec('image_transport', 'raw', 'the same as for relative_pose', ('raw', 'compressed')),
    Spec('disk_used', 8000.0,
         'largest size of all recordings in the folder; beyond it the oldest files are deleted',
         Range(10.0, 1e8, 'MB')),
    Spec('disk_free', 1000.0,
         'space kept free on the disk: with less, the oldest files are deleted; if that is not '
         'enough, recording stops', Range(10.0, 1e8, 'MB')),
    *CAMERA_SPECS,
]


class CameraValues(NamedTuple):
    """The parameters of one camera; its name is '' if there is no other."""

    name: str
    image: str = 'image_raw'
    """Base topic of the images; see :meth:`images`."""
    camera_info: str = 'camera_info'
    position: Sequence[float] = POSITION
    rpy: Sequence[float] = AHEAD
    rectified: bool = False
    time_offset: float = 0.0
    readout_time: float = 0.0

    def images(self, transport: str) -> str:
        """Return the topic of the images of a transport, raw or compressed."""
        return f'{self.image}/compressed' if transport == 'compressed' else self.image


def cameras(values: Mapping[str, Any]) -> list[CameraValues]:
    """
    Return the cameras in the checked values of a node's parameters.

    :raises ValueError: if two cameras share a name or a topic, or if a parameter of a single
        camera is set beside several cameras.
    """
    names = [name for name in values[NAMES] if name]
    if not names:
        return [CameraValues('', **{key: values[name] for name, (key, _) in ALONE.items()
                                    if name in values})]
    for name, (key, default) in ALONE.items():
        if values.get(name, default) != default:
            raise ValueError(f'{name} = {values[name]!r}: must be left out with cameras = '
                             f'{names}: set camera.{names[0]}.{key}, and so on')
    found = [CameraValues(name, **{key: values[f'camera.{name}.{key}']
                                   for key in CameraValues._fields[1:]}) for name in names]
    for other, camera in combinations(found, 2):
        same = [key for key in ('image', 'camera_info')
                if getattr(camera, key) == getattr(other, key)]
        if (camera.position, camera.rpy) == (other.position, other.rpy):
            same.append('rpy')
        if same:
            raise ValueError(f'camera.{camera.name}.{same[0]} = {getattr(camera, same[0])!r}: '
                             f'that of {other.name}: must be its own')
    return found


def alone(values: Mapping[str, Any], name: str = '') -> tuple[CameraValues, dict[str, Any]]:
    """
    Return a camera by name, or the first one, and the values for a system of only this camera.

    :raises ValueError: if none of them has that name.
    """
    configured = cameras(values)
    found = next((camera for camera in configured if name in ('', camera.name)), None)
    if found is None:
        names = ', '.join(camera.name for camera in configured if camera.name)
        raise ValueError(f'camera {name}: must be {f"one of {names}" if names else "left out"}')
    return found, {**values, **{single: getattr(found, key) for single, (key, _) in ALONE.items()
                                if single in values}}


def tracker(values: Mapping[str, Any]) -> Tracker:
    """
    Return the tracker of the parameters of relative_pose.

    :raises ValueError: if they, or the neighbours' file, are wrong.
    :raises OSError: if the file cannot be read.
    """
    path = values['neighbors_file'] or resource('config/neighbors.yaml')
    fixed = values['time_offset_mode'] == 'fixed'
    params = filled(FilterParams(), values)
    mounted = {camera.name: MountedCamera(
        camera_mounting(camera.position, camera.rpy), TimeOffset(camera.time_offset, fixed),
        camera.readout_time, params.attitude_noise, camera.rectified)
        for camera in cameras(values)}
    return Tracker(load(path), mounted, params, ranging_params=filled(RangingParams(), values))


def planner_params(values: Mapping[str, Any], name: str = '') -> PlannerParams:
    """
    Return the parameters of the planner's core.

    :param name: of this vehicle; the neighbours' file may contain it, too.
    :raises ValueError: if they do not fit together, cannot fly, or the neighbours' file is wrong.
    :raises OSError: if it cannot be read.
    """
    cameras(values)
    params = filled(PlannerParams(), values, vehicles={
        other: who for other, who in _vehicles(values['neighbors_file']).items() if other != name})
    refuse(values)
    return params


def gate_limits(values: Mapping[str, Any]) -> GateLimits:
    """
    Return the limits of the gate in the values of mavlink_bridge.

    :raises ValueError: if they do not fit together, or cannot fly.
    """
    limits = filled(GateLimits(), values)
    refuse(values)
    return limits


@lru_cache
def _vehicles(path: str) -> Mapping[str, Member]:
    """Return the neighbours by name; read once, because parameters are set in flight, too."""
    if not path:
        return {}
    return {n.name: Member(n.role, n.radius, tuple(
        math.atan2(*normal[1::-1]) for normal in (
            marker.T_body_marker.rotation[:, 2].round(6) + 0.0 for marker in n.markers)))
        for n in load(path).neighbors}


def origin(values: list[float]) -> tuple[float, float, float] | None:
    """
    Return latitude and longitude, deg, and height, m, or None for zeros.

    :raises ValueError: if they are no place on Earth.
    """
    if not any(values):
        return None
    for (name, valid), value in zip(ORIGIN.items(), values):
        valid.check(f'global_origin = {values}: {name}', value)
    latitude, longitude, height = values
    return latitude, longitude, height


def recommendations(forwarding: bool, takeoff_height: float) -> dict[str, list[Recommendation]]:
    """
    Return the recommended parameters of each autopilot by the name of its dialect.

    :param forwarding: whether odometry is forwarded, which takes more of them.
    :param takeoff_height: m; an autopilot that would climb higher by itself is to climb no higher.
    """
    found = {}
    for dialect in DIALECTS.values():
        text = resource(f'config/{dialect.recommendations}').read_text(encoding='utf-8')
        found[dialect.name] = [
            entry._replace(value=min(entry.value, takeoff_height))
            if entry.name == dialect.minimum_takeoff else entry
            for entry in read_recommendations(text, forwarding=forwarding)]
    return found


def recordings_folder(values: Mapping[str, Any], ros_home: str, namespace: str) -> Path:
    """
    Return the folder of the recordings; ``ros_home`` is $ROS_HOME, or ''.

    A user without a home folder (a container's) has / instead, as with an empty $HOME.
    """
    folder = Path(values['record_folder']) if values['record_folder'] else (
        Path(ros_home or '~/.ros') / 'flock_follower' / 'black_box' / namespace.strip('/'))
    try:
        return folder.expanduser()
    except RuntimeError:
        return Path('/', *folder.parts[1:])
