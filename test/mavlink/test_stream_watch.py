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

from flock_follower.mavlink.estimator_health import (
    Arrivals,
    AskAgain,
    LONGEST_WAIT,
    RECENT,
    SHORTEST_WAIT,
)
from flock_follower.mavlink.housekeeping import wanted_rates

POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION


def arrived(*times, message_id=POSITION):
    arrivals = Arrivals()
    for time in times:
        arrivals.take(message_id, time)
    return arrivals


def test_a_rate_is_that_of_the_last_five_seconds_and_begins_with_the_first_message():
    assert arrived(3.0, 3.02, 3.04).rate(POSITION, 3.05) == pytest.approx(50.0)
    assert arrived(3.0).rate(POSITION, 3.05) == 0.0
    arrivals = arrived(*np.arange(0.0, 20.0, 0.02))
    for now in (20.0, 22.4):
        assert arrivals.rate(POSITION, now) == pytest.approx(50.0, abs=0.3)
    assert arrivals.rate(POSITION, 22.6) == arrivals.rate(ATTITUDE, 20.0) == 0.0


@pytest.mark.parametrize('wanted', [5.0, 50.0, 200.0])
@pytest.mark.parametrize(('share', 'low'), [(0.0, True), (0.3, True), (0.8, False), (1.5, False)])
def test_what_comes_well_below_the_rate_asked_for_comes_too_seldom(wanted, share, low):
    period = 1.0 / (share * wanted) if share else 100.0
    arrivals = arrived(*np.arange(0.0, 10.0, period))
    # Wherever the window begins: one message more or less is chance.
    assert {arrivals.too_seldom(POSITION, wanted, 10.0 + t) for t in np.linspace(
        0.0, min(period, 0.02), 20)} == {low}


def test_the_longest_pause_is_told_while_it_lasts_and_for_five_seconds():
    assert Arrivals().longest_pause(7.0) == 0.0 and arrived(3.0).longest_pause(7.0) == 4.0
    arrivals, reported = Arrivals(), {}
    for step in range(600):
        time = step * 0.02
        if not (3.0 < time < 3.5 or 4.0 < time < 4.3):
            arrivals.take((ATTITUDE, POSITION)[step % 2], time)
        reported[step] = arrivals.longest_pause(time)
    assert [reported[step] for step in (140, 170, 250, 420, 430, 599)] == pytest.approx(
        [0.02, 0.4, 0.5, 0.5, 0.3, 0.02])


def asking(low, seconds):
    """Return when it asks, looking at 20 Hz; ``low`` is given the time and what was asked."""
    again, times = AskAgain(), []
    again.asked(0.0)
    for now in np.arange(0.0, seconds, 0.05):
        if again.due(low(now, times), now):
            times.append(now)
    return times


def test_what_stays_low_is_asked_for_less_and_less_often():
    waits = np.diff([0.0, *asking(lambda now, times: True, 200.0)])
    assert waits == pytest.approx([2, 2, 4, 8, 16, 30, 30, 30, 30, 30], abs=0.06)
    assert waits.min() >= SHORTEST_WAIT and waits[-1] >= LONGEST_WAIT
    # Nor is a rate that goes up and down a reason to ask every two seconds.
    assert len(asking(lambda now, times: now % 1.0 < 0.5, 200.0)) < 12


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
def test_all_is_asked_for_at_the_start_and_what_another_one_lowers_again(
        personality, message_id, hertz, seconds):
    flight = Flight(personality)
    flight.fly(4.0)
    dialect = flight.bridge.telemetry.dialect
    assert {*intervals(flight), dialect.estimator_status} == {*wanted_rates(dialect, 50.0)}
    since = flight.now
    sets_rate(flight, message_id, hertz)
    flight.fly(seconds)
    assert set(intervals(flight, since)) == {message_id}
    if message_id == POSITION:
        flight.fly(RECENT)
        assert intervals(flight, since) == [POSITION]
        assert flight.bridge.housekeeping.rates(flight.now)['LOCAL_POSITION_NED'] == (
            pytest.approx(50.0, abs=0.5), 50.0)


@pytest.mark.slow
@pytest.mark.parametrize(('fault', 'reported'), [
    # Below half of what was asked for; none at all has other causes than the link.
    ({'message': 'LOCAL_POSITION_NED', 'share': 0.7},
     r'LOCAL_POSITION_NED comes at 1[2-8] Hz of 50 asked for'),
    ({'at': 6.5, 'duration': 0.6},
     r'nothing came from the autopilot for 0.6[0-3] s in the last 5 s')])
def test_a_slow_link_is_told_after_seven_seconds(fault, reported):
    flight = Flight(faults=[Fault('drop', direction='sent', **{'at': 0.0, **fault})])
    flight.fly(6.4)
    assert flight.bridge.housekeeping.too_slow(flight.now) == ''
    flight.fly(2.6)
    assert re.fullmatch(reported, flight.bridge.housekeeping.too_slow(flight.now))


@pytest.mark.slow
def test_whether_it_flies_is_asked_again_until_it_is_told():
    flight = Flight(faults=[Fault('drop', 0.0, 5.0, message='EXTENDED_SYS_STATE')])
    flight.fly(6.5)
    assert intervals(flight).count(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE) == 3
    assert flight.bridge.telemetry.flying(flight.now)
