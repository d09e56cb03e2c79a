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

"""The signs of commands and setpoints, judged in lock step."""

import pytest

from flock_desk.fly import at_any_load
from flock_desk.runs.lock_step import sign_faults, SIGNS
from flock_desk.runs.processes import TOO_BUSY_EXIT_CODE, TooBusyError
from flock_desk.scenarios.scenario_file import load
from flock_follower.gate import setpoint_rules
from flock_follower.planner.loop import PlannerLoop

INDOOR = load('indoor')
ALONG, OPPOSED = SIGNS


@pytest.fixture
def turned_setpoints(monkeypatch):
    limited = setpoint_rules.LimitedCommand
    monkeypatch.setattr(setpoint_rules, 'LimitedCommand',
                        lambda total, reason: limited(-total, reason))


@pytest.fixture
def turned_commands(monkeypatch):
    tick = PlannerLoop.tick

    def turned(*arguments, **options):
        decision, command = tick(*arguments, **options)
        return decision, command and command._replace(acceleration=-command.acceleration)

    monkeypatch.setattr(PlannerLoop, 'tick', turned)


def broken(scenario):
    return [fault.partition(' ')[0] for fault in sign_faults(scenario)]


def too_busy():
    raise TooBusyError('for the nodes')


def test_right_signs_break_no_bound_in_the_narrow_band_either():
    assert broken(load('narrow_hover')) == []


def test_turned_setpoints_fail_whatever_the_load_prevented(turned_setpoints):
    assert broken(INDOOR) == [OPPOSED]


def test_turned_commands_are_against_the_law(turned_commands):
    assert broken(INDOOR) == [ALONG]


@pytest.mark.parametrize(('faults', 'codes'), [([], (None, 3, 0, 1)), (['x'], (1, 1, 0, 1))])
def test_verdict_of_the_signs_replaces_too_busy_alone(monkeypatch, faults, codes):
    """None stands for TooBusyError."""
    monkeypatch.setattr('flock_desk.fly.sign_faults', lambda _: faults)
    found = []
    for flight in too_busy, lambda: TOO_BUSY_EXIT_CODE, lambda: 0, lambda: 1:
        try:
            found.append(at_any_load(INDOOR, flight))
        except TooBusyError:
            found.append(None)
    assert tuple(found) == codes
