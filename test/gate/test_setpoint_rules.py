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

"""The rules of setpoints, argument by argument: what passes, what brakes, what is never sent."""

import math
import struct

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from situations import judge_situation

from flock_follower.gate.envelope import GateLimits, Location
from flock_follower.gate.permission import MODE_TIMEOUT
from flock_follower.gate.setpoint_rules import BRAKE, COMMAND, LEVEL, NONE
from flock_follower.gate.situation import Held
from flock_follower.gate.velocity_check import (
    AUTOPILOT,
    FUTURE_TOLERANCE,
    known_motion,
    ODOM,
    SourceMotion,
)
from flock_follower.mavlink.setpoint_encoding import encode_setpoint
from flock_follower.messages import FASTEST_OWN
from flock_follower.messages.commands import Command
from flock_follower.ranges import A_MAX, THRUST_OFFSET_MAX, V_MAX

LIMITS = GateLimits()
UNKNOWN = SourceMotion()
FORWARD = Command((1.0, 0.0, 0.0), 1.0)
SLOW = SourceMotion((0.1, 0.0, 0.0), 0.02, 0.5, 0.02)
KNOWN = ('odom', 'autopilot', 'source', 'disagreeing_for')


def judge(limits=LIMITS, **changes):
    """Return the setpoint of a healthy situation with some arguments changed."""
    known = {'odom': SLOW, 'autopilot': SLOW, 'source': ODOM}
    known.update((name, changes.pop(name)) for name in KNOWN if name in changes)
    return judge_situation(limits, known_motion(limits, **known),
                           **{'command': FORWARD, 'held': Held(0.3), **changes})


def same(setpoint, kind, reason, acceleration=(0.0, 0.0, 0.0), yaw=0.3, limited=''):
    assert (setpoint.kind, setpoint.reason, setpoint.limited) == (kind, reason, limited)
    # What is shortened ends a hair inside its limit: float32 on the wire must not exceed it.
    np.testing.assert_allclose(setpoint.acceleration, acceleration, atol=1e-6)
    assert setpoint.yaw == yaw


def test_what_is_withheld_sends_nothing_whatever_else_is_known():
    same(judge(withheld='offboard was left'), NONE, 'offboard was left')
    same(judge(withheld='why', armed=False, link_age=9.0), NONE, 'why')


def test_a_disarmed_vehicle_gets_level_setpoints():
    same(judge(armed=False), LEVEL, 'disarmed')
    same(judge(armed=False, command=None), LEVEL, 'disarmed')


BRAKING = (-0.1 / 0.3, 0.0, 0.0)


@pytest.mark.parametrize(('change', 'reason'), [
    ({'link_age': 1.001}, 'link lost'), ({'link_age': math.nan}, 'link lost'),
    ({'link_age': math.inf}, 'link lost'),
    ({'mode_age': 3.01}, 'mode unknown'), ({'mode_age': math.nan}, 'mode unknown'),
    ({'odom': UNKNOWN}, 'no velocity from odom'),
    ({'odom': SLOW._replace(velocity_age=0.301)}, 'velocity from odom stale'),
    ({'odom': SLOW._replace(velocity_age=-0.101)}, 'velocity from odom stale'),
    ({'odom': SLOW._replace(velocity_age=math.nan)}, 'velocity from odom stale'),
    ({'odom': SLOW._replace(velocity=(0.1, math.nan, 0.0))}, 'velocity from odom stale'),
    ({'odom': SLOW._replace(velocity=(0.0, 100.1, 0.0))}, 'velocity from odom stale'),
    ({'source': AUTOPILOT, 'autopilot': UNKNOWN}, 'no velocity from autopilot'),
    ({'command': None}, 'no command'),
    ({'command': FORWARD._replace(acceleration=(1.0, math.nan, 0.0))}, 'command not finite'),
    ({'command': FORWARD._replace(acceleration=(1.0, 0.0))}, 'command not finite'),
    ({'command': FORWARD._replace(acceleration='fast')}, 'command not finite'),
    ({'command': FORWARD._replace(acceleration=None)}, 'command not finite'),
    ({'command': FORWARD._replace(yaw=math.inf)}, 'command not finite'),
    ({'command_age': 0.201}, 'command stale'), ({'command_age': -0.101}, 'command stale'),
    ({'command_age': math.nan}, 'command stale')])
def test_each_obstacle_brakes_with_its_reason(change, reason):
    same(judge(**change), BRAKE, reason, BRAKING)


TOO_LOW_AND_FAR = Location(0.3, 0.0, np.array([50.5, 0.0]))


@pytest.mark.parametrize('command', [FORWARD, None])
@pytest.mark.parametrize('speed', [0.1, 99.0, 100.1, 1e200])
def test_no_wrong_velocity_removes_a_bound_of_envelope(command, speed):
    odom = SLOW._replace(velocity=(0.0, speed, 0.0))
    setpoint = judge(command=command, odom=odom, place=TOO_LOW_AND_FAR)
    assert setpoint.kind == (BRAKE if command is None or speed > 100.0 else COMMAND)
    assert setpoint.acceleration[2] > 0.2 and 'envelope' in setpoint.limited
    if not 1.0 < speed < 100.0:  # else braking takes all that the heights leave of a_max
        assert setpoint.acceleration[0] < -0.2


def test_an_implausible_velocity_alone_is_none():
    fast = SLOW._replace(velocity=(0.0, 0.0, -101.0))
    same(judge(odom=fast, autopilot=UNKNOWN), LEVEL, 'velocity from odom stale')


@pytest.mark.parametrize('command', [FORWARD, None])
@pytest.mark.parametrize('place', [
    Location(None, 0.0, np.array([51.0, 0.0])),
    Location(math.nan, 0.0, np.array([51.0, 0.0])),
    Location(5.0, math.inf, np.array([51.0, 0.0]))])
def test_without_a_height_the_radius_still_bounds(command, place):
    setpoint = judge(command=command, place=place)
    assert setpoint.acceleration[0] < -0.3 and setpoint.acceleration[2] == 0.0


@pytest.mark.parametrize('offset', [(math.nan, 0.0), (math.inf, 0.0), (1.7e308, 1.7e308)])
def test_without_a_place_the_heights_still_bound(offset):
    setpoint = judge(place=Location(0.3, 0.0, np.array(offset)))
    assert setpoint.acceleration[2] > 0.2


def test_a_healthy_situation_passes_the_command_bit_for_bit():
    same(judge(), COMMAND, '', FORWARD.acceleration, FORWARD.yaw)
    np.testing.assert_array_equal(judge().acceleration, FORWARD.acceleration)


@pytest.mark.parametrize('change', [
    {'link_age': 1.0}, {'link_age': -5.0}, {'command_age': 0.2}, {'command_age': -0.1},
    {'odom': SLOW._replace(velocity_age=0.3)}, {'odom': SLOW._replace(velocity_age=-0.1)},
    {'autopilot': UNKNOWN}, {'source': AUTOPILOT, 'odom': UNKNOWN}])
def test_at_its_limit_every_age_still_passes(change):
    assert judge(**change).kind == COMMAND


# Frames that contradict one another.


def test_yaws_may_differ_by_the_limit_and_not_by_more_either_way():
    for turn in (0.349, -0.349):
        assert judge(autopilot=SLOW._replace(yaw=0.5 + turn)).kind == COMMAND
    for turn in (0.351, -0.351, 3.0):
        setpoint = judge(autopilot=SLOW._replace(yaw=0.5 + turn, velocity=(0.0, 0.2, 0.0)))
        same(setpoint, BRAKE, 'yaws of odom and of the autopilot disagree', (0, -0.2 / 0.3, 0))


@pytest.mark.parametrize(('disagreeing_for', 'kind'), [
    (-0.01, COMMAND), (0.0, LEVEL), (0.6, LEVEL), (0.601, NONE), (math.inf, NONE),
    (math.nan, COMMAND)])
def test_velocity_mismatch_levels_then_ends_stream(
        disagreeing_for, kind):
    setpoint = judge(disagreeing_for=disagreeing_for)
    assert setpoint.kind == kind
    if kind != COMMAND:
        same(setpoint, kind, 'velocities of odom and of the autopilot disagree')


# Braking.


def test_braking_is_limited_to_a_max_as_a_vector():
    fast = SLOW._replace(velocity=(3.0, 4.0, 0.0))
    setpoint = judge(command=None, odom=fast, autopilot=fast)
    same(setpoint, BRAKE, 'no command', (-1.5, -2.0, 0.0), limited='v_max')
    same(judge(GateLimits(a_max=1.5), command=None, odom=fast, autopilot=fast), BRAKE,
         'no command', (-0.9, -1.2, 0.0), limited='v_max')


@pytest.mark.parametrize(('age', 'more'), [
    (-0.1, 0.0), (0.0, 0.0), (0.05, 0.0), (0.1, 0.05 * math.e), (0.3, 0.25 * math.e)])
def test_a_late_velocity_lengthens_braking_and_the_horizon(age, more):
    late = SourceMotion((0.4, 0.0, 0.0), age)
    same(judge(GateLimits(brake_time=0.5), command=None, odom=late, autopilot=UNKNOWN), BRAKE,
         'no command', (-0.4 / (0.5 + more), 0.0, 0.0))
    same(judge(odom=late, autopilot=UNKNOWN), COMMAND, '', (0.1 / (0.3 + more), 0.0, 0.0),
         1.0, 'v_max')
    # The age is that of the velocity braked with.
    same(judge(odom=SLOW._replace(velocity_age=0.4), autopilot=late), BRAKE,
         'velocity from odom stale', (-0.4 / (0.3 + more), 0.0, 0.0))


@pytest.mark.parametrize('delay', [0.05, 0.15, 0.29])
def test_held_height_does_not_oscillate_with_late_velocity(delay):
    step, response = 0.01, 0.25  # s: thrust follows late, too
    heights, rates, acceleration, commanded = [2.4] * 50, [0.0] * 50, 0.0, 0.0
    for k in range(3000):
        if k % 5 == 0:
            late = SourceMotion((0.0, 0.0, rates[-1 - round(delay / step)]), delay, 0.3, delay)
            place = Location(height=heights[-6], climb_rate=late.velocity[2])
            commanded = judge(command=None, odom=late, autopilot=UNKNOWN, held=Held(0.3, 2.0),
                              place=place).acceleration[2]
        acceleration += step / response * (commanded - acceleration)
        rates.append(rates[-1] + step * acceleration)
        heights.append(heights[-1] + step * rates[-1])
    assert min(heights) > 1.9
    np.testing.assert_allclose(heights[-500:], 2.0, atol=0.01)


@pytest.mark.parametrize(('ages', 'kind', 'reason'), [
    ((0.31, 0.31), LEVEL, 'velocity from odom stale'),
    ((2.31, 2.29), LEVEL, 'velocity from odom stale'),
    ((2.31, 2.31), NONE, 'velocity from odom stale'),
    ((math.inf, 2.31), NONE, 'no velocity from odom'),
    ((math.inf, math.inf), LEVEL, 'no velocity from odom')])
def test_without_any_velocity_it_is_level_then_silent(ages, kind, reason):
    odom, autopilot = (SLOW._replace(velocity_age=age) for age in ages)
    same(judge(odom=odom, autopilot=autopilot), kind, reason)


# Limits.


def test_the_yaw_is_wrapped():
    setpoint = judge(command=Command((0.1, 0.0, 0.0), 4.0))
    assert setpoint.yaw == pytest.approx(4.0 - 2 * math.pi)


# Whatever comes in.

ANY = st.floats(allow_nan=True, allow_infinity=True, width=64)
NUMBER = ANY | st.floats(-4.0, 4.0)
AGE = st.sampled_from([0.0, 0.05, 0.15, 0.29, 0.31, 1.5, 5.0, -0.05, -0.5]) | ANY
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER) | st.lists(NUMBER, max_size=4)
MOTION = st.builds(SourceMotion, VECTOR, AGE, NUMBER, AGE)
BOTH_MOTIONS = st.fixed_dictionaries({
    'odom': MOTION, 'autopilot': MOTION, 'source': st.sampled_from([ODOM, AUTOPILOT])})
LIMIT_SETS = st.builds(
    GateLimits, a_max=st.floats(A_MAX.low, 20.0), v_max=st.floats(V_MAX.low, V_MAX.high),
    speed_horizon=st.floats(0.02, 2.0),
    brake_time=st.floats(0.05, 2.0))
ARGUMENTS = st.fixed_dictionaries({
    'command': st.none() | st.builds(
        lambda *fields: Command(*fields), VECTOR, NUMBER, NUMBER, st.none() | VECTOR),
    'command_age': AGE, 'link_age': AGE, 'mode_age': AGE,
    'armed': st.sampled_from([True, True, False]),
    'airborne': st.sampled_from([True, True, False]),
    'withheld': st.sampled_from(['', '', '', 'x']),
    'place': st.builds(Location, st.none() | NUMBER, NUMBER,
                       st.none() | st.tuples(NUMBER, NUMBER).map(np.array)),
    'unplaced': st.sampled_from(['', '', '', 'height stale']),
    'held': st.builds(Held, st.none() | NUMBER, st.none() | NUMBER),
    'offset': VECTOR})


DIRECTION = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def norm_on_wire(setpoint):
    """Return the norm, m/s^2, of the acceleration that the floats of the message hold."""
    message = encode_setpoint(setpoint.acceleration, setpoint.yaw)
    packed = struct.pack('<3f', message.afx, message.afy, message.afz)
    return np.linalg.norm(struct.unpack('<3f', packed))


def usable(motion):
    fresh = -FUTURE_TOLERANCE <= motion.velocity_age <= LIMITS.odom_timeout
    return fresh and len(motion.velocity) == 3 and math.hypot(*motion.velocity) <= FASTEST_OWN


@pytest.mark.slow
@settings(max_examples=150)
@given(LIMIT_SETS, BOTH_MOTIONS, ARGUMENTS)
def test_whatever_comes_in_only_safe_setpoints_come_out(limits, both, arguments):
    setpoint, again, still = (
        judge_situation(limits, known_motion(limits, **both), **arguments | change)
        for change in ({}, {}, {'offset': np.zeros(3)}))
    command = arguments['command']
    # It is a pure function.
    assert again._replace(acceleration=None) == setpoint._replace(acceleration=None)
    np.testing.assert_array_equal(again.acceleration, setpoint.acceleration)

    assert setpoint.acceleration.shape == (3,) and np.all(np.isfinite(setpoint.acceleration))
    assert norm_on_wire(setpoint) <= limits.a_max
    # A disturbance changes neither whether nor why something is sent.
    assert setpoint[:2] == still[:2]
    assert setpoint.yaw is None or math.isfinite(setpoint.yaw)
    assert bool(setpoint.reason) == (setpoint.kind != COMMAND)
    if arguments.get('withheld'):
        assert setpoint.kind == NONE
    if setpoint.kind == COMMAND:
        judged = both[both['source']]
        assert arguments['armed'] and arguments['link_age'] <= limits.link_timeout
        assert arguments['mode_age'] <= MODE_TIMEOUT
        assert arguments['command_age'] <= limits.planner_timeout and usable(judged)
        assert command is not None and all(map(math.isfinite, command.acceleration))
    if not arguments['airborne']:
        assert setpoint.acceleration[2] <= 0.0
    elif setpoint.kind in (COMMAND, BRAKE):
        step = still.acceleration * limits.speed_horizon
        velocities = [np.array(m.velocity) for m in (both[ODOM], both[AUTOPILOT])
                      if usable(m)]
        with np.errstate(over='ignore'):  # velocities of 1e200 m/s are among the tries
            assert any(np.linalg.norm(v + step) <= max(limits.v_max, np.linalg.norm(v))
                       * (1 + 1e-9) for v in velocities)
    else:
        assert not setpoint.acceleration[:2].any() and not still.acceleration.any()
        assert abs(setpoint.acceleration[2]) <= THRUST_OFFSET_MAX


@settings(max_examples=250)
@given(st.floats(1.5, 20.0), st.floats(V_MAX.low, 2.0), DIRECTION, st.floats(0.0, 3.0),
       st.tuples(*[st.floats(-20.0, 20.0)] * 3), st.tuples(*[st.floats(-2.0, 2.0)] * 3),
       st.none() | st.floats(-math.pi, math.pi), st.sampled_from([True, False]))
def test_offset_is_added_except_along_too_fast_velocity(
        a_max, v_max, direction, speed, wanted, offset, axis, commanded):
    limits = GateLimits(a_max=a_max, v_max=v_max)
    v = speed * v_max * np.array(direction) / np.linalg.norm(direction)
    motion = SourceMotion(tuple(v), 0.02)
    unit = None if axis is None else np.array([math.cos(axis), math.sin(axis), 0.0])
    known = known_motion(limits, motion, motion, ODOM)
    still, sent = (judge_situation(
        limits, known, command=Command(wanted, 0.5, 0.0, unit) if commanded else None,
        offset=each).acceleration for each in (np.zeros(3), offset))
    expected = np.clip(offset, (-9.0, -9.0, -THRUST_OFFSET_MAX), (9.0, 9.0, THRUST_OFFSET_MAX))
    if speed > 1.1:
        expected = expected - max(expected @ v, 0.0) / (v @ v) * v
    if np.linalg.norm(still + expected) < a_max * (1.0 - 1e-6):
        np.testing.assert_allclose(sent, still + expected, atol=1e-9)
    else:  # the height goes first
        assert sent[2] == pytest.approx(np.clip((still + expected)[2], -a_max, a_max), rel=1e-6)
        assert a_max * (1.0 - 1e-6) <= np.linalg.norm(sent) <= a_max


SHORT = st.floats(0.0, 3e-7) | st.floats(-1.0, 1.0)  # by this share a vector misses a limit


@settings(max_examples=250)
@given(a_max=st.floats(A_MAX.low, 20.0), lower=st.sampled_from([1.0, 1.0, 0.5]),
       v_max=st.sampled_from([0.5, 5.0]), direction=DIRECTION, short=SHORT,
       velocity=DIRECTION, speed=st.sampled_from([0.0, 0.1, 0.5, 1.0, 1.001, 4.9]),
       commanded=st.sampled_from([True, True, False]), axis=st.none() | DIRECTION,
       airborne=st.sampled_from([True, True, False]),
       wind=st.just((0.0, 0.0, 0.0)) | DIRECTION, offset=st.sampled_from([0.0, 1.0, -1.0]),
       height=st.sampled_from([0.4, 0.6, 5.0, 9.9, 11.0]), climb_rate=st.floats(-1.0, 1.0),
       out=st.sampled_from([0.0, 49.9, 51.0]))
def test_single_precision_of_the_wire_does_not_exceed_a_max(
        a_max, lower, v_max, direction, short, velocity, speed, commanded, axis, airborne, wind,
        offset, height, climb_rate, out):
    full = GateLimits(a_max=a_max, v_max=v_max)
    limits = GateLimits(a_max=max(lower * a_max, A_MAX.low), v_max=v_max)
    wanted = (1.0 - short) * limits.a_max * np.array(direction) / np.linalg.norm(direction)
    motion = SourceMotion(
        tuple(speed * v_max * np.array(velocity) / np.linalg.norm(velocity)), 0.02)
    unit = None if axis is None else np.array(axis) / np.linalg.norm(axis)
    setpoint = judge_situation(
        limits, known_motion(limits, motion, motion, ODOM), full=full,
        command=Command(wanted, 0.5, 0.0, unit) if commanded else None,
        airborne=airborne, held=Held(0.5, 2.0), offset=(*wind[:2], offset),
        place=Location(height, climb_rate, np.array([out, 0.0])))
    assert setpoint.kind == (COMMAND if commanded else BRAKE)
    assert norm_on_wire(setpoint) <= (limits if commanded and axis is None else full).a_max


@pytest.mark.parametrize('axis', [(math.nan, 0.0, 0.0), (1.0, 0.0), 'up', (0.0, math.inf, 0.0),
                                  (0.0, 1e200, 0.0), (0.0, -1e300, 1.0), (0.0, 3.0, 0.0),
                                  (0.0, 0.0, 0.0)])
def test_a_direction_that_is_none_changes_nothing(axis):
    known = SourceMotion((0.5, -0.1, 0.0), 0.02, 0.5, 0.02)
    evade, lowered = Command((0.0, 2.5, 0.0), 0.0), GateLimits(a_max=1.5)
    np.testing.assert_array_equal(
        judge(lowered, command=evade._replace(separation_axis=axis), odom=known,
              full=LIMITS).acceleration,
        judge(lowered, command=evade, odom=known, full=LIMITS).acceleration)
