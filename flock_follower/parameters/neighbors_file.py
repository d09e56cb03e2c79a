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
The neighbors and the markers they carry, read from YAML.

A file holds the dictionary of the markers and a list of neighbors::

    dictionary: DICT_4X4_50
    neighbors:
      - name: leader             # child_frame_id of its estimates: letters, digits and _
        marker_id: 0
        side_length: 0.16        # m, outer edge to outer edge of the black border
        position: [-0.20, 0.0, 0.0]         # marker center on the neighbor's body (FLU), m
        rpy: [1.5707963, 0.0, -1.5707963]   # marker frame on the body, fixed-axis, rad

A neighbor with several markers has a list of markers instead of the last four keys::

      - name: leader
        markers:
          - {marker_id: 0, side_length: 0.16, position: [...], rpy: [...]}
          - {marker_id: 1, side_length: 0.10, position: [...], rpy: [...]}

If another detector measures the neighbor's pose, the entry has a source instead of markers::

      - name: leader
        pose_topic: /tracker/leader   # PoseStamped, PoseWithCovarianceStamped or Odometry
        position_std: 0.05       # m, and
        attitude_std: 0.1        # rad, per axis: of messages without a covariance
        position_only: false     # true: its attitude is not used

Instead of ``pose_topic``, ``tf_frame: leader`` names its frame on ``/tf``; then both deviations
are required. If no neighbor has markers, the key ``frames_topic`` at the level of ``neighbors``
names a topic with a header, with one message for each image that the other detector processes,
whether it finds a neighbor or not.

Each neighbor may have keys for the planner::

        role: follower           # leader (the default), follower, or avoid: kept clear of only
        radius: 0.3              # m, of its hull: distances are kept between hulls; 0

``tag_position: [x, y, z]``, m, is the place of the antenna for ranges on the body; by default the
body's origin.

The marker frame is OpenCV's: seen from the front, x points right and y up; z points out of the
marker.

This module needs only the names and sizes of the dictionaries, not OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
import math
from pathlib import Path
import re
from typing import Any, Final

import yaml

from flock_follower.geometry import quaternion_from_rpy, Transform
from flock_follower.ranges import check_topic, Range, suggestion, WORDS
from flock_follower.system.files import read_text

#: Number of markers of OpenCV's dictionaries: ids run from 0 to one less.
DICTIONARY_SIZES: Final[Mapping[str, int]] = {
    **{f'DICT_{bits}X{bits}_{size}': size
       for bits in (4, 5, 6, 7) for size in (50, 100, 250, 1000)},
    'DICT_ARUCO_ORIGINAL': 1024,
    **{name: size for family, size in (
        ('APRILTAG_16h5', 30), ('APRILTAG_25h9', 35), ('APRILTAG_36h10', 2320),
        ('APRILTAG_36h11', 587), ('ARUCO_MIP_36h12', 250))
       for name in (f'DICT_{family}', f'DICT_{family.upper()}')}}
#: A marker's side, m: shorter than the thickness of its print or larger than the drone is a slip.
SIDE_LENGTHS = Range(0.01, 2.0, 'm')
#: Each coordinate of a marker on the body.
POSITIONS = Range(-5.0, 5.0, 'm')
ANGLES = Range(-2.0 * math.pi, 2.0 * math.pi, 'rad')
#: Of a hull; the planner has the same.
RADII = Range(0.0, 5.0, 'm')
#: Deviations of the pose of another detector, per axis.
POSITION_STDS = Range(0.001, 1.0, 'm')
ATTITUDE_STDS = Range(0.001, 1.0, 'rad')
_SOURCES = {'pose_topic', 'tf_frame'}
_SOURCE_KEYS = {'position_std', 'attitude_std', 'position_only'}
ROLES = ('leader', 'follower', 'avoid')
_MARKER_KEYS = {'marker_id', 'side_length', 'position', 'rpy'}
#: Of a neighbor: it is a part of topics, and the frame on ``/tf``.
_NAME = re.compile(f'(?!.*/duplicate){WORDS}')
_LONGEST_NAME = 100  # characters; ROS takes 247 for a whole topic
#: Frames of the ego vehicle, which a neighbor would replace on ``/tf``.
_OWN_FRAMES = ('base_link', 'map', 'odom')


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker: its id, its side, m, and its place on the neighbor's body (FLU)."""

    marker_id: int
    side_length: float
    T_body_marker: Transform


@dataclass(frozen=True)
class PoseSource:
    """The topic, or the frame on ``/tf``, on which another detector sends a neighbor's pose."""

    topic: str = ''
    tf_frame: str = ''
    position_std: float | None = None
    """Per axis, m, for a message without covariance; None: a covariance is required."""
    attitude_std: float | None = None
    """The same for the attitude, rad."""
    position_only: bool = False


@dataclass(frozen=True, eq=False)
class MarkedNeighbor:
    """One neighbor and the markers on its body; without markers if it has a ``source``."""

    name: str
    markers: tuple[Marker, ...]
    role: str = 'leader'
    """One of ``ROLES``."""
    radius: float = 0.0
    """Radius of the neighbor's hull, m."""
    tag_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place of the antenna for ranges on the neighbor's body (FLU), m."""
    source: PoseSource | None = None
    """Source of the neighbor's poses, if it has no markers."""


@dataclass(frozen=True, eq=False)
class NeighborConfig:
    """The neighbors to look for; names and ids are unique, the ids of one dictionary."""

    dictionary: str
    """Dictionary of all markers; '' without markers."""
    neighbors: tuple[MarkedNeighbor, ...]
    frames_topic: str = ''
    """Topic with one message for each image that another detector processes."""

    def by_marker(self) -> dict[int, tuple[MarkedNeighbor, Marker]]:
        """Return the neighbors with their markers, by marker id."""
        return {marker.marker_id: (neighbor, marker)
                for neighbor in self.neighbors for marker in neighbor.markers}


def size_by_name(name: str) -> int:
    """
    Return how many markers a dictionary has.

    :raises ValueError: for an unknown dictionary.
    """
    if name not in DICTIONARY_SIZES:
        raise ValueError(f'dictionary = {name!r}: must be one of '
                         f'{", ".join(sorted(DICTIONARY_SIZES))}')
    return DICTIONARY_SIZES[name]


def load(path: str | Path,
         dictionary_size: Callable[[str], int] = size_by_name) -> NeighborConfig:
    """
    Read a neighbors file.

    :param dictionary_size: returns how many markers a dictionary has; ValueError if unknown.
    :raises ValueError: naming the file, the key, its value and the valid range.
    :raises OSError: if the file cannot be read.
    """
    text = read_text(path)
    try:
        return parse(yaml.load(text, _Loader), dictionary_size)
    except yaml.YAMLError as error:
        raise ValueError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


class _Loader(yaml.SafeLoader):
    """Reads YAML, and refuses a key that is given twice: the first value would be ignored."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Return a mapping."""
        known: set[str] = set()
        for key, _ in node.value:
            # Keys that ``<<`` merges in are from elsewhere, and may be given anew.
            own = key.start_mark.index >= node.start_mark.index
            if not own or not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in known:
                raise ValueError(f'line {key.start_mark.line + 1}: {key.value} is given twice: '
                                 'remove one')
            known.add(key.value)
        return super().construct_mapping(node, deep)


def parse(document: Any,
          dictionary_size: Callable[[str], int] = size_by_name) -> NeighborConfig:
    """
    Return the configuration of a parsed YAML document.

    :param dictionary_size: see :func:`load`.
    :raises ValueError: naming the key, its value and the valid range.
    """
    entries = document.get('neighbors') if isinstance(document, Mapping) else None
    marked = not isinstance(entries, list) or 'dictionary' in document or not any(
        isinstance(each, Mapping) and _SOURCES & {*each} for each in entries)
    _check_keys('the document', document, {'neighbors'} | ({'dictionary'} if marked else set()),
                {'frames_topic'})
    dictionary = str(document['dictionary']) if marked else ''
    ids = Range(0, dictionary_size(dictionary) - 1, whole=True) if marked else None
    neighbors = tuple(_parse_neighbor(where, entry, ids)
                      for where, entry in _entries('neighbors', document['neighbors']))
    frames_topic = document.get('frames_topic', '')
    if frames_topic != '':
        check_topic('frames_topic', frames_topic)
    if frames_topic and any(neighbor.markers for neighbor in neighbors):
        raise ValueError(f'frames_topic = {frames_topic!r}: remove it: with markers, the images '
                         'show which frames are processed')
    taken: set[tuple[str, object]] = {('pose_topic', frames_topic)}
    for i, neighbor in enumerate(neighbors):
        source = neighbor.source or PoseSource()
        for key, value in (('name', neighbor.name), ('pose_topic', source.topic),
                           ('tf_frame', source.tf_frame),
                           *(('marker_id', marker.marker_id) for marker in neighbor.markers)):
            if value != '' and (key, value) in taken:
                also = ', also of frames_topic' if value == frames_topic else ''
                raise ValueError(f'neighbors[{i}].{key} = {value!r}: must be unique{also}')
            taken.add((key, value))
    return NeighborConfig(dictionary, neighbors, frames_topic)


def _parse_neighbor(where: str, entry: Any, ids: Range | None) -> MarkedNeighbor:
    several = isinstance(entry, Mapping) and 'markers' in entry
    source = next(iter(_SOURCES & {*entry}), '') if isinstance(entry, Mapping) else ''
    _check_keys(where, entry, {'name', source} if source else {'name', 'markers'} if several else {
        'name', *_MARKER_KEYS}, {'role', 'radius', 'tag_position'} | (
            _SOURCE_KEYS if source else set()))
    name, role, radius = entry['name'], entry.get('role', 'leader'), entry.get('radius', 0.0)
    if (not isinstance(name, str) or not _NAME.fullmatch(name) or len(name) > _LONGEST_NAME
            or name in _OWN_FRAMES):
        raise ValueError(
            f'{where}.name = {name!r}: must be a word of letters, digits and _, such as leader_1; '
            f'not {", ".join(_OWN_FRAMES)}, nor with /duplicate in it')
    if role not in ROLES:
        raise ValueError(f'{where}.role = {role!r}: must be one of {", ".join(ROLES)}')
    RADII.check(f'{where}.radius', radius)
    x, y, z = _triple(f'{where}.tag_position', entry.get('tag_position', [0.0] * 3), POSITIONS)
    if source:
        return MarkedNeighbor(name, (), role, float(radius), (x, y, z),
                              _parse_source(where, source, entry))
    if ids is None:
        raise ValueError('the document lacks dictionary')
    if several:
        places = _entries(f'{where}.markers', entry['markers'])
        for place, marker in places:
            _check_keys(place, marker, _MARKER_KEYS)
    else:
        places = [(where, entry)]
    markers = tuple(_parse_marker(place, marker, ids) for place, marker in places)
    return MarkedNeighbor(name, markers, role, float(radius), (x, y, z))


def _parse_source(where: str, key: str, entry: Mapping[str, Any]) -> PoseSource:
    only = entry.get('position_only', False)
    if not isinstance(only, bool):
        raise ValueError(f'{where}.position_only = {only!r}: must be true or false')
    deviations: dict[str, float] = {}
    for name, valid in (('position_std', POSITION_STDS), ('attitude_std', ATTITUDE_STDS)):
        if name in entry:
            valid.check(f'{where}.{name}', entry[name])
            deviations[name] = float(entry[name])
        elif key == 'tf_frame' and not (only and name == 'attitude_std'):
            raise ValueError(f'{where} lacks {name}: transforms have no covariance')
    topic, frame = ('', _frame(f'{where}.{key}', entry[key])) if key == 'tf_frame' else (
        entry[key], '')
    if not frame:
        check_topic(f'{where}.{key}', topic)
    return PoseSource(topic, frame, deviations.get('position_std'),
                      deviations.get('attitude_std'), only)


def _frame(where: str, value: Any) -> str:
    """Return the name of a frame; tf2 knows none with a slash before it."""
    if not isinstance(value, str) or value.split() != [value] or not value.strip('/'):
        raise ValueError(f'{where} = {value!r}: must be a word')
    return value.lstrip('/')


def _parse_marker(where: str, entry: Any, ids: Range) -> Marker:
    ids.check(f'{where}.marker_id', entry['marker_id'])
    SIDE_LENGTHS.check(f'{where}.side_length', entry['side_length'])
    position = _triple(f'{where}.position', entry['position'], POSITIONS)
    roll, pitch, yaw = _triple(f'{where}.rpy', entry['rpy'], ANGLES)
    return Marker(entry['marker_id'], float(entry['side_length']), Transform.from_quaternion(
        position, quaternion_from_rpy(roll, pitch, yaw)))


def _entries(where: str, values: Any) -> list[tuple[str, Any]]:
    """Return the entries of a list, each with its place in the file."""
    if not isinstance(values, list) or not values:
        raise ValueError(f'{where} = {values!r}: must be a list of at least one entry')
    return [(f'{where}[{i}]', value) for i, value in enumerate(values)]


def _check_keys(where: str, entry: Any, keys: set[str],
                optional: Collection[str] = frozenset()) -> None:
    if not isinstance(entry, Mapping):
        raise ValueError(f'{where} = {entry!r}: must map {", ".join(sorted(keys))}')
    unknown = sorted(map(str, set(entry) - keys - {*optional}))
    if unknown:
        raise ValueError(f'{where} has an unknown key {unknown[0]}: ' + suggestion(
            unknown[0], {*keys, *optional}, 'must be one of'))
    for key in sorted(keys - set(entry)):
        raise ValueError(f'{where} lacks {key}')


def _triple(where: str, values: Any, valid: Range) -> list[float]:
    if not isinstance(values, list) or len(values) != 3 or not all(map(valid.holds, values)):
        raise ValueError(f'{where} = {values!r}: must be three values, each {valid}')
    return [float(value) for value in values]
