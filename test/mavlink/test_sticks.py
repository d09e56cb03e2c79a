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

"""The pilot's sticks: which motion takes over, which does not, and what the bridge requests."""

from bridge_flight import Flight
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.gate.permission import Phase
from flock_follower.mavlink.parameter_check import ParameterCheck
from flock_follower.mavlink.sticks import needs_stick_handover, Sticks, StickWatch
from flock_follower.mavlink.telemetry import Telemetry

RATE = 10.0  # Hz
RC_LOST = 0
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
REST = Sticks(0.0, 0.0, 0.0, 0.0)
SIGNAL = 100  # strength
NOTHING = 65535


def manual_control(sticks):
    roll, pitch, yaw, throttle = (round(1000.0 * value) for value in sticks)
    return mavlink.MAVLink_manual_control_message(
        1, pitch, roll, round(0.5 * (throttle + 1000)), yaw, 0)


def rc_channels(sticks, rssi=SIGNAL, count=8):
    roll, pitch, yaw, throttle = (round(1500.0 + 500.0 * value) for value in sticks)
    return mavlink.MAVLink_rc_channels_message(
        0, count, roll, pitch, throttle, yaw, *[NOTHING] * 14, rssi)


BOTH = pytest.mark.parametrize('message', [manual_control, rc_channels])


def moved_after(samples, rest=REST, make=manual_control, threshold=0.3):
    """Return the time, s, after which sticks (n, 4) take over, None if they do not."""
    watch = StickWatch(threshold)
    watch.take(make(rest), 0.0)
    watch.begin(0.05)
    for number, sticks in enumerate(samples, 1):
        watch.take(make(Sticks(*sticks)), number / RATE)
        if watch.has_moved:
            return number / RATE
    return None


def motion(axis, values, rest=REST):
    """Return samples of one stick that moves through values; the others rest."""
    return [rest._replace(**{axis: float(value)}) for value in values]


def ramp(seconds, end, held=3.0, begin=0.0):
    times = np.arange(1, round((seconds + held) * RATE) + 1) / RATE
    return begin + (end - begin) * np.clip(times / seconds, 0.0, 1.0)


# What the pilot does.


@BOTH
@pytest.mark.parametrize('axis', ['roll', 'pitch', 'yaw'])
@pytest.mark.parametrize(('seconds', 'end', 'soonest', 'latest'), [
    (1.5, 0.9, 0.5, 0.8), (1.5, -0.9, 0.5, 0.8), (0.1, 0.9, 0.2, 0.2), (20.0, 0.5, 12.0, 12.3)])
def test_a_stick_takes_over_fast_or_slow(message, axis, seconds, end, soonest, latest):
    taken = moved_after(motion(axis, ramp(seconds, end)), make=message)
    assert soonest <= taken <= latest + 1e-9


@pytest.mark.parametrize('rest', [-1.0, 0.0, 0.4])
def test_throttle_takes_over_only_at_its_center(rest):
    still = REST._replace(throttle=rest)
    away = ramp(0.5, 0.9 if rest <= 0.0 else -0.9, begin=rest)
    away = away[np.abs(away) > 0.1]  # through the center between two messages
    assert moved_after(motion('throttle', away), still) is None
    back = [*away, *ramp(0.5, 0.05, begin=away[-1])]
    taken = moved_after(motion('throttle', back), still)
    assert len(away) / RATE < taken <= len(away) / RATE + 0.7


def test_a_throttle_that_rests_takes_over_at_no_place():
    for rest in (-1.0, -0.5, 0.0, 0.7):
        assert moved_after(motion('throttle', [rest] * 50), REST._replace(throttle=rest)) is None


@BOTH
def test_a_trim_offset_at_offboard_is_the_rest_position(message):
    trimmed = Sticks(0.28, -0.25, 0.29, -1.0)
    assert moved_after([trimmed] * 100, trimmed, message) is None
    assert moved_after(motion('roll', ramp(1.5, 0.9, begin=0.28), trimmed), trimmed, message)
    # Back to the center: still less than the threshold.
    assert moved_after(motion('roll', ramp(0.5, 0.0, begin=0.28), trimmed), trimmed) is None


@BOTH
@pytest.mark.parametrize('threshold', [0.2, 0.3])  # the least that is accepted, the default
@pytest.mark.parametrize('deviation', [0.005, 0.03])
def test_sticks_at_rest_raise_no_alarm_in_15_minutes(message, deviation, threshold):
    rng = np.random.default_rng(42)
    rest = Sticks(0.02, -0.05, 0.01, -0.6)
    steps = round(15 * 60 * RATE)
    noise = rng.normal(0.0, deviation, (steps, 4))
    drift = 0.03 * np.sin(np.arange(steps)[:, None] / 3000.0 + np.arange(4))
    glitches = rng.random(steps) < 1.0 / 60.0 / RATE  # one message per minute
    glitches[1:] &= ~glitches[:-1]
    samples = np.clip(np.array(rest) + noise + drift + glitches[:, None], -1.0, 1.0)
    assert glitches.sum() >= 5
    assert moved_after(samples, rest, message, threshold) is None


# What the line does.


@pytest.mark.parametrize('lost', [
    lambda sticks: (rc_channels(sticks, rssi=RC_LOST), False),
    lambda sticks: (rc_channels(sticks, count=0), False),
    lambda sticks: (mavlink.MAVLink_rc_channels_message(
        0, 8, 0, 0, 0, 0, *[NOTHING] * 14, SIGNAL), False),
    lambda sticks: (rc_channels(sticks), True)])
def test_a_lost_transmitter_takes_nothing_over(lost):
    watch = StickWatch(0.3)
    watch.take(rc_channels(REST), 0.0)
    watch.begin(0.05)
    for now in np.arange(0.1, 5.0, 0.1):
        watch.take(*(lost(Sticks(0.9, 0.9, 0.9, 0.0))[0], now), lost(REST)[1])
    watch.take(rc_channels(REST), 5.0)
    assert not watch.has_moved
    watch.take(rc_channels(Sticks(0.9, 0.0, 0.0, 0.0)), 5.1)
    assert not watch.has_moved  # one message
    watch.take(rc_channels(Sticks(0.9, 0.0, 0.0, 0.0)), 5.2)
    assert watch.has_moved


def test_an_invalid_manual_control_takes_nothing_over():
    watch = StickWatch(0.3)
    watch.take(manual_control(REST), 0.0)
    watch.begin(0.05)
    for now in (0.1, 0.2, 0.3):
        watch.take(mavlink.MAVLink_manual_control_message(1, *[32767] * 4, 0), now)
    assert not watch.has_moved


def test_messages_on_both_sides_of_a_gap_are_not_consecutive():
    watch = StickWatch(0.3)
    watch.begin(0.0)
    for now, roll, moved in ((0.0, 0.0, False), (0.1, 0.9, False), (1.2, 0.9, False),
                             (1.3, 0.9, True)):
        watch.take(manual_control(REST._replace(roll=roll)), now)
        assert watch.has_moved is moved, now


def test_receiver_values_do_not_count_beside_manual_control():
    watch = StickWatch(0.3)
    for now in np.arange(0.0, 1.0, 0.1):
        watch.take(manual_control(REST), now)
        watch.take(rc_channels(REST), now)
    watch.begin(1.0)
    for now in np.arange(1.0, 5.0, 0.1):  # MANUAL_CONTROL ends with the transmitter
        watch.take(rc_channels(Sticks(0.9, 0.9, 0.9, -1.0)), now)
    assert not watch.has_moved


# Where it acts.


def version(major, minor):
    return mavlink.MAVLink_autopilot_version_message(
        0, major << 24 | minor << 16 | 255, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0)


@pytest.mark.parametrize(('autopilot', 'reported', 'known', 'watched'), [
    (mavlink.MAV_AUTOPILOT_PX4, (1, 18), False, True),
    (mavlink.MAV_AUTOPILOT_PX4, (1, 16), True, False),
    (mavlink.MAV_AUTOPILOT_PX4, (2, 0), False, True),
    (mavlink.MAV_AUTOPILOT_PX4, None, True, True),
    (mavlink.MAV_AUTOPILOT_PX4, None, False, False),
    (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, (4, 7), True, False)])
def test_it_acts_where_slow_sticks_do_not_take_over(autopilot, reported, known, watched):
    telemetry, parameters = Telemetry(), ParameterCheck(())
    telemetry.update(mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, autopilot, 1, 0, 4, 3), 0.0)
    if reported:
        parameters.take_version(version(*reported))
    if known:
        parameters.values['MAN_OVERRIDE_SPD'] = 3.0
    assert needs_stick_handover(telemetry.dialect, parameters) is watched


def sticks_in_flight(minor, accepts):
    """Return a flight by setpoints in which a stick has been moved slowly."""
    flight = Flight()
    flight.controller._sticks = accepts

    def arrives(message):
        # Numbered with the others of the autopilot.
        flight.wire.arrived += flight.autopilot._packed([message])
    flight.fly(0.5)
    arrives(version(1, minor))
    arrives(manual_control(REST))
    flight.follow(1.0)
    flight.moved_at = flight.now
    for sticks in motion('roll', ramp(1.5, 0.9, held=2.0)):
        arrives(manual_control(sticks))
        flight.fly(1.0 / RATE)
    return flight


@pytest.mark.slow
@pytest.mark.parametrize(('accepts', 'mode'), [(True, 'POSCTL'), (False, 'AUTO.LOITER')])
def test_on_118_a_slow_stick_ends_the_flight_in_the_pilots_mode(accepts, mode):
    flight = sticks_in_flight(18, accepts)
    assert flight.mode == mode and flight.bridge.gate.permission.phase is Phase.TAKEN_OVER
    assert flight.bridge.state(flight.now) == (
        f'TAKEN_OVER: offboard was left for {mode}: the pilot moved a stick')
    assert 'the pilot took over' in flight.ask('offboard', True).message
    assert not flight.setpoints(flight.now - 1.0)


@pytest.mark.slow
def test_on_116_px4_decides_about_sticks_by_itself():
    flight = sticks_in_flight(16, True)
    assert flight.mode == 'OFFBOARD' and flight.kinds(20) == {'command'}
    assert not flight.commands(SET_MODE, flight.moved_at)


@pytest.mark.slow
def test_no_program_undoes_a_stick_that_no_mode_has_answered():
    flight = Flight().follow(1.0)
    flight.bridge.housekeeping.parameters.take_version(version(1, 18))
    flight.bridge.sticks.has_moved = True
    flight.fly(0.1)
    assert flight.bridge.gate.permission.phase is Phase.GIVING_BACK
    assert 'the pilot took over' in flight.bridge.requests.offboard_obstacle(flight.now)
    assert flight.kinds(1) == {'brake'}


@pytest.mark.slow
def test_the_end_of_the_bridge_does_not_undo_a_moved_stick():
    flight = Flight().follow(1.0)
    flight.controller._sticks = True
    flight.bridge.housekeeping.parameters.take_version(version(1, 18))
    flight.bridge.sticks.has_moved = True
    deadline = flight.now + 2.0
    while flight.mode != 'POSCTL' and flight.now < deadline:
        flight.fly(0.01)  # shorter than the period of HEARTBEAT
    assert flight.mode == 'POSCTL'
    flight.bridge.stop(flight.now)
    assert flight.bridge.gate.flies  # no HEARTBEAT has shown it yet
    flight.bridge.finish(flight.now)
    flight.bridge.cycle = lambda now: None  # the bridge is gone
    flight.fly(1.0)
    assert flight.mode == 'POSCTL'


def ends_by_itself(how):
    """Return a flight on 1.18 that the bridge is about to end by itself, and when, s."""
    flight = Flight()
    flight.controller._sticks = True
    flight.fly(0.5)
    flight.wire.arrived += flight.autopilot._packed([version(1, 18)])
    flight.follow(1.0)
    flight.wire.arrived += flight.autopilot._packed([manual_control(REST)])
    flight.fly(0.05)
    if how == 'land':
        flight.odom_error[0] = 3.0  # contradicted: neither velocity is used
        return flight, flight.now + 0.8
    flight.planner = None
    return flight, flight.now + 2.95


@pytest.mark.slow
@pytest.mark.parametrize('how', ['land', 'hold'])
@pytest.mark.parametrize('early', [0.25, 0.15, 0.05, -0.05, -0.5])
def test_a_stick_that_crosses_the_end_by_the_bridge_counts(how, early):
    flight, ends = ends_by_itself(how)
    flight.fly(ends - early - flight.now)
    for roll in [0.8] * 4 + [0.0] * 10:
        flight.wire.arrived += flight.autopilot._packed([
            manual_control(REST._replace(roll=roll))])
        flight.fly(1.0 / RATE)
    assert flight.mode == 'POSCTL'
    assert 'the pilot took over' in flight.ask('offboard', True).message


@pytest.mark.slow
@pytest.mark.parametrize('how', ['land', 'hold'])
def test_a_stick_moved_later_undoes_no_switch_to_hold(how):
    """The pilot switches away, flies by stick, and switches to the mode of the bridge."""
    flight, ends = ends_by_itself(how)
    flight.fly(ends + 0.5 - flight.now)
    assert flight.mode == (flight.modes.hold if how == 'hold' else flight.modes.land)
    flight.fly(1.0)
    for mode in ('POSCTL', flight.modes.hold, flight.modes.land):
        flight.controller.pilot_switches(mode)
        for _ in range(5):
            flight.wire.arrived += flight.autopilot._packed([
                manual_control(REST._replace(roll=0.8))])
            flight.fly(1.0 / RATE)
        assert flight.mode == mode


@pytest.mark.slow
def test_a_stick_that_moves_while_the_bridge_stops_counts():
    flight, _ = ends_by_itself('hold')
    flight.bridge.stop(flight.now)
    for _ in range(2):
        flight.wire.arrived += flight.autopilot._packed([
            manual_control(REST._replace(roll=0.8))])
        flight.fly(1.0 / RATE)
    assert flight.mode == 'OFFBOARD'  # nothing more is requested before the end
    flight.bridge.finish(flight.now)
    flight.bridge.cycle = lambda now: None  # the bridge is gone
    flight.fly(0.1)
    assert flight.mode == 'POSCTL'
