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

"""The limits of the gate: what they are by default, and what they may be."""

from dataclasses import fields, FrozenInstanceError
import math

import pytest

from flock_follower.mavlink.envelope import GateLimits

LIMITS = GateLimits()


@pytest.mark.parametrize(('name', 'lowest', 'highest'), [
    ('a_max', 0.01, 20.0), ('v_max', 0.01, 20.0), ('planner_timeout', 0.15, 1.0),
    ('odom_timeout', 0.05, 1.0), ('link_timeout', 0.2, 5.0), ('blind_timeout', 0.2, 10.0),
    ('speed_horizon', 0.02, 2.0), ('brake_time', 0.02, 2.0), ('yaw_disagreement', 0.01, 3.2)])
def test_a_limit_out_of_range_is_named_with_its_value_and_range(name, lowest, highest):
    for value in (lowest, highest):
        assert getattr(GateLimits(**{name: value}), name) == value
    valid = rf'must be a number in \[{lowest:g}, {highest:g}\]'
    for value in (0.0, -1.0, math.nan, lowest * 0.999, highest * 1.001, math.inf):
        with pytest.raises(ValueError, match=rf'^{name} = {value}: {valid}'):
            GateLimits(**{name: value})


@pytest.mark.parametrize(('name', 'highest', 'unit'), [('velocity_disagreement', 100.0, 'm/s')])
def test_some_limits_may_be_absent(name, highest, unit):
    for value in (0.0, highest):
        assert getattr(GateLimits(**{name: value}), name) == value
    for value in (-0.1, math.nan, highest + 0.1):
        valid = rf'must be a number in \[0, {highest:g}\] {unit}'
        with pytest.raises(ValueError, match=rf'^{name} = {value}: {valid}'):
            GateLimits(**{name: value})


def test_the_flight_defaults():
    assert {field.name: getattr(LIMITS, field.name) for field in fields(LIMITS)} == {
        'a_max': 2.5, 'v_max': 0.5, 'planner_timeout': 0.2, 'odom_timeout': 0.3,
        'link_timeout': 1.0, 'blind_timeout': 2.0, 'speed_horizon': 0.3, 'brake_time': 0.3,
        'yaw_disagreement': 0.35, 'velocity_disagreement': 0.0,
        'height_min': 0.5, 'height_max': 10.0, 'radius_max': 50.0}


def test_the_limits_cannot_be_changed_behind_the_back_of_their_checks():
    with pytest.raises(FrozenInstanceError):
        LIMITS.a_max = math.inf


@pytest.mark.parametrize(('limits', 'tolerance'), [
    (GateLimits(), 0.4), (GateLimits(v_max=0.3), 0.4), (GateLimits(v_max=2.0), 1.0),
    (GateLimits(v_max=2.0, velocity_disagreement=0.7), 0.7),
    (GateLimits(velocity_disagreement=0.1), 0.1)])
def test_how_much_velocities_may_differ_follows_from_v_max_unless_it_is_set(limits, tolerance):
    assert limits.velocity_tolerance == tolerance
