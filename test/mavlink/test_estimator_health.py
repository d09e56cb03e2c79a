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

"""When the autopilot's velocity is no longer believed."""

import math

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.estimator_health import (
    distrusted,
    estimator_status,
    EstimatorStatus,
    explained,
    gps_fix,
    GpsFix,
)

# What PX4 1.16 sent while vision was fused in flight, then 0.6 s and 5 s after it was lost.
FUSED, UNAIDED, GONE = 0x016f, 0x006f, 0x0065
GOOD = EstimatorStatus(9.0, True, ())
BAD = EstimatorStatus(9.0, False, ('VELOCITY_HORIZ', 'POS_HORIZ_REL'))


def px4(flags):
    return mavlink.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 0, 0)


def ardupilot(flags):
    return mavlink.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(('flags', 'has_velocity'), [
    (FUSED, True), (FUSED | mavlink.ESTIMATOR_CONST_POS_MODE, True),  # the latter on the ground
    (UNAIDED, False), (GONE, False), (FUSED & ~2, False), (0, False)])
def test_px4_has_a_velocity_while_something_carries_it(flags, has_velocity):
    assert estimator_status(px4(flags), 5.0)[:2] == (5.0, has_velocity)


@pytest.mark.parametrize(('flags', 'has_velocity'), [
    (mavlink.EKF_VELOCITY_HORIZ, True), (0x033f, True), (0, False),
    (mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_CONST_POS_MODE, False)])
def test_ardupilot_has_a_velocity_unless_it_takes_its_position_for_constant(flags, has_velocity):
    assert estimator_status(ardupilot(flags), 5.0).has_velocity is has_velocity


@pytest.mark.parametrize('message', [px4, ardupilot])
@pytest.mark.parametrize(('flags', 'missing'), [
    (0x033f, ()), (FUSED, ('POS_HORIZ_ABS',)),  # no origin was told
    (UNAIDED, ('POS_HORIZ_ABS', 'PRED_POS_HORIZ_REL')),
    (GONE, ('VELOCITY_HORIZ', 'POS_HORIZ_REL', 'POS_HORIZ_ABS', 'PRED_POS_HORIZ_REL')),
    (0x03fe, ('ATTITUDE',))])
def test_the_flags_that_an_estimator_lacks_are_named_as_mavlink_names_them(
        message, flags, missing):
    status = estimator_status(message(flags), 5.0)
    assert status.missing == missing
    assert explained('arm refused', status, 5.0) == (
        f'arm refused; its estimator lacks {", ".join(missing)}' if missing else 'arm refused')
    assert explained('arm refused', status, 8.1) == 'arm refused'
    assert explained('arm refused', None, 5.0) == 'arm refused'


def test_no_global_position_though_no_flag_is_missing_is_px4s_yaw_alignment():
    refusal = 'arm refused: temporarily rejected: no global position (neither GPS nor an origin)'
    assert explained(refusal, GOOD, 9.0).startswith(
        f'{refusal}; its estimator lacks no flag: its yaw is not aligned')
    assert 'lacks VELOCITY_HORIZ' in explained(refusal, BAD, 9.0)


def test_a_fix_is_lost_where_there_was_one():
    def raw(fix_type):
        return mavlink.MAVLink_gps_raw_int_message(0, fix_type, 0, 0, 0, 0, 0, 0, 0, 0)
    never = gps_fix(raw(1), None, 4.0)
    fixed = gps_fix(raw(6), never, 5.0)
    lost = gps_fix(raw(1), gps_fix(raw(1), fixed, 6.0), 7.0)
    assert (never.fixed, fixed.fixed) == (False, True)
    assert lost == GpsFix(False, 6.0)
    assert distrusted(GOOD, lost, math.inf, 9.0) == 'rests on GPS, whose fix is lost'
    for gps in (never, fixed, gps_fix(raw(3), lost, 8.0)):
        assert not distrusted(GOOD, gps, math.inf, 9.0)
    # Where odometry is forwarded, that is what carries the estimate,
    assert not distrusted(GOOD, lost, 0.1, 9.0)
    # and where its estimator does not miss the fix for long, something else.
    assert distrusted(GOOD, lost, math.inf, 16.0)
    assert not distrusted(GOOD._replace(time=16.0), lost, math.inf, 16.1)


@pytest.mark.parametrize(('status', 'forwarded', 'why'), [
    (None, math.inf, ''), (GOOD, math.inf, ''), (GOOD, 0.0, ''), (GOOD, 0.2, ''),
    (GOOD, 0.201, 'rests on odometry that is lost'), (None, 5.0, 'rests on odometry that is lost'),
    (BAD, 0.1, 'is none, says its estimator'), (BAD, math.inf, 'is none, says its estimator')])
def test_it_is_distrusted_from_what_it_rests_on_and_from_what_the_estimator_says(
        status, forwarded, why):
    assert distrusted(status, None, forwarded, 10.0) == why


def test_what_the_estimator_said_long_ago_says_nothing_of_now():
    assert distrusted(BAD, None, math.inf, 12.0)
    assert not distrusted(BAD, None, math.inf, 12.01)
