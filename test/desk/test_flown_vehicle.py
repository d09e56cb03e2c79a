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

"""A flight of a vehicle elsewhere: where the scenario is put, and what is not invented."""

import math

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.closed_loop.flown_vehicle import ExternalVehicle
from flock_desk.closed_loop.real_time_flight import (
    real_time_camera,
    RealTimeFlight,
    STEP_NS,
)
from flock_desk.external.told_motion import ExternalMotion
from flock_desk.scenarios.scenario import Scenario, Sensing, VioErrors
from flock_follower.geometry import quaternion_to_matrix, yaw_from_quaternion

pytestmark = pytest.mark.slow
START = 5_000_000_000  # ns, of the flight
EXACT = VioErrors(latency=(0.0, 0.0), **dict.fromkeys((
    'position_walk', 'height_walk', 'yaw_walk', 'position', 'tilt', 'tilt_bias', 'attitude',
    'velocity', 'velocity_white', 'gyro_bias', 'gyro'), 0.0))


@pytest.fixture(scope='module')
def camera():
    return real_time_camera(0)


class Elsewhere:
    """A vehicle that flies north at 0.2 m/s, facing north-east, as ground truth tells at 50 Hz."""

    def __init__(self, camera):
        self.motion = ExternalMotion()
        self.told_ns = START
        self.tell(START)
        self.vehicle = ExternalVehicle(self.motion, START, height=0.0)
        scenario = Scenario('test', 'for a test', sensing=Sensing(latency=(0.1, 0.1)),
                            odometry=EXACT)
        self.flight = RealTimeFlight(scenario, 0, self.vehicle, camera)
        self.odometry, self.frames = [], []

    def tell(self, now):
        seconds = (now - START) * 1e-9
        north = 0.2 * seconds
        yaw = math.pi / 4
        self.motion.take(mavlink.MAVLink_sim_state_message(
            math.cos(yaw / 2), 0, 0, math.sin(yaw / 2), 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
            488.0 + 2.0 * min(seconds, 1.0), 0, 0, 0.2, 0.0, -2.0 * (seconds < 1.0),
            round(474000000 + north / 111_320.0 * 1e7), 85000000), now)
        self.told_ns = now

    def fly(self, seconds, engaged=False, silent=(math.inf, math.inf)):
        """Fly on; nothing is told from one moment of the flight to another, s."""
        end = self.flight.time_ns + round(seconds * 1e9)
        while self.flight.time_ns < end:
            while self.told_ns < START + self.flight.time_ns + STEP_NS:
                self.told_ns += 20_000_000
                if not silent[0] < (self.told_ns - START) * 1e-9 < silent[1]:
                    self.tell(self.told_ns)
            self.odometry += [(stamp, state) for stamp, state in self.flight.after_step(engaged)]
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
    offset = frame.leader.position - flown.flight.truth(1_510_000_000).position
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
