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

"""What the autopilot tells of itself: motion, battery, mode, whether it flies and lives."""

import math

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.geometry import quaternion_from_rpy, quaternion_from_yaw, yaw_from_quaternion
from flock_follower.mavlink.dialects import PX4
from flock_follower.mavlink.telemetry import (
    Attitude,
    ATTITUDE_TIMEOUT,
    estimate,
    LocalPosition,
    Telemetry,
)

ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
BEAT, PLACE = 'HEARTBEAT', 'LOCAL_POSITION_NED'


def stamped(kind, boot_ms=0):
    """Return a message of a kind, stamped so and else zero, as it comes from the wire."""
    message_class = next(c for c in mavlink.mavlink_map.values() if c.msgname == kind)
    fields = {name: bytes(10) if name == 'name' else [0.0] * 4 if name == 'quaternion' else 0
              for name in message_class.ordered_fieldnames}
    return message_class(**{**fields, 'time_boot_ms': boot_ms})


def heartbeat(mode='OFFBOARD', base_mode=ARMED):
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base_mode, PX4.modes[mode],
        mavlink.MAV_STATE_ACTIVE, 3)


def mode_message(mode):
    return mavlink.MAVLink_current_mode_message(0, PX4.modes[mode], PX4.modes[mode])


def received(*messages):
    """Return what is known after messages that came at 1 s, 2 s and so on."""
    telemetry = Telemetry()
    for time, message in enumerate(messages, start=1):
        telemetry.update(message, float(time))
    return telemetry


def test_position_and_attitude_arrive_in_enu_and_flu():
    # Facing east (NED yaw 90 deg), nose up 0.1 rad, turning right at 0.3 rad/s.
    x, y, z, w = quaternion_from_rpy(0.0, 0.1, math.pi / 2)
    telemetry = received(
        mavlink.MAVLink_local_position_ned_message(0, 1, 2, -3, 0.1, 0.2, -0.3),
        mavlink.MAVLink_attitude_quaternion_message(0, w, x, y, z, 0.1, 0.2, 0.3))
    np.testing.assert_allclose(telemetry.local_position.position, [2, 1, 3])
    np.testing.assert_allclose(telemetry.local_position.velocity, [0.2, 0.1, 0.3])
    # In FLU a nose-up pitch is negative.
    np.testing.assert_allclose(
        telemetry.attitude.quaternion, quaternion_from_rpy(0.0, -0.1, 0.0), atol=1e-6)
    np.testing.assert_allclose(telemetry.attitude.angular_velocity, [0.1, -0.2, -0.3])


def test_telemetry_that_is_not_finite_is_dropped():
    telemetry = received(mavlink.MAVLink_local_position_ned_message(0, math.nan, 0, 0, 0, 0, 0),
                         mavlink.MAVLink_attitude_quaternion_message(
                          0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0))
    assert telemetry.local_position is telemetry.attitude is None


@pytest.mark.parametrize(('fields', 'numbers'), [
    ((15200, 1850, 81), (15.2, 18.5, 0.81)), ((65535, -1, -1), (math.nan, math.nan, math.nan))])
def test_the_battery_is_read_in_volts_amperes_and_fractions(fields, numbers):
    other = mavlink.MAVLink_battery_status_message(1, 1, 1, 2350, [4100] * 10, 100, 0, 0, 90)
    battery = received(
        mavlink.MAVLink_sys_status_message(0, 0, 0, 0, *fields, 0, 0, 0, 0, 0, 0), other).battery
    assert battery[1:] == pytest.approx(numbers, nan_ok=True)


@pytest.mark.parametrize(('came', 'now', 'alive'), [
    ([], 0.0, False), ([(PLACE, 1.0)], 1.0, False),  # of no autopilot yet
    ([(BEAT, 1.0)], 4.9, True), ([(BEAT, 1.0)], 5.1, False),
    # What streamed is missed after link_timeout; any message shows that the link is alive.
    ([(BEAT, 1.0), (PLACE, 1.1)], 2.05, True), ([(BEAT, 1.0), (PLACE, 1.1)], 2.15, False),
    ([(BEAT, 1.0), (PLACE, 9.1)], 9.2, True)])
def test_the_link_is_alive_while_any_message_comes(came, now, alive):
    telemetry = Telemetry()
    for kind, time in came:
        telemetry.update(heartbeat() if kind == BEAT else stamped(kind), time)
    assert telemetry.alive(now, 1.0) == alive


@pytest.mark.parametrize('stamps', [
    # (ms since boot, reboots so far)
    [(5000, 0), (4500, 0), (6000, 0), (300, 0), (320, 1), (900, 1), (100, 1)],
    # One that comes late is none, nor are stamps that are not set.
    [(60_000, 0), (60_020, 0), (58_800, 0), (60_040, 0), (58_820, 0), (0, 0), (60_060, 0)],
    # They wrap after 50 days.
    [(2**32 - 30, 0), (2**32 - 10, 0), (10, 0), (30, 0), (2**32 - 5, 0), (50, 0), (70, 0)],
    [(2**32 - 90_000, 0), (10, 0), (30, 1)]])
def test_an_autopilot_whose_clock_falls_back_has_rebooted(stamps):
    telemetry = Telemetry()
    for boot_ms, reboots in stamps:
        known = telemetry.newest['HOME_POSITION'] = 1.0, None
        before = telemetry.reboots
        telemetry.update(stamped('ATTITUDE_QUATERNION', boot_ms), 1.0)
        assert telemetry.reboots == reboots, boot_ms
        assert telemetry.newest.get('HOME_POSITION') == (known if before == reboots else None)


@pytest.mark.parametrize(('quality', 'altitude'), [(0, 1.5), (1, None), (100, 1.5)])
def test_a_rangefinder_without_a_valid_signal_has_no_altitude(quality, altitude):
    known = received(mavlink.MAVLink_distance_sensor_message(
        0, 10, 1000, 150, 0, 0, mavlink.MAV_SENSOR_ROTATION_PITCH_270, 0,
        signal_quality=quality)).sensor_altitude
    assert altitude == (None if known is None else known.altitude)


@pytest.mark.parametrize(('noise', 'grounded', 'newest'), [
    (0.01, 3.5, 4.5), (0.0, 3.5, 5.0), (0.01, 2.0, 5.0), (0.01, 0.0, 5.0)])
def test_repeated_pressure_in_flight_is_stuck_if_it_had_noise(noise, grounded, newest):
    telemetry = Telemetry()
    for k in range(101):
        now = 0.05 * k
        state = (mavlink.MAV_LANDED_STATE_ON_GROUND if now < grounded else
                 mavlink.MAV_LANDED_STATE_IN_AIR)
        telemetry.update(mavlink.MAVLink_extended_sys_state_message(0, state), now)
        telemetry.update(mavlink.MAVLink_scaled_pressure_message(
            0, 950.0 + noise * min(k, 90), 0.0, 2000), now)
    assert telemetry.sensor_altitude.time == pytest.approx(newest)


@pytest.mark.parametrize(('state', 'flying'), [
    (mavlink.MAV_LANDED_STATE_UNDEFINED, None), (mavlink.MAV_LANDED_STATE_ON_GROUND, False),
    (mavlink.MAV_LANDED_STATE_IN_AIR, True), (mavlink.MAV_LANDED_STATE_TAKEOFF, False),
    (mavlink.MAV_LANDED_STATE_LANDING, True)])
def test_the_vehicle_says_whether_it_flies(state, flying):
    telemetry = received(mavlink.MAVLink_extended_sys_state_message(0, state))
    assert telemetry.is_flying(3.9) is flying
    assert telemetry.is_flying(4.1) is None and Telemetry().is_flying(0.0) is None  # told at 5 Hz


def test_heights_are_known_above_the_sea_and_the_local_origin():
    telemetry = received(mavlink.MAVLink_global_position_int_message(
        0, 0, 0, 491000, 3000, 0, 0, 0, 0), mavlink.MAVLink_local_position_ned_message(
            0, 0, 0, -3, 0, 0, 0))
    assert (telemetry.altitude(2.9), telemetry.altitude(3.1)) == (3.0, None)
    assert telemetry.sea_level_altitude(2.0) == 491.0


# CURRENT_MODE shows the pilot's switch at once.


def test_current_mode_sets_mode_and_leaves_rest_to_heartbeat():
    assert received(mode_message('OFFBOARD')).status is None
    telemetry = received(heartbeat('OFFBOARD'), mode_message('POSCTL'))
    assert telemetry.status == (True, 'POSCTL', False)
    assert telemetry.shown_time(mavlink.MAV_CMD_COMPONENT_ARM_DISARM) == 1.0
    assert telemetry.shown_time(mavlink.MAV_CMD_DO_SET_MODE) == 2.0
    assert telemetry.mode_age(6.0) == 4.0
    assert telemetry.current(5.0, 9.0) and not telemetry.current(5.1, 9.0)  # 3 s after the mode
    telemetry.update(heartbeat('OFFBOARD', base_mode=0), 4.0)
    assert telemetry.status == (False, 'OFFBOARD', True) and telemetry.mode_time == 4.0


# Position and attitude become one estimate, valid at one time.


def position(boot_ms=5000):
    return LocalPosition(10.0, np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0]), boot_ms)


def attitude(time=10.0, boot_ms=5000, yaw=np.pi / 2, rate=0.0):
    return Attitude(time, quaternion_from_yaw(yaw), np.array([0.0, 0.0, rate]), boot_ms)


@pytest.mark.parametrize(('age', 'time'), [(0.05, 9.95), (0.0, 10.0), (-0.02, 10.0)])
@pytest.mark.parametrize('attitude_ms', [4980, 5000, 5015])
def test_an_attitude_is_turned_to_when_the_position_was_valid(age, time, attitude_ms):
    # It turns left at 2 rad/s, and faces north at 5000 ms.
    found, valid = estimate(position(), attitude(
        10.01, attitude_ms, np.pi / 2 + 2.0 * (attitude_ms - 5000) * 1e-3, 2.0), age)
    assert valid == pytest.approx(time)  # never in the future
    assert yaw_from_quaternion(found.quaternion) == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(found.position, [1, 2, 3])
    np.testing.assert_allclose(found.velocity, [0, 1, 0])


@pytest.mark.parametrize('share', [0.99, 1.01])
def test_an_attitude_that_came_long_before_is_no_part_of_it(share):
    found = estimate(position(), attitude(10.0 - share * ATTITUDE_TIMEOUT), 0.0)
    assert (found is None) == (share > 1.0)
