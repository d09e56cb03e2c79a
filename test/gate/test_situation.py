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

"""Situations as values: whatever one holds, its setpoint is safe, and a line of text keeps it."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from recorded_situation import read_situation
from situations import situation

from flock_follower.gate.envelope import GateLimits, Location
from flock_follower.gate.obstacle import Obstacle
from flock_follower.gate.permission import MODE_TIMEOUT
from flock_follower.gate.relative_flight import Relative
from flock_follower.gate.setpoint_rules import BRAKE, COMMAND, decide, LEVEL, NONE
from flock_follower.gate.situation import Held
from flock_follower.gate.velocity_check import (
    AUTOPILOT,
    FUTURE_TOLERANCE,
    known_motion,
    ODOM,
    SourceMotion,
)
from flock_follower.messages.commands import Command, OLDEST_MARKER, RELATIVE_ACCELERATION_MAX

ANY = st.floats() | st.floats(-4.0, 4.0)
VECTOR = st.tuples(ANY, ANY, ANY)


def mostly(usual, otherwise):
    """Return a strategy that draws the usual value nine times out of ten."""
    return st.integers(0, 9).flatmap(lambda k: st.just(usual) if k else otherwise)


def age(usual):
    return mostly(usual, st.sampled_from([0.21, 0.31, 0.51, 1.5, 5.0, -0.05, -0.5]) | ANY)


LIMITS = st.builds(GateLimits, a_max=st.floats(1.5, 20.0), v_max=st.floats(0.1, 5.0),
                   relative_flight=st.booleans())
SLOW = SourceMotion((0.1, 0.0, 0.0), 0.02, 0.5, 0.02)
MOTION = mostly(SLOW, st.builds(SourceMotion, VECTOR, age(0.02), ANY, age(0.02)))
COMMANDS = mostly(Command((1.0, 0.3, 0.1), 1.0), st.none() | st.builds(
    Command, VECTOR, ANY, ANY, st.none() | VECTOR.map(np.array), relative=st.booleans(),
    retreat=st.none()))
SITUATIONS = st.builds(
    lambda limits, lowered, odom, autopilot, source, since, **more: situation(
        GateLimits(a_max=max(lowered * limits.a_max, 1.5), v_max=limits.v_max,
                   relative_flight=limits.relative_flight),
        known_motion(limits, odom, autopilot, source, since, since), full=limits, **more),
    LIMITS, st.sampled_from([1.0, 0.7]), MOTION, MOTION, st.sampled_from([ODOM, AUTOPILOT]),
    mostly(-math.inf, st.sampled_from([0.1, 0.7]) | ANY),
    command=COMMANDS, command_age=age(0.05), source_age=age(0.2),
    armed=mostly(True, st.just(False)), airborne=mostly(True, st.just(False)),
    link_age=age(0.1), mode_age=age(0.5),
    withheld=mostly('', st.just('offboard was left')),
    unplaced=mostly('', st.just('height stale')),
    place=mostly(Location(2.0), st.builds(
        Location, st.none() | ANY, ANY, st.none() | st.tuples(ANY, ANY).map(np.array))),
    held=st.builds(Held, st.none() | ANY, st.none() | ANY),
    offset=mostly(np.zeros(3), VECTOR.map(np.array)), retreat=st.none() | VECTOR.map(np.array),
    relative=mostly(Relative(5.0), st.builds(Relative, ANY, st.booleans())))


#: Flown situations in which one age alone is not the usual one.
ONE_AGE = st.builds(
    lambda name, seconds, relative: situation(
        GateLimits(relative_flight=True),
        known_motion(GateLimits(), SLOW, SLOW, ODOM), place=Location(2.0),
        command=Command((0.3, 0.2, 0.1), 1.0, relative=relative), relative=Relative(5.0),
        **{name: seconds}),
    st.sampled_from(['command_age', 'source_age', 'link_age', 'mode_age']),
    st.sampled_from([0.21, 0.31, 0.51, 1.5, 5.0, -0.2, math.nan, math.inf]), st.booleans())


def fresh(seconds, longest):
    return -FUTURE_TOLERANCE <= seconds <= longest


@settings(max_examples=200, deadline=None)
@given(ONE_AGE | SITUATIONS)
def test_any_situation_sends_nothing_unsafe_unpermitted_or_stale(given):
    setpoint, limits, report = decide(given), given.limits, given.report
    assert setpoint.kind in (COMMAND, BRAKE, LEVEL, NONE)
    assert np.all(np.isfinite(setpoint.acceleration))
    assert setpoint.yaw is None or math.isfinite(setpoint.yaw)
    assert np.linalg.norm(setpoint.acceleration) <= given.start_limits.a_max
    assert (setpoint.cause is None) == (setpoint.kind == COMMAND)
    if given.withheld:
        assert (setpoint.kind, setpoint.cause) == (NONE, Obstacle.WITHHELD)
    if not report.armed or setpoint.kind == NONE:
        assert not setpoint.acceleration.any()
    if not report.airborne:
        assert setpoint.acceleration[2] <= 0.0
    if setpoint.kind == COMMAND:
        assert report.armed and report.link_age <= limits.link_timeout
        assert report.mode_age <= MODE_TIMEOUT and given.unplaced is None
        assert fresh(given.command_age, limits.planner_timeout)
        if given.command.command.relative:
            assert limits.relative_flight and fresh(given.source_age, OLDEST_MARKER)
            assert np.linalg.norm(setpoint.acceleration[:2]) <= (
                RELATIVE_ACCELERATION_MAX + np.linalg.norm(given.offset[:2]))
        else:
            assert given.known.velocity is not None and given.known.contradiction is None


@settings(max_examples=30, deadline=None)
@given(SITUATIONS)
def test_situation_read_from_its_line_decides_the_same(given):
    line = given.to_json()
    assert '\n' not in line
    again = read_situation(line)
    assert again.to_json() == line
    setpoint, before = decide(again), decide(given)
    assert setpoint._replace(acceleration=None) == before._replace(acceleration=None)
    np.testing.assert_array_equal(setpoint.acceleration, before.acceleration)
