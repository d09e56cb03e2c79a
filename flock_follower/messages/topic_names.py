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

"""Our names of nodes and topics, the names in drivers, and how to connect the two."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from flock_follower.messages import STATE
from flock_follower.messages.command_writer import TRAJECTORY
from flock_follower.messages.state_writer import ODOMETRY

#: The nodes that a flight needs.
OURS: Final = ('relative_pose', 'planner', 'mavlink_bridge')
IMAGE: Final = 'sensor_msgs/msg/Image'
COMPRESSED: Final = 'sensor_msgs/msg/CompressedImage'
INFO: Final = 'sensor_msgs/msg/CameraInfo'
RANGE: Final = 'sensor_msgs/msg/Range'
RAW_IMAGES: Final = 'image_raw'
COMPRESSED_IMAGES: Final = 'image_raw/compressed'

#: The types of our topics.
TYPES: Final[Mapping[str, str]] = {
    RAW_IMAGES: IMAGE, COMPRESSED_IMAGES: COMPRESSED, 'camera_info': INFO, 'odom': ODOMETRY,
    'neighbors': ODOMETRY, 'neighbors/frames': 'std_msgs/msg/Header',
    'command/trajectory': TRAJECTORY, 'planner/state': STATE, 'mavlink_bridge/state': STATE,
    'ranges': RANGE, 'mavlink/odom': ODOMETRY, 'truth/odom': ODOMETRY, 'truth/neighbors': ODOMETRY}
#: Parts of the names of images that show no brightness, are drawn by us, or are compressed in
#: other ways than JPEG and PNG.
_NEVER: Final = ('depth', 'disparity', 'confidence', 'debug_image', 'zstd', 'ffmpeg', 'theora')
#: Types of poses that nodes derive odometry from if they come as odometry, the best first.
POSES: Final = ('geometry_msgs/msg/PoseWithCovarianceStamped', 'geometry_msgs/msg/PoseStamped',
                'geometry_msgs/msg/TransformStamped', 'tf2_msgs/msg/TFMessage')
#: Parts of the names of poses that are wanted, or of another body.
_NO_POSE: Final = ('goal', 'setpoint', 'initialpose', 'target', 'static', 'truth', 'neighbors')
#: The arguments of the launch file by our names of topics.
_ARGUMENTS: Final = {RAW_IMAGES: 'image', COMPRESSED_IMAGES: 'image', 'camera_info': 'camera_info',
                     'odom': 'odom'}
#: Parts of the names of unlikely topics, and of likely ones.
_UNLIKELY: Final = ('debug', 'truth', 'mavlink', 'mavros', 'neighbors', 'loop',
                    'imu_propagate', 'right', 'infra2', 'fisheye2')
_LIKELY: Final = ('infra1', 'mono', 'left', 'fisheye1', 'gray', 'image_rect', 'odomimu', 'vio',
                  'odom')


def parse_remaps(remaps: Iterable[str]) -> dict[str, str]:
    """
    Return the topics by our names, from ``OURS:=THEIRS`` as in ROS.

    :raises ValueError: naming a remap that is malformed, or whose first name is not ours.
    """
    found: dict[str, str] = {}
    for remap in remaps:
        ours, separator, theirs = (part.strip() for part in remap.partition(':='))
        name = ours.strip('/')
        if not separator or name not in TYPES or not theirs.strip('/'):
            raise ValueError(f'--remap {remap}: must be NAME:=TOPIC, as odom:=/camera/odom/sample,'
                             f' with a name of ours: one of {", ".join(TYPES)}')
        found[name] = theirs
    return found


def full_name(name: str, namespace: str = '') -> str:
    """Return the full name of a topic; a name that begins with a slash is full already."""
    if name.startswith('/'):
        return name
    return '/' + '/'.join(filter(None, [namespace.strip('/'), name.strip('/')]))


def names_there(namespace: str, remaps: Mapping[str, str]) -> dict[str, str]:
    """Return the full name of each of our topics."""
    return {name: full_name(remaps.get(name, name), namespace) for name in TYPES}


def topics_of_camera(image: str, camera_info: str) -> dict[str, str]:
    """Return the topics of a camera by our names, as :func:`parse_remaps` does."""
    return {RAW_IMAGES: image, COMPRESSED_IMAGES: f'{image}/compressed',
            'camera_info': camera_info}


def images_by_type(names: dict[str, str], topics: Mapping[str, str]) -> None:
    """
    Exchange the names of raw and compressed images if the topics have the other type.

    :param names: those of :func:`names_there`, changed in place.
    :param topics: the type of each topic that is there, by its full name.
    """
    if (topics.get(names[RAW_IMAGES]) == COMPRESSED
            or topics.get(names[COMPRESSED_IMAGES]) == IMAGE):
        names[RAW_IMAGES], names[COMPRESSED_IMAGES] = names[COMPRESSED_IMAGES], names[RAW_IMAGES]


def offer(name: str, topics: Mapping[str, str], taken: Iterable[str] = (),
          live: bool = False) -> str:
    """
    Return how to connect a missing topic to the most likely existing topic, or ''.

    :param name: our name; ``image_raw`` also means the compressed images.
    :param topics: the type of each existing topic, by its full name.
    :param taken: topics that are used under another of our names.
    :param live: whether nodes are connected, not a bag.
    """
    msgtypes = (IMAGE, COMPRESSED) if name == RAW_IMAGES else (TYPES[name],)
    found = sorted(
        (full for full, msgtype in topics.items() if msgtype in msgtypes
         and full not in set(taken) and not any(word in full.lower() for word in _NEVER)),
        key=lambda full: (sum(word in full for word in _UNLIKELY),
                          not any(word in full for word in _LIKELY), len(full)))
    if not found:
        return _offer_pose(topics) if name == 'odom' else ''
    others = f' (or {", ".join(found[1:3])})' if found[1:] else ''
    ours = COMPRESSED_IMAGES if topics[found[0]] == COMPRESSED else name
    remap = f'--remap {ours}:={found[0]}{others}'
    if live and ours in _ARGUMENTS:
        base = found[0].removesuffix('/compressed')
        transport = ' image_transport:=compressed' if ours == COMPRESSED_IMAGES else ''
        remap = f'launch with {_ARGUMENTS[ours]}:={base}{transport}{others}; here {remap}'
    return f'{found[0]} has type {topics[found[0]]}: {remap}'


def _offer_pose(topics: Mapping[str, str]) -> str:
    """Return how to use the likeliest pose as odometry, or ''."""
    found = sorted((POSES.index(msgtype), len(full), full) for full, msgtype in topics.items()
                   if msgtype in POSES and not any(word in full for word in _NO_POSE))
    if not found:
        return ''
    _, _, full = found[0]
    return (f'{full} has type {topics[full]}: have its source send {ODOMETRY}, or send the poses '
            'as odometry (examples/pose_as_odometry.py, docs/sensors.md)')
