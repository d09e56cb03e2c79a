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

"""External vision, barometer, battery and home of the embedded autopilots."""

import math

from embedded_flight import BLIND, Flight, odometry, seen, setpoint
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.vehicles.estimator import Barometer, GROUND_AMSL

pytestmark = pytest.mark.slow
BOTH = pytest.mark.parametrize('personality', ['px4', 'arducopter'])


def height(message):
    """Return the height above the ground, m, that a SCALED_PRESSURE means."""
    return (1.0 - (message.press_abs / 1013.25) ** 0.190263) * 288.15 / 0.0065 - GROUND_AMSL


@pytest.mark.parametrize(('personality', 'options', 'used'), [
    ('px4', {'frame': mavlink.MAV_FRAME_LOCAL_NED}, True), ('px4', {}, True),
    ('px4', {'variance': math.nan}, False), ('px4', {'variance': 0.0}, False),
    ('px4', {'child': mavlink.MAV_FRAME_LOCAL_FRD}, False),
    ('px4', {'error': (math.nan, 0.0, 0.0)}, False),
    ('px4', {'frame': mavlink.MAV_FRAME_BODY_FRD}, False),
    ('arducopter', {}, True), ('arducopter', {'variance': math.nan}, True),
    ('arducopter', {'frame': mavlink.MAV_FRAME_LOCAL_NED}, False),
    ('arducopter', {'child': mavlink.MAV_FRAME_BODY_NED}, False)])
def test_odometry_counts_only_in_the_frames_the_autopilot_wants(personality, options, used):
    flight = Flight(personality, start='landed', parameters=BLIND[personality])
    flight.fly(1.0, seen(flight, **options))
    # PX4 sends it without a position, too.
    assert bool(flight.all('LOCAL_POSITION_NED')) == (used or personality == 'px4')
    if personality == 'arducopter':
        flight.mode('GUIDED')
    else:
        flight.take_off(math.nan)
    assert (flight.arm() == [0]) == used


@BOTH
def test_the_estimate_follows_the_vision_even_if_it_is_wrong(personality):
    flight = Flight(personality, parameters=BLIND[personality])
    flight.fly(3.0, seen(flight, error=np.array([3.0, 0.0, 0.5]), yaw_error=0.5), rate=30.0)
    position, truth = flight.last('LOCAL_POSITION_NED'), flight.vehicle.position
    assert position.y == pytest.approx(truth[0] + 3.0, abs=0.1)
    assert -position.z == pytest.approx(truth[2] + 0.5, abs=0.1)
    attitude = flight.last('ATTITUDE_QUATERNION')
    assert 2 * math.atan2(attitude.q4, attitude.q1) == pytest.approx(
        math.pi / 2 - flight.vehicle.yaw - 0.5, abs=0.05)


@pytest.mark.parametrize(('personality', 'barometer'), [
    ('px4', {'EKF2_HGT_REF': 0}), ('arducopter', {'EK3_SRC1_POSZ': 1})])
def test_height_by_barometer_follows_velocity_of_vision(personality, barometer):
    flight = Flight(personality, parameters={**BLIND[personality], **barometer})
    flight.fly(1.0, seen(flight, error=(0.0, 0.0, 0.5)), rate=30.0)
    before = flight.last('LOCAL_POSITION_NED').z + flight.vehicle.position[2]
    assert abs(before) < 0.05  # not its height
    flight.fly(5.0, lambda: odometry(flight.vehicle.position, (
        flight.vehicle.rotation.T @ (flight.vehicle.velocity - [0.0, 0.0, 0.3])),
        yaw=flight.vehicle.yaw), rate=30.0)
    after = flight.last('LOCAL_POSITION_NED').z + flight.vehicle.position[2]
    assert after - before == pytest.approx(1.4, abs=0.1)  # as on both real autopilots


def test_jump_is_outlier_unless_reset_counter_announces_it():
    flight, away = Flight(parameters=BLIND['px4']), np.array([5.0, 0.0, 0.0])
    flight.fly(1.0, seen(flight), rate=30.0)
    flight.fly(0.5, seen(flight, error=away), rate=30.0)
    assert abs(flight.last('LOCAL_POSITION_NED').y) < 0.5
    flight.fly(0.2, seen(flight, error=away, reset_counter=1), rate=30.0)
    assert flight.last('LOCAL_POSITION_NED').y == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize(('personality', 'synchronized', 'age', 'used'), [
    ('px4', True, 0.05, True), ('px4', True, 0.5, False), ('px4', True, -1.0, False),
    ('px4', False, 0.5, True), ('arducopter', True, 0.5, True)])
def test_px4_uses_no_vision_that_is_old_by_its_clock(
        personality, synchronized, age, used):
    flight = Flight(personality, start='landed', parameters=BLIND[personality])
    flight.fly(0.01)
    if synchronized:  # our clock is 1000 s ahead of the autopilot's
        flight.send(mavlink.MAVLink_timesync_message(
            round((1000.0 + flight.now) * 1e9), flight.last('TIMESYNC').ts1))
    flight.fly(0.5, lambda: odometry((0.0, 0.0, 0.0), time=1000.0 + flight.now - age))
    assert flight.controller.position_known(flight.now) == used


@pytest.mark.parametrize(('personality', 'seconds', 'error'), [
    ('px4', 13.0, 1.6), ('arducopter', 7.0, 0.11)])
def test_without_vision_the_velocity_is_sent_on_and_drifts(personality, seconds, error):
    flight = Flight(personality, parameters=BLIND[personality])
    flight.fly(1.2, seen(flight), setpoint())
    flight.mode('OFFBOARD' if personality == 'px4' else 'GUIDED')
    flight.fly(seconds, setpoint())
    assert flight.controller.mode in ('OFFBOARD', 'GUIDED')
    sent, true = flight.last('LOCAL_POSITION_NED'), flight.vehicle.velocity
    assert flight.now - sent.time_boot_ms * 1e-3 < 0.1
    assert math.hypot(sent.vy - true[0], sent.vx - true[1]) == pytest.approx(error, rel=0.1)


def test_arducopter_lands_after_seconds_without_vision():
    flight = Flight('arducopter', altitude=20.0, parameters=BLIND['arducopter'])
    flight.fly(1.0, seen(flight))
    flight.mode('GUIDED')
    flight.fly(7.0, setpoint())
    assert flight.controller.mode == 'GUIDED'
    flight.fly(2.0, setpoint())
    assert flight.controller.mode == 'LAND' and flight.controller.in_failsafe
    assert flight.texts()[-1] == 'EKF Failsafe: changed to LAND Mode'
    assert flight.last('HEARTBEAT').system_status == mavlink.MAV_STATE_CRITICAL
    flight.fly(0.5, seen(flight, reset_counter=1))
    assert flight.controller.mode == 'LAND' and not flight.controller.in_failsafe


def test_barometer_measures_height_with_noise_and_drift():
    flight = Flight(parameters={'EKF2_GPS_CTRL': 0, 'EKF2_HGT_REF': 3})
    assert flight.ask('SCALED_PRESSURE') == [0]
    flight.fly(4.0, lambda: odometry((0.0, 0.0, 2.0 + 0.3 * flight.now)), rate=30.0)
    reported = [height(m) for m in flight.all('SCALED_PRESSURE')]
    assert len(reported) == pytest.approx(80, abs=1)
    assert np.std(np.diff(reported)) == pytest.approx(0.05 * 2 ** 0.5, rel=0.3)
    assert reported[-1] == pytest.approx(flight.vehicle.position[2], abs=0.3)
    assert reported[-1] < 2.0 - 0.5  # it holds the height of the odometry, and sinks
    barometer = Barometer([np.random.default_rng(i) for i in range(500)])
    deviations = [np.std(barometer.heights(np.zeros(500), time)) for time in (10.0, 11.0, 2000.0)]
    assert deviations == pytest.approx([0.05, 0.05, np.hypot(0.05, 0.1)], rel=0.15)


@BOTH
def test_home_is_where_it_was_armed(personality):
    flight = Flight(personality, start='landed')
    flight.mode('GUIDED' if personality == 'arducopter' else 'AUTO.LOITER')
    flight.fly(0.1)
    assert flight.arm() == [0]
    assert flight.ask('HOME_POSITION', 1.0) == flight.ask('GLOBAL_POSITION_INT') == [0]
    flight.take_off(2.5 if personality == 'arducopter' else GROUND_AMSL + 2.5)
    flight.fly(8.0)
    home, position = flight.last('HOME_POSITION'), flight.last('GLOBAL_POSITION_INT')
    assert (home.altitude, home.z, home.latitude) == (round(GROUND_AMSL * 1e3), 0.0, 473977420)
    assert flight.vehicle.position[2] > 2.0
    assert position.alt - home.altitude == pytest.approx(
        flight.vehicle.position[2] * 1e3, abs=20)


def test_the_battery_shows_its_charge():
    flight = Flight(faults=[Fault('battery', 1.5, remaining=0.15)])
    shown = []
    for seconds in (1.4, 2.0):
        flight.fly(seconds)
        status = flight.last('SYS_STATUS')
        shown.append((status.battery_remaining, status.voltage_battery))
    assert shown == [(100, 16800), (15, pytest.approx(14420, abs=4))]
