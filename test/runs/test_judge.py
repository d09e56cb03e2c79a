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

"""Bounds on the figures of a summary."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flock_desk.runs.judge import check_names, FigureBound, judge, load_bounds, parse_bounds

SUMMARY: dict[str, Any] = {
    'bag': 'sample', 'recall': 0.97, 'frames': 360, 'nees_position': None,
    'distance_m': {'min': 1.3, 'max': 2.5}, 'rejections': {'outside the gate': 4}}


def faults(document: Any) -> list[str]:
    bounds = parse_bounds(document)
    check_names(bounds, SUMMARY)
    return [judgement.fault for judgement in judge(bounds, SUMMARY) if judgement.fault]


def test_bounds_that_hold_are_no_faults_and_both_ends_belong() -> None:
    assert faults({'recall': {'min': 0.97, 'max': 0.97}, 'frames': {'min': 1},
                   'distance_m.max': {'max': 2.83}}) == []


def test_every_bound_broken_is_named_with_figure_and_limit() -> None:
    assert faults({'recall': {'min': 0.98}, 'distance_m.min': {'max': 1.0},
                   'rejections.outside the gate': {'max': 3}}) == [
        'recall = 0.97: must be at least 0.98', 'distance_m.min = 1.3: must be at most 1',
        'rejections.outside the gate = 4: must be at most 3']


def test_what_is_not_known_fails_and_what_was_never_counted_is_zero() -> None:
    (fault,) = faults({'nees_position': {'max': 6.0}})
    assert fault.startswith('nees_position is not known')
    assert faults({'rejections.invalid image': {'max': 0}}) == []
    assert faults({'rejections.invalid image': {'min': 1}}) == [
        'rejections.invalid image = 0: must be at least 1']


@pytest.mark.parametrize('figure', [float('nan'), float('inf'), -float('inf')])
@pytest.mark.parametrize('bound', [FigureBound('x', least=1.0), FigureBound('x', most=1.0)])
def test_a_figure_that_is_not_finite_fails(figure: float, bound: FigureBound) -> None:
    assert judge([bound], {'x': figure})[0].fault == f'x = {figure:g}: must be finite'


@pytest.mark.parametrize(('document', 'message'), [
    ({'recal': {'min': 1}}, 'recal is no figure of the summary: did you mean recall?'),
    ({'bag': {'min': 1}}, 'bag is no figure'), ({'distance_m': {'min': 1}}, 'distance_m is no'),
    ({'recall': 0.9}, 'recall = 0.9: must have min, max or both'),
    ({'recall': {'least': 0.9}}, 'must have min, max or both, and nothing else'),
    ({'recall': {}}, 'must have min, max or both'),
    ({'recall': {'min': 'high'}}, "recall: min = 'high': must be a finite number"),
    ({'recall': {'min': float('nan')}}, 'recall: min = nan: must be a finite number'),
    ({'recall': {'min': True}}, 'recall: min = True: must be a finite number'),
    ({'recall': {'min': 2, 'max': 1}}, 'recall: min = 2: must be at most max = 1'),
    ([], 'must map figures'), (None, 'must map figures')])
def test_a_wrong_bound_is_named(document: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        faults(document)


def test_the_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / 'bounds.yaml'
    path.write_text('recall: [')
    with pytest.raises(ValueError, match='bounds.yaml: not valid YAML'):
        load_bounds(path)
    path.write_text('recall: {min: 0.5}')
    assert load_bounds(path)[0].least == 0.5
