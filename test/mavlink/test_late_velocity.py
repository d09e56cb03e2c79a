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

"""Telemetry that is late: how late it is known to be, and what the vehicle does then."""

from collections import deque

from bridge_flight import Flight
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.vehicles.mavlink_vehicle import STEP
from flock_follower.mavlink.housekeeping import TimeSync

pytestmark = pytest.mark.slow
BOOT = 1234.5  # s on our clock, when the autopilot booted
LIMIT = 0.5  # m/s, v_max


class Clocks:
    """A TimeSync and an autopilot; times are s on our clock, delays those of the line."""

    def __init__(self, speed=1.0, boot=BOOT):
        self.sync = TimeSync()
        self.speed = speed
        self.boot = boot

    def theirs(self, time):
        return self.speed * (time - self.boot)

    def ask(self, time, up=0.004, down=0.004):
        question = self.sync.question(round(time * 1e9))
        written = round(self.theirs(time + up) * 1e9)
        assert self.sync.take(mavlink.MAVLink_timesync_message(written, question.ts1),
                              round((time + up + down) * 1e9)) is None

    def age(self, time, down=0.004):
        """Return the age of what is received at a time."""
        stamp = round(self.theirs(time - down) * 1e3) % 2**32
        return self.sync.age(stamp, round(time * 1e9))


def test_the_age_is_the_way_down_and_the_quickest_way_up():
    clocks = Clocks()
    for time, up in ((2000.0, 0.08), (2001.0, 0.02), (2002.0, 0.3)):
        clocks.ask(time, up=up, down=0.1)
    for down in (0.0, 0.03, 0.5, 2.0):
        assert clocks.age(2002.5, down) == pytest.approx(down + 0.02, abs=1e-3)


def test_a_line_that_was_late_from_the_start_is_known_to_be_late():
    clocks = Clocks()
    for time in (2000.0, 2001.0):
        clocks.ask(time, down=1.5)
    assert clocks.age(2004.0, 1.5) == pytest.approx(1.504, abs=1e-3)


def test_before_the_second_answer_nothing_is_known():
    clocks = Clocks()
    assert clocks.age(2000.2, 0.55) == 0.0
    clocks.ask(2000.3)  # a single one cannot tell the speed of a clock
    assert clocks.age(2000.4, 0.55) == 0.0
    clocks.ask(2001.3)
    assert clocks.age(2001.4, 0.55) == pytest.approx(0.554, abs=2e-3)
    clocks.sync.forget()
    assert clocks.age(2001.5, 0.55) == 0.0


@pytest.mark.parametrize('ahead', [1.0, 3600.0, 1e6])
def test_stamps_of_another_clock_than_the_answers_tell_nothing(ahead):
    clocks = Clocks()
    for time in (2000.0, 2001.0):
        clocks.ask(time)
    clocks.boot -= ahead
    assert clocks.age(2001.5) == 0.0


@pytest.mark.parametrize('late', [9.0, 11.0, 3600.0])
def test_what_is_late_by_any_time_is_not_fresh(late):
    clocks = Clocks(boot=-10_000.0)
    for time in (2000.0, 2001.0):
        clocks.ask(time)
    assert clocks.age(2001.5, late) == pytest.approx(late + 0.004, abs=2e-3)


def test_answers_that_have_ceased_are_no_longer_believed():
    clocks = Clocks()
    for time in (2000.0, 2001.0):
        clocks.ask(time)
    assert clocks.age(2002.0, 0.1) == pytest.approx(0.104, abs=1e-3)
    assert clocks.age(2029.0, 0.2) == pytest.approx(0.204, abs=1e-3)
    assert clocks.age(2031.5, 0.2) == 0.0


@pytest.mark.parametrize('speed', [0.1, 0.5, 0.9, 0.98, 1.02, 1.5, 10.0])
def test_a_simulator_that_is_slower_or_faster_than_time_is_not_late(speed):
    clocks = Clocks(speed)
    for second in range(30):
        clocks.ask(2000.0 + second)
        for tenth in range(1, 11):
            age = clocks.age(2000.0 + second + 0.1 * tenth)
            assert second < 2 or age < 0.05


def test_a_clock_that_drifts_as_crystals_do_is_followed():
    clocks = Clocks(1.0 - 1e-4)
    for second in range(100):
        clocks.ask(2000.0 + second, up=0.002)
        assert second == 0 or clocks.age(2000.5 + second, 0.2) == pytest.approx(0.202, abs=3e-3)


def test_nothing_is_as_good_as_new_where_the_stamps_say_nothing():
    clocks = Clocks()
    for time in (2000.0, 2001.0):
        clocks.ask(time)
    assert clocks.sync.age(0, round(2001.5e9)) == 0.0  # which autopilots do that do not stamp
    assert clocks.age(2001.5, -3.0) == 0.0  # from the future


def test_stamps_begin_again_after_fifty_days():
    clocks = Clocks(boot=2000.5 - 2**32 * 1e-3)
    for time in (1999.0, 2001.0):
        clocks.ask(time)
    for time in (2000.3, 2000.6, 2002.0):  # sent before, and just after
        assert clocks.age(time, 0.25) == pytest.approx(0.254, abs=1e-3)


def flown(flight, seconds, planner=None):
    """Return the speeds north, m/s, of each step; odometry is given by ``flight.look``."""
    speeds = []
    for _ in range(round(seconds / STEP)):
        flight.planner = planner
        flight.fly(STEP)
        speeds.append(flight.vehicle.velocity[1])
    return np.array(speeds)


NORTH = np.array([0.0, 2.5, 0.0])


@pytest.mark.parametrize('late', [0.5, 1.0])
@pytest.mark.parametrize('personality', ['px4', 'arducopter'])
def test_a_link_that_turns_late_is_judged_stale_and_the_vehicle_does_not_swing(personality, late):
    flight = Flight(personality, source='autopilot', start='airborne',
                    faults=[Fault('delay', 4.0, 60.0, 'sent', by=late)])
    flight.odometry = False
    flight.engage()
    speeds = np.concatenate([flown(flight, 6.0, NORTH), flown(flight, 6.0)])
    assert 0.9 * LIMIT < speeds.max() < 1.2 * LIMIT and speeds.min() > -0.1
    assert abs(flight.vehicle.velocity[1]) < 0.1
    assert 'velocity from autopilot stale' in {c.setpoint.reason for c in flight.cycles}
    assert flight.bridge.alive(flight.now)
    assert flight.bridge.link.ignored['LOCAL_POSITION_NED too old'] > 50


def test_a_link_that_is_late_from_the_start_gives_no_velocity_to_fly_with():
    flight = Flight(source='autopilot', start='airborne',
                    faults=[Fault('delay', 0.0, 60.0, 'sent', by=0.5)])
    flight.odometry = False
    flight.fly(5.0)
    outcome = flight.ask('offboard', True)
    assert not outcome.success and 'no velocity known' in outcome.message


@pytest.mark.parametrize('late', [0.1, 0.2, 0.28])
@pytest.mark.parametrize('personality', ['px4', 'arducopter'])
def test_odometry_that_is_late_and_says_so_neither_swings_nor_speeds(personality, late):
    flight = Flight(personality, start='airborne')
    flight.odometry = False
    on_the_way = deque()
    fly = flight.fly

    def fly_with_late_odometry(seconds):
        for _ in range(round(seconds / STEP)):
            on_the_way.append((flight.now, flight.vehicle.velocity.copy(), flight.vehicle.yaw))
            while on_the_way and on_the_way[0][0] <= flight.now - late + 1e-9:
                time, velocity, yaw = on_the_way.popleft()
                flight.bridge.on_odometry(velocity, yaw, flight.now - time, flight.now)
            fly(STEP)
    flight.fly = fly_with_late_odometry
    flight.engage()
    speeds = flown(flight, 5.0, NORTH)
    assert speeds.max() < 1.25 * LIMIT and np.ptp(speeds[200:]) < 0.1
    braking = flown(flight, 5.0)
    assert braking.min() > -0.15 and np.abs(braking[200:]).max() < 0.06
