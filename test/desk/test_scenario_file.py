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

from flock_desk.scenarios.scenario_file import (
    key_tables,
    load,
    load_for_real_time,
    names,
    parse,
    ScenarioError,
)

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
def test_every_packaged_scenario_is_valid_and_described(name: str) -> None:
    scenario = load(name)
    assert scenario.name == name
    assert len(scenario.summary) > 10


def test_own_file_is_read_with_integers_and_single_values(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text(GOOD + 'wind: {speed: 2}\nduration: 30\n')
    scenario = load(str(path))
    assert (scenario.name, scenario.duration, scenario.wind.speed) == ('mine', 30.0, (2.0, 2.0))
    assert parse(GOOD + 'variants:\n', 'mine.yaml') == parse(GOOD, 'mine.yaml')
    assert parse(GOOD.replace('v_max: 2', 'K: 0.5'), 'mine').flight.planner(True).law.K == 0.5
    assert '| `name`' not in key_tables() and '| `outages` | [] |' in key_tables()
    assert scenario.leader.legs[0].velocity == (1.2, 0.0, 0.0)


FLOCK = 'summary: a test\nflock: {followers: 4, cameras: [front]}'


@pytest.mark.parametrize(('change', 'message'), [
    (('v_max: 2', 'v_max: fast'), "flight.v_max = 'fast': must be a number"),
    (('v_max: 2', 'v_max: -1'), 'flight.v_max = -1.0: must be a number in [0.1, 5] m/s'),
    (('v_max: 2', 'd1: 0.5'),
     'flight.d1 = 0.5: must be a number in [d0 + 0.001, 10000] m^2, where d0 = 1.0'),
    (('v_max: 2', 'vmax: 2'), 'flight.vmax: unknown key: must be one of K, beta, d0, d1, a_max'),
    (('motion: legs', 'motion: spiral'), "leader.motion = 'spiral': must be one of legs, circle"),
    (('motion: legs', 'motion: random_walk\n  climb: 0.5'),
     'leader.climb = 0.5: must be at most speed = 0.4'),
    (('duration: 6,', ''), 'leader.legs[0].duration: is missing'),
    (('[1.2, 0, 0]', '[1.2, 0]'), 'leader.legs[0].velocity = [1.2, 0]: must be a list of 3'),
    (('[1.2, 0, 0]', '[1.2, 0, x]'), "leader.legs[0].velocity[2] = 'x': must be a number"),
    (('legs:\n    -', 'legs: 3 #'), 'leader.legs = 3: must be a list'),
    (('motion: legs', 'motion: circle\n  speed: 3'),
     'leader: needs 6.00 m/s^2: must be at most acceleration = 1 m/s^2'),
    (('summary: a test', 'start: {distance: [2, 1]}'),
     'start.distance = [2.0, 1.0]: must be [lowest, highest]'),
    (('summary: a test', 'x: [1'), 'while parsing a flow sequence in'),
    (('summary: a test\n', ''), 'summary: is missing'),
    (('motion: legs', 'motion: legs\n  repeat: 1'), 'leader.repeat = 1: must be true or false'),
    (('summary: a test', 'summary: a test\nduration: .inf'), 'duration = inf: must be a number'),
    (('summary: a test', FLOCK.replace('4', '2.5')), 'flock.followers = 2.5: must be an integer'),
    (('summary: a test', FLOCK.replace('[front]', '[aft]')),
     'flock.cameras = [aft]: must be some of front, left, right, back, up, down, each once'),
    (('summary: a test', FLOCK.replace('}', ', fails: {follower: 5, at: 9}}')),
     'flock.fails = follower 5: must be an integer in [1, followers], where followers = 4'),
    (('summary: a test', FLOCK.replace('}', ', ranges: true}')), 'ranges: rate = 0: must be'),
    (('summary: a test', f'{FLOCK}\nflight: {{v_max: 2}}'),
     'flight: v_max = 2: must be at most 1 m/s'),
    (('summary: a test', 'summary: a test\nvariants: [windy]'),
     "variants = ['windy']: must be a mapping of names to keys"),
])
def test_a_wrong_file_is_refused_with_key_and_valid_values(change: tuple[str, str],
                                                           message: str) -> None:
    text = GOOD.replace(*change)
    assert text != GOOD
    with pytest.raises(ScenarioError) as error:
        parse(text, 'x.yaml')
    assert str(error.value).startswith(f'x.yaml: {message}')


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
    with pytest.raises(ScenarioError, match=r'x\.yaml: variants\.windy\.wind\.sped: unknown'):
        parse(VARIANTS.replace('speed', 'sped'), 'x.yaml', 'windy')


@pytest.mark.parametrize('text', ['', '# nothing', 'just text', '- a\n- b'])
def test_a_file_that_is_no_scenario_at_all_is_refused(text: str) -> None:
    with pytest.raises(ScenarioError, match=r'^x\.yaml: the file: must be a mapping of summary'):
        parse(text, 'x.yaml')


def test_an_unknown_name_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"^scenario = 'loop': must be one of approach, "):
        load('loop')
    with pytest.raises(ScenarioError, match='cannot be read'):
        load(str(tmp_path / 'absent.yaml'))


@pytest.mark.parametrize('name', ['flock_line', 'handover'])
def test_flocks_and_operations_are_refused_in_real_time(name: str) -> None:
    with pytest.raises(ScenarioError, match=f'in lock step only: flights --scenario {name}'):
        load_for_real_time(name)
