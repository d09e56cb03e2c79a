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

"""What is known of the vehicle's motion: which velocity is believed, and what contradicts it."""

from dataclasses import FrozenInstanceError, replace
import math

import numpy as np
import pytest

from flock_follower.mavlink.envelope import GateLimits
from flock_follower.mavlink.velocity_check import (
    AUTOPILOT,
    finite_vector,
    fresh,
    KnownMotion,
    Motion,
    ODOM,
    UNKNOWN,
)

LIMITS = GateLimits()
SLOW = Motion((0.1, 0.0, 0.0), 0.02, 0.5, 0.02)
ACROSS = Motion((0.0, 0.2, 0.0), 0.02, 0.5, 0.02)
BOTH = KnownMotion(odom=SLOW, autopilot=ACROSS, source=ODOM)


def by(source, **changes):
    return replace(BOTH, source=source, **changes)


def braking(known):
    """Return the velocity that is braked with as a tuple, or None."""
    velocity = known.braking_velocity(LIMITS)
    return None if velocity is None else tuple(velocity.vector)


# One source.

@pytest.mark.parametrize(('age', 'is_fresh'), [
    (0.3, True), (0.301, False), (0.0, True), (-0.1, True), (-0.101, False), (math.nan, False),
    (math.inf, False), (-math.inf, False)])
def test_an_age_is_fresh_within_its_timeout_and_a_step_of_clocks(age, is_fresh):
    assert fresh(age, 0.3) == is_fresh


@pytest.mark.parametrize('value', [
    (0.1, math.nan, 0.0), (math.inf, 0.0, 0.0), (0.1, 0.2), (0.1, 0.2, 0.3, 0.4),
    ((0.1, 0.2, 0.3),), 0.1, 'fast', None, (None, 0.0, 0.0)])
def test_what_is_not_three_finite_numbers_is_no_vector(value):
    assert finite_vector(value) is None
    assert SLOW._replace(velocity=value).fresh_velocity(LIMITS) is None


def test_a_vector_is_a_copy():
    mine = np.array([1.0, 2.0, 3.0])
    vector = finite_vector(mine)
    mine[0] = 9.0
    np.testing.assert_array_equal(vector, (1.0, 2.0, 3.0))


@pytest.mark.parametrize(('age', 'margin'), [
    (-0.1, 0.0), (0.05, 0.0), (0.1, 0.05 * math.e), (0.3, 0.25 * math.e)])
def test_the_age_of_a_velocity_prolongs_time_constants_once_it_is_unusual(age, margin):
    velocity = SLOW._replace(velocity_age=age).fresh_velocity(LIMITS)
    np.testing.assert_array_equal(velocity.vector, SLOW.velocity)
    assert velocity.margin == pytest.approx(margin)


def test_a_stale_velocity_is_none_and_odom_timeout_says_which_is():
    late = SLOW._replace(velocity_age=0.301, yaw_age=0.301)
    assert late.fresh_velocity(LIMITS) is None and late.fresh_yaw(LIMITS) is None
    patient = GateLimits(odom_timeout=0.4)
    assert late.fresh_velocity(patient) is not None and late.fresh_yaw(patient) == 0.5


def test_what_is_not_said_is_unknown():
    assert Motion((0.0, 0.0, 0.0), math.inf, 0.0, math.inf) == UNKNOWN
    assert UNKNOWN.fresh_velocity(LIMITS) is None and UNKNOWN.fresh_yaw(LIMITS) is None
    known = KnownMotion(odom=UNKNOWN, autopilot=SLOW, source=ODOM)
    # Nothing disagrees and nothing is distrusted until somebody says so.
    assert (known.disagreeing_for, known.distrusted_for) == (-math.inf, -math.inf)


def test_what_is_known_is_a_value_and_its_parts_are_named():
    with pytest.raises(FrozenInstanceError):
        BOTH.source = AUTOPILOT
    with pytest.raises(TypeError):
        KnownMotion(SLOW, ACROSS, ODOM)  # one motion is easily mistaken for the other


# Two sources that may disagree.

def test_the_source_comes_first():
    assert BOTH.source_first == (SLOW, ACROSS)
    assert by(AUTOPILOT).source_first == (ACROSS, SLOW)


def test_a_source_is_told_by_its_letters():
    # As a parameter gives it: another string object than the constant.
    odom = ''.join(['od', 'om'])
    known = KnownMotion(odom=SLOW, autopilot=SLOW, source=odom)
    assert known.velocity_difference(LIMITS) is not None
    other = Motion((0.2, 0.0, 0.0), 0.0)
    assert replace(known, autopilot=other).braking_velocity(LIMITS).vector[0] == 0.1


def test_the_difference_of_yaws_is_wrapped_and_signed():
    east, west = SLOW._replace(yaw=3.1), SLOW._replace(yaw=-3.1)
    turned = by(ODOM, odom=east, autopilot=west)
    assert turned.yaw_difference(LIMITS) == pytest.approx(6.2 - 2 * math.pi)
    turned = by(AUTOPILOT, autopilot=SLOW._replace(yaw=0.4))
    assert turned.yaw_difference(LIMITS) == pytest.approx(0.1)


@pytest.mark.parametrize('unusable', [
    {'yaw_age': 0.301}, {'yaw_age': math.nan}, {'yaw_age': -0.2}, {'yaw': math.nan}])
def test_only_two_fresh_and_finite_yaws_can_contradict_one_another(unusable):
    turned = SLOW._replace(yaw=2.5)
    for known in (by(ODOM, odom=turned, autopilot=SLOW._replace(**unusable)),
                  by(ODOM, odom=turned._replace(**unusable), autopilot=SLOW)):
        assert known.yaw_difference(LIMITS) is None
        assert not known.yaws_disagree(LIMITS) and known.contradiction(LIMITS) == ''


@pytest.mark.parametrize('turn', [0.4, -0.4])
def test_yaws_disagree_by_more_than_the_limit_either_way(turn):
    known = by(ODOM, odom=SLOW._replace(yaw=0.0), autopilot=SLOW._replace(yaw=turn))
    assert known.yaws_disagree(LIMITS)
    assert known.contradiction(LIMITS) == 'yaws of odom and of the autopilot disagree'
    # Of just the limit is none.
    assert not known.yaws_disagree(GateLimits(yaw_disagreement=0.4))


@pytest.mark.parametrize(('disagreeing_for', 'what'), [
    (-math.inf, ''), (-0.01, ''), (math.nan, ''),
    (0.0, 'velocities of odom and of the autopilot disagree'),
    (9.0, 'velocities of odom and of the autopilot disagree')])
def test_velocities_disagree_from_the_moment_that_is_told(disagreeing_for, what):
    known = by(ODOM, disagreeing_for=disagreeing_for)
    assert known.contradiction(LIMITS) == what
    assert (braking(known) is None) == bool(what)
    # Yaws are told first: they explain it.
    turned = replace(known, odom=SLOW._replace(yaw=2.0))
    assert turned.contradiction(LIMITS).startswith('yaws')


def test_the_difference_of_velocities_is_that_of_two_fresh_ones():
    own = SLOW._replace(velocity=(0.0, 0.3, 0.0))
    np.testing.assert_allclose(
        by(ODOM, autopilot=own).velocity_difference(LIMITS), (0.1, -0.3, 0.0))
    # Odometry does not judge the autopilot where that is the source.
    assert by(AUTOPILOT, autopilot=own).velocity_difference(LIMITS) is None
    stale = own._replace(velocity_age=0.4)
    assert by(ODOM, autopilot=stale).velocity_difference(LIMITS) is None
    assert by(ODOM, odom=stale, autopilot=SLOW).velocity_difference(LIMITS) is None


@pytest.mark.filterwarnings('error')
def test_a_difference_beyond_every_number_is_no_warning():
    known = by(ODOM, odom=SLOW._replace(velocity=(1.7e308, 0.0, 0.0)),
               autopilot=SLOW._replace(velocity=(-1.7e308, 0.0, 0.0)))
    assert known.velocity_difference(LIMITS)[0] == math.inf


# What to brake with, and for how long there may be nothing to brake with.

def test_braking_takes_the_velocity_of_the_source_first_then_the_other():
    late = {'velocity_age': 0.4}
    assert braking(BOTH) == SLOW.velocity
    assert braking(by(AUTOPILOT)) == ACROSS.velocity
    assert braking(by(ODOM, odom=SLOW._replace(**late))) == ACROSS.velocity
    assert braking(by(AUTOPILOT, autopilot=ACROSS._replace(**late))) == SLOW.velocity
    assert braking(by(ODOM, odom=UNKNOWN, autopilot=UNKNOWN)) is None


@pytest.mark.parametrize('source', [ODOM, AUTOPILOT])
@pytest.mark.parametrize('disagreeing_for', [-math.inf, 1.0])
def test_where_yaws_disagree_the_autopilot_brakes_in_its_own_frame(source, disagreeing_for):
    turned = by(source, odom=SLOW._replace(yaw=2.0), disagreeing_for=disagreeing_for)
    assert braking(turned) == ACROSS.velocity
    stale = replace(turned, autopilot=ACROSS._replace(velocity_age=0.4))
    assert braking(stale) == SLOW.velocity


def blind(odom_age, autopilot_age, limits=LIMITS, **changes):
    return by(ODOM, odom=SLOW._replace(velocity_age=odom_age),
              autopilot=SLOW._replace(velocity_age=autopilot_age), **changes).blind(limits)


def test_it_is_blind_once_the_last_velocity_is_long_gone():
    assert not blind(0.31, 0.31) and not blind(2.3, 2.3)
    assert not blind(2.31, 2.29) and not blind(2.29, 2.31)
    assert blind(2.31, 2.31) and blind(math.inf, 2.31) and blind(2.31, math.inf)
    # None was ever known: on the ground.
    assert not blind(math.inf, math.inf) and not blind(math.nan, math.nan)
    # One that is fresh is enough.
    assert not blind(2.31, 0.3) and not blind(0.3, 2.31)
    assert blind(1.0, 1.0, GateLimits(blind_timeout=0.6))
    assert not blind(1.0, 1.0, GateLimits(blind_timeout=0.8))


@pytest.mark.parametrize('why', ['disagreeing_for', 'distrusted_for'])
@pytest.mark.parametrize(('seconds', 'is_blind'), [
    (-0.01, False), (0.6, False), (0.601, True), (math.inf, True), (math.nan, False)])
def test_it_is_blind_sooner_where_a_velocity_is_told_that_cannot_be_believed(
        why, seconds, is_blind):
    assert blind(0.4, 0.4, **{why: seconds}) == is_blind


def test_distrust_of_the_autopilot_blinds_nobody_who_has_good_odometry():
    assert not blind(0.0, 0.4, distrusted_for=9.0)
    assert blind(0.0, 0.0, disagreeing_for=0.601)  # though both are fresh
