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

POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION


def arrived(*times, message_id=POSITION):
    arrivals = Arrivals()
    for time in times:
        arrivals.take(message_id, time)
    return arrivals


def test_a_rate_begins_with_the_first_message():
    assert arrived(3.0, 3.02, 3.04).rate(POSITION, 3.05) == pytest.approx(50.0)
    assert arrived(3.0).rate(POSITION, 3.05) == 0.0


def test_a_rate_is_that_of_the_last_five_seconds():
    arrivals = arrived(*np.arange(0.0, 20.0, 0.02))
    assert arrivals.rate(POSITION, 20.0) == pytest.approx(50.0, abs=0.3)
    assert arrivals.rate(POSITION, 22.4) == pytest.approx(50.0, abs=0.3)
    assert arrivals.rate(POSITION, 22.6) == 0.0
    assert arrivals.rate(ATTITUDE, 20.0) == 0.0


@pytest.mark.parametrize('wanted', [5.0, 20.0, 50.0, 200.0])
@pytest.mark.parametrize(('share', 'low'), [(0.0, True), (0.3, True), (0.8, False), (1.5, False)])
def test_what_comes_well_below_the_rate_asked_for_comes_too_seldom(wanted, share, low):
    period = 1.0 / (share * wanted) if share else 100.0
    arrivals = arrived(*np.arange(0.0, 10.0, period))
    # Wherever the window begins: one message more or less is chance.
    assert {arrivals.too_seldom(POSITION, wanted, 10.0 + t) for t in np.linspace(
        0.0, min(period, 0.02), 20)} == {low}


def test_a_fall_to_four_hertz_is_noticed_within_half_a_second():
    arrivals = arrived(*np.arange(0.0, 10.0, 0.02), 10.2, 10.45)
    assert not arrivals.too_seldom(POSITION, 50.0, 10.25)
    assert arrivals.too_seldom(POSITION, 50.0, 10.45)


def test_the_longest_pause_is_told_for_five_seconds():
    arrivals, told = Arrivals(), {}
    for step in range(600):
        time = step * 0.02
        if not (3.0 < time < 3.5 or 4.0 < time < 4.3):
            arrivals.take((ATTITUDE, POSITION)[step % 2], time)
        told[step] = arrivals.longest_pause(time)
    assert told[140] == pytest.approx(0.02)
    assert told[170] == pytest.approx(0.4)  # it lasts
    assert told[250] == told[420] == pytest.approx(0.5)
    assert told[430] == pytest.approx(0.3)
    assert told[599] == pytest.approx(0.02)


def test_a_pause_counts_while_it_lasts_and_none_before_the_first_message():
    assert Arrivals().longest_pause(7.0) == 0.0
    assert arrived(3.0).longest_pause(7.0) == 4.0


def asking(low, seconds, again=None, begin=0.0):
    """Return when it asks, looking at 20 Hz; ``low`` is given the time."""
    again = again or AskAgain()
    again.asked(begin)
    return [round(now, 2) for now in np.arange(begin, begin + seconds, 0.05)
            if again.due(low(now), now)]


def test_what_stays_low_is_asked_for_less_and_less_often():
    times = asking(lambda now: True, 200.0)
    waits = np.diff([0.0, *times])
    assert waits == pytest.approx([2, 2, 4, 8, 16, 30, 30, 30, 30, 30], abs=0.06)
    assert waits.min() >= SHORTEST_WAIT and waits[-1] >= LONGEST_WAIT


def test_where_asking_helps_it_asks_at_once_each_time():
    # Another one sets its rates every 15 s; what we ask for is obeyed half a second later.
    state = {'low': False}
    again, times = AskAgain(), []
    again.asked(0.0)
    for step in range(1, 1220):
        now = step * 0.05
        if times and now - times[-1] > 0.5:
            state['low'] = False
        if step % 300 == 0:
            state['low'] = True
        if again.due(state['low'], now):
            times.append(now)
    assert times == pytest.approx([15.0, 30.0, 45.0, 60.0], abs=0.06)


def test_a_rate_that_goes_up_and_down_is_no_reason_to_ask_every_two_seconds():
    times = asking(lambda now: now % 1.0 < 0.5, 200.0)
    assert len(times) < 12


def intervals(flight, since=0.0):
    return [int(m.param1) for t, m in flight.received if t >= since
            and m.get_type() == 'COMMAND_LONG'
            and m.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL]


def sets_rate(flight, message_id, hertz):
    """Let a ground station on the same line set a rate."""
    command = mavlink.MAVLink_command_long_message(
        1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, 1e6 / hertz, 0, 0, 0, 0, 0)
    flight.autopilot.receive(bytes(command.pack(mavlink.MAVLink(None, 255, 190))), flight.now)


@pytest.mark.slow
@pytest.mark.parametrize('personality', ['px4', 'arducopter'])
def test_rates_that_another_one_lowers_are_asked_for_again(personality):
    flight = Flight(personality)
    flight.fly(10.0)
    asked = len(intervals(flight))
    sets_rate(flight, POSITION, 4.0)
    flight.fly(1.0)
    assert intervals(flight)[asked:] == [POSITION]
    flight.fly(RECENT)
    assert flight.bridge.housekeeping.rates(flight.now)['LOCAL_POSITION_NED'] == (
        pytest.approx(50.0, abs=0.5), 50.0)
    assert len(intervals(flight)) == asked + 1


@pytest.mark.slow
def test_a_line_that_carries_no_more_is_not_filled_with_requests():
    flight = Flight(bridge={'estimate_rate': 150.0})  # the embedded autopilot has 100 Hz
    flight.fly(100.0)
    for message_id in (POSITION, ATTITUDE):
        assert 5 <= intervals(flight).count(message_id) <= 9
    assert flight.bridge.housekeeping.too_slow(flight.now) == ''


@pytest.mark.slow
@pytest.mark.parametrize(('personality', 'message_id'), [('px4', 436), ('arducopter', 0)])
def test_what_shows_the_pilots_switch_is_asked_for_again_where_the_request_was_lost(
        personality, message_id):
    flight = Flight(personality)
    flight.fly(10.0)
    asked = len(intervals(flight))
    sets_rate(flight, message_id, 0.4)
    flight.fly(5.0)
    assert set(intervals(flight)[asked:]) == {message_id}


@pytest.mark.slow
def test_below_half_of_what_was_asked_for_is_told_after_seven_seconds():
    flight = Flight(faults=[Fault('drop', 0.0, direction='sent', message='LOCAL_POSITION_NED',
                                  share=0.7)])
    flight.fly(6.9)
    assert flight.bridge.housekeeping.too_slow(flight.now) == ''
    flight.fly(3.0)
    told = flight.bridge.housekeeping.too_slow(flight.now)
    assert re.fullmatch(r'LOCAL_POSITION_NED comes at 1[2-8] Hz of 50 asked for', told)


@pytest.mark.slow
@pytest.mark.parametrize(('length', 'told'), [
    (0.2, ''), (0.6, 'nothing came from the autopilot for 0.6[0-3] s in the last 5 s')])
def test_a_link_that_stalls_is_told_with_its_longest_gap(length, told):
    flight = Flight(faults=[Fault('drop', 10.0, length, 'sent')])
    flight.fly(12.0)
    assert re.fullmatch(told, flight.bridge.housekeeping.too_slow(flight.now))
    flight.fly(4.0)
    assert flight.bridge.housekeeping.too_slow(flight.now) == ''


@pytest.mark.slow
def test_a_vehicle_without_an_estimate_is_not_told_as_a_slow_link():
    flight = Flight(faults=[Fault('drop', 0.0, direction='sent', message='LOCAL_POSITION_NED')])
    flight.fly(10.0)
    assert flight.bridge.housekeeping.too_slow(flight.now) == ''


@pytest.mark.slow
def test_an_estimate_that_comes_late_and_slowly_is_asked_for_two_seconds_later():
    flight = Flight(faults=[Fault('drop', 0.0, 40.0, 'sent', message='LOCAL_POSITION_NED')])
    flight.fly(39.0)
    assert 4 <= intervals(flight).count(POSITION) <= 7  # less and less often
    sets_rate(flight, POSITION, 4.0)
    asked = len(intervals(flight))
    flight.fly(3.5)
    assert intervals(flight)[asked:] == [POSITION]
