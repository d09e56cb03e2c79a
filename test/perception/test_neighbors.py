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

"""The neighbors file: what it means, and every way of writing it wrongly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flock_follower.perception.markers import load, parse

SHIPPED = Path(__file__).resolve().parents[2] / 'config' / 'neighbors.yaml'


def document(**changes: Any) -> dict[str, Any]:
    neighbor = {'name': 'leader', 'marker_id': 0, 'side_length': 0.16,
                'position': [-0.2, 0, 0.0], 'rpy': [1.5707963, 0.0, -1.5707963], **changes}
    return {'dictionary': 'DICT_4X4_50', 'neighbors': [neighbor]}


def test_shipped_file_is_a_marker_on_the_tail_facing_backwards() -> None:
    config = load(SHIPPED)
    assert config.dictionary == 'DICT_4X4_50'
    (leader,) = config.neighbors
    (marker,) = leader.markers
    assert (leader.name, marker.marker_id, marker.side_length) == ('leader', 0, 0.16)
    np.testing.assert_allclose(marker.T_body_marker.translation, [-0.2, 0.0, 0.0])
    # Columns: the marker's x points right (-y of the body), its y up, its z backwards.
    np.testing.assert_allclose(
        marker.T_body_marker.rotation, [[0, 0, -1], [-1, 0, 0], [0, 1, 0]], atol=1e-7)


def marker_entry(marker_id: int, **changes: Any) -> dict[str, Any]:
    return {'marker_id': marker_id, 'side_length': 0.1 + 0.01 * marker_id,
            'position': [-0.2, 0.1 * marker_id, 0.0], 'rpy': [0.0, 0.0, 0.5 * marker_id],
            **changes}


def several(*markers: Any, name: Any = 'leader', **changes: Any) -> dict[str, Any]:
    return {'dictionary': 'DICT_4X4_50',
            'neighbors': [{'name': name, 'markers': list(markers), **changes}]}


def test_a_neighbor_may_carry_several_markers() -> None:
    config = parse(several(marker_entry(2), marker_entry(0), marker_entry(1)))
    (leader,) = config.neighbors
    assert [m.marker_id for m in leader.markers] == [2, 0, 1]  # as written
    assert [m.side_length for m in leader.markers] == pytest.approx([0.12, 0.1, 0.11])
    for marker in leader.markers:
        k = marker.marker_id
        np.testing.assert_allclose(marker.T_body_marker.translation, [-0.2, 0.1 * k, 0.0])
        np.testing.assert_allclose(marker.T_body_marker.rotation[:2, 0],
                                   [np.cos(0.5 * k), np.sin(0.5 * k)])
        assert config.by_marker()[k] == (leader, marker)


def test_neighbor_has_role_radius_and_antenna_as_given() -> None:
    (plain,) = parse(document()).neighbors
    assert (plain.role, plain.radius, plain.tag_position) == ('leader', 0.0, (0.0, 0.0, 0.0))
    for written in document, lambda **changes: several(marker_entry(0), **changes):
        (given,) = parse(written(role='avoid', radius=1, tag_position=[0, 0.02, 0.1])).neighbors
        assert (given.role, given.radius, given.tag_position) == ('avoid', 1.0, (0.0, 0.02, 0.1))


LEADER = document()['neighbors'][0]


def two(**changes: Any) -> dict[str, Any]:
    """Return a leader, and another neighbor with some values of the leader."""
    other = {**LEADER, 'name': 'other', 'marker_id': 1, **changes}
    return {'dictionary': 'DICT_4X4_50', 'neighbors': [LEADER, other]}


@pytest.mark.parametrize(('broken', 'message'), [
    (None, 'the document = None: must map dictionary, neighbors'),
    ({'neighbors': []}, 'the document lacks dictionary'),
    ({**document(), 'dictionary': 'DICT_3X3'}, "dictionary = 'DICT_3X3': must be one of"),
    ({**document(), 'neighbors': []}, r'neighbors = \[\]: must be a list of at least one'),
    ({**document(), 'neighbors': [3]}, r'neighbors\[0\] = 3: must map'),
    ({**document(), 'neighbors': [{'name': 'leader'}]}, r'neighbors\[0\] lacks marker_id'),
    (several(), r'neighbors\[0\]\.markers = \[\]: must be a list of at least one'),
    (several(3), r'\.markers\[0\] = 3: must map marker_id, position, rpy, side_length'),
    (several(marker_entry(0), {'marker_id': 1}), r'markers\[1\] lacks position'),
    (several(marker_entry(0, name='x')), r'markers\[0\] has an unknown key name'),
    (several(marker_entry(0), marker_entry(50)),
     r'neighbors\[0\]\.markers\[1\]\.marker_id = 50: must be an integer in \[0, 49\]'),
    (several(marker_entry(0), marker_id=1), r'neighbors\[0\] has an unknown key marker_id'),
    (several(marker_entry(4), marker_entry(4)), r'neighbors\[0\]\.marker_id = 4: must be unique'),
    (two(name='leader'), r"neighbors\[1\]\.name = 'leader': must be unique"),
    (two(marker_id=0), r'neighbors\[1\]\.marker_id = 0: must be unique'),
    (document(name='the leader'), r"neighbors\[0\]\.name = 'the leader': must be a word"),
    (document(name=7), 'name = 7'),
    # The name is a part of topics, and a frame.
    *((document(name=name), f"name = '{name}': must be a word of letters")
      for name in ('leader-1', '1st', 'führer', 'a//b', '/a', 'a/', 'a' * 101, 'base_link',
                   'leader/duplicate', 'leader/duplicate_2')),
    ({'neighbors': None}, 'the document lacks dictionary'),
    ({'neighbors': 5}, 'the document lacks dictionary'),
    (document(marker_id=True), 'marker_id = True'),
    (document(side_length=0.0), r'side_length = 0\.0: must be a number in \[0\.01, 2\] m'),
    (document(side_length=float('nan')), 'side_length = nan'),
    (document(side_length='0.16 m'), "side_length = '0.16 m'"),
    (document(position=[0.0, 0.0]), 'position = .*: must be three values'),
    (document(position=[0.0, 0.0, 200.0]), r'in \[-5, 5\] m'),
    (document(rpy=[90.0, 0.0, -90.0]), r'rpy = .*in \[-6\.28319, 6\.28319\] rad'),
    (document(tag_position=[0.0, 0.0, 9.0]), 'tag_position = .*: must be three values'),
    ({**document(), 'neighbors': [{'name': 'leader', 'marker': 0}]},
     r'neighbors\[0\] has an unknown key marker: did you mean marker_id\?'),
    (document(role=['avoid']), r'role = \[.avoid.\]: must be one of'),
    (document(radius=-0.1), r'neighbors\[0\]\.radius = -0\.1: must be a number in \[0, 5\] m'),
])
def test_wrong_files_are_refused_by_place_and_value(broken: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(broken)


@pytest.mark.parametrize(('text', 'message'), [
    ('neighbors: []\n', r'wrong\.yaml: the document lacks dictionary'),
    ('neighbors: [\n', r'wrong\.yaml: not valid YAML'),
    ('dictionary: A\nneighbors:\n  - {name: a, marker_id: 1, "marker_id": 2}\n',
     r'wrong\.yaml: line 3: marker_id is given twice')])
def test_errors_name_the_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'wrong.yaml'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(ValueError, match=message):
        load(path)


def test_keys_that_are_merged_in_may_be_given_anew(tmp_path: Path) -> None:
    path = tmp_path / 'neighbors.yaml'
    path.write_text('dictionary: DICT_4X4_50\nneighbors:\n  - &a {name: a, marker_id: 0, '
                    'side_length: 0.1, position: [0, 0, 0], rpy: [0, 0, 0]}\n'
                    '  - {<<: *a, name: b, marker_id: 1}\n', encoding='utf-8')
    assert [(n.name, n.markers[0].marker_id) for n in load(path).neighbors] == [
        ('a', 0), ('b', 1)]
