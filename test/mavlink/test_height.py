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

"""The height by a barometer: it follows the sensor, bridges its noise, and notices its jumps."""

import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from flock_follower.gate.height import (
    HEIGHT_TIMEOUT,
    HeightEstimator,
    MAX_CORRECTION,
    pressure_altitude,
    RateSteps,
    STEP_PAUSE,
)
from flock_follower.gate.obstacle import Obstacle
from flock_follower.messages import FASTEST_OWN, SANE

PERIOD = 0.05
NOISE = 0.09  # m: SCALED_PRESSURE of PX4 1.16, SIH


def flown(seconds, altitude=lambda t: 100.0, rate=lambda t: 0.0):
    """Return an estimator after a flight, and its heights above the start, each 0.05 s."""
    rng, heights, found = np.random.default_rng(1), HeightEstimator(), []
    for k in range(round(seconds / PERIOD)):
        now = k * PERIOD
        sensor = ''.join(('SCALED_', 'PRESSURE'))  # an equal name each time
        assert heights.take(altitude(now) + NOISE * rng.normal(), rate(now), now, sensor) == ''
        if k == 40:
            heights.refer(0.0, now)
        found.append(heights.height(now))
    return heights, found


def test_pressures_are_altitudes_of_the_standard_atmosphere():
    assert pressure_altitude(1013.25) == 0.0
    assert pressure_altitude(954.61) == pytest.approx(500.0, abs=0.5)  # ISO 2533
    assert pressure_altitude(1074.78) == pytest.approx(-500.0, abs=0.5)
    assert all(math.isnan(pressure_altitude(p)) for p in (0.0, -1.0, 2000.0, math.nan, math.inf))
    assert all(math.isfinite(pressure_altitude(p)) for p in (0.5, 1999.5))


def test_the_noise_of_a_real_barometer_is_bridged_and_no_jump():
    heights, found = flown(3600.0)
    assert np.std(found[100:]) < 0.03 and heights.stepped == -math.inf


@pytest.mark.parametrize(('elapsed', 'difference', 'altitude', 'rate'), [
    (0.05, 0.1, 0.01, 0.005), (0.1, -0.2, -0.04, -0.02), (0.6, 0.3, 0.3, 0.18),
    (HEIGHT_TIMEOUT, 0.2, 0.2, 0.2),
    (HEIGHT_TIMEOUT + 0.01, 0.2, 0.2, 0.0)])  # it begins again
def test_sensor_alone_is_followed_by_its_bandwidth(elapsed, difference, altitude, rate):
    heights = HeightEstimator()
    heights.take(100.0, None, 0.0, 'SCALED_PRESSURE')
    heights.take(100.0 + difference, None, elapsed, 'SCALED_PRESSURE')
    assert heights.altitude(elapsed) == pytest.approx(100.0 + altitude)
    assert heights.climb_rate == pytest.approx(rate)
    assert heights.altitude(elapsed + 0.5) == pytest.approx(100.0 + altitude + 0.5 * rate)
    assert heights.altitude(elapsed - 0.1) == heights.altitude(elapsed)


@pytest.mark.parametrize('leap', [30.0, -30.0])
def test_a_leap_of_the_sensor_hardly_changes_the_climb_rate(leap):
    heights = HeightEstimator()
    heights.take(100.0, None, 0.0)
    heights.take(100.0 + leap, None, PERIOD)
    assert heights.climb_rate == pytest.approx(math.copysign(0.025, leap))


def test_two_altitudes_far_apart_are_a_leap_of_the_sensor():
    heights, found = HeightEstimator(), []
    for k, altitude in enumerate((90.0, 90.5, 90.0, 90.51, 90.51)):
        heights.take(altitude, 0.0, 0.1 * k)
        found.append(heights.leapt)
    assert found == pytest.approx([-math.inf, -math.inf, -math.inf, 0.3, 0.3])


@pytest.mark.parametrize('rate', [0.7, -0.2])  # by the other source, when it comes
@pytest.mark.parametrize(('seconds', 'before', 'settled'), [
    (8.0, 1.0, True), (3.1, 0.82, True), (2.9, 0.78, False), (2.0, 0.59, False)])
def test_first_rate_of_another_source_is_compared_if_settled(seconds, before, settled, rate):
    heights = HeightEstimator()
    for k in range(round(seconds / PERIOD)):
        heights.take(0.05 * k, None, 10.0 + k * PERIOD)  # climbs at 1 m/s
    assert before - 0.1 < heights.climb_rate < before + 0.1
    heights.take(seconds, rate, 10.0 + seconds)
    assert heights.climb_rate == pytest.approx(before if settled else rate, abs=0.03)


def climb(t):
    return min(max(0.5 * (t - 4.0), 0.0), 5.0)


@pytest.mark.parametrize('rate', [
    lambda t: 0.5 * (4.0 < t < 14.0), lambda t: 0.0, lambda t: 0.3, lambda t: None])
def test_a_climb_is_followed_whatever_the_odometry_says_of_it(rate):
    heights, found = flown(30.0, climb, rate)
    assert found[-1] == pytest.approx(5.0, abs=0.15) and heights.stepped == -math.inf
    assert heights.climb_rate == pytest.approx(0.0, abs=0.08)
    if rate(10.0) == 0.5:  # not late, where the rate is right
        assert found[200] == pytest.approx(climb(10.0), abs=0.1)


def test_a_climb_that_the_other_source_denies_is_no_jump():
    heights = HeightEstimator()
    for k in range(200):
        heights.take(1.2 * max(k * PERIOD - 4.0, 0.0), 0.0, k * PERIOD)
        assert heights.stepped == -math.inf


@pytest.mark.parametrize(('lacks', 'seconds'), [(0.0, 20.0), (0.3, 20.0), (-0.3, 20.0),
                                                (0.8, 6.0), (-0.8, 6.0)])
def test_other_source_is_corrected_in_seconds_hardly_disturbed(lacks, seconds):
    heights, _ = flown(seconds, altitude=lambda t: 100.0 + lacks * t)
    assert heights.correct(2.0) == pytest.approx(2.0 + lacks, abs=0.05)


def test_what_is_corrected_beyond_its_bound_grows_in_ten_seconds():
    """The sensor climbs ever faster, to 3 m/s, where the other source knows of nothing."""
    heights = HeightEstimator()
    for k in range(401):
        now = k * PERIOD
        heights.take(0.15 * min(now, 10.0) ** 2 + 3.0 * max(now - 10.0, 0.0), 0.0, now)
        if k in (200, 300, 400):
            assert heights.correct(0.0) == pytest.approx(
                {200: 2.73, 300: 2.99, 400: 3.0}[k], abs=0.03)
    assert heights.stepped == -math.inf


@pytest.mark.parametrize(('rate', 'known'), [
    (FASTEST_OWN, True), (-FASTEST_OWN, True), (1.01 * FASTEST_OWN, False), (math.nan, False),
    (-math.inf, False)])
def test_an_absurd_rate_of_another_source_counts_as_none(rate, known):
    heights = HeightEstimator()
    assert heights.take(100.0, rate, 5.0) == ''
    assert heights.climb_rate == (rate if known else 0.0)


@pytest.mark.parametrize(('altitude', 'now', 'refused'), [
    (100.0, 5.1, ''), (SANE, 5.1, ''), (-SANE, 5.1, ''), (1.01 * SANE, 5.1, 'not plausible'),
    (math.nan, 5.1, 'not plausible'), (math.inf, 5.1, 'not plausible'),
    (100.0, 5.0, 'not newer'), (100.0, 4.9, 'not newer'), (100.0, math.nan, 'not newer')])
def test_altitude_that_is_absurd_or_not_newer_changes_nothing(altitude, now, refused):
    heights = HeightEstimator()
    heights.take(90.0, 1.0, 5.0)
    assert heights.take(altitude, -1.0, now) == refused
    assert (heights.climb_rate == 1.0) == bool(refused)


@pytest.mark.parametrize('back', [11.5, 14.5])  # s: in the descent, after the touchdown
@pytest.mark.parametrize('lacks', [0.0, 0.3])
def test_odometry_that_returns_has_its_error_of_before(back, lacks):
    """PX4 1.18: after a landing without odometry its estimate sank by 1 m on the ground."""
    def sinks(t):
        return -0.6 * (10.0 < t < 14.0)

    def falls(t):
        return -0.6 * min(max(t - 10.0, 0.0), 4.0)
    heights, _ = flown(back + 0.1, falls, lambda t: (
        None if 10.3 < t < back else sinks(t) - lacks))
    assert heights.correct(sinks(back) - lacks) == pytest.approx(
        sinks(back), abs=0.1)


@pytest.mark.parametrize('jump', [0.5, -0.5, 2.0, 30.0])
def test_jump_without_matching_velocity_shifts_reference_counted(jump):
    heights, found = flown(20.0, lambda t: jump * (t > 10.0))
    assert 10.0 < heights.stepped < 10.3 and abs(found[-1]) < 0.2
    assert max(abs(h) for h in found[60:]) < 0.35 * max(1.0, abs(jump) / 2.0)


@pytest.mark.parametrize(('period', 'jump', 'jumped'), [
    (0.0625, 0.3, False), (0.0625, 0.32, True), (0.0625, -0.3, False), (0.0625, -0.32, True),
    (0.09375, 0.3, False), (0.09375, 0.32, True), (0.125, 2.0, False)])  # periods without rounding
def test_jump_counts_from_a_size_on_in_three_samples(period, jump, jumped):
    for first in (8, 40):
        heights = HeightEstimator()
        for k in range(120):
            now = k * period
            heights.take(100.0 + jump * (k >= first), 0.0, now, acceleration=0.0)
            if k == 7:
                heights.refer(2.0, now)
            pausing = 0.0 <= now - heights.stepped < STEP_PAUSE
            assert (heights.obstacle(now) is Obstacle.HEIGHT_JUMPED) == pausing
        assert (first * period <= heights.stepped < first * period + 0.25) == jumped
        if jumped:  # its speed is not that of the jump
            assert heights.climb_rate == 0.0 and abs(heights.height(now) - 2.0) < 0.4 * abs(jump)
        else:
            assert heights.stepped == -math.inf


def test_for_a_while_after_a_jump_the_height_is_lost():
    heights, _ = flown(10.3, lambda t: 1.0 * (t > 10.0))
    assert heights.obstacle(10.25) is Obstacle.HEIGHT_JUMPED
    assert heights.obstacle(10.25 + STEP_PAUSE + 0.1) is Obstacle.HEIGHT_STALE
    assert flown(12.0, lambda t: 1.0 * (t > 10.0))[0].obstacle(12.0) is None


def test_a_height_that_is_old_or_has_no_reference_is_unknown():
    heights = HeightEstimator()
    assert heights.height(0.0) is None and heights.obstacle(0.0) is None
    assert heights.climb_rate == 0.0 and heights.correct(1.0) == 1.0
    heights.take(50.0, None, 1.0)
    assert heights.height(1.0) is None and heights.altitude(1.0) == 50.0
    assert heights.altitude(1.0 + HEIGHT_TIMEOUT) == 50.0
    heights.refer(1.5, 1.0)
    assert heights.height(1.0) == 1.5
    late = 1.01 + HEIGHT_TIMEOUT
    assert heights.height(late) is None and heights.obstacle(late)
    heights.take(52.0, None, 9.0)  # it comes back
    assert heights.height(9.0) == 3.5
    heights.refer(None, 9.0)
    assert not heights.has_reference


@pytest.mark.parametrize('referenced', [False, True])
@pytest.mark.parametrize('first', [1, 4, 12])
@pytest.mark.parametrize('sensors', ['DISTANCE_SENSOR SCALED_PRESSURE',
                                     'SCALED_PRESSURE DISTANCE_SENSOR'])
def test_other_sensor_takes_over_without_jump_of_height(first, referenced, sensors):
    # A bridge restarted in flight: the rangefinder's messages come before the barometer's.
    heights = HeightEstimator()
    for k in range(200):
        now, other = k * PERIOD, k >= first
        rate = -0.7 if k > 2 else None  # the first odometry comes later than the first height
        heights.take((490.0 if other else 0.0) + 2.0 - 0.7 * now, rate, now,
                     sensors.split()[other])
        if k == 0 and referenced:
            heights.refer(2.0, now)
        assert heights.correct(-0.7) == pytest.approx(-0.7, abs=0.1)
        if referenced:
            assert heights.height(now) == pytest.approx(2.0 - 0.7 * now, abs=0.15)
    assert math.isinf(heights.stepped)


def test_sensor_that_replaces_a_long_silent_one_has_no_reference():
    heights = HeightEstimator()
    heights.take(2.0, None, 0.0, 'DISTANCE_SENSOR')
    heights.refer(2.0, 0.0)
    heights.take(492.0, None, 0.1 + HEIGHT_TIMEOUT, 'SCALED_PRESSURE')
    assert not heights.has_reference and heights.height(0.1 + HEIGHT_TIMEOUT) is None
    # The vehicle must not fly on without its bounds.
    assert heights.is_missing(0.1 + HEIGHT_TIMEOUT) and heights.obstacle(0.1 + HEIGHT_TIMEOUT) is (
        Obstacle.HEIGHT_STALE)


def test_barometer_jump_corrects_climb_by_its_bound_at_most():
    heights = HeightEstimator()
    for k in range(100):
        now = k * PERIOD
        heights.take(2.0 + (30.0 if k >= 40 else 0.0) + 5.0 * max(now - 2.0, 0.0), 0.0, now)
        assert abs(heights.correct(0.0)) <= MAX_CORRECTION


@pytest.mark.parametrize('seconds', [0.0, 0.4])
@pytest.mark.parametrize('step', [1.0, -1.0, 3.0])
def test_step_that_no_setpoint_explains_is_error_of_its_source(step, seconds):
    rng, heights = np.random.default_rng(2), HeightEstimator()
    for k in range(320):  # the vehicle hovers
        now = k * PERIOD
        part = min(max(now - 10.0, 0.0) / seconds, 1.0) if seconds else float(now > 10.0)
        heights.take(100.0 + NOISE * rng.normal(), step * part, now, acceleration=0.0)
        if k == 40:
            heights.refer(0.0, now)
        if now > 10.3 + 2.0 * seconds:  # beyond MAX_CORRECTION, too
            assert heights.correct(step) == pytest.approx(0.0, abs=0.35)
        assert heights.height(now) is None or abs(heights.height(now)) < 0.2
    assert heights.stepped == -math.inf


@pytest.mark.parametrize('side', [1.0, -1.0])
def test_suspected_source_is_followed_by_the_fast_observer(side):
    """It drifts by 0.45 m/s^2, which is no step: the slow observer alone lags by 0.73 m/s."""
    heights = HeightEstimator()
    for k in range(251):
        now = k * PERIOD
        drift = side * 0.45 * max(now - 10.0, 0.0)
        heights.take(100.0, drift, now, acceleration=0.0)
    assert abs(heights.correct(drift)) < 0.3


@pytest.mark.parametrize(('jump', 'counts'), [(12.5, False), (13.5, True)])
def test_while_a_source_is_suspected_no_small_jump_counts(jump, counts):
    heights = HeightEstimator()
    for k in range(round((jump + 0.3) / PERIOD)):
        now = k * PERIOD
        heights.take(100.0 + 0.4 * (now > jump), 0.4 * (now > 10.0), now, acceleration=0.0)
    assert (heights.stepped > jump) == counts


@pytest.mark.parametrize('acceleration', [2.0, -2.0])
def test_steady_source_is_not_blamed_if_setpoints_are_not_flown(acceleration):
    heights = HeightEstimator()
    for k in range(100):
        heights.take(100.0, 0.0, k * PERIOD, acceleration=acceleration)
        assert heights.correct(0.0) == 0.0


def test_climb_that_setpoints_explain_is_no_error_of_its_source():
    heights, rate = HeightEstimator(), 0.0
    for k in range(100):
        acceleration = 2.5 if 40 <= k < 50 else 0.0
        rate += PERIOD * acceleration
        heights.take(100.0 + max(k - 45, 0) * PERIOD * rate, rate, k * PERIOD,
                     acceleration=acceleration)
    assert heights.correct(rate) == pytest.approx(rate, abs=0.05)


def sunk(t):
    """Return the height lost by the divergence of ``diverging``, m."""
    late = max(t - 1.4, 0.0)
    return 0.5 * min(max(t, 0.0), 1.4) ** 2 + 1.4 * late


def diverging(t):
    return min(max(t, 0.0), 1.4)


@pytest.mark.parametrize('seed', range(8))
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_error_of_a_rate_that_stays_constant_is_found_soon(sign, seed):
    """An autopilot that fuses a diverging rate moves so that the rate stays as it was."""
    rng, heights = np.random.default_rng(seed), HeightEstimator()
    for k in range(260):
        now = k * PERIOD
        heights.take(100.0 - sign * sunk(now - 10.0) + NOISE * rng.normal(), 0.0, now,
                     acceleration=0.0)
        if k == 40:
            heights.refer(0.0, now)
        if now > 11.4:  # with the slow observer alone a fifth
            assert -sign * heights.correct(0.0) > 0.35 * diverging(now - 10.0)
            assert heights.height(now) == pytest.approx(-sign * sunk(now - 10.0), abs=0.4)
    assert heights.correct(0.0) == pytest.approx(-sign * 1.4, abs=0.2)
    assert heights.stepped == -math.inf


def test_a_vehicle_that_follows_the_correction_is_no_step():
    """ArduCopter: the corrected rate is the one that it keeps, so odometry's rate rises."""
    rng, heights, climbed = np.random.default_rng(3), HeightEstimator(), 0.0
    for k in range(320):
        now = k * PERIOD
        true = -1.2 * (10.0 < now <= 11.0) if now <= 11.0 else -1.2 - heights.correct(0.0)
        climbed += PERIOD * true
        heights.take(100.0 + climbed + NOISE * rng.normal(), true + 1.2 * (now > 10.0), now,
                     acceleration=0.0)
        assert now < 11.0 or abs(heights.correct(0.0) + 1.2) < 1.25
    assert heights.correct(0.0) == pytest.approx(-1.2, abs=0.15)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('after', [-2.5, -0.1, 0.0, 0.1, 0.3, 1.0, 2.5])  # s from rate to sensor
@pytest.mark.parametrize(('jump', 'step'), [(1.0, 1.0), (1.0, -1.0), (-2.0, 3.0), (3.0, 0.7)])
def test_two_faults_within_suspicion_are_told_apart(jump, step, after, seed):
    rng, heights = np.random.default_rng(seed), HeightEstimator()
    for k in range(320):  # the vehicle hovers
        now = k * PERIOD
        heights.take(100.0 + jump * (now > 10.0 + after) + NOISE * rng.normal(),
                     step * (now > 10.0), now, acceleration=0.0)
        if k == 40:
            heights.refer(0.0, now)
        assert now < 13.0 or heights.correct(step) == pytest.approx(0.0, abs=0.3)
        assert heights.height(now) is None or abs(heights.height(now)) < 0.6
    assert heights.stepped == pytest.approx(10.0 + after, abs=0.3)
    assert heights.height(now) == pytest.approx(0.0, abs=0.3)


def test_error_outlasts_the_sensor_and_follows_steps():
    heights, _ = flown(20.0, altitude=lambda t: 100.0 + 0.3 * t)
    known, now = heights.correct(0.0), 20.0
    for k in range(200):
        now += PERIOD
        heights.take_rate(1.0 * (k > 100), now, 0.0)
    assert heights.height(now) is None and heights.is_silent(now)
    assert heights.correct(1.0) == pytest.approx(known, abs=0.01)
    heights.refer(None, now)
    assert heights.correct(1.0) == 1.0  # in the next flight


def test_first_rate_in_a_climb_is_no_error():
    heights = HeightEstimator()
    heights.take(50.0, 1.0, 0.0)
    assert heights.correct(1.0) == 1.0


@pytest.mark.parametrize(('changes', 'elapsed', 'acceleration', 'step'), [
    ([0.2] * 20, 0.05, None, 0.0),  # 4 m/s^2: what a vehicle can
    ([0.8], 0.05, None, 0.6), ([-0.8], 0.05, None, -0.6),
    ([0.5], 0.05, 0.0, 0.0), ([0.51], 0.05, 0.0, 0.51), ([-0.51], 0.05, 0.0, -0.51),
    ([0.6], 0.1, 1.5, 0.0), ([0.7], 0.1, 1.5, 0.55), ([-0.6], 0.1, 1.5, -0.6),
    # It does not obey.
    ([0.0] * 20, 0.1, 2.0, 0.0), ([0.1] * 8, 0.1, 9.0, 0.0), ([0.3], 0.1, -9.0, 0.0),
    ([0.55], 0.1, -9.0, 0.55),
    # Forgotten within a second.
    ([0.4, 0.4], 0.1, 0.0, 0.4 + 0.4 * math.exp(-0.1)), ([0.3] * 20, 1.0, 0.0, 0.0),
    ([0.4, 0.4], 1.0, 0.0, 0.4 + 0.4 * math.exp(-1.0)), ([0.4, 0.4], 2.0, 0.0, 0.0),
    # A step counts once.
    ([0.6, 0.4], 0.1, 0.0, 0.6), ([0.6, 0.6], 0.1, 0.0, 1.2), ([0.6, -0.6], 0.1, 0.0, 0.0)])
def test_change_no_vehicle_makes_is_a_step_of_its_source(changes, elapsed, acceleration, step):
    steps = RateSteps()
    found = [steps.take(change, elapsed, acceleration, 0.0) for change in changes]
    assert math.fsum(found) == pytest.approx(step)


def test_source_is_suspected_before_its_change_is_a_step():
    steps, found = RateSteps(), []
    for k, change in enumerate((0.3, -0.3, 0.32, 0.0, 0.0, -0.62)):
        steps.take(change, 0.05, 0.0, float(k))
        found.append(steps.suspected)
    assert found == [-math.inf, -math.inf, 2.0, 2.0, 2.0, 5.0]


ANY = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(ANY | st.floats(-10.0, 10.0), st.none() | ANY, st.floats(-0.1, 0.4)),
                max_size=40))
def test_whatever_comes_height_and_rate_are_finite_or_unknown(samples):
    heights, now = HeightEstimator(), 0.0
    for altitude, rate, pause in samples:
        now += pause
        if heights.take(altitude, rate, now) == '' and not heights.has_reference:
            heights.refer(0.0, now)
        height = heights.height(now)
        assert height is None or math.isfinite(height)
        assert math.isfinite(heights.climb_rate)
