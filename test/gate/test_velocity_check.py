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

import math

import numpy as np
import pytest

from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.obstacle import Obstacle
from flock_follower.gate.velocity_check import (
    AUTOPILOT,
    difference,
    DISPLACEMENT_WINDOW,
    find_displacement,
    finite_vector,
    fresh,
    known_motion,
    LATCH_TIME,
    MotionReport,
    ODOM,
    Path,
    plausible_velocity,
    Source,
    SourceMotion,
    VelocityComparison,
)
from flock_follower.geometry import Array
from flock_follower.messages import FASTEST_OWN, FUTURE_TOLERANCE, OdometryState, SANE

LIMITS = GateLimits()
SLOW = SourceMotion((0.1, 0.0, 0.0), 0.02, 0.5, 0.02)
ACROSS = SourceMotion((0.0, 0.2, 0.0), 0.02, 0.5, 0.02)
LATE = {'velocity_age': 0.4}


def by(source, limits=LIMITS, **changes):
    return known_motion(limits, source=source, **{
        'odom': SLOW, 'autopilot': ACROSS, **changes})


# One source.

@pytest.mark.parametrize('value', [
    (0.1, math.nan, 0.0), (math.inf, 0.0, 0.0), (0.1, 0.2), (0.1, 0.2, 0.3, 0.4),
    ((0.1, 0.2, 0.3),), 0.1, 'fast', None, (None, 0.0, 0.0)])
def test_what_is_not_three_finite_numbers_is_no_vector(value):
    assert finite_vector(value) is None
    assert SLOW._replace(velocity=value).fresh_velocity(LIMITS) is None


@pytest.mark.parametrize(('speed', 'known'), [
    (FASTEST_OWN, True), (math.nextafter(FASTEST_OWN, math.inf), False)])
def test_a_velocity_is_plausible_up_to_the_fastest(speed: float, known: bool) -> None:
    assert (plausible_velocity((0.0, -speed, 0.0)) is not None) == known


@pytest.mark.parametrize(('age', 'usable'), [
    (0.0, True), (0.3, True), (0.301, False), (-FUTURE_TOLERANCE, True),
    (-FUTURE_TOLERANCE - 0.001, False), (math.inf, False), (-math.inf, False), (math.nan, False)])
def test_what_is_old_or_from_the_future_is_not_fresh(age: float, usable: bool) -> None:
    assert fresh(age, 0.3) == usable


@pytest.mark.parametrize(('variance', 'std'), [(0.01, 0.3), (-0.01, 0.0)])
def test_a_report_of_odometry_has_the_deviation_of_its_place(variance: float, std: float) -> None:
    covariance = np.diag([2.0, 3.0, 4.0, 100.0, 100.0, 100.0]) * variance
    state = OdometryState(0, 'odom', 'base_link', np.array([1.0, 2.0, 3.0]),
                          np.array([0.0, 0.0, math.sin(0.2), math.cos(0.2)]),
                          np.array([4.0, 5.0, 6.0]), np.zeros(3), covariance, 9.0 * covariance,
                          np.eye(3))
    report = MotionReport.from_odometry(state)
    assert report.std == pytest.approx(std) and report.yaw == pytest.approx(0.4)
    assert np.array_equal(report.velocity, (4.0, 5.0, 6.0))
    assert np.array_equal(report.position, (1.0, 2.0, 3.0))  # type: ignore[arg-type]
    assert MotionReport((4.0, 5.0, 6.0)).std == 0.0


# Two sources that may disagree.

def test_velocities_are_compared_if_commands_use_odometry() -> None:
    for source in (ODOM, ''.join(['od', 'om'])):
        np.testing.assert_allclose(by(source).difference, [0.1, -0.2, 0.0])
    assert by(AUTOPILOT).difference is None
    assert by(ODOM, autopilot=ACROSS._replace(**LATE)).difference is None


@pytest.mark.parametrize(('yaw', 'own', 'turned'), [
    (3.1, -3.1, 6.2 - 2 * math.pi), (0.5, 0.4, 0.1), (0.0, 0.4, -0.4), (0.0, -0.4, 0.4)])
def test_yaw_difference_is_wrapped_signed_and_limited(yaw, own, turned):
    known = by(ODOM, odom=SLOW._replace(yaw=yaw), autopilot=ACROSS._replace(yaw=own))
    assert known.turned == pytest.approx(turned)
    assert known.contradiction == (Obstacle.YAWS_DISAGREE if abs(turned) == 0.4 else None)
    # Of just the limit is none.
    assert not by(ODOM, GateLimits(yaw_disagreement=0.4), odom=SLOW._replace(yaw=yaw),
                  autopilot=ACROSS._replace(yaw=own)).contradiction


@pytest.mark.parametrize('unusable', [
    {'yaw_age': 0.301}, {'yaw_age': math.nan}, {'yaw': math.nan}])
def test_only_two_fresh_finite_yaws_can_disagree(unusable):
    turned = SLOW._replace(yaw=2.5)
    for known in (by(ODOM, odom=turned, autopilot=SLOW._replace(**unusable)),
                  by(ODOM, odom=turned._replace(**unusable), autopilot=SLOW)):
        assert known.turned is None and known.contradiction is None


@pytest.mark.parametrize(('known', 'velocity'), [
    (by(ODOM), SLOW), (by(AUTOPILOT), ACROSS), (by(''.join(['od', 'om'])), SLOW),
    (by(ODOM, odom=SLOW._replace(**LATE)), ACROSS),
    (by(AUTOPILOT, autopilot=ACROSS._replace(**LATE)), SLOW),
    # Where yaws disagree the autopilot brakes in its own frame, whoever is the source.
    *((by(source, odom=SLOW._replace(yaw=2.0), disagreeing_for=since), ACROSS)
      for source in (ODOM, AUTOPILOT) for since in (-math.inf, 1.0)),
    (by(AUTOPILOT, odom=SLOW._replace(yaw=2.0), autopilot=ACROSS._replace(**LATE)), SLOW)])
def test_braking_takes_source_velocity_first_then_the_other(known, velocity):
    assert tuple(known.braking.vector) == velocity.velocity


def blind(odom_age, autopilot_age, limits=LIMITS, **changes):
    return by(ODOM, limits, odom=SLOW._replace(velocity_age=odom_age),
              autopilot=SLOW._replace(velocity_age=autopilot_age), **changes).blind


@pytest.mark.parametrize(('ages', 'is_blind'), [
    ((0.31, 0.31), False), ((2.3, 2.3), False), ((2.31, 2.29), False), ((2.29, 2.31), False),
    ((2.31, 2.31), True), ((math.inf, 2.31), True), ((2.31, math.inf), True),
    # None was ever known: on the ground.
    ((math.inf, math.inf), False), ((math.nan, math.nan), False),
    # One that is fresh is enough.
    ((2.31, 0.3), False), ((0.3, 2.31), False),
    ((1.0, 1.0, GateLimits(blind_timeout=0.6)), True),
    ((1.0, 1.0, GateLimits(blind_timeout=0.8)), False)])
def test_it_is_blind_once_the_last_velocity_is_long_gone(ages, is_blind):
    assert blind(*ages) == is_blind


@pytest.mark.parametrize(('seconds', 'contradiction'), [
    (-math.inf, None), (-0.1, None), (0.0, Obstacle.VELOCITIES_DISAGREE),
    (9.0, Obstacle.VELOCITIES_DISAGREE)])
def test_no_velocity_brakes_while_two_disagree(seconds, contradiction):
    known = by(ODOM, disagreeing_for=seconds)
    assert known.contradiction is contradiction and (known.braking is None) == bool(contradiction)


@pytest.mark.parametrize('why', ['disagreeing_for', 'distrusted_for'])
@pytest.mark.parametrize(('seconds', 'is_blind'), [
    (-0.01, False), (0.6, False), (0.601, True), (math.inf, True), (math.nan, False)])
def test_it_is_blind_sooner_with_an_untrusted_velocity(
        why, seconds, is_blind):
    assert blind(0.4, 0.4, **{why: seconds}) == is_blind
    # Good odometry is all that is needed, unless one of both is wrong.
    assert blind(0.0, 0.0, **{why: seconds}) == (is_blind and why == 'disagreeing_for')


# Velocities are compared on average, and what was found is remembered in flight.

def compared(differences, rate=20.0):
    """Return the comparison after differences of a time each, and the time of the last."""
    comparison, now = VelocityComparison(), 0.0
    for value in differences:
        now += 1.0 / rate
        comparison.take(np.array([value, 0.0, 0.0]), 0.25, True, now)
    return comparison, now


NOISE = np.random.default_rng(1).normal(0.0, 0.2, 2000).tolist()
"""m/s: a fifth of it is above the tolerance."""


@pytest.mark.parametrize(('differences', 'disagree'), [
    *(([0.0] * 10 + [wrong], False) for wrong in (3.0, 1e9, 1.7e308)),  # one wrong sample
    ([0.7] * 4, True), ([0.3] * 12, True), ([50.0] * 4, True), (NOISE, False)])
def test_velocities_disagree_by_mean_sooner_if_more(differences, disagree):
    for rate in (20.0, 50.0) if not disagree else (20.0,):
        comparison, now = compared(differences, rate)
        assert (comparison.disagreeing_for(now) >= 0.0) == disagree


def test_the_first_difference_has_no_weight_the_next_have() -> None:
    assert compared([0.7])[0].difference == 0.0
    for rate, step in ((20.0, 0.05), (5.0, 0.1)):  # of a long pause nothing is known
        for value, counted in ((0.7, 0.7), (1e9, 3.0 * 0.25)):  # nor how wrong one sample is
            assert compared([value] * 2, rate)[0].difference == pytest.approx(
                counted * (1.0 - math.exp(-step / 0.3)))


@pytest.mark.parametrize(('samples', 'latched'), [(20, True), (4, False)])
def test_long_mismatch_lasts_until_it_no_longer_flies(samples, latched):
    comparison, now = compared([0.7] * samples)
    assert (comparison.disagreeing_for(now) > LATCH_TIME) == latched
    for _ in range(100):
        now += 0.07
        comparison.take(np.zeros(3), 0.25, True, now)
    comparison.take(None, 0.25, True, now)  # nothing to compare either
    assert (comparison.disagreeing_for(now) > 5.0) == latched
    comparison.take(np.zeros(3), 0.25, False, now)
    assert comparison.disagreeing_for(now) == -math.inf


# Displacements over five seconds: what differs, and what only jumped.

def paths(seconds, one, other, turn=0.0, velocity=None):
    """Return two paths of positions by functions of time; the first one's frame is turned."""
    cos, sin = math.cos(turn), math.sin(turn)
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]).T
    first, second = Path(), Path()
    for now in np.arange(0.0, seconds + 1e-9, 0.05):
        first.take(axes @ np.asarray(one(now), dtype=float), velocity, now)
        second.take(np.asarray(other(now), dtype=float), None, now)
    return first, second


def still(t):
    return 0.0, 0.0, 0.0


@pytest.mark.parametrize('turn', [0.0, 1.0, -2.5])
def test_equal_motions_in_turned_frames_do_not_differ(turn):
    first, second = paths(8.0, lambda t: (0.4 * t, 0.1 * t, 0.2 * t),
                          lambda t: (5.0 + 0.4 * t, 0.1 * t - 3.0, 0.2 * t), turn)
    assert np.linalg.norm(difference(first, second, turn, 8.0)) < 1e-9


@pytest.mark.parametrize('axis', [0, 1, 2])
@pytest.mark.parametrize(('seconds', 'shown'), [(12.05, 0.99), (2.0, 0.39)])
def test_a_velocity_error_adds_up_over_the_window(axis, seconds, shown):
    drift = np.eye(3)[axis]
    first, second = paths(seconds, lambda t: 0.2 * t * drift, still)
    np.testing.assert_allclose(difference(first, second, 0.0, seconds), shown * drift, atol=1e-9)


@pytest.mark.parametrize('speed', [0.0, 0.4])
def test_a_jump_that_the_velocity_does_not_match_is_taken_out(speed):
    first, second = paths(8.0, lambda t: (speed * t + 1.5 * (t > 6.0), 0.0, 0.0),
                          lambda t: (speed * t, 0.0, 0.0), velocity=np.array([speed, 0.0, 0.0]))
    assert np.linalg.norm(difference(first, second, 0.0, 8.0)) < 1e-9


@pytest.mark.parametrize('before', [None, (0.0, 1.0, 0.0)])
@pytest.mark.parametrize('elapsed', [0.05, 0.5])
@pytest.mark.parametrize(('surprise', 'jumped'), [(0.29, False), (0.31, True)])
def test_without_a_gap_a_jump_is_more_than_position_jump(before, elapsed, surprise, jumped):
    path = Path()
    path.take(np.ones(3), None if before is None else np.array(before), 1.0)
    path.take(np.array([1.0, 1.0, 1.0 + surprise]), np.zeros(3), 1.0 + elapsed)
    assert path.position == pytest.approx(np.array([1.0, 1.0, 1.0 if jumped else 1.0 + surprise]))


def test_a_displacement_within_the_window_follows_a_curve() -> None:
    def curve(t: float) -> Array:
        return np.array([0.1 * t * t, math.sin(t), -0.2 * t])

    path = paths(20.0, curve, still)[0]
    start, end = path.span
    assert start <= 20.0 - DISPLACEMENT_WINDOW <= start + 0.2 and 19.9 <= end <= 20.0
    for first, last in ((15.0, 20.0), (16.03, 18.32), (17.5, 17.6), (start, end)):
        last = min(last, end)
        np.testing.assert_allclose(
            path.displacement(first, last), curve(last) - curve(first), atol=0.005)
    np.testing.assert_allclose(  # at the beginning, too
        paths(1.0, curve, still)[0].displacement(0.05, 1.0), curve(1.0) - curve(0.05), atol=0.005)


def test_a_path_keeps_the_window_in_tenths_of_a_second() -> None:
    path = Path()
    for now, newest in ((0.0, 0.0), (0.04, 0.0), (0.09, 0.0), (0.1, 0.1), (0.19, 0.1)):
        path.take(np.array([now, 0.0, 0.0]), None, now)
        assert path.span == (0.0, newest)
    for now in (0.15, 0.19):  # not newer
        path.take(np.array([9.0, 0.0, 0.0]), None, now)
    assert path.time == 0.19 and path.position is not None and path.position[0] == 0.19
    for step in range(2, 81):
        path.take(np.zeros(3), None, 0.1 * step)
    start, end = path.span
    assert end - DISPLACEMENT_WINDOW - 0.15 < start <= end - DISPLACEMENT_WINDOW


@pytest.mark.parametrize(('change', 'largest'), [(0.0, 6.3), (-1.5, 9.3)])
@pytest.mark.parametrize('off', [-0.01, 0.01])
def test_motion_that_explains_a_step_in_a_gap_is_no_jump(
        change: float, largest: float, off: float) -> None:
    path, velocity = Path(), np.array([1.0, 0.0, 0.0])
    after = velocity + np.array([0.0, change, 0.0])
    path.take(np.zeros(3), velocity, 10.0)
    path.take(2.0 * after + [0.0, 0.0, largest + off], after, 12.0)  # 0.3 + 2 (|change| + 3)
    assert path.position is not None
    assert path.position[2] == pytest.approx(0.0 if off > 0.0 else largest + off)


def test_a_position_beyond_a_sane_one_changes_nothing() -> None:
    source = Source()
    for position, std, expected, kept in (
            ((1.0, 2.0, 3.0), 0.5, (1.0, 2.0, 3.0), 0.5),
            ((-SANE, 2.0, 3.0), 0.7, (1.0, 2.0, 3.0), 0.5),
            ((math.nan, 2.0, 3.0), 0.7, (1.0, 2.0, 3.0), 0.5),
            ((1.0, 2.0, 3.1), math.nan, (1.0, 2.0, 3.1), 0.0)):
        source.take_position(position, 1.0, std, 0.3)
        assert source.position is not None
        assert tuple(source.position) == expected and source.std == kept


@pytest.mark.parametrize(('age', 'jumped'), [(0.2, True), (0.4, False)])
def test_only_a_fresh_velocity_finds_a_jump(age: float, jumped: bool) -> None:
    source, now = Source(), 0.5
    source.take_velocity(np.zeros(3), now - age)
    source.take_position((0.0, 0.0, 0.0), now - 0.1, 0.0, 0.3)
    source.take_position((2.0, 0.0, 0.0), now, 0.0, 0.3)
    assert source.path.position is not None
    assert source.path.position[0] == (0.0 if jumped else 2.0)


def test_ages_of_velocity_and_yaw_count_from_their_own_times() -> None:
    source = Source()
    source.take_velocity(np.ones(3), 3.0)
    source.take_yaw(0.5, 2.0)
    motion = source.motion(9.0)
    assert (motion.velocity_age, motion.yaw_age, motion.yaw) == (6.0, 7.0, 0.5)


def test_what_is_old_or_interrupted_is_not_compared():
    first, second = paths(8.0, lambda t: (t, 0.0, 0.0), still)
    assert np.array_equal(difference(first, second, 0.0, 8.6), np.zeros(3))
    assert np.array_equal(difference(first, Path(), 0.0, 8.0), np.zeros(3))
    soon, other = paths(0.2, lambda t: (t, 0.0, 0.0), still)
    assert not difference(soon, other, 0.0, 0.9).any()
    for path in (first, second):
        path.take(np.array([99.0, 0.0, 0.0]), None, 9.0)  # after a gap it begins again
    assert not difference(first, second, 0.0, 9.0).any()


@pytest.mark.parametrize(('axis', 'drift', 'std', 'height', 'contradicts'), [
    (0, 0.6, 0.0, False, True), (1, -0.6, 0.0, False, True), (1, 0.4, 0.0, False, False),
    (1, 0.6, 0.25, False, False), (1, 1.4, 0.5, False, False),
    # The drift since the start says nothing of the last seconds.
    (1, 1.6, 100.0, False, True), (2, 0.6, 0.0, False, False),
    (2, 1.0, 0.0, True, True), (2, -1.0, 0.0, True, True), (2, 0.8, 0.0, True, False),
    (2, 1.0, 0.4, True, False), (1, 2.0, 0.0, True, False)])
def test_displacement_mismatch_beyond_deviation_is_reported(
        axis, drift, std, height, contradicts):
    odom, autopilot = Source(), Source()
    odom.path, autopilot.path = paths(4.0, lambda t: drift * t / 4.0 * np.eye(3)[axis], still)
    odom.std = std
    why = find_displacement(odom, None if height else autopilot, 0.0,
                            autopilot.path if height else Path(), 4.0)
    assert bool(why) == contradicts
    assert not why or ('barometer' in why.detail) == height


@pytest.mark.parametrize('turn', [-0.4, 0.4])
@pytest.mark.parametrize(('speed', 'contradicts'), [(0.5, False), (0.7, True)])
def test_displacements_are_compared_in_one_frame(turn, speed, contradicts):
    odom, autopilot = Source(), Source()
    odom.path, autopilot.path = paths(
        4.0, lambda t: (speed * t, 0.0, 0.0), lambda t: (0.5 * t, 0.0, 0.0), turn)
    # Anticlockwise axes of odometry make its yaw smaller.
    assert bool(find_displacement(odom, autopilot, -turn, Path(), 4.0)) == contradicts


def test_yaw_nearest_to_time_is_returned_old_ones_forgotten():
    source = Source()
    assert source.yaw(1.0) == source.yaw() == (0.0, -math.inf)
    for step in range(31):
        source.take_yaw(0.1 * step - 2.5, 0.1 * step)
    for refused, time in ((1.0, 2.95), (math.nan, 3.1)):  # out of order, not finite
        source.take_yaw(refused, time)
    assert source.yaw() == pytest.approx((0.5, 3.0))
    for time, nearest in ((2.52, 2.5), (2.58, 2.6), (2.48, 2.5), (2.04, 2.0), (0.0, 2.0)):
        assert source.yaw(time) == pytest.approx((nearest - 2.5, nearest))
    kept = len(source.yaws)
    source.take_yaw(0.5 + math.pi, 3.0)  # of the same time: the later report, wrapped
    assert source.yaw() == pytest.approx((0.5 - math.pi, 3.0)) and len(source.yaws) == kept
