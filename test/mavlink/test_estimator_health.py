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

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.dialects import ARDUPILOT, PX4
from flock_follower.mavlink.estimator_health import (
    estimator_status,
    EstimatorStatus,
    explain_refusal,
    find_misplacement,
    gps_fix,
    GpsFix,
    velocity_fault,
)

# What PX4 1.16 sent while vision was fused in flight, then 0.6 s and 5 s after it was lost.
FUSED, UNAIDED, GONE = 0x016f, 0x006f, 0x0065
GOOD = EstimatorStatus(9.0, True, ())
BAD = EstimatorStatus(9.0, False, ('VELOCITY_HORIZ', 'POS_HORIZ_REL'))


def px4(flags):
    return mavlink.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 0, 0)


def ardupilot(flags):
    return mavlink.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0)


MESSAGES = {'px4': px4, 'ardupilot': ardupilot}


@pytest.mark.parametrize(('dialect', 'flags', 'has_velocity'), [
    # PX4 has a velocity while something carries it; the second on the ground.
    (PX4, FUSED, True), (PX4, FUSED | mavlink.ESTIMATOR_CONST_POS_MODE, True),
    (PX4, UNAIDED, False), (PX4, GONE, False), (PX4, FUSED & ~2, False), (PX4, 0, False),
    # ArduPilot has one unless it takes its position for constant.
    (ARDUPILOT, mavlink.EKF_VELOCITY_HORIZ, True), (ARDUPILOT, 0x033f, True),
    (ARDUPILOT, 0, False),
    (ARDUPILOT, mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_CONST_POS_MODE, False)])
def test_an_estimator_says_whether_it_has_a_velocity(dialect, flags, has_velocity):
    assert estimator_status(MESSAGES[dialect.name](flags), dialect, 5.0)[:2] == (5.0, has_velocity)


@pytest.mark.parametrize('dialect', [PX4, ARDUPILOT])
@pytest.mark.parametrize(('flags', 'missing'), [
    (0x033f, ()), (FUSED, ('POS_HORIZ_ABS',)),  # no origin was told
    (UNAIDED, ('POS_HORIZ_ABS', 'PRED_POS_HORIZ_REL')),
    (GONE, ('VELOCITY_HORIZ', 'POS_HORIZ_REL', 'POS_HORIZ_ABS', 'PRED_POS_HORIZ_REL')),
    (0x03fe, ('ATTITUDE',))])
def test_missing_estimator_flags_are_named_as_in_mavlink(
        dialect, flags, missing):
    status = estimator_status(MESSAGES[dialect.name](flags), dialect, 5.0)
    assert status.missing == missing
    assert explain_refusal('arm refused', status, 5.0) == (
        f'arm refused; its estimator lacks {", ".join(missing)}' if missing else 'arm refused')
    assert explain_refusal('arm refused', status, 8.1) == 'arm refused'
    assert explain_refusal('arm refused', None, 5.0) == 'arm refused'


def fixes(*types):
    """Return the fix after GPS_RAW_INT of these types at 4 s, 5 s and so on."""
    fix = None
    for time, fix_type in enumerate(types, start=4):
        fix = gps_fix(mavlink.MAVLink_gps_raw_int_message(
            0, fix_type, 0, 0, 0, 0, 0, 0, 0, 0), fix, float(time))
    return fix


ODOMETRY, ESTIMATOR = 'rests on odometry that is lost', 'is invalid according to its estimator'
LOST = fixes(1, 6, 1, 1)


@pytest.mark.parametrize(('status', 'gps', 'forwarded', 'now', 'why'), [
    *((status, None, forwarded, 10.0, why) for status, forwarded, why in (
        (None, math.inf, ''), (GOOD, math.inf, ''), (GOOD, 0.0, ''), (GOOD, 0.2, ''),
        (GOOD, 0.201, ODOMETRY), (None, 5.0, ODOMETRY), (BAD, 0.1, ESTIMATOR),
        (BAD, math.inf, ESTIMATOR))),
    # What the estimator said long ago says nothing of now.
    (BAD, None, math.inf, 12.0, ESTIMATOR), (BAD, None, math.inf, 12.01, ''),
    # A fix is lost where there was one.
    (GOOD, LOST, math.inf, 9.0, 'rests on GPS, whose fix is lost'),
    (GOOD, fixes(1), math.inf, 9.0, ''), (GOOD, fixes(1, 6), math.inf, 9.0, ''),
    (GOOD, fixes(1, 6, 1, 1, 3), math.inf, 9.0, ''),
    # Where odometry is forwarded, that is what carries the estimate,
    (GOOD, LOST, 0.1, 9.0, ''),
    # and where its estimator does not miss the fix for long, something else.
    (GOOD, LOST, math.inf, 16.0, 'rests on GPS, whose fix is lost'),
    (GOOD._replace(time=16.0), LOST, math.inf, 16.1, '')])
def test_it_is_distrusted_by_its_source_and_by_estimator_flags(
        status, gps, forwarded, now, why):
    assert velocity_fault(status, gps, forwarded, now) == why


def test_a_fix_is_lost_since_the_first_message_without_it():
    assert (fixes(1).fixed, fixes(1, 6).fixed) == (False, True)
    assert GpsFix(False, 6.0) == LOST


@pytest.mark.parametrize(('position', 'home', 'odometry', 'reason'), [
    (None, (0, 0, 0), (0, 0, 0), ''), ((1, 2, 3), None, None, ''),
    ((990, 0, 0), (0, 0, 0), (0, 0, 0), ''), ((1, 2, 3), (math.nan, 0, 0), (1, 2, 3), ''),
    ((1100, 0, 0), None, (0, 0, 0), 'km from odom'), ((0, 0, 0), (0, 1100, 0), None, 'km from H'),
    # What PX4 1.18 sent after its origin came too late.
    ((-1067128.1, -5227320.5, 489.7), None, None, 'steps of 0.5 m'),
    ((math.nan, 0, 0), None, None, 'steps of 0.5 m')])
def test_an_estimate_in_another_place_is_found(position, home, odometry, reason):
    found = find_misplacement(*(None if each is None else np.array(each, dtype=float)
                                for each in (position, home, odometry)))
    assert (reason in found) and bool(found) == bool(reason)
