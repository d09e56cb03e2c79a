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

"""A flight of vehicles elsewhere: where the scenario is put, and what is not invented."""

import math

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.closed_loop.flown import ExternalLeader, ExternalVehicle
from flock_desk.closed_loop.real_time_flight import (
    LATEST_NS,
    real_time_camera,
    RealTimeFlight,
    SENSOR,
    STEP_NS,
)
from flock_desk.external.external_motion import ExternalMotion
from flock_desk.scenarios.scenario import LeaderMotion, Scenario, Sensing, VioErrors
from flock_follower.geometry import quaternion_to_matrix, yaw_from_quaternion

pytestmark = pytest.mark.slow
START = 5_000_000_000  # ns, of the flight
PERIOD = 20_000_000  # ns between poses
LATE = 13_000_000  # ns by which those of the leader come later
EXACT = VioErrors(latency=(0.0, 0.0), **dict.fromkeys((
    'position_walk', 'height_walk', 'yaw_walk', 'position', 'tilt', 'tilt_bias', 'attitude',
    'velocity', 'velocity_white', 'gyro_bias', 'gyro'), 0.0))
NEVER = math.inf, math.inf


@pytest.fixture(scope='module')
def camera():
    return real_time_camera(0)


def reported(north, up, yaw=0.0, velocity=(0.0, 0.0, 0.0)):
    """Return ground truth, yaw from north."""
    return mavlink.MAVLink_sim_state_message(
        math.cos(yaw / 2), 0, 0, math.sin(yaw / 2), *[0] * 11, 488.0 + up, 0, 0, *velocity,
        round(474000000 + north / 111_320.0 * 1e7), 85000000)


class Elsewhere:
    """
    A vehicle that climbs to 2 m, flies north at 0.2 m/s and faces north-east.

    With ``led`` its leader, too, is flown elsewhere: 2 m ahead at 2 m height, north at 0.3 m/s.
    """

    def __init__(self, camera, led=False):
        self.motion, self.ahead = ExternalMotion(), ExternalMotion()
        self.sent_ns, self.led_ns = START - PERIOD, START - PERIOD
        self.report(START, NEVER, NEVER)
        self.vehicle = ExternalVehicle(self.motion, START, height=0.0)
        self.flight = RealTimeFlight(
            Scenario('test', 'for a test', sensing=Sensing(latency=(0.1, 0.1)), odometry=EXACT,
                     leader=LeaderMotion(motion='circle', speed=1.0) if led else LeaderMotion()),
            0, self.vehicle, camera, LATEST_NS + 40_000_000 * led,
            ExternalLeader(self.ahead, START, self.vehicle.origin) if led else None)
        self.odometry, self.frames, self.distances = [], [], []

    def report(self, now, silent, leader_silent):
        while self.sent_ns + PERIOD <= now:
            self.sent_ns += PERIOD
            time = (self.sent_ns - START) * 1e-9
            if not silent[0] < time < silent[1]:
                climb = -2.0 * (time < 1.0)
                self.motion.take(reported(0.2 * time, 2.0 * min(time, 1.0), math.pi / 4,
                                      (0.2, 0.0, climb)), self.sent_ns)
        self.ahead.origin = self.motion.origin
        while self.led_ns + PERIOD + LATE * (self.led_ns > START) <= now:
            self.led_ns += PERIOD
            time = (self.led_ns - START) * 1e-9
            if not leader_silent[0] < time < leader_silent[1]:
                self.ahead.take(reported(2.0 + 0.3 * time, 2.0, velocity=(0.3, 0.0, 0.0)),
                                self.led_ns)

    def fly(self, seconds, engaged=False, silent=NEVER, leader_silent=NEVER):
        """Fly on; nothing is told from one moment of the flight to another, s."""
        end = self.flight.time_ns + round(seconds * 1e9)
        while self.flight.time_ns < end:
            self.report(START + self.flight.time_ns + STEP_NS + PERIOD, silent, leader_silent)
            self.odometry += [(stamp, state) for stamp, state in self.flight.after_step(engaged)]
            self.distances.append(self.flight.distance)
            frame = self.flight.look(self.flight.time_ns)
            if frame is not None:
                self.frames.append(frame)
        return self


def test_the_leader_comes_to_where_the_follower_is_once_it_is_in_offboard_mode(camera):
    flown = Elsewhere(camera).fly(1.5)
    assert math.isnan(flown.flight.distance)
    assert {frame.leader for frame in flown.frames} == {None}
    assert not any(frame.usable for frame in flown.frames)
    flown.vehicle.offboard = True
    flown.fly(0.2)
    frame = flown.frames[-1]
    # 1.5 m ahead of where it faced then, at its height, facing away from it as it did.
    offset = frame.leader.position - flown.vehicle.at(1_510_000_000).position
    assert offset == pytest.approx([1.5 * math.sqrt(0.5), 1.5 * math.sqrt(0.5), 0.0], abs=0.05)
    assert frame.leader.position[2] == pytest.approx(2.0, abs=0.02)
    assert yaw_from_quaternion(frame.leader.quaternion) == pytest.approx(math.pi / 4, abs=1e-6)
    assert flown.flight.began_ns is None and frame.usable
    flown.fly(0.1, engaged=True)
    assert flown.flight.time == pytest.approx(0.09, abs=0.011)


def test_a_scenario_that_has_not_begun_comes_anew_with_the_next_offboard_mode(camera):
    flown = Elsewhere(camera).fly(1.2)
    places = []
    for _ in range(2):
        flown.vehicle.offboard = True
        flown.fly(0.1)
        places.append(flown.frames[-1].leader.position)
        flown.vehicle.offboard = False
        flown.fly(0.5)
        assert flown.frames[-1].leader is None
    assert places[1] - places[0] == pytest.approx([0.0, 0.6 * 0.2, 0.0], abs=0.02)
    flown.vehicle.offboard = True
    flown.fly(0.2, engaged=True)
    flown.vehicle.offboard = False  # the pilot's switch, in the middle of it
    flown.fly(0.2, engaged=False)
    assert flown.frames[-1].leader is not None


def test_odometry_is_in_the_autopilots_heading_and_height(camera):
    flown = Elsewhere(camera).fly(2.0)
    stamp, state = flown.odometry[-1]
    assert stamp == flown.flight.time_ns
    assert state.position == pytest.approx([0.0, 0.4, 2.0], abs=0.03)
    assert yaw_from_quaternion(state.quaternion) == pytest.approx(math.pi / 4, abs=1e-6)
    assert quaternion_to_matrix(state.quaternion) @ state.linear == pytest.approx(
        [0.0, 0.2, 0.0], abs=0.01)


def test_where_no_poses_come_no_image_and_no_odometry_is_invented(camera):
    flown = Elsewhere(camera).fly(3.0, silent=(1.0, 1.8))
    stamps = np.array([stamp for stamp, _ in flown.odometry]) * 1e-9
    images = np.array([frame.stamp_ns for frame in flown.frames]) * 1e-9
    for times, spacing in ((stamps, 0.01), (images, 1 / 30)):
        assert not np.any((times > 1.0) & (times < 1.8 - 1e-9))
        others = times[(times < 1.0) | (times > 1.8)]
        assert np.count_nonzero(np.diff(others) > 1.5 * spacing) == 1
    assert flown.flight.skipped_images >= 23  # of 0.8 s


def test_a_leader_elsewhere_is_where_it_says_and_the_scenarios_does_not_fly(camera):
    flown = Elsewhere(camera, led=True).fly(1.5)
    assert flown.distances[-1] == pytest.approx(2.15, abs=0.02)
    flown.vehicle.offboard = True  # nothing is placed before the follower then
    flown.fly(1.0, engaged=True)
    assert flown.flight.time == pytest.approx(0.99, abs=0.02)
    for frame in flown.frames:
        north = 2.0 + 0.3 * frame.stamp_ns * 1e-9
        assert frame.leader.position == pytest.approx([0.0, north, 2.0], abs=0.012)  # 1e-7 deg
        assert quaternion_to_matrix(frame.leader.quaternion) @ frame.leader.linear == (
            pytest.approx([0.0, 0.3, 0.0], abs=1e-6))
        assert frame.usable
        # Nothing that the image shows was yet to be told.
        assert START + frame.stamp_ns + round(0.5e9 * SENSOR.exposure) <= flown.ahead.newest
    assert len(flown.frames) >= 73 and flown.flight.skipped_images == 0


def test_where_the_leaders_poses_stall_there_is_no_image_and_no_distance_but_odometry(camera):
    flown = Elsewhere(camera, led=True).fly(3.0, leader_silent=(1.0, 1.8))
    images = np.array([frame.stamp_ns for frame in flown.frames]) * 1e-9
    assert not np.any((images > 1.02) & (images < 1.8))
    assert np.count_nonzero(np.diff(images) > 1.5 / 30) == 1
    assert 22 <= flown.flight.skipped_images <= 25  # of 0.8 s
    assert np.diff([stamp for stamp, _ in flown.odometry]) == pytest.approx(STEP_NS)
    times = np.arange(1, len(flown.distances) + 1) * STEP_NS * 1e-9
    lost = times[np.isnan(flown.distances)]
    assert lost.min() == pytest.approx(1.15, abs=0.03) and lost.max() < 1.82
    assert flown.distances[-1] == pytest.approx(2.3, abs=0.02)
