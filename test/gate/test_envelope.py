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

"""The safety envelope: whatever is commanded, the vehicle stays inside, or is handed over."""

from dataclasses import fields
import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from situations import judge_situation

from flock_follower.gate.envelope import (
    approach_speed,
    find_exceeded_bound,
    GateLimits,
    inward,
    Location,
    refuse_height,
    vertical_range,
)
from flock_follower.gate.gate import Gate
from flock_follower.gate.permission import Permission
from flock_follower.gate.setpoint_rules import BRAKE, COMMAND
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.gate.velocity_check import MotionReport
from flock_follower.messages.commands import Command

FLOWN = VehicleStatus(True, 'OFFBOARD', True)
STEP, CYCLE = 0.01, 5  # 20 Hz
NOISE = 0.09


class FlownGate:
    """A gate, and a vehicle with a lag of 0.25 s that obeys it."""

    def __init__(self, limits, height=3.0, thrust_error=0.0):
        self.gate = Gate(limits, 'odom')
        self.gate.permit(Permission().request(-1.0))
        self.gate.take_status(FLOWN, 0.0)
        self.position, self.velocity = np.array([0.0, 0.0, height]), np.zeros(3)
        self.response, self.error = np.zeros(3), np.array([0.0, 0.0, thrust_error])
        self.commander, self.setpoint = None, None
        self.kinds, self.trace, self.rng = [], [], np.random.default_rng(3)
        self.handed_over = math.inf

    def fly(self, seconds):
        for _ in range(round(seconds / STEP)):
            self._step(STEP * len(self.trace), len(self.trace))
        return np.array(self.trace)

    def _step(self, now, steps):
        gate = self.gate
        if steps % 2 == 0:
            gate.take_motion('odom', MotionReport(self.velocity, position=self.position), 0.02,
                             now)
        if steps % CYCLE == 0:
            gate.take_height(self.position[2] + NOISE * self.rng.normal(), now)
            if steps == 200:
                gate.heights.refer(self.position[2], now)
            if self.commander is not None and steps % 10 == 0:
                gate.take_command(Command(self.commander(self), 0.0), 0.0, now)
            self.setpoint, _ = gate.decide(now)
            self.kinds.append(self.setpoint.kind)
            if gate.handover(now):
                self.handed_over = min(self.handed_over, now)
        self.response = self.response + (
            self.setpoint.acceleration - self.response) * STEP / 0.25
        self.velocity = self.velocity + STEP * (
            self.response + self.error - 0.1 * self.velocity)
        self.position = self.position + STEP * self.velocity
        self.trace.append(self.position)


def push(*acceleration):
    return lambda vehicle: np.array(acceleration)


@pytest.mark.parametrize(('v_max', 'seconds'), [
    (2.0, 15.0), *(pytest.param(v_max, 60.0, marks=pytest.mark.sweep) for v_max in (0.5, 5.0))])
@pytest.mark.parametrize(('towards', 'axis', 'sign', 'bound'), [
    (push(0, 0, -2.5), 2, -1, 0.5), (push(0, 0, 2.5), 2, 1, 10.0), (push(2.5, 0, 0), 0, 1, 20.0),
    (push(1.7, 0.0, -1.7), 2, -1, 0.5)])
def test_a_commander_that_keeps_pushing_stays_inside_by_a_margin(
        v_max, seconds, towards, axis, sign, bound):
    vehicle = FlownGate(GateLimits(v_max=v_max, radius_max=20.0))
    vehicle.fly(3.0)
    vehicle.commander = towards
    trace = vehicle.fly(seconds)
    assert np.max(sign * trace[:, axis]) < sign * bound + 0.15
    assert vehicle.handed_over == math.inf  # it stops in front of the bound
    assert abs(trace[-1, axis] - bound) < 0.3


@pytest.mark.parametrize('thrust_error', [-1.0, 0.0, 1.0])
def test_braking_holds_the_height_though_the_thrust_is_wrong(thrust_error):
    vehicle = FlownGate(GateLimits(), 3.0, thrust_error)
    # A planner that closes the height itself, as ours does.
    integral = [0.0]

    def follow(flown):
        integral[0] += 0.1 * (3.0 - flown.position[2])
        return np.array([0.2, 0.0, 2.25 * (3.0 - flown.position[2]) - 3.0 * flown.velocity[2]
                         + 1.5 * integral[0]])
    vehicle.commander = follow
    vehicle.fly(12.0)
    vehicle.commander, killed = None, vehicle.position[2]
    trace = vehicle.fly(15.0)[-1500:]
    assert set(vehicle.kinds[-280:]) == {BRAKE}
    assert np.max(np.abs(trace[:, 2] - killed)) < 0.3


@pytest.mark.parametrize('thrust_error', [-2.0, 2.0])
def test_a_thrust_that_cannot_be_offset_is_handed_over(thrust_error):
    vehicle = FlownGate(GateLimits(), 5.0, thrust_error)
    vehicle.fly(8.0)
    assert vehicle.handed_over < 8.0
    assert 'hover thrust is wrong' in vehicle.gate.thrust_error(8.0)


@pytest.mark.parametrize(('place', 'reason'), [
    (Location(0.2), 'height 0.20 m: below height_min = 0.5 m'),
    (Location(10.2), 'height 10.20 m: above height_max = 10 m'),
    (Location(None, 0.0, np.array([40.0, 31.0])), 'radius_max = 50 m'),
    (Location(0.4, 0.0, np.array([50.1, 0.0])), '')])  # tolerated
def test_the_reasons_name_the_parameter(place, reason):
    limits = GateLimits()
    exceeded = find_exceeded_bound(limits, place)
    assert reason in exceeded and bool(reason) == bool(exceeded)
    assert 'height_min' in refuse_height(limits, 0.4)
    assert 'height_max' in refuse_height(limits, 10.1)
    assert 'SCALED_PRESSURE' in refuse_height(limits, None) and refuse_height(limits, 2.0) == ''


@given(st.floats(0.0, 1e4), st.floats(0.01, 20.0))
def test_from_the_approach_speed_it_stops_before_the_bound(distance, deceleration):
    speed = approach_speed(distance, deceleration)
    flown = speed * 0.4 + speed ** 2 / (2.0 * deceleration)
    assert speed >= 0.0 and flown <= distance * (1.0 + 1e-9) + 1e-9


@pytest.mark.parametrize('place', [
    Location(), Location(None, 0.2), Location(math.nan, 0.0), Location(5.0, math.inf)])
def test_an_unknown_height_bounds_no_vertical_acceleration(place):
    assert vertical_range(GateLimits(), place, 0.1, 0.5, 2.5) == (-math.inf, math.inf)


def test_the_bounds_are_those_of_the_approach_speeds():
    limits, place = GateLimits(), Location(1.0, -0.2, np.array([0.0, 40.0]))
    braking = 0.4 * limits.a_max
    least, most = vertical_range(limits, place, 0.1, 0.5, limits.a_max)
    assert least == pytest.approx((-approach_speed(0.5, braking) + 0.2) / 0.5)
    assert most == pytest.approx((approach_speed(9.0, braking) - 0.1) / 0.5)
    assert approach_speed(9.0, 0.5) == pytest.approx(math.sqrt(0.2 ** 2 + 9.0) - 0.2)
    near = Location(1.0, -0.2, np.array([0.0, 24.0]))
    assert inward(limits, near, np.array([0.0, 0.5, 0.0]), 0.5) is None  # of a radius of 50 m
    normal, bound = inward(limits, place, np.array([0.0, 0.5, 0.0]), 0.5)
    assert normal == -1j
    assert bound == pytest.approx((0.5 - approach_speed(10.0, braking)) / 0.5)


def test_gate_on_ground_sends_nothing_upward_in_any_noise():
    limits = GateLimits()
    rng, gate = np.random.default_rng(5), Gate(limits, 'odom')
    gate.permit(Permission().request(-1.0))
    gate.take_status(FLOWN, 0.0, airborne=None)
    sent = []
    for k in range(400):
        now = 0.05 * k
        gate.take_motion('odom', MotionReport(0.02 * rng.normal(size=3)), 0.0, now)
        gate.take_height(0.1 * rng.normal(), now)
        if k == 20:
            gate.heights.refer(0.0, now)
        setpoint, _ = gate.decide(now)
        sent.append(setpoint)
        command = Command(rng.uniform(-2.0, 2.0, 3), 0.0)
        sent.append(judge_situation(limits, gate.motion.known_motion(limits, now), command=command,
                                    command_age=0.0, airborne=False, place=gate.place(now)))
    assert {COMMAND, BRAKE} == {setpoint.kind for setpoint in sent}
    assert max(setpoint.acceleration[2] for setpoint in sent) <= 0.0


def test_the_flight_defaults():
    assert {field.name: getattr(GateLimits(), field.name) for field in fields(GateLimits)} == {
        'a_max': 2.5, 'v_max': 0.5, 'planner_timeout': 0.2, 'odom_timeout': 0.3,
        'link_timeout': 1.0, 'blind_timeout': 2.0, 'speed_horizon': 0.3, 'brake_time': 0.3,
        'yaw_disagreement': 0.35, 'velocity_disagreement': 0.0,
        'height_min': 0.5, 'height_max': 10.0, 'radius_max': 50.0,
        'relative_flight': False, 'relative_timeout': 30.0}
    with pytest.raises(ValueError, match=r'height_max = 0.5: must be .* where height_min = 0.5'):
        GateLimits(height_max=0.5)


@pytest.mark.parametrize(('limits', 'tolerance'), [
    (GateLimits(), 0.4), (GateLimits(v_max=2.0), 1.0),
    (GateLimits(v_max=2.0, velocity_disagreement=0.7), 0.7)])
def test_allowed_velocity_difference_follows_v_max_unless_set(limits, tolerance):
    assert limits.velocity_tolerance == tolerance
