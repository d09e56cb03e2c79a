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

"""Barometer, battery and home of the embedded autopilots."""

from embedded_flight import Flight, odometry, setpoint
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_desk.vehicles.estimator import Barometer, GROUND_AMSL

PERSONALITIES = pytest.mark.parametrize('personality', ['px4', 'arducopter'])
PRESSURE = mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE
HOME = mavlink.MAVLINK_MSG_ID_HOME_POSITION


def ask(flight, message_id, rate=20.0):
    """Ask for a message at a rate, Hz, and return the results."""
    return flight.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(message_id), 1e6 / rate)


def all_of(flight, kind):
    return [m for m in flight.messages if m.get_type() == kind]


def height(message):
    """Return the height above the mean sea level, m, that a SCALED_PRESSURE says."""
    return (1.0 - (message.press_abs / 1013.25) ** 0.190263) * 288.15 / 0.0065


@PERSONALITIES
def test_the_barometer_is_streamed_once_it_is_asked_for(personality):
    flight = Flight(personality, altitude=3.0)
    assert ask(flight, PRESSURE) == [0]
    flight.messages.clear()
    flight.fly(20.0)
    reported = all_of(flight, 'SCALED_PRESSURE')
    assert len(reported) == 400
    heights = np.array([height(m) for m in reported]) - GROUND_AMSL
    assert np.mean(heights) == pytest.approx(3.0, abs=0.1)
    assert np.std(np.diff(heights)) == pytest.approx(0.05 * 2 ** 0.5, rel=0.15)
    assert reported[0].temperature == 1181
    assert np.diff([m.time_boot_ms for m in reported]).tolist() == [50] * 399


def test_the_barometer_rests_on_the_true_height_not_on_the_odometry():
    flight = Flight(parameters={'EKF2_GPS_CTRL': 0, 'EKF2_HGT_REF': 3})
    ask(flight, PRESSURE)
    flight.fly(4.0, lambda: odometry((0.0, 0.0, 2.0 + 0.3 * flight.now)), rate=30.0)
    reported = height(flight.last('SCALED_PRESSURE')) - GROUND_AMSL
    assert reported == pytest.approx(flight.vehicle.position[2], abs=0.3)
    assert reported < 2.0 - 0.5  # it holds the height of the odometry, and sinks


def test_the_drift_is_slow_and_bounded():
    barometer = Barometer([np.random.default_rng(i) for i in range(500)])
    deviations = [np.std(barometer.heights(np.zeros(500), time)) for time in (10.0, 11.0, 2000.0)]
    assert deviations == pytest.approx([0.05, 0.05, np.hypot(0.05, 0.1)], rel=0.15)


@PERSONALITIES
def test_home_is_where_it_was_armed(personality):
    flight = Flight(personality, start='landed')
    flight.mode('GUIDED' if personality == 'arducopter' else 'AUTO.LOITER')
    flight.fly(0.1)
    assert flight.arm() == [0] and ask(flight, HOME, 1.0) == [0]
    flight.take_off(2.5 if personality == 'arducopter' else GROUND_AMSL + 2.5)
    flight.fly(8.0)
    assert flight.vehicle.position[2] > 2.0
    home = flight.last('HOME_POSITION')
    assert (home.altitude, home.z, home.latitude) == (round(GROUND_AMSL * 1e3), 0.0, 473977420)
    flight.command(mavlink.MAV_CMD_REQUEST_MESSAGE, float(
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT))
    position = flight.last('GLOBAL_POSITION_INT')
    assert position.alt - home.altitude == pytest.approx(
        flight.vehicle.position[2] * 1e3, abs=2)


def test_px4_has_no_home_without_an_origin():
    flight = Flight(start='landed', parameters={'EKF2_GPS_CTRL': 0})
    still = odometry((0.0, 0.0, 0.0))
    flight.fly(4.0, still, rate=30.0)
    assert not all_of(flight, 'HOME_POSITION')
    flight.send(mavlink.MAVLink_set_gps_global_origin_message(1, 473977420, 85455940, 488000))
    flight.fly(4.0, still, rate=30.0)
    assert all_of(flight, 'HOME_POSITION')


@PERSONALITIES
def test_the_battery_can_be_drained_and_become_unknown(personality):
    flight = Flight(personality, faults=[Fault('battery', 1.5, remaining=0.15),
                                         Fault('battery', 3.5, remaining=None)])
    shown = []
    for seconds in (1.4, 2.0, 2.0):
        flight.fly(seconds, setpoint())
        status, battery = flight.last('SYS_STATUS'), flight.last('BATTERY_STATUS')
        assert status.battery_remaining == battery.battery_remaining
        shown.append((status.battery_remaining, status.voltage_battery))
    assert [remaining for remaining, _ in shown] == [100, 15, -1]
    assert shown[0][1] > 16500 and 14000 < shown[1][1] < 15000 and shown[2][1] == 65535
