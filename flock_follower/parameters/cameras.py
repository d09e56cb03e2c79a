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
The parameters of the cameras.

A single camera needs no name. Several cameras are listed in ``cameras``, and each has its
parameters below ``camera.NAME``; planner, relative_pose and black_box have the same parameters of
cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
import math
from typing import Any, Final, NamedTuple

from flock_follower.parameters.spec import CAMERA_NAMES, CAMERAS, Spec
from flock_follower.ranges import check_topic, MAX_OFFSET, Range

#: Default position of a camera on the body, m: in front of the middle of the vehicle.
DEFAULT_POSITION: Final = (0.10, 0.0, 0.0)
#: Default attitude of a camera on the body, rad: it looks ahead.
DEFAULT_RPY: Final = (0.0, 0.0, 0.0)
#: Each coordinate of a camera on the body.
PLACES: Final = Range(-10.0, 10.0, 'm')
#: Roll, pitch and yaw of a camera: more is in degrees.
ANGLES: Final = Range(-2.0 * math.pi, 2.0 * math.pi, 'rad')

CAMERA_SPECS = [
    CAMERA_NAMES,
    Spec('camera.NAME.image', 'NAME/image_raw',
         "topic of the camera's images; of compressed images without /compressed"),
    Spec('camera.NAME.camera_info', 'NAME/camera_info', "topic of the camera's calibration"),
    Spec('camera.NAME.position', list(DEFAULT_POSITION),
         'place of the camera on the body, FLU', PLACES, fixed_length=True),
    Spec('camera.NAME.rpy', list(DEFAULT_RPY),
         'roll, pitch, yaw of the camera on the body; zeros look ahead, [0, 0, 1.5708] to the '
         'left',
         ANGLES, fixed_length=True),
    Spec('camera.NAME.rectified', False, 'whether the images are undistorted already'),
    Spec('camera.NAME.time_offset', 0.0, 'time_offset of this camera',
         Range(-MAX_OFFSET, MAX_OFFSET, 's')),
    Spec('camera.NAME.readout_time', 0.0, 'readout_time of this camera',
         Range(0.0, 0.2, 's')),
]
#: The parameters of one camera that has no name: their key below camera.NAME, and the default.
ALONE: Final[Mapping[str, tuple[str, Any]]] = {
    'camera_position': ('position', list(DEFAULT_POSITION)),
    'camera_rpy': ('rpy', list(DEFAULT_RPY)),
    'rectified': ('rectified', False), 'time_offset': ('time_offset', 0.0),
    'readout_time': ('readout_time', 0.0)}


class CameraValues(NamedTuple):
    """The parameters of one camera; the name of a single camera is ''."""

    name: str
    image: str = 'image_raw'
    """Base topic of the images; see :meth:`images`."""
    camera_info: str = 'camera_info'
    position: Sequence[float] = DEFAULT_POSITION
    rpy: Sequence[float] = DEFAULT_RPY
    rectified: bool = False
    time_offset: float = 0.0
    readout_time: float = 0.0

    def images(self, transport: str) -> str:
        """Return the topic of the images of a transport, raw or compressed."""
        return f'{self.image}/compressed' if transport == 'compressed' else self.image


def cameras(values: Mapping[str, Any]) -> list[CameraValues]:
    """
    Return the cameras in the checked values of a node's parameters.

    :raises ValueError: if a name of a topic is invalid, if two cameras share a name or a topic, or
        if a parameter of a single camera is set although there are several cameras.
    """
    names = [name for name in values[CAMERAS] if name]
    if not names:
        return [CameraValues('', **{key: values[name] for name, (key, _) in ALONE.items()
                                    if name in values})]
    for name, (key, default) in ALONE.items():
        if values.get(name, default) != default:
            raise ValueError(f'{name} = {values[name]!r}: must be left out with cameras = '
                             f'{names}: set camera.{names[0]}.{key}, and so on')
    found = [CameraValues(name, **{key: values[f'camera.{name}.{key}']
                                   for key in CameraValues._fields[1:]}) for name in names]
    for camera in found:
        for key in ('image', 'camera_info'):
            check_topic(f'camera.{camera.name}.{key}', getattr(camera, key))
    for other, camera in combinations(found, 2):
        same = [key for key in ('image', 'camera_info')
                if getattr(camera, key) == getattr(other, key)]
        if (camera.position, camera.rpy) == (other.position, other.rpy):
            same.append('rpy')
        if same:
            raise ValueError(f'camera.{camera.name}.{same[0]} = {getattr(camera, same[0])!r}: '
                             f'that of {other.name}: must be its own')
    return found
