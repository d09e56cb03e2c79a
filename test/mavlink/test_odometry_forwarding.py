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

"""Odometry on its way to the autopilot: frames, covariances, jumps and gaps."""

import math

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.geometry import (
    quaternion_from_yaw,
)
from flock_follower.mavlink.dialects import ARDUPILOT, PX4
from flock_follower.mavlink.odometry_forwarding import (
    encode_odometry,
    has_jumped,
    OdometryForwarder,
    OLDEST_FORWARDED,
    quality,
    UNKNOWN_QUALITY,
)
from flock_follower.messages import OdometryState

POSE, TWIST = map(np.diag, (
    [0.01, 0.02, 0.03, 0.1, 0.2, 0.3], [0.04, 0.05, 0.06, 0.4, 0.5, 0.6]))


def sample(time=10.0, position=(1.0, 2.0, 3.0), quaternion=(0.0, 0.0, 0.0, 1.0),
           velocity=(0.4, 0.0, 0.0), rates=(0.0, 0.0, 0.0), pose=POSE, twist=TWIST):
    """Return a state whose velocity covariance is in the odometry's frame, and its time."""
    return OdometryState(
        0, 'odom', 'base_link', np.array(position), np.array(quaternion), np.array(velocity),
        np.array(rates), pose, twist, np.eye(3)), time


def diagonal(triangle):
    return [triangle[i] for i in (0, 6, 11, 15, 18, 20)]


@pytest.mark.parametrize(('dialect', 'frame'), [
    (PX4, mavlink.MAV_FRAME_LOCAL_NED), (ARDUPILOT, mavlink.MAV_FRAME_LOCAL_FRD)])
def test_each_autopilot_gets_its_frame_and_the_same_numbers(dialect, frame):
    message = encode_odometry(*sample(velocity=(0.4, 0.1, 0.2), rates=(0.1, 0.2, 0.3)), dialect, 0)
    assert (message.frame_id, message.child_frame_id, message.estimator_type) == (
        frame, mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_ESTIMATOR_TYPE_VIO)
    assert (message.time_usec, message.x, message.y, message.z) == (10_000_000, 2.0, 1.0, -3.0)
    # Facing east is a yaw of 90 degrees; north is to the left of somebody who faces east.
    assert message.q == pytest.approx([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    assert (message.vx, message.vy, message.vz) == pytest.approx((0.4, -0.1, -0.2))
    assert (message.rollspeed, message.pitchspeed, message.yawspeed) == (0.1, -0.2, -0.3)
    # The size that the link budget counts with.
    assert len(message.pack(mavlink.MAVLink(None, 1, 191))) <= 247


def test_covariances_turn_with_their_axes():
    pose = POSE.copy()
    pose[0, 2] = pose[2, 0] = 0.005  # east with up
    message = encode_odometry(
        *sample(quaternion=quaternion_from_yaw(math.pi / 2), pose=pose), PX4, 0)
    # ENU x is NED y; a body that faces north has FLU x along ENU y.
    assert diagonal(message.pose_covariance) == pytest.approx([0.02, 0.01, 0.03, 0.2, 0.1, 0.3])
    assert diagonal(message.velocity_covariance) == pytest.approx(
        [0.05, 0.04, 0.06, 0.4, 0.5, 0.6])
    assert message.pose_covariance[7] == pytest.approx(-0.005)  # east with down: row 1, column 2


@pytest.mark.parametrize('bad', [
    np.zeros((6, 6)), np.full((6, 6), math.nan), -np.eye(6), 1e308 * np.eye(6), 1e6 * np.eye(6),
    np.eye(6) - 1e308 * np.eye(6, k=1)])
def test_a_covariance_that_is_none_is_replaced(bad):
    message = encode_odometry(
        *sample(pose=bad, twist=bad), ARDUPILOT, 0)
    for triangle in (message.pose_covariance, message.velocity_covariance):
        assert diagonal(triangle) == pytest.approx([0.01] * 3 + [0.0025] * 3)
    message.pack(mavlink.MAVLink(None))  # which raises where a float32 cannot hold a number


@pytest.mark.parametrize(('change', 'jump'), [
    ({'position': (1.04, 2.0, 3.0)}, False), ({'position': (1.5, 2.0, 3.0)}, True),
    ({'quaternion': quaternion_from_yaw(0.1)}, False),
    ({'quaternion': quaternion_from_yaw(0.5)}, True), ({'time': 9.9}, True),
    # Half a second later it has moved on by its velocity, and turned by its rate.
    ({'time': 10.5, 'position': (1.2, 2.0, 3.0)}, False),
    ({'time': 11.0, 'position': (1.0, 2.0, 3.0)}, True)])
def test_a_jump_is_what_the_motion_does_not_explain(change, jump):
    assert has_jumped(*sample(), *sample(**{'time': 10.1, **change})) == jump


def test_jumps_raise_the_reset_counter_of_every_message_after():
    forwarder, counters = OdometryForwarder(rate=30.0), []
    for n, east in enumerate([0.0, 0.02, 5.0, 5.02, 0.0]):
        assert forwarder.take(*sample(n * 0.05, (east, 0.0, 0.0)), n * 0.05) == ''
        if n != 1:  # what waits keeps the counter it was taken with
            counters += [m.reset_counter for m in forwarder.messages(PX4, n * 0.05)]
    assert counters == [0, 0, 1, 1, 2] and forwarder.counters['jumps'] == 2


def test_old_future_or_fast_odometry_is_not_sent_but_counted():
    forwarder = OdometryForwarder(rate=30.0)
    assert forwarder.silence(1.0) == math.inf
    for sent in (True, False):
        forwarder.sent(sent, 1.0)
    assert forwarder.silence(1.5) == 0.5 and forwarder.counters == {'sent': 1, 'not sent': 1}
    assert forwarder.take(*sample(10.0), 10.31) == 'too old to forward'
    assert forwarder.take(*sample(10.0), 9.8) == 'from the future, not forwarded'
    fast = sample(10.0, velocity=(101.0, 0.0, 0.0))
    assert forwarder.take(*fast, 10.0) == 'not plausible, not forwarded'
    assert forwarder.messages(PX4, 9.8) == []
    for time in (20.0, 20.1, 20.2):
        forwarder.take(*sample(time, (0.4 * (time - 20.0), 0.0, 0.0)), time)
    assert [m.time_usec for m in forwarder.messages(PX4, 20.35)] == [20_100_000, 20_200_000]
    assert forwarder.counters['too old to send'] == 1
    # A source that starts again is forwarded at once.
    resets = forwarder.reset_counter
    forwarder.take(*sample(5.0), 5.0)
    assert [m.reset_counter for m in forwarder.messages(PX4, 5.0)] == [resets + 1]


@pytest.mark.parametrize(('source', 'rate', 'expected'), [
    (50.0, 30.0, 30.0), (30.0, 30.0, 30.0), (200.0, 30.0, 30.0), (20.0, 30.0, 20.0)])
def test_the_rate_is_limited_evenly_and_never_halved(source, rate, expected):
    forwarder, times = OdometryForwarder(rate), []
    for n in range(round(10 * source)):
        # A stamp that wanders by 2 ms.
        time = n / source + (0.002 if n % 3 else 0.0)
        forwarder.take(*sample(time, (0.4 * time, 0.0, 0.0)), time)
        times += [m.time_usec * 1e-6 for m in forwarder.messages(PX4, time)]
    assert len(times) == pytest.approx(10 * expected, rel=0.02)
    assert np.diff(times).max() < 1.6 / expected


def test_quality_falls_with_covariance_and_age_never_unknown():
    def of(std, age=0.0):
        return quality(sample(twist=np.eye(6) * std ** 2)[0], age)
    assert [of(std) for std in (0.01, 0.1, 0.2, 1.0, 100.0)] == [100, 100, 50, 10, 1]
    ages = -0.1, 0.0, 0.5 * OLDEST_FORWARDED, OLDEST_FORWARDED, 9.0
    assert [of(0.1, age) for age in ages] == [100, 100, 50, 1, 1]
    assert of(0.0) == of(math.nan) == UNKNOWN_QUALITY
    for dialect in (PX4, ARDUPILOT):
        forwarder = OdometryForwarder()
        forwarder.take(*sample(), 10.1)
        (message,) = forwarder.messages(dialect, 10.1)
        assert 1 <= message.quality == quality(sample()[0], 0.1) < 100
