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

"""The motion of a vehicle elsewhere, from the messages that tell it."""

import math

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.external.external_motion import (
    ExternalMotion,
    JUMP,
    POSE_GAP,
)
from flock_follower.geometry import yaw_from_quaternion

DEGREE = 111_320.0  # m
LATITUDE, LONGITUDE = 47.4, 8.5
MS = 1_000_000  # ns


def wxyz(yaw_ned, roll=0.0):
    """Return an attitude NED<-FRD: roll, then yaw clockwise from north."""
    (w, z), (c, s) = ((math.cos(0.5 * a), math.sin(0.5 * a)) for a in (yaw_ned, roll))
    return [w * c, w * s, z * s, z * c]


def truth(kind, ned=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), yaw=0.0, rates=(0.0, 0.0, 0.0),
          roll=0.0):
    """Return a message of ArduPilot's or PX4's simulator; m, m/s and rad, NED and FRD."""
    latitude = round((LATITUDE + ned[0] / DEGREE) * 1e7)
    longitude = round((LONGITUDE + ned[1] / (DEGREE * math.cos(math.radians(LATITUDE)))) * 1e7)
    height = 488.0 - ned[2]
    if kind == 'SIM_STATE':
        return mavlink.MAVLink_sim_state_message(
            *wxyz(yaw, roll), 0, 0, 0, 0, 0, 0, *rates, 0.0, 0.0, height, 0, 0, *velocity,
            latitude, longitude)
    return mavlink.MAVLink_hil_state_quaternion_message(
        0, wxyz(yaw, roll), *rates, latitude, longitude, round(height * 1e3),
        *(round(100 * v) for v in velocity), 0, 0, 0, 0, 0)


def estimate(boot_ms, ned, velocity=(0.0, 0.0, 0.0), yaw=0.0):
    return (mavlink.MAVLink_attitude_quaternion_message(boot_ms, *wxyz(yaw), 0.0, 0.0, 0.1),
            mavlink.MAVLink_local_position_ned_message(boot_ms, *ned, *velocity))


def received(*arrived, by_estimate=False):
    """Return the motion after messages, or tuples of them, that arrived at times, ms."""
    motion = ExternalMotion()
    if by_estimate:
        motion.source = 'LOCAL_POSITION_NED'
    for time, messages in arrived:
        for message in messages if isinstance(messages, tuple) else (messages,):
            motion.take(message, round(time * MS))
    return motion


@pytest.mark.parametrize('kind', ['SIM_STATE', 'HIL_STATE_QUATERNION'])
def test_both_truths_are_enu_from_first_report(kind):
    motion = received((0, truth(kind)), (1_000, truth(
        kind, (3.0, 2.0, -1.0), (0.5, 0.25, -0.125), math.radians(30.0), (0.1, 0.2, 0.3))))
    now = motion.at(1_000 * MS)  # 3 m to the north in a second: no flight
    assert motion.source == kind
    np.testing.assert_allclose(now.position, [2.0, 3.0, 1.0], atol=0.012)  # 1e-7 deg
    np.testing.assert_allclose(now.velocity, [0.25, 0.5, 0.125], atol=0.006)
    assert yaw_from_quaternion(now.quaternion) == pytest.approx(math.radians(60.0))
    np.testing.assert_allclose(now.angular, [0.1, -0.2, -0.3], atol=1e-6)
    # An attitude with a roll faces where its yaw says: east, right side down.
    x, _, _, w = received((0, truth(kind, yaw=math.pi / 2, roll=0.2))).at(0).quaternion
    assert (x, w) == (pytest.approx(math.sin(0.1)), pytest.approx(math.cos(0.1)))


def test_place_in_centimeter_steps_moves_evenly_without_drift():
    motion, steps = ExternalMotion(), []
    for k in range(400):
        motion.take(truth('HIL_STATE_QUATERNION', (0.006 * k, 0, 0), (0.3, 0, 0)), 20 * MS * k)
        steps.append(motion.at(20 * MS * k).position[1])
    np.testing.assert_allclose(np.diff(steps)[50:], 0.006, atol=0.0003)  # 11 mm as told
    np.testing.assert_allclose(steps, 0.006 * np.arange(400), atol=0.015)


def test_motion_is_interpolated_between_poses_and_still_beyond():
    motion = received(*((20 * k, truth('SIM_STATE', (k * JUMP * 0.02, 0.0, 0.0), (JUMP, 0.0, 0.0),
                                       yaw=math.pi - 0.1 + 0.1 * k)) for k in range(3)))
    half = motion.at(30 * MS)
    assert half.position[1] == pytest.approx(1.5 * JUMP * 0.02, abs=0.006)
    # Across the seam of the angles, the short way.
    assert yaw_from_quaternion(half.quaternion) == pytest.approx(-math.pi / 2 - 0.05, abs=1e-6)
    np.testing.assert_array_equal(motion.at(90 * MS).position, motion.at(40 * MS).position)
    np.testing.assert_array_equal(motion.at(-5 * MS).position, motion.at(0).position)
    assert motion.newest == 40 * MS


def test_events_in_a_gap_or_after_last_pose_are_unknown():
    motion = ExternalMotion()
    assert motion.newest is None and not motion.knows(0)
    with pytest.raises(ValueError, match='no pose'):
        motion.at(0)
    late = 100 * MS + POSE_GAP + 1
    motion = received(*((time / MS, truth('SIM_STATE')) for time in (
        0, 100 * MS, late, late + 20 * MS)))
    assert all(map(motion.knows, (0, 50 * MS, 100 * MS, late, late + 10 * MS)))
    assert not any(map(motion.knows, (100 * MS + 1, late - 1, late + 20 * MS + 1)))


def test_the_estimate_counts_only_where_no_truth_came():
    assert received((0, estimate(1_000, (1.0, 0.0, 0.0)))).newest is None
    motion = received(*((20 * k, estimate(1_000 + 20 * k, (1.0 + 0.01 * k, 0.5, -2.0),
                                          (0.5, 0.0, 0.0), yaw=0.5)) for k in range(3)),
                      (70, truth('SIM_STATE', (9.0, 9.0, 9.0))), by_estimate=True)
    assert motion.estimated and motion.knows(30 * MS) and motion.newest == 40 * MS
    now = motion.at(30 * MS)
    np.testing.assert_allclose(now.position, [0.0, 0.015, 0.0], atol=1e-6)
    np.testing.assert_allclose(now.velocity, [0.0, 0.5, 0.0], atol=1e-6)
    assert now.angular[2] == pytest.approx(-0.1)


@pytest.mark.parametrize('message', [
    truth('SIM_STATE', velocity=(math.nan, 0.0, 0.0)),
    mavlink.MAVLink_sim_state_message(*[0.0] * 21, 474000000, 85000000),  # no attitude
    mavlink.MAVLink_hil_state_quaternion_message(0, [1, 0, 0, 0], *[0] * 14),  # nowhere yet
])
def test_what_is_no_pose_places_nothing(message):
    assert received((0, message)).newest is None
