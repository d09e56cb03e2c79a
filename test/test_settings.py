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
"""Sets of parameters: what endangers is refused, what performs badly is named."""

from dataclasses import asdict, replace
import math
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
import pytest

from flock_desk.scenarios.scenario_file import load
from flock_follower.gate.envelope import GateLimits
from flock_follower.mavlink.parameter_table import gate_limits
from flock_follower.parameters.settings import (
    Camera,
    find_unsafe_settings,
    NARROWEST,
    NEAREST,
    refuse,
    UNKNOWN,
)
from flock_follower.parameters.spec import specs_of
from flock_follower.planner.parameter_table import planner_params
from flock_follower.planner.params import PlannerParams
from flock_follower.ranges import A_MAX, V_MAX

ROOT = Path(__file__).resolve().parents[1]
DEFAULTS = {spec.name: spec.default for spec in (*specs_of(PlannerParams()),
                                                 *specs_of(GateLimits()))}
#: A camera of 640x480 pixels and a marker of 0.16 m.
USUAL = Camera(30.0, 610.0 * 0.16, 0.37)


def found(camera=USUAL, **changes):
    """Return parameter and danger of each judgment of the defaults with some changes."""
    return [(each.parameter, each.dangerous)
            for each in find_unsafe_settings(DEFAULTS | changes, camera)]


def test_the_defaults_can_fly():
    assert found() == [] and found(Camera()) == []


def test_the_recommendation_for_first_flights_can_fly():
    text = (ROOT / 'docs' / 'field_card.md').read_text(encoding='utf-8')
    assert '`v_max` 0.3, `a_max` 1.5 for the first flights' in text
    assert found(v_max=0.3, a_max=1.5) == []


@pytest.mark.parametrize('path', sorted((ROOT / 'config' / 'scenarios').glob('*.yaml')),
                         ids=lambda path: path.stem)
def test_every_scenario_can_fly(path):
    flight = load(str(path)).flight
    assert not [each for each in find_unsafe_settings(asdict(flight), USUAL) if each.dangerous]


@pytest.mark.parametrize(('changes', 'camera', 'expected'), [
    ({'a_max': 1.5, 'v_max': 1.0}, USUAL, ('a_max', True)),
    ({'a_max': 2.0, 'v_max': 2.0}, USUAL, ('a_max', True)),
    ({'a_max': 2.5, 'v_max': 3.0}, USUAL, ('a_max', True)),
    ({'d0': 100.0, 'd1': 400.0}, USUAL, ('d1', True)),
    ({'d1': 60.0, 'radius': 1.0}, USUAL, ('d1', True)),
    ({'d0': 0.1}, USUAL, ('d0', True)),
    ({'d1': 1.4}, USUAL, ('d1', True)),
    ({'d1': 2.25}, USUAL, ('d1', False)),
    ({'predict_timeout': 0.3}, USUAL._replace(rate=5.0), ('predict_timeout', True)),
    ({}, USUAL._replace(rate=5.0), ('perception_timeout', False)),
    ({'altitude_offset': 0.6}, UNKNOWN, ('altitude_offset', True)),
    ({'altitude_offset': -0.6}, USUAL, ('altitude_offset', True)),
    ({'leader_acceleration_max': 5.0}, USUAL, ('leader_acceleration_max', False))])
def test_what_cannot_fly_is_named(changes, camera, expected):
    assert expected in found(camera, **changes)


@given(st.floats(A_MAX.low, A_MAX.high), st.floats(V_MAX.low, V_MAX.high),
       st.floats(0.01, 100.0), st.floats(0.01, 400.0))
def test_the_value_that_a_refusal_names_is_accepted(a_max, v_max, d0, d1):
    values = DEFAULTS | {'a_max': a_max, 'v_max': v_max, 'd0': d0, 'd1': max(d1, d0)}
    for _ in range(4):
        dangers = [each for each in find_unsafe_settings(values) if each.dangerous]
        if not dangers:
            break
        named = dangers[0]
        values[named.parameter] = float(named.valid.split()[2])
    else:
        pytest.fail(f'still refused: {dangers}')
    near, far = math.sqrt(values['d0']), math.sqrt(values['d1'])
    assert near >= NEAREST - 1e-9 and far - near >= NARROWEST - 1e-9


def test_nodes_and_programs_refuse_by_the_same_judgment():
    slow = DEFAULTS | {'a_max': 1.5, 'v_max': 2.0, 'neighbors_file': '', 'cameras': ['']}
    for build in (refuse, gate_limits, planner_params):
        with pytest.raises(ValueError, match=r'^a_max = 1\.5: must be at least 2\.43 m/s\^2 for '
                                             r'v_max = 2: '):
            build(slow)
    with pytest.raises(ValueError, match='^a_max = 1.5: must be at least'):
        replace(load('hover').flight, a_max=1.5, v_max=2.0)
