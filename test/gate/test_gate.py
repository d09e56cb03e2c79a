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

"""The setpoint gate: what leaves, when it brakes, when it falls silent."""

import math

import numpy as np
import pytest

from flock_follower.gate.envelope import GateLimits
from flock_follower.gate.gate import Gate
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.gate.velocity_check import MotionReport
from flock_follower.messages.commands import Command

FORWARD = np.array([1.0, 0.0, 0.0])
LIMITS = GateLimits()
FLOWN = VehicleStatus(True, 'OFFBOARD', True)
NOT_FLOWN = VehicleStatus(True, 'POSCTL', False)


def fly(gate, now, status=FLOWN):
    """Permit setpoints, which the vehicle obeys unless its status says otherwise."""
    gate.permit(gate.permission.request(now - 0.001))
    gate.take_status(status, now)
    return gate


def flying_gate(limits=LIMITS, source='auto', now=0.0):
    return fly(Gate(limits, source), now)


def fresh_gate(now=10.0, velocity=(0.1, 0.0, 0.0), source='auto', limits=LIMITS):
    gate = flying_gate(limits, source, now)
    assert gate.take_motion('odom', MotionReport(velocity), 0.0, now) == ''
    gate.motion.take_yaw('odom', 0.5, now)
    assert gate.take_command(Command(FORWARD, 1.0), 0.0, now) == ''
    return gate


def decide(gate, now, **options):
    return gate.decide(now, **options)[0]


def test_a_fresh_command_passes_unchanged():
    decision = decide(fresh_gate(), 10.05)
    np.testing.assert_array_equal(decision.acceleration, FORWARD)
    assert (decision.kind, decision.yaw, decision.reason, decision.limited) == (
        'command', 1.0, '', '')
    # In auto only until odometry has been heard is the autopilot's velocity enough.
    gate = flying_gate()
    gate.take_motion('autopilot', MotionReport([0, 0, 0]), 0.0, 10.0)
    gate.take_command(Command(FORWARD, 1.0), 0.0, 10.0)
    assert decide(gate, 10.0).kind == 'command'
    gate.take_motion('odom', MotionReport([0, 0, 0]), 0.0, 9.0)
    assert decide(gate, 10.0).reason == 'velocity from odom stale'
    # A vehicle replayed on the desk is judged by its own velocity only.
    gate = fresh_gate(velocity=(3.0, 0, 0), source='autopilot')
    assert decide(gate, 10.0).reason == 'no velocity from autopilot'
    gate.take_motion('autopilot', MotionReport([0.0, 0.1, 0]), 0.0, 10.0)
    assert decide(gate, 10.0).kind == 'command'


@pytest.mark.parametrize(('age', 'until'), [(0.0, 10.2), (0.15, 10.05), (0.2, 10.0)])
def test_command_older_than_planner_timeout_is_replaced_by_brake(age, until):
    gate = fresh_gate()
    assert gate.take_command(Command(FORWARD, 1.0), age, 10.0) == ''
    gate.take_motion('odom', MotionReport([0.4, 0, 0]), 0.0, until)
    # A refused command does not extend the life of the one before.
    assert gate.take_command(Command([math.nan, 0, 0], 0.0), 0.0, until - 0.001) == 'not finite'
    assert decide(gate, until - 0.001).kind == 'command'
    decision = decide(gate, until + 0.001)
    assert (decision.kind, decision.reason) == ('brake', 'command stale')
    np.testing.assert_allclose(decision.acceleration, [-0.4 / 0.3, 0, 0])


def lost_odometry(command_time, now, autopilot=(-0.4, 0.0, 0.0), retreat=(-1.0, 0.0, 0.0)):
    """Return the decision of a gate whose odometry ended at 10 s, beside a leader that came."""
    gate = fresh_gate(limits=GateLimits(v_max=2.0))
    command = Command(FORWARD, 1.0, retreat=np.array(retreat))
    assert gate.take_command(command, 0.0, command_time) == ''
    if autopilot is not None:
        gate.take_motion('autopilot', MotionReport(autopilot), 0.0, now)
    return decide(gate, now)


def test_retreat_goes_on_without_odometry():
    for now in (10.31, 12.99):
        decision = lost_odometry(10.25, now)
        assert (decision.kind, decision.reason) == ('brake', 'velocity from odom stale')
        np.testing.assert_allclose(decision.acceleration, [-0.6 / 0.3, 0, 0])


@pytest.mark.parametrize(('command_time', 'now', 'autopilot', 'retreat', 'acceleration'), [
    (10.25, 13.01, (-0.4, 0.0, 0.0), (-1.0, 0.0, 0.0), 0.4 / 0.3),  # too long ago
    (9.95, 10.31, (-0.4, 0.0, 0.0), (-1.0, 0.0, 0.0), 0.4 / 0.3),  # the planner failed first
    (10.25, 10.31, (-0.4, 0.0, 0.0), (math.nan, 0.0, 0.0), 0.4 / 0.3),
    (10.25, 10.31, None, (-1.0, 0.0, 0.0), 0.0),  # without any velocity: level
    (10.25, 10.31, (-1.9, 0.0, 0.0), (-9.0, 0.0, 0.0), -0.1 / 0.3)])  # at most v_max
def test_the_retreat_without_odometry_ends(command_time, now, autopilot, retreat, acceleration):
    decision = lost_odometry(command_time, now, autopilot, retreat)
    np.testing.assert_allclose(decision.acceleration, [acceleration, 0, 0], atol=1e-6)


@pytest.mark.parametrize(('age', 'reason'), [
    (0.21, 'too old'), (3600.0, 'too old'), (-0.2, 'from the future'), (math.nan, 'not finite')])
def test_commands_with_impossible_stamps_are_refused(age, reason):
    gate = flying_gate()
    assert gate.take_command(Command(FORWARD, 0.0), age, 10.0) == reason
    decision = decide(gate, 10.0)  # without any velocity, and without a yaw
    assert (decision.kind, decision.yaw) == ('level', None)


@pytest.mark.parametrize(('source_age', 'reason'), [
    (2.4, ''), (2.6, 'resting on an old image'), (math.nan, 'resting on an old image')])
def test_a_command_that_rests_on_an_old_image_is_refused(source_age, reason):
    assert flying_gate().take_command(
        Command(FORWARD, 0.0), 0.0, 10.0, source_age=source_age) == reason


@pytest.mark.parametrize(('speed', 'reason'), [
    (100.1, 'too fast'), (1e300, 'too fast'), (math.inf, 'not finite'), (math.nan, 'not finite')])
def test_implausible_velocity_is_refused_last_one_counts(speed, reason):
    gate = fresh_gate()
    gate.take_command(Command(FORWARD, 1.0), 0.0, 10.0)
    assert gate.take_motion('odom', MotionReport([0.0, 0.0, -speed]), 0.0, 10.1) == reason
    assert decide(gate, 10.1).kind == 'command'
    assert decide(gate, 10.31).reason == 'velocity from odom stale'


def test_late_odometry_brakes_more_softly_from_its_stamp_on():
    gate = flying_gate(LIMITS, 'odom')
    assert gate.take_motion('odom', MotionReport([0.4, 0.0, 0.0]), 0.15, 10.0) == ''
    decision = decide(gate, 10.1)
    assert (decision.kind, decision.reason) == ('brake', 'no command')
    np.testing.assert_allclose(decision.acceleration, [-0.4 / (0.3 + 0.2 * math.e), 0, 0])


def test_only_accepted_command_asks_for_one_decision_at_once():
    gate = flying_gate()
    assert gate.take_command(Command(FORWARD, 0.0), 0.3, 10.0) == 'too old'
    assert not gate.commands.is_new
    assert gate.take_command(Command(FORWARD, 0.0), 0.0, 10.0) == ''
    assert gate.commands.is_new
    # Once, though it is not sent: without a velocity the gate levels the vehicle.
    assert decide(gate, 10.0).kind == 'level' and not gate.commands.is_new
    gate.permit(gate.permission.end('hold'))
    assert gate.take_command(Command(FORWARD, 0.0), 0.0, 10.0) == 'while GIVING_BACK'
    assert not gate.commands.is_new


@pytest.mark.parametrize(('flown', 'yaws'), [(True, (0.7, 0.7)), (False, (0.7, 0.9))])
def test_yaw_is_held_from_braking_once_obeyed(flown, yaws):
    gate = fresh_gate() if flown else fly(Gate(), 10.0, NOT_FLOWN)
    for now, yaw, expected in zip((10.25, 10.3), (0.7, 0.9), yaws):
        gate.motion.take_yaw('autopilot', yaw, now)
        assert decide(gate, now).yaw == pytest.approx(expected)


def test_yaws_are_compared_at_the_time_of_the_odometry():
    gate = Gate()
    for now in np.arange(10.0, 10.5, 0.02):
        gate.motion.take_yaw('autopilot', now - 10.0, now)  # it turns at 1 rad/s
    gate.motion.take_yaw('odom', 0.23, 10.23)
    assert gate.yaw_difference(10.48) == pytest.approx(0.0, abs=0.02)


def test_a_height_that_ceases_hands_the_vehicle_over():
    gate = fresh_gate()
    for now in np.arange(10.0, 11.0, 0.05):
        gate.take_height(2.0, now)
        gate.heights.refer(1.0, now)
        decide(gate, now)
    for now in np.arange(11.0, 14.9, 0.05):
        decide(gate, now, link_age=0.0 if now > 12.5 else 1.1)
        assert gate.handover(now) == ('no height from the autopilot' if now > 14.5 else '')


@pytest.mark.parametrize(('axis', 'fused', 'distrusted', 'other'), [
    (0, False, '', 'autopilot'), (2, True, '', 'barometer'),
    # An estimate that rests on the odometry, or on nothing, proves nothing.
    (0, True, '', ''), (0, False, 'rests on GPS, whose fix is lost', '')])
def test_displacement_mismatch_brakes_and_hands_over(
        axis, fused, distrusted, other):
    gate, kinds, handovers = fresh_gate(), [], []
    gate.autopilot = gate.autopilot._replace(fused=fused)
    for now in np.arange(10.0, 20.0, 0.05):
        gate.take_motion('odom', MotionReport([0.0, 0.0, 0.0]), 0.0, now)
        gate.take_position('odom', 0.3 * (now - 10.0) * np.eye(3)[axis], now)
        gate.take_position('autopilot', np.zeros(3), now)
        gate.take_height(2.0, now)
        gate.take_command(Command(FORWARD, 1.0), 0.0, now)
        decision = decide(gate, now, distrusted=distrusted)
        kinds.append(decision.kind)
        handovers.append(bool(gate.handover(now)))
    assert (decision.kind == 'brake') == bool(other)
    assert other in decision.reason and other in gate.handover(now)
    if other:  # it brakes for a second before
        assert handovers.index(True) - kinds.index('brake') == pytest.approx(20, abs=1)


@pytest.mark.parametrize(('height', 'climb', 'end'), [
    (1.5, 0.0, ''),  # a wall below, or a door
    (0.0, 2.5, 'displacements')])
def test_a_jump_of_the_sensor_alone_is_no_displacement(height, climb, end):
    gate, handovers = fresh_gate(), []
    for now in np.arange(10.0, 20.0, 0.05):
        later = max(now - 14.0, 0.0)
        gate.take_motion('odom', MotionReport(
            [0.0, 0.0, climb * (later > 0.0)], 0.5, [0.0, 0.0, climb * later]), 0.0, now)
        gate.take_height(2.0 + height * (later > 0.0), now)
        gate.take_command(Command(FORWARD, 1.0), 0.0, now)
        decide(gate, now)
        handovers.append(gate.handover(now))
    assert (gate.heights.stepped > 14.0) == bool(height)  # else odometry has stepped
    assert next(filter(None, handovers), '').startswith(end) and bool(end) == any(handovers)
    assert not any(handovers[:81])


@pytest.mark.parametrize(('latency', 'late'), [(0.12, False), (0.18, True)])
def test_odometry_late_at_setpoints_of_a_flight_is_named(latency, late):
    gate = fresh_gate()
    for now in np.arange(10.0, 30.0, 0.05):
        gate.take_motion('odom', MotionReport((0.0, 0.0, 0.0)), latency, now)
        decide(gate, now)
        if now == 10.0:
            assert gate.motion.lateness() == ''  # one late message is none
    assert ('0.18 s old' in gate.motion.lateness()) == late


def test_a_velocity_that_comes_late_replaces_no_newer_one():
    gate = fresh_gate()
    assert gate.take_motion('odom', MotionReport((0.9, 0.0, 0.0)), 0.2, 10.0) == ''
    assert gate.speed(10.0) == pytest.approx(0.1)


def along(gate, source, start, velocity, begin, seconds, offset=0.0):
    """Fly along x by a source's positions; return the last of them, m, and its time, s."""
    for now in np.arange(begin, begin + seconds, 0.05):
        x = start + velocity * (now - begin)
        gate.take_motion(source, MotionReport(
            [velocity, 0.0, 0.0], 0.0, [x - offset, 0.0, 2.0]), 0.0, now)
        decide(gate, now)
    return x, now


@pytest.mark.parametrize(('pause', 'velocity'), [(0.1, 0.5), (0.6, 0.5), (2.9, 0.0), (2.9, 0.5)])
def test_odometry_that_starts_anew_keeps_the_radius(pause, velocity):
    gate = fly(Gate(LIMITS), 10.0)
    x, now = along(gate, 'odom', 0.0, 1.0, 10.0, 30.0)
    along(gate, 'odom', x, velocity, now + pause, 1.0, offset=x)
    far = x + velocity * (pause + 1.0)
    assert gate.place(now + pause).offset[0] == pytest.approx(far, abs=1.5)


@pytest.mark.parametrize('pause', [0.6, 2.5])
@pytest.mark.parametrize('restarts', [True, False])
def test_autopilot_shows_the_motion_while_odometry_pauses(pause, restarts):
    gate = fly(Gate(LIMITS), 10.0)
    for now in np.arange(10.0, 25.0 + pause, 0.05):
        x = 0.5 * min(now - 10.0, 14.0)  # a stop during the pause
        gate.take_motion('autopilot', MotionReport(
            [0.5 * (now < 24.0), 0.0, 0.0], 0.0, [x + 7.0, 3.0, 2.0]), 0.0, now)
        if not 23.8 < now < 23.8 + pause:
            origin = 6.5 if restarts and now > 23.8 else 0.0
            gate.take_motion('odom', MotionReport(
                [0.5 * (now < 24.0), 0.0, 0.0], 0.0, [x - origin, 0.0, 2.0]), 0.0, now)
        decide(gate, now)
    assert gate.place(now).offset[0] == pytest.approx(7.0, abs=0.1)


@pytest.mark.parametrize('turn', [-0.3, 0.0, 0.3])
def test_motion_in_a_pause_counts_in_the_frame_of_odometry(turn):
    """The frame of the autopilot may be turned against it by up to ``yaw_disagreement``."""
    gate = fly(Gate(GateLimits(v_max=2.0)), 10.0)
    ahead = np.array([math.cos(turn), math.sin(turn), 0.0])
    for now in np.arange(10.0, 16.0, 0.05):
        x = 2.0 * (now - 10.0)
        gate.take_motion('autopilot', MotionReport(2.0 * ahead, turn, x * ahead), 0.0, now)
        if not 12.0 < now < 14.5:
            gate.take_motion('odom', MotionReport([2.0, 0.0, 0.0], 0.0, [x, 0.0, 0.0]), 0.0, now)
        decide(gate, now)
    assert gate.place(now).offset == pytest.approx([x, 0.0], abs=0.1)


def test_motion_while_odometry_pauses_is_no_jump():
    gate = fly(Gate(LIMITS), 10.0)
    x, now = along(gate, 'odom', 0.0, 2.0, 10.0, 5.0)
    # It brakes by 2 m/s^2.
    along(gate, 'odom', x + 1.0, 0.0, now + 1.5, 0.2)
    assert gate.place(now + 1.5).offset[0] == pytest.approx(x + 1.0)


def test_odometry_that_comes_in_flight_keeps_the_radius():
    gate = fly(Gate(LIMITS), 10.0)
    x, now = along(gate, 'autopilot', 100.0, 1.0, 10.0, 20.0)
    x, now = along(gate, 'odom', x, 1.0, now + 0.05, 5.0, offset=500.0)
    assert gate.place(now).offset[0] == pytest.approx(x - 100.0, abs=0.1)


def test_command_is_accepted_only_while_active():
    gate = Gate(LIMITS)
    assert gate.take_motion('odom', MotionReport((0.1, 0.0, 0.0)), 0.0, 10.0) == ''
    gate.take_status(FLOWN, 10.0)
    assert gate.take_command(Command(FORWARD, 1.0), 0.0, 10.0) == 'while INACTIVE'
    assert gate.decide(10.0)[0].kind == 'none'
    gate.permit(gate.permission.request(10.0))
    assert gate.take_command(Command(FORWARD, 1.0), 0.0, 10.0) == 'while READY'
    gate.take_status(FLOWN, 10.01)
    assert gate.take_command(Command(FORWARD, 1.0), 0.0, 10.02) == ''
    assert gate.decide(10.03)[0].kind == 'command'
    gate.permit(gate.permission.end('hold'))
    gate.permit(gate.permission.request(10.04))
    gate.take_status(FLOWN, 10.05)
    assert gate.permission.phase.name == 'ACTIVE'
    assert gate.decide(10.06)[0].kind == 'brake'
    gate.decide(13.0)  # without any velocity since
    assert gate.permission.reason == 'fell silent: velocity from odom stale'


def test_a_silence_without_the_mode_hides_no_takeover():
    gate = fresh_gate()
    assert decide(gate, 13.2, link_age=3.2, mode_age=3.2).kind == 'none'
    gate.take_status(NOT_FLOWN, 14.0)
    assert gate.permission.takeover_refusal(23.9)
