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

"""Flight without odometry: what the gate admits then, for how long, and after what."""

from dataclasses import replace
import math
import struct

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from situations import judge_situation

from flock_follower.gate.envelope import approach_speed, GateLimits, Location
from flock_follower.gate.gate import Gate
from flock_follower.gate.relative_flight import LONGEST_STEP, Reckoning, Relative
from flock_follower.gate.setpoint_rules import COMMAND, LEVEL, NONE
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.gate.velocity_check import known_motion, MotionReport, ODOM, SourceMotion
from flock_follower.geometry import quaternion_from_rpy
from flock_follower.mavlink.setpoint_encoding import encode_setpoint
from flock_follower.messages.commands import Command

LIMITS = GateLimits(relative_flight=True)
LOST = SourceMotion((0.3, 0.0, 0.0), 9.0), SourceMotion(), ODOM
FORWARD = Command((0.6, 0.0, 0.0), 1.0, relative=True)
OFFBOARD = VehicleStatus(True, 'OFFBOARD', True)
MANUAL = VehicleStatus(True, 'POSCTL', False)


def judge(limits=LIMITS, **changes):
    """Return the setpoint for a command on the marker alone, with some arguments changed."""
    arguments = {'known': known_motion(limits, *LOST), 'command': FORWARD,
                 'place': Location(2.0), 'relative': Relative(5.0)}
    return judge_situation(limits, **{**arguments, **changes})


def test_a_command_on_the_marker_alone_passes_as_it_is():
    setpoint = judge()
    assert (setpoint.kind, setpoint.yaw, setpoint.limited) == (COMMAND, 1.0, '')
    np.testing.assert_array_equal(setpoint.acceleration, FORWARD.acceleration)
    # In spite of velocities that contradict each other: neither is used.
    assert judge(known=known_motion(LIMITS, *LOST, disagreeing_for=9.0)).kind == COMMAND


@pytest.mark.parametrize(('change', 'reason'), [
    ({'limits': GateLimits()}, 'relative command not permitted'),
    ({'relative': Relative(math.nan)}, 'relative command not permitted'),
    ({'relative': Relative(30.1)}, 'relative command not permitted'),
    ({'source_age': 0.51}, 'marker lost'),
    ({'source_age': math.nan}, 'marker lost'),
    ({'place': Location(None)}, 'no height'), ({'place': Location(math.nan)}, 'no height'),
    ({'place': Location(2.0, math.inf)}, 'no height'), ({'airborne': False}, 'on the ground'),
    ({'unplaced': 'height stale'}, 'height stale'), ({'link_age': 1.01}, 'link lost'),
    ({'command_age': 0.21}, 'command stale'), ({'command_age': math.nan}, 'command stale'),
    ({'command': FORWARD._replace(acceleration=(0.1, math.nan, 0.0))}, 'command not finite'),
    ({'command': FORWARD._replace(yaw=math.inf)}, 'command not finite')])
def test_each_obstacle_ends_it_as_lost_odometry_does(change, reason):
    setpoint = judge(**change)
    assert (setpoint.kind, setpoint.reason) == (NONE, reason)


def test_while_it_begins_the_stream_goes_on_level():
    begun = Relative(0.1, True)
    assert judge(command=None, relative=begun).kind == LEVEL
    assert judge(command=None).kind == NONE


ANY = st.floats(allow_nan=True, allow_infinity=True, width=64)
COMPONENT = ANY | st.floats(-3.0, 3.0) | st.floats(-1e300, 1e300)


@settings(max_examples=200)
@given(st.tuples(COMPONENT, COMPONENT, COMPONENT), ANY | st.floats(-4.0, 4.0),
       st.floats(0.0, 12.0) | ANY, st.floats(-2.0, 2.0) | ANY, st.floats(-1.0, 40.0) | ANY,
       st.floats(-0.2, 1.0) | ANY, st.tuples(*[st.floats(-3.0, 3.0)] * 3),
       st.sampled_from([1.5, 2.5, 20.0]), st.booleans())
@example((0.0, 0.0, -1.0), 0.0, 0.9, 0.0, 1.0, 0.1, (0.0, 0.0, 0.0), 2.5, True)
@example((0.0, 0.0, 1.0), 0.0, 9.6, 0.0, 1.0, 0.1, (0.0, 0.0, 0.0), 2.5, True)
@example((1.5, 0.0, 0.0), 0.0, 5.0, 0.0, 1.0, 0.1, (0.0, 0.0, 0.0), 2.5, True)
@example((1.0, 0.0, 0.0), 0.0, 5.0, 0.0, 1.0, 0.1, (1.0, 0.0, 0.0), 1.5, True)
def test_acceleration_is_small_and_leads_into_heights(
        wanted, yaw, height, climb, lasted, marker_age, offset, a_max, airborne):
    limits = GateLimits(relative_flight=True, a_max=a_max)  # lowered in flight
    setpoint = judge(limits, full=replace(limits, a_max=20.0),
                     command=Command(wanted, yaw, relative=True), airborne=airborne,
                     place=Location(height, climb), offset=offset,
                     relative=Relative(lasted), source_age=marker_age)
    if setpoint.kind != COMMAND:
        assert not setpoint.acceleration.any()
        return
    assert 0.0 <= lasted <= 30.0 and -0.1 <= marker_age <= 0.5 and airborne
    sent = encode_setpoint(setpoint.acceleration, setpoint.yaw)
    north, east_sent, down = struct.unpack(
        '<3f', struct.pack('<3f', sent.afx, sent.afy, sent.afz))
    # The offset does not move the vehicle: it is beside the limit of the command.
    east, ahead, up = offset
    up = min(max(up, -1.2), 1.2)
    assert math.hypot(north, east_sent, down) <= a_max
    if math.hypot(*setpoint.acceleration) < a_max * (1.0 - 1e-6):
        flown = np.array(setpoint.acceleration) - (east, ahead, up)
        assert math.hypot(*flown) <= 1.0 + 1e-9
        # Towards a bound it never accelerates beyond the speed from which it stops.
        reached, braking = climb + limits.speed_horizon * flown[2], 0.4 * (1.0 - 1e-6)
        if flown[2] < 1.0 - 1e-6:
            assert reached >= -approach_speed(height - 1.0, braking) - 1e-5
        if flown[2] > -1.0 + 1e-6:
            assert reached <= approach_speed(9.5 - height, braking) + 1e-5


class Flown:
    """A gate in flight: time passes in cycles of 50 ms."""

    def __init__(self, limits=LIMITS):
        self.gate, self.now, self.odometry = Gate(limits), 10.0, True
        self.gate.take_height(2.0, self.now)
        self.gate.heights.refer(2.0, self.now)
        self.flown = []  # times of commands on the marker alone

    def permit(self):
        self.gate.permit(self.gate.permission.request(self.now - 0.001))

    def cycle(self, relative, status=OFFBOARD, command=True):
        self.now += 0.05
        gate, now = self.gate, self.now
        gate.take_status(status, now)
        gate.take_height(2.0, now)
        if self.odometry:
            gate.take_motion('odom', MotionReport((0.1, 0.0, 0.0)), 0.0, now)
        if command:
            gate.take_command(FORWARD._replace(relative=relative), 0.0, now, 0.1)
        setpoint = gate.decide(now)[0]
        if relative and setpoint.kind == COMMAND:
            self.flown.append(now)
        return setpoint

    def for_seconds(self, seconds, *args, **options):
        return [self.cycle(*args, **options) for _ in range(round(seconds / 0.05))][-1]


def test_it_begins_when_used_odometry_is_lost_ends_on_return():
    vehicle = Flown()
    vehicle.permit()
    vehicle.for_seconds(1.0, False)
    assert vehicle.gate.take_command(FORWARD, 0.0, vehicle.now) == 'relative: not permitted'
    vehicle.odometry = False
    assert vehicle.for_seconds(0.25, False).kind == COMMAND
    assert vehicle.for_seconds(0.2, True).kind == COMMAND
    assert vehicle.for_seconds(0.4, True, command=False).kind == LEVEL
    assert vehicle.for_seconds(20.0, True).kind == COMMAND
    motion = vehicle.gate.take_attitude(
        quaternion_from_rpy(0.0, 0.1, 0.5), np.zeros(3), vehicle.now, vehicle.now)
    assert (motion.frame, motion.position[2]) == ('flock_relative', 2.0)
    vehicle.odometry = True
    vehicle.for_seconds(0.9, True)
    assert vehicle.cycle(False).kind == COMMAND  # already
    vehicle.for_seconds(0.3, False)
    assert vehicle.gate.take_command(FORWARD, 0.0, vehicle.now) == 'relative: not permitted'


@pytest.mark.parametrize('limits', [LIMITS, GateLimits()])
def test_by_default_it_never_begins_and_the_loss_ends_as_before(limits):
    vehicle = Flown(limits)
    vehicle.permit()
    vehicle.for_seconds(1.0, False)
    vehicle.odometry = False
    vehicle.for_seconds(5.0, limits.relative_flight)
    assert vehicle.gate.permission.streams is limits.relative_flight


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(['odometry', 'none', 'takeover', 'offboard', 'silent']),
                          st.floats(0.1, 15.0)), max_size=10))
def test_it_ends_at_timeout_and_never_follows_a_takeover(events):
    vehicle = Flown(GateLimits(relative_flight=True, relative_timeout=8.0, blind_timeout=10.0))
    vehicle.permit()
    vehicle.for_seconds(1.0, False)
    for what, seconds in events:
        vehicle.odometry = what == 'odometry'
        if what == 'takeover':
            before = len(vehicle.flown)
            vehicle.for_seconds(seconds, True, MANUAL)
            vehicle.permit()
            vehicle.for_seconds(1.0, True)
            assert len(vehicle.flown) == before
            continue
        if what == 'offboard':
            vehicle.permit()
        vehicle.for_seconds(seconds, what != 'odometry', command=what != 'silent')
    flown = np.array(vehicle.flown)
    for start in flown[::20]:
        window = flown[(flown >= start) & (flown < start + 16.0)]
        assert 0.05 * len(window) <= 8.0 + 8.0 + 0.4
    breaks = np.flatnonzero(np.diff(flown) > 0.06)
    for span in np.split(flown, breaks + 1):
        assert len(span) == 0 or span[-1] - span[0] <= 8.0 + 1.1


def test_time_without_odometry_is_balanced_by_time_with_it():
    vehicle = Flown(GateLimits(relative_flight=True, relative_timeout=8.0, blind_timeout=10.0))
    vehicle.permit()
    vehicle.for_seconds(1.0, False)
    for with_odometry, kind in ((2.0, COMMAND), (2.0, LEVEL), (9.0, COMMAND)):
        vehicle.for_seconds(with_odometry, False)
        vehicle.odometry = False
        assert vehicle.for_seconds(6.0, True).kind == kind
        vehicle.odometry = True
        vehicle.cycle(False)


def test_displacement_mismatch_flies_without_odometry_then_ends():
    vehicle = Flown()
    vehicle.permit()
    for k in range(800):
        gate, now = vehicle.gate, vehicle.now
        gate.take_position('odom', np.array([0.0, 0.0, 0.3 * max(now - 15.0, 0.0)]), now)
        vehicle.cycle(k > 150)
        if now < 35.0:
            assert not gate.handover(now)
    assert len(vehicle.flown) > 300 and 'barometer' in gate.handover(now)


def test_the_motion_follows_tilt_and_height_and_leaks():
    level, tilted = Reckoning(1.0), Reckoning(1.0)
    lean = np.array([[math.cos(0.1), 0.0, math.sin(0.1)], [0.0, 1.0, 0.0],
                     [-math.sin(0.1), 0.0, math.cos(0.1)]])
    for k in range(100):
        level.step(np.eye(3), np.zeros(3), 2.0, 0.02 * k)
        tilted.step(lean, np.zeros(3), 1.0, 0.02 * k)
    tilted.step(lean, np.zeros(3), 1.0, 2.0 + 2.0 * LONGEST_STEP)  # a gap is not integrated
    np.testing.assert_allclose(tilted.velocity[:2], [9.80665 * math.tan(0.1) * 5.0 * (
        1.0 - math.exp(-1.98 / 5.0)), 0.0], rtol=0.01)
    assert not level.velocity[:2].any() and 1.3 < level.position[2] < 2.2
