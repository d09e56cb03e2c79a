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

"""The neighbours file: what it means, and every way of writing it wrongly."""

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


def test_a_neighbour_may_carry_several_markers() -> None:
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


@pytest.mark.parametrize(('broken', 'message'), [
    (several(), r'neighbors\[0\]\.markers = \[\]: must be a list of at least one marker'),
    ({**several(), 'neighbors': [{'name': 'a', 'markers': {'marker_id': 0}}]},
     r'neighbors\[0\]\.markers = .*: must be a list'),
    ({**several(), 'neighbors': [{'name': 'a', 'markers': None}]}, r'markers = None: must be'),
    (several(3), r'\.markers\[0\] = 3: must map marker_id, position, rpy, side_length'),
    (several(marker_entry(0), {'marker_id': 1}), r'markers\[1\] lacks position'),
    (several(marker_entry(0, name='x')), r'markers\[0\] has an unknown key name'),
    (several(marker_entry(0), marker_entry(50)),
     r'neighbors\[0\]\.markers\[1\]\.marker_id = 50: must be an integer in \[0, 49\]'),
    (several(marker_entry(0, side_length=5)),
     r'markers\[0\]\.side_length = 5: must be a number in'),
    (several(marker_entry(0, position=[1])), r'markers\[0\]\.position = \[1\]: must be three'),
    (several(marker_entry(0, rpy=[0, 0, 90])), r'markers\[0\]\.rpy = .*rad'),
    (several(marker_entry(0), marker_id=1), r'neighbors\[0\] has an unknown key marker_id'),
    (several(marker_entry(0), name='a b'), r'neighbors\[0\]\.name = .*must be a word'),
    ({**several(), 'neighbors': [{'markers': [marker_entry(0)]}]}, r'neighbors\[0\] lacks name'),
    (several(marker_entry(4), marker_entry(4)),
     r'neighbors\[0\]\.marker_id = 4: another marker has it'),
])
def test_wrong_lists_of_markers_are_refused_by_place_and_value(broken: Any,
                                                               message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(broken)


def test_a_neighbour_has_a_role_and_a_radius_where_they_are_given() -> None:
    (plain,) = parse(several(marker_entry(0))).neighbors
    assert (plain.role, plain.radius) == ('leader', 0.0)
    (given,) = parse(several(marker_entry(0), role='avoid', radius=1)).neighbors
    assert (given.role, given.radius) == ('avoid', 1.0) and isinstance(given.radius, float)


@pytest.mark.parametrize(('change', 'message'), [
    ({'name': ''}, r"neighbors\[0\]\.name = '': must be a word"),
    ({'name': 'the leader'}, 'must be a word'),
    ({'name': 7}, 'name = 7'),
    ({'marker_id': 50}, r'marker_id = 50: must be an integer in \[0, 49\]'),
    ({'marker_id': -1}, 'marker_id = -1'),
    ({'marker_id': True}, 'marker_id = True'),
    ({'marker_id': '0'}, "marker_id = '0'"),
    ({'side_length': 0.0}, r'side_length = 0\.0: must be a number in \[0\.01, 2\] m'),
    ({'side_length': 16}, 'side_length = 16'),
    ({'side_length': float('nan')}, 'side_length = nan'),
    ({'side_length': '0.16 m'}, "side_length = '0.16 m'"),
    ({'position': [0.0, 0.0]}, 'position = .*: must be three values'),
    ({'position': [0.0, 0.0, float('inf')]}, 'position = .*inf'),
    ({'position': [0.0, 0.0, 200.0]}, r'in \[-5, 5\] m'),
    ({'position': 'tail'}, "position = 'tail'"),
    ({'rpy': [90.0, 0.0, -90.0]}, r'rpy = .*in \[-6\.28319, 6\.28319\] rad'),
    ({'sidelength': 0.16}, 'unknown key sidelength'),
    ({'role': 'boss'}, r"neighbors\[0\]\.role = 'boss': must be one of leader, follower, avoid"),
    ({'role': ['avoid']}, r'role = \[.avoid.\]: must be one of'),
    ({'radius': -0.1}, r'neighbors\[0\]\.radius = -0\.1: must be a number in \[0, 5\] m'),
    ({'radius': True}, 'radius = True: must be'),
])
def test_wrong_entries_are_refused_by_key_and_value(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(document(**change))


@pytest.mark.parametrize(('broken', 'message'), [
    (None, 'the document = None: must map dictionary, neighbors'),
    ([], 'must map'),
    ({'neighbors': []}, 'lacks dictionary'),
    ({'dictionary': 'DICT_4X4_50'}, 'lacks neighbors'),
    ({**document(), 'dictionary': 'DICT_3X3'}, "dictionary = 'DICT_3X3': must be one of"),
    ({**document(), 'neighbors': []}, r'neighbors = \[\]: must be a list of at least one'),
    ({**document(), 'neighbors': [3]}, r'neighbors\[0\] = 3: must map'),
    ({**document(), 'neighbors': [{'name': 'leader'}]}, r'neighbors\[0\] lacks marker_id'),
])
def test_wrong_documents_are_refused(broken: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(broken)


@pytest.mark.parametrize(('key', 'value'), [('name', 'leader'), ('marker_id', 0)])
def test_names_and_markers_are_unique(key: str, value: Any) -> None:
    first = document()['neighbors'][0]
    second = {**first, 'name': 'other', 'marker_id': 1, key: value}
    with pytest.raises(ValueError, match=rf'neighbors\[1\]\.{key} = {value!r}: another'):
        parse({'dictionary': 'DICT_4X4_50', 'neighbors': [first, second]})


def test_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / 'wrong.yaml'
    path.write_text('neighbors: []\n', encoding='utf-8')
    with pytest.raises(ValueError, match=r'wrong\.yaml: the document lacks dictionary'):
        load(path)
    path.write_text('neighbors: [\n', encoding='utf-8')
    with pytest.raises(ValueError, match=r'wrong\.yaml: not valid YAML'):
        load(path)
    with pytest.raises(OSError, match=r'missing\.yaml'):
        load(tmp_path / 'missing.yaml')


def test_where_the_antenna_is_may_be_told_with_one_marker_or_several() -> None:
    for written in (document(tag_position=[0.0, 0.02, 0.1]),
                    several(marker_entry(0), tag_position=[0, 0.02, 0.1])):
        assert parse(written).neighbors[0].tag_position == (0.0, 0.02, 0.1)
    assert parse(document()).neighbors[0].tag_position == (0.0, 0.0, 0.0)
    for wrong in ([0.0, 0.0], 0.1, [0.0, 0.0, 9.0], ['a', 0.0, 0.0]):
        with pytest.raises(ValueError, match=r'tag_position = .*: must be three values'):
            parse(document(tag_position=wrong))
