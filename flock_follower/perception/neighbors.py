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
Who flies along: the neighbours and the markers they carry, read from YAML.

A file holds the dictionary of the markers and a list of neighbours::

    dictionary: DICT_4X4_50
    neighbors:
      - name: leader             # child_frame_id of its estimates
        marker_id: 0
        side_length: 0.16        # m, outer edge to outer edge of the black border
        position: [-0.20, 0.0, 0.0]         # marker centre on the neighbour's body (FLU), m
        rpy: [1.5707963, 0.0, -1.5707963]   # marker frame on the body, fixed-axis, rad

A neighbour that carries several has, instead of the last four keys, a list of them::

      - name: leader
        markers:
          - {marker_id: 0, side_length: 0.16, position: [...], rpy: [...]}
          - {marker_id: 1, side_length: 0.10, position: [...], rpy: [...]}

Either may say what it is for the planner::

        role: follower           # leader (the default), follower, or avoid: kept clear of only
        radius: 0.3              # m, of its hull: distances are kept between hulls; 0

``tag_position: [x, y, z]``, m, on its body, says where the antenna is that ranges are measured to;
without it they are to the body's origin.

The marker frame is OpenCV's: x right and y up as one faces the marker, z out of it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from flock_follower.geometry import quaternion_from_rpy, Transform
from flock_follower.perception import aruco
from flock_follower.ranges import Range

#: A marker's side, m: shorter than the thickness of its print or larger than the drone is a slip.
SIDE_LENGTHS = Range(0.01, 2.0, 'm')
#: Each coordinate of a marker on the body.
POSITIONS = Range(-5.0, 5.0, 'm')
ANGLES = Range(-2.0 * math.pi, 2.0 * math.pi, 'rad')

#: Of a hull; the planner has the same.
RADII = Range(0.0, 5.0, 'm')
ROLES = ('leader', 'follower', 'avoid')

_MARKER_KEYS = {'marker_id', 'side_length', 'position', 'rpy'}


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker: its id, its side, m, and where it sits on its neighbour's body (FLU)."""

    marker_id: int
    side_length: float
    T_body_marker: Transform


@dataclass(frozen=True, eq=False)
class Neighbor:
    """One neighbour, and the markers mounted rigidly on it, at least one."""

    name: str
    markers: tuple[Marker, ...]
    role: str = 'leader'
    """One of ``ROLES``."""
    radius: float = 0.0
    """Of its hull, m."""
    tag_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the antenna is on its body (FLU), m, that ranges are measured to."""


class MarkerOf(NamedTuple):
    """A marker and the neighbour that carries it."""

    neighbor: Neighbor
    marker: Marker


@dataclass(frozen=True, eq=False)
class NeighborConfig:
    """The neighbours to look for; names and marker ids are unique, all of one dictionary."""

    dictionary: str
    neighbors: tuple[Neighbor, ...]

    def by_marker(self) -> dict[int, MarkerOf]:
        """Return the markers, and who carries them, by marker id."""
        return {marker.marker_id: MarkerOf(neighbor, marker)
                for neighbor in self.neighbors for marker in neighbor.markers}


def load(path: str | Path) -> NeighborConfig:
    """
    Read a neighbours file.

    :raises ValueError: naming the file, the key, its value and what is valid.
    :raises OSError: where the file cannot be read.
    """
    text = Path(path).read_text(encoding='utf-8')
    try:
        return parse(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise ValueError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from None
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


def parse(document: Any) -> NeighborConfig:
    """
    Return the configuration of a parsed YAML document.

    :raises ValueError: naming the key, its value and what is valid.
    """
    _check_keys('', document, {'dictionary', 'neighbors'})
    dictionary = document['dictionary']
    size = aruco.dictionary_size(str(dictionary))
    entries = document['neighbors']
    if not isinstance(entries, list) or not entries:
        raise ValueError(f'neighbors = {entries!r}: must be a list of at least one neighbour')
    neighbors = tuple(_parse_neighbor(f'neighbors[{i}]', entry, size)
                      for i, entry in enumerate(entries))
    names: set[str] = set()
    ids: set[int] = set()
    for i, neighbor in enumerate(neighbors):
        if neighbor.name in names:
            raise ValueError(
                f'neighbors[{i}].name = {neighbor.name!r}: another neighbour has it')
        names.add(neighbor.name)
        for marker in neighbor.markers:
            if marker.marker_id in ids:
                raise ValueError(f'neighbors[{i}].marker_id = {marker.marker_id}: '
                                 'another marker has it')
            ids.add(marker.marker_id)
    return NeighborConfig(dictionary, neighbors)


def _parse_neighbor(where: str, entry: Any, dictionary_size: int) -> Neighbor:
    several = isinstance(entry, Mapping) and 'markers' in entry
    _check_keys(where, entry, {'name', 'markers'} if several else {'name', *_MARKER_KEYS},
                {'role', 'radius', 'tag_position'})
    name = entry['name']
    if not isinstance(name, str) or not name or name.split() != [name]:
        raise ValueError(f'{where}.name = {name!r}: must be a word')
    role, radius = entry.get('role', 'leader'), entry.get('radius', 0.0)
    if role not in ROLES:
        raise ValueError(f'{where}.role = {role!r}: must be one of {", ".join(ROLES)}')
    RADII.check(f'{where}.radius', radius)
    x, y, z = _triple(f'{where}.tag_position', entry.get('tag_position', [0.0, 0.0, 0.0]),
                      POSITIONS)
    what = role, float(radius), (x, y, z)
    if not several:
        return Neighbor(name, (_parse_marker(where, entry, dictionary_size),), *what)
    markers = entry['markers']
    if not isinstance(markers, list) or not markers:
        raise ValueError(f'{where}.markers = {markers!r}: must be a list of at least one marker')
    for i, marker in enumerate(markers):
        _check_keys(f'{where}.markers[{i}]', marker, _MARKER_KEYS)
    return Neighbor(name, tuple(_parse_marker(f'{where}.markers[{i}]', marker, dictionary_size)
                                for i, marker in enumerate(markers)), *what)


def _parse_marker(where: str, entry: Any, dictionary_size: int) -> Marker:
    marker_id = entry['marker_id']
    Range(0, dictionary_size - 1, whole=True).check(f'{where}.marker_id', marker_id)
    side = entry['side_length']
    SIDE_LENGTHS.check(f'{where}.side_length', side)
    position = _triple(f'{where}.position', entry['position'], POSITIONS)
    roll, pitch, yaw = _triple(f'{where}.rpy', entry['rpy'], ANGLES)
    return Marker(marker_id, float(side), Transform.from_quaternion(
        position, quaternion_from_rpy(roll, pitch, yaw)))


def _check_keys(where: str, entry: Any, keys: set[str],
                optional: Collection[str] = frozenset()) -> None:
    place = where or 'the document'
    if not isinstance(entry, Mapping):
        raise ValueError(f'{place} = {entry!r}: must map {", ".join(sorted(keys))}')
    for key in sorted(keys - set(entry)):
        raise ValueError(f'{place} lacks {key}')
    for unknown in sorted(str(key) for key in set(entry) - keys - {*optional}):
        raise ValueError(f'{place} has an unknown key {unknown}: must be one of '
                         f'{", ".join(sorted({*keys, *optional}))}')


def _triple(where: str, values: Any, valid: Range) -> list[float]:
    if not isinstance(values, list) or len(values) != 3 or not all(map(valid.holds, values)):
        raise ValueError(f'{where} = {values!r}: must be three values, each {valid}')
    return [float(value) for value in values]
