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

"""Scenario files: those of the package fly, and a wrong one says where and what is allowed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flock_desk.scenarios.scenario import RangeErrors
from flock_desk.scenarios.scenario_file import load, names, parse, ScenarioError

GOOD = """summary: a test
flight: {v_max: 2}
leader:
  motion: legs
  legs:
    - {duration: 6, velocity: [1.2, 0, 0]}
"""


NAMES = """approach bobbing circle duplicate_marker fast_approach fast_leader fast_random_walk
fast_spline fast_stairs figure_eight flock_line flock_line_all_round flock_ring
flock_ring_all_round flock_wedge flock_wedge_all_round handover hidden_coming hidden_stop hover
hover_noisy indoor latency marker_lost_1s marker_lost_5s narrow_circle narrow_figure_eight
narrow_hover narrow_toward occluded outdoor overhead random_walk range_only_5s restart shuttle
spline stairs stop straight toward vio_lost worst_case"""


def test_the_package_has_these_scenarios() -> None:
    assert names() == NAMES.split()


@pytest.mark.parametrize('name', names())
def test_every_scenario_of_the_package_is_valid_and_says_what_it_is(name: str) -> None:
    scenario = load(name)
    assert scenario.name == name
    assert len(scenario.summary) > 10


def test_a_file_of_ones_own_is_read_with_integers_and_single_values(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text(GOOD + 'wind: {speed: 2}\nduration: 30\n')
    scenario = load(str(path))
    assert (scenario.name, scenario.duration, scenario.wind.speed) == ('mine', 30.0, (2.0, 2.0))
    assert scenario.leader.legs[0].velocity == (1.2, 0.0, 0.0)


@pytest.mark.parametrize(('change', 'message'), [
    (('v_max: 2', 'v_max: fast'), "x.yaml:2: flight.v_max = 'fast': must be a number"),
    (('v_max: 2', 'v_max: -1'), 'x.yaml:2: flight.v_max = -1.0: must be a number in '
                                '[0.05, 20] m/s'),
    (('v_max: 2', 'd1: 0.5'), 'x.yaml:2: flight.d1 = 0.5: must be a number in '
                              '[d0 + 0.001, 10000] m^2, where d0 = 1.0'),
    (('v_max: 2', 'vmax: 2'), 'x.yaml:2: flight.vmax: unknown key (did you mean v_max?): must be '
                              'one of beta, d0, d1, a_max, v_max'),
    (('v_max: 2', 'v_max: 2, v_max: 3'), 'x.yaml:2: flight.v_max: given twice, first in line 2'),
    (('motion: legs', 'motion: spiral'), "x.yaml:4: leader.motion = 'spiral': must be one of "
                                         'legs, circle, figure_eight, wander'),
    (('duration: 6,', ''), 'x.yaml:6: leader.legs[0].duration: is missing'),
    (('[1.2, 0, 0]', '[1.2, 0]'), 'x.yaml:6: leader.legs[0].velocity = a sequence: must be a '
                                  'list of 3 numbers'),
    (('[1.2, 0, 0]', '[1.2, 0, x]'), "x.yaml:6: leader.legs[0].velocity[2] = 'x': must be a "
                                     'number'),
    (('[1.2, 0, 0]', '[99, 0, 0]'), 'x.yaml:6: leader.legs[0].velocity = 99.0: must be a '
                                    'number in [-10, 10] m/s'),
    (('legs:\n    -', 'legs: 3 #'), "x.yaml:5: leader.legs = '3': must be a list"),
    (('motion: legs', 'motion: circle\n  speed: 3'),
     'x.yaml:3: leader: needs 6.00 m/s^2: must be at most acceleration = 1 m/s^2 (slower, or a '
     'larger size)'),
    (('summary: a test', 'start: {distance: [2, 1]}'),
     'x.yaml:1: start.distance = [2.0, 1.0]: must be [lowest, highest]'),
    (('summary: a test', 'x: [1'), 'x.yaml:2: not valid YAML: '),
    (('summary: a test\n', ''), 'x.yaml:1: summary: is missing'),
    (('summary: a test', 'summary: a test\nrepeat: yes'), 'x.yaml:2: repeat: unknown key'),
    (('motion: legs', 'motion: legs\n  repeat: 1'),
     "x.yaml:5: leader.repeat = '1': must be true or false"),
    (('summary: a test', 'summary: a test\nduration: .inf'),
     "x.yaml:2: duration = '.inf': must be a number"),
])
def test_a_wrong_file_is_told_with_line_and_what_is_allowed(change: tuple[str, str],
                                                            message: str) -> None:
    text = GOOD.replace(*change)
    assert text != GOOD
    with pytest.raises(ScenarioError) as error:
        parse(text, 'x.yaml')
    assert str(error.value).startswith(message)


VARIANTS = GOOD + """variants:
  windy: {summary: with wind, wind: {speed: 2}, leader: {repeat: true}}
"""


def test_a_variant_differs_in_the_keys_that_it_has(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text(VARIANTS)
    base, windy = load(str(path)), load(f'{path}:windy')
    assert windy == replace(base, name='windy', summary='with wind', wind=replace(
        base.wind, speed=(2.0, 2.0)), leader=replace(base.leader, repeat=True))
    with pytest.raises(ScenarioError, match=r'mine\.yaml: has no variant calm, only windy'):
        load(f'{path}:calm')
    with pytest.raises(ScenarioError, match=r'x\.yaml:8: variants\.windy\.wind\.sped: unknown'):
        parse(VARIANTS.replace('speed', 'sped'), 'x.yaml', 'windy')


@pytest.mark.parametrize('text', ['', '# nothing', 'just text', '- a\n- b'])
def test_a_file_that_is_no_scenario_at_all_is_refused(text: str) -> None:
    with pytest.raises(ScenarioError, match=r'^x\.yaml:1: '):
        parse(text, 'x.yaml')


def test_an_unknown_name_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"^scenario = 'loop': must be one of approach, "):
        load('loop')
    with pytest.raises(ScenarioError, match='cannot be read'):
        load(str(tmp_path / 'absent.yaml'))


def test_a_flock_has_to_say_that_it_measures_distances():
    line = load('flock_line')
    with pytest.raises(ValueError, match='ranges: rate = 0: must be above 0 Hz where flock'):
        replace(line, flock=replace(line.flock, ranges=True))
    off = replace(line, ranges=RangeErrors(rate=20.0))
    assert not off.measures_ranges
    assert replace(off, flock=replace(line.flock, ranges=True)).measures_ranges
