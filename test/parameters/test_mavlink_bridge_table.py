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

"""Every parameter of the gate reaches the gate."""

from dataclasses import fields

import pytest

from flock_follower.mavlink.envelope import GateLimits
from flock_follower.parameters.mavlink_bridge_table import SPECS
from flock_follower.parameters.spec import filled

OF_THE_GATE = [spec for spec in SPECS if spec.name in {field.name for field in fields(GateLimits)}]


@pytest.mark.parametrize('spec', OF_THE_GATE, ids=lambda spec: spec.name)
def test_a_value_that_is_set_is_the_one_that_limits(spec):
    other = not spec.default if isinstance(spec.default, bool) else 0.9 * spec.default or 0.5
    values = {each.name: each.default for each in SPECS} | {spec.name: other}
    assert getattr(filled(GateLimits(), values), spec.name) == other


def test_constants_of_the_gate_are_no_parameters():
    missing = {field.name for field in fields(GateLimits)} - {spec.name for spec in OF_THE_GATE}
    assert missing == {'brake_time', 'speed_horizon', 'blind_timeout'}
