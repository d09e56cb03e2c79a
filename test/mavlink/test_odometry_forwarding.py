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

"""Odometry on its way to the autopilot: frames, covariances, jumps, gaps, and TIMESYNC."""

import math

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.geometry import (
    quaternion_from_rpy,
    quaternion_from_yaw,
    quaternion_ned_frd_to_enu_flu,
    quaternion_to_matrix,
)
from flock_follower.mavlink.dialects import ARDUPILOT, PX4
from flock_follower.mavlink.housekeeping import TimeSync
from flock_follower.mavlink.odometry_forwarding import (
    encode_odometry,
    ForwardedOdometry,
    jumped,
    OdometryForwarder,
)

SECOND = 1_000_000_000


def sample(time=10.0, position=(1.0, 2.0, 3.0), quaternion=(0.0, 0.0, 0.0, 1.0),
           velocity=(0.4, 0.0, 0.0), rates=(0.0, 0.0, 0.0), pose=None, twist=None, rate=None):
    return ForwardedOdometry(
        time, np.array(position), np.array(quaternion), np.array(velocity), np.array(rates),
        np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]) if pose is None else pose,
        np.diag([0.04, 0.05, 0.06]) if twist is None else twist,
        np.diag([0.4, 0.5, 0.6]) if rate is None else rate)


def diagonal(triangle):
    return [triangle[i] for i in (0, 6, 11, 15, 18, 20)]


def test_px4_gets_local_ned_and_ardupilot_local_frd_with_the_same_numbers():
    px4, ardupilot = (encode_odometry(sample(), d, 0) for d in (PX4, ARDUPILOT))
    assert (px4.frame_id, px4.child_frame_id) == (
        mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
    assert (ardupilot.frame_id, ardupilot.child_frame_id) == (
        mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    for message in (px4, ardupilot):
        assert (message.x, message.y, message.z) == (2.0, 1.0, -3.0)
        assert message.time_usec == 10_000_000
        assert message.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_VIO


def test_facing_east_is_a_yaw_of_90_degrees_and_east_is_forward():
    message = encode_odometry(sample(velocity=(0.4, 0.1, 0.2), rates=(0.1, 0.2, 0.3)), PX4, 0)
    half = math.sqrt(0.5)
    assert message.q == pytest.approx([half, 0.0, 0.0, half])
    # North is to the left of somebody who faces east.
    assert (message.vx, message.vy, message.vz) == pytest.approx((0.4, -0.1, -0.2))
    assert (message.rollspeed, message.pitchspeed, message.yawspeed) == (0.1, -0.2, -0.3)


def test_pose_and_velocity_survive_the_way_out_and_back():
    q = quaternion_from_rpy(0.1, -0.2, 2.0)
    message = encode_odometry(sample(quaternion=q, velocity=(0.3, -0.2, 0.1)), PX4, 0)
    w, x, y, z = message.q
    back = quaternion_ned_frd_to_enu_flu([x, y, z, w])
    np.testing.assert_allclose(back, q, atol=1e-12)
    flu = np.array([message.vx, -message.vy, -message.vz])
    np.testing.assert_allclose(quaternion_to_matrix(back) @ flu, [0.3, -0.2, 0.1], atol=1e-12)


def test_covariances_turn_with_their_axes():
    message = encode_odometry(sample(quaternion=quaternion_from_yaw(math.pi / 2)), PX4, 0)
    # ENU x is NED y; a body that faces north has FLU x along ENU y.
    assert diagonal(message.pose_covariance) == pytest.approx([0.02, 0.01, 0.03, 0.2, 0.1, 0.3])
    assert diagonal(message.velocity_covariance) == pytest.approx(
        [0.05, 0.04, 0.06, 0.4, 0.5, 0.6])


def test_correlations_turn_too():
    pose = np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    pose[0, 2] = pose[2, 0] = 0.005  # east with up
    message = encode_odometry(sample(pose=pose), PX4, 0)
    triangle = np.zeros((6, 6))
    triangle[np.triu_indices(6)] = message.pose_covariance
    assert triangle[1, 2] == pytest.approx(-0.005)  # east with down


@pytest.mark.parametrize('bad', [
    np.zeros((6, 6)), np.full((6, 6), math.nan), -np.eye(6), 1e308 * np.eye(6), 1e6 * np.eye(6),
    np.eye(6) - 1e308 * np.eye(6, k=1)])
def test_a_covariance_that_is_none_is_replaced(bad):
    message = encode_odometry(
        sample(pose=bad, twist=bad[:3, :3], rate=bad[3:, 3:]), ARDUPILOT, 0)
    assert diagonal(message.pose_covariance) == pytest.approx([0.01] * 3 + [0.0025] * 3)
    assert diagonal(message.velocity_covariance) == pytest.approx([0.01] * 3 + [0.0025] * 3)
    message.pack(mavlink.MAVLink(None))  # which raises where a float32 cannot hold a number


def test_the_message_packs_within_the_size_the_link_budget_counts_with():
    data = encode_odometry(sample(), PX4, 7).pack(mavlink.MAVLink(None, 1, 191))
    assert len(data) <= 247


@pytest.mark.parametrize(('change', 'jump'), [
    ({'position': (1.04, 2.0, 3.0)}, False), ({'position': (1.5, 2.0, 3.0)}, True),
    ({'quaternion': quaternion_from_yaw(0.1)}, False),
    ({'quaternion': quaternion_from_yaw(0.5)}, True), ({'time': 9.9}, True),
    # Half a second later it has moved on by its velocity, and turned by its rate.
    ({'time': 10.5, 'position': (1.2, 2.0, 3.0)}, False),
    ({'time': 11.0, 'position': (1.0, 2.0, 3.0)}, True)])
def test_a_jump_is_what_the_motion_does_not_explain(change, jump):
    assert jumped(sample(), sample(**{'time': 10.1, **change})) == jump


def test_jumps_raise_the_reset_counter_of_every_message_after():
    forwarder = OdometryForwarder(rate=30.0)
    counters = []
    for n, east in enumerate([0.0, 0.02, 5.0, 5.02, 0.0]):
        assert forwarder.take(sample(n * 0.05, (east, 0.0, 0.0)), n * 0.05) == ''
        counters += [m.reset_counter for m in forwarder.messages(PX4, n * 0.05)]
    assert counters == [0, 0, 1, 1, 2]
    assert forwarder.counters['jumps'] == 2


def test_what_waits_keeps_the_reset_counter_it_was_taken_with():
    forwarder = OdometryForwarder(rate=30.0)
    for time, east in ((0.0, 0.0), (0.04, 0.016), (0.08, 5.0)):
        forwarder.take(sample(time, (east, 0.0, 0.0)), time)
    sent = [(m.y, m.reset_counter) for m in forwarder.messages(PX4, 0.08)]
    assert sent == [(0.0, 0), (0.016, 0), (5.0, 1)]


def test_what_has_waited_for_too_long_is_not_sent_and_counted():
    forwarder = OdometryForwarder(rate=30.0)
    for time in (0.0, 0.1, 0.2):
        forwarder.take(sample(time, (0.4 * time, 0.0, 0.0)), time)
    assert [m.time_usec for m in forwarder.messages(PX4, 0.35)] == [100_000, 200_000]
    assert dict(forwarder.counters) == {'too old to send': 1}
    forwarder.take(sample(0.3, (0.12, 0.0, 0.0)), 0.35)
    assert forwarder.messages(PX4, 60.0) == []  # such as where the autopilot is heard late
    assert forwarder.counters['too old to send'] == 2


@pytest.mark.parametrize(('source', 'rate', 'expected'), [
    (50.0, 30.0, 30.0), (30.0, 30.0, 30.0), (200.0, 30.0, 30.0), (20.0, 30.0, 20.0)])
def test_the_rate_is_limited_evenly_and_never_halved(source, rate, expected):
    forwarder, times = OdometryForwarder(rate), []
    for n in range(round(10 * source)):
        # A stamp that wanders by 2 ms.
        time = n / source + (0.002 if n % 3 else 0.0)
        forwarder.take(sample(time, (0.4 * time, 0.0, 0.0)), time)
        times += [m.time_usec * 1e-6 for m in forwarder.messages(PX4, time)]
    assert len(times) == pytest.approx(10 * expected, rel=0.02)
    assert np.diff(times).max() < 1.6 / expected


def test_old_odometry_and_that_of_the_future_is_not_forwarded():
    forwarder = OdometryForwarder()
    assert forwarder.take(sample(10.0), 10.31) == 'too old to forward'
    assert forwarder.take(sample(10.0), 9.8) == 'from the future, not forwarded'
    assert forwarder.messages(PX4, 9.8) == []


def test_a_source_that_starts_again_is_forwarded_at_once():
    forwarder = OdometryForwarder()
    for time in (100.0, 5.0):
        forwarder.take(sample(time), time)
        assert len(forwarder.messages(PX4, time)) == 1
    assert forwarder.reset_counter == 1


def test_gaps_and_losses_are_counted():
    forwarder = OdometryForwarder()
    assert forwarder.silence(1.0) == math.inf
    for time in (1.0, 1.09, 1.25, 1.3):
        forwarder.sent(True, time)
    forwarder.sent(False, 1.35)
    assert dict(forwarder.counters) == {'sent': 4, 'gaps over 100 ms': 1, 'not sent': 1}
    assert forwarder.silence(1.5) == pytest.approx(0.2)


# TIMESYNC.

def test_a_question_is_answered_with_our_clock():
    answer = TimeSync().take(mavlink.MAVLink_timesync_message(0, 123), 5 * SECOND)
    assert (answer.tc1, answer.ts1) == (5 * SECOND, 123)


def test_the_fastest_of_the_recent_answers_gives_the_offset():
    sync = TimeSync()
    assert sync.best is None
    for way in (40, 10, 80):  # ms there and back; only the way there is slow
        asked = sync.question(7 * SECOND)
        assert (asked.tc1, asked.ts1) == (0, 7 * SECOND)
        theirs = 7 * SECOND + (way - 5) * 1_000_000 + 100 * SECOND
        assert sync.take(mavlink.MAVLink_timesync_message(theirs, asked.ts1),
                         7 * SECOND + way * 1_000_000) is None
    assert sync.best.way == 10_000_000
    assert sync.best.offset == pytest.approx(100 * SECOND, abs=5_000_000)
    sync.forget()
    assert sync.best is None


@pytest.mark.parametrize('asked', [8 * SECOND, 5 * SECOND])
def test_answers_to_somebody_elses_questions_are_not_taken(asked):
    sync = TimeSync()
    sync.take(mavlink.MAVLink_timesync_message(1, asked), 7 * SECOND)
    assert sync.best is None
