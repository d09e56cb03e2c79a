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

"""Rates and pauses of what arrives, and asking again for what comes too seldom."""

import re

from bridge_flight import Flight
from faulty_autopilot import Fault
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.dialects import PX4
from flock_follower.mavlink.estimator_health import Arrivals, REPORT_WINDOW
from flock_follower.mavlink.housekeeping import STREAM_REQUEST_PERIOD, wanted_rates

POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED


#: The embedded autopilots send none.
NEVER = {mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR}


def arrived(*times):
    arrivals = Arrivals()
    for time in times:
        arrivals.take(POSITION, time)
    return arrivals


def test_rate_and_longest_pause_cover_last_five_seconds():
    arrivals = arrived(*(t for t in np.arange(0.0, 20.0, 0.02) if not 16.0 < t < 16.5))
    assert arrivals.rate(POSITION, 20.0) == pytest.approx(45.0, abs=0.5)
    assert arrivals.rate(0, 20.0) == Arrivals().longest_pause(7.0) == 0.0
    assert arrivals.longest_pause(20.0) == pytest.approx(0.5, abs=0.03)
    assert arrivals.longest_pause(21.0) == pytest.approx(1.02, abs=0.03)  # while it lasts


@pytest.mark.parametrize('wanted', [5.0, 50.0, 200.0])
@pytest.mark.parametrize(('share', 'low'), [(0.0, True), (0.3, True), (0.8, False), (1.5, False)])
def test_rate_well_below_request_is_too_low(wanted, share, low):
    period = 1.0 / (share * wanted) if share else 100.0
    arrivals = arrived(*np.arange(0.0, 10.0, period))
    # Wherever the window begins: one message more or less is chance.
    assert {arrivals.too_seldom(POSITION, wanted, 10.0 + t) for t in np.linspace(
        0.0, min(period, 0.02), 20)} == {low}


def intervals(flight, since=0.0):
    """Return the ids of the messages whose rates were asked for."""
    return [int(m.param1) for m in flight.commands(
        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, since)]


def sets_rate(flight, message_id, hertz):
    """Let a ground station on the same line set a rate."""
    command = mavlink.MAVLink_command_long_message(
        1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, 1e6 / hertz, 0, 0, 0, 0, 0)
    flight.autopilot.receive(bytes(command.pack(mavlink.MAVLink(None, 255, 190))), flight.now)


@pytest.mark.slow
@pytest.mark.parametrize(('personality', 'message_id', 'hertz', 'seconds'), [
    # HEARTBEAT shows the pilot's switch.
    ('px4', POSITION, 4.0, 1.0), ('arducopter', 0, 0.4, 5.0)])
def test_all_is_requested_at_start_and_when_another_lowers_it(
        personality, message_id, hertz, seconds):
    flight = Flight(personality)
    flight.fly(1.0 + STREAM_REQUEST_PERIOD)
    dialect = flight.bridge.telemetry.dialect
    assert {*intervals(flight), dialect.estimator_status} == {*wanted_rates(dialect, 50.0)}
    since = flight.now
    sets_rate(flight, message_id, hertz)
    flight.fly(seconds)
    assert set(intervals(flight, since)) - NEVER == {message_id}
    if message_id == POSITION:
        flight.fly(REPORT_WINDOW)
        assert intervals(flight, since).count(POSITION) == 1
        assert flight.bridge.housekeeping.rates(flight.now)['LOCAL_POSITION_NED'] == (
            pytest.approx(50.0, abs=0.5))


@pytest.mark.slow
def test_requests_that_are_lost_are_repeated():
    flight = Flight(faults=[Fault('drop', 0.0, 3.0, 'received', message='COMMAND_LONG')])
    flight.fly(2.0)
    assert not flight.bridge.housekeeping.has_reasons(2.0)  # nor are reasons known
    flight.fly(8.0)
    arrivals = flight.bridge.telemetry.arrivals
    low = {message_id for message_id, hertz in wanted_rates(PX4, 50.0).items()
           if arrivals.too_seldom(message_id, hertz, flight.now)}
    assert low == NEVER | {PX4.mode_message}  # which is sent at changes
    assert flight.ask('offboard', True).success


@pytest.mark.slow
@pytest.mark.parametrize(('fault', 'reported'), [
    # Below half of what was asked for; none at all has other causes than the link.
    ({'message': 'LOCAL_POSITION_NED', 'share': 0.7},
     r'LOCAL_POSITION_NED comes at 1[2-8] Hz of 50 requested'),
    ({'at': 6.5, 'duration': 0.6},
     r'nothing came from the autopilot for 0.6[0-3] s in the last 5 s')])
def test_a_slow_or_stalling_link_is_reported(fault, reported):
    flight = Flight(faults=[Fault('drop', direction='sent', **{'at': 0.0, **fault})])
    flight.fly(5.9)
    assert flight.bridge.housekeeping.too_slow(flight.now) == ''
    flight.fly(3.1)
    assert re.fullmatch(reported, flight.bridge.housekeeping.too_slow(flight.now))
