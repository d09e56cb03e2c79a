"""A leader that is flown elsewhere: seen where it truly is, and nowhere else."""

import math

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.closed_loop.flown_leader import ExternalLeader
from flock_desk.closed_loop.flown_vehicle import ExternalVehicle
from flock_desk.closed_loop.real_time_flight import (
    real_time_camera,
    RealTimeFlight,
    SENSOR,
    STEP_NS,
)
from flock_desk.external.told_motion import ExternalMotion
from flock_desk.scenarios.leader_motion import LeaderMotion
from flock_desk.scenarios.scenario import Scenario, Sensing
from flock_follower.geometry import quaternion_to_matrix

pytestmark = pytest.mark.slow
START = 5_000_000_000  # ns, of the flight
HALF_EXPOSURE = round(0.5e9 * SENSOR.exposure)
GROUND = 488.0  # m above the sea
PERIOD = 20_000_000  # ns between poses of each


@pytest.fixture(scope='module')
def camera():
    return real_time_camera(0)


def told(north, up, velocity=0.0):
    """Return the truth of a vehicle that faces north and flies there."""
    return mavlink.MAVLink_sim_state_message(
        1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, GROUND + up, 0, 0, velocity, 0.0, 0.0,
        round(474000000 + north / 111_320.0 * 1e7), 85000000)


class Pair:
    """
    A follower that hovers at 1.5 m, its leader 2 m before it flying north at 0.3 m/s.

    The leader's poses come 13 ms after those of the follower, and not at all while it is silent.
    """

    def __init__(self, camera, **fields):
        self.follower, self.leader = ExternalMotion(), ExternalMotion()
        self.follower.take(told(0.0, 0.0), START)
        self.leader.origin = self.follower.origin
        self.leader.take(told(2.0, 0.0, 0.3), START)
        vehicle = ExternalVehicle(self.follower, START, height=1.5)
        self.flight = RealTimeFlight(
            Scenario('test', 'for a test', sensing=Sensing(latency=(0.1, 0.1)),
                     leader=LeaderMotion(motion='circle', speed=1.0, wait=0.0), **fields),
            0, vehicle, camera, 70_000_000,
            ExternalLeader(self.leader, START, vehicle.origin))
        self.told, self.led = START, START + 13_000_000 - PERIOD
        self.odometry, self.frames, self.distances = [], [], []

    def fly(self, seconds, engaged=False, silent=(math.inf, math.inf)):
        end = self.flight.time_ns + round(seconds * 1e9)
        while self.flight.time_ns < end:
            now = START + self.flight.time_ns + STEP_NS
            while self.told < now:
                self.told += PERIOD
                self.follower.take(told(0.0, 0.0), self.told)
            while self.led + PERIOD <= now:
                self.led += PERIOD
                at = (self.led - START) * 1e-9
                if not silent[0] < at < silent[1]:
                    self.leader.take(told(2.0 + 0.3 * at, 0.0, 0.3), self.led)
            self.odometry += [stamp for stamp, _ in self.flight.after_step(engaged)]
            self.distances.append(self.flight.distance)
            frame = self.flight.look(self.flight.time_ns)
            if frame is not None:
                # Nothing that the image shows was yet to be told.
                assert START + frame.stamp_ns + HALF_EXPOSURE <= self.leader.newest
                self.frames.append(frame)
        return self


def test_the_leader_is_where_it_says_and_the_scenarios_does_not_fly(camera):
    flown = Pair(camera).fly(0.5)
    assert flown.distances[-1] == pytest.approx(2.15, abs=0.02)
    flown.flight.vehicle.offboard = True  # nothing is placed before the follower then
    flown.fly(2.0, engaged=True)
    assert flown.flight.time == pytest.approx(1.99, abs=0.02)
    for frame in flown.frames:
        north = 2.0 + 0.3 * frame.stamp_ns * 1e-9
        assert frame.leader.position == pytest.approx([0.0, north, 1.5], abs=0.012)  # 1e-7 deg
        assert quaternion_to_matrix(frame.leader.quaternion) @ frame.leader.linear == (
            pytest.approx([0.0, 0.3, 0.0], abs=1e-6))
        assert frame.usable
    assert len(flown.frames) >= 73 and flown.flight.skipped_images == 0
    assert np.isfinite(flown.distances).all()


def test_where_the_leaders_poses_stall_there_is_no_image_and_no_distance_but_odometry(camera):
    flown = Pair(camera).fly(3.0, silent=(1.0, 1.8))
    images = np.array([frame.stamp_ns for frame in flown.frames]) * 1e-9
    assert not np.any((images > 1.02) & (images < 1.8))
    assert np.count_nonzero(np.diff(images) > 1.5 / 30) == 1
    assert 22 <= flown.flight.skipped_images <= 25  # of 0.8 s
    assert np.diff(flown.odometry) == pytest.approx(STEP_NS)
    times = np.arange(1, len(flown.distances) + 1) * STEP_NS * 1e-9
    lost = times[np.isnan(flown.distances)]
    assert lost.min() == pytest.approx(1.15, abs=0.03) and lost.max() < 1.82
    assert flown.distances[-1] == pytest.approx(2.9, abs=0.02)
