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

"""Unanswered questions: each is unknown, and a line that works one way only is named."""

from bridge_flight import BOTH, Flight, without_gps
from faulty_autopilot import Fault
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.housekeeping import UNSIGNED
from flock_follower.mavlink.link_questions import (
    LinkQuestions,
    NO_ANSWER,
    RATES,
    REASONS,
    TIMESYNC,
)
from flock_follower.mavlink.parameter_check import ASK

OURS = 1, 191
ORIGIN = mavlink.MAVLink_gps_global_origin_message(0, 0, 0)
HOME = mavlink.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
VERSION = mavlink.MAVLink_autopilot_version_message(
    0, 0, 0, 0, 0, bytes(8), bytes(8), bytes(8), 0, 0, 0)


def command(number, first=0.0):
    return mavlink.MAVLink_command_long_message(1, 1, number, 0, first, *[0.0] * 6)


def ack(number, result=0, target=OURS):
    return mavlink.MAVLink_command_ack_message(number, result, 0, 0, *target)


#: Each question, and its answer.
QUESTIONS = {
    'parameter EKF2_EV_CTRL': (
        mavlink.MAVLink_param_request_read_message(1, 1, b'EKF2_EV_CTRL', -1),
        mavlink.MAVLink_param_value_message(b'EKF2_EV_CTRL', 1.0, 9, 1, 0)),
    TIMESYNC: (mavlink.MAVLink_timesync_message(0, 77), mavlink.MAVLink_timesync_message(5, 77)),
    RATES: (command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30.0),
            ack(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_RESULT_DENIED)),
    'AUTOPILOT_VERSION': (command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148.0), VERSION),
    'GPS_GLOBAL_ORIGIN': (command(mavlink.MAV_CMD_REQUEST_MESSAGE, 49.0), ORIGIN),
    'HOME_POSITION': (command(mavlink.MAV_CMD_REQUEST_MESSAGE, 242.0), HOME),
    REASONS: (command(mavlink.MAV_CMD_RUN_PREARM_CHECKS),
              ack(mavlink.MAV_CMD_RUN_PREARM_CHECKS)),
    # A refused command is an answered one: ArduCopter refuses to arm with the throttle up.
    'COMPONENT_ARM_DISARM': (
        command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0),
        ack(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_RESULT_FAILED)),
    'DO_SET_MODE': (command(mavlink.MAV_CMD_DO_SET_MODE, 1.0), ack(mavlink.MAV_CMD_DO_SET_MODE))}
#: They arrive without a question, too.
UNASKED = {'GPS_GLOBAL_ORIGIN', 'HOME_POSITION'}
#: Messages that resemble an answer.
NO_ANSWERS = (
    mavlink.MAVLink_timesync_message(0, 77), mavlink.MAVLink_timesync_message(5, 78),
    mavlink.MAVLink_param_value_message(b'EKF2_EV_CTR', 1.0, 9, 1, 0),
    ack(mavlink.MAV_CMD_DO_SET_MODE, target=(255, 190)),
    mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 4, 3))


@given(st.sets(st.sampled_from(sorted(QUESTIONS))))
def test_every_question_is_unknown_until_its_own_answer_arrives(answered):
    questions = LinkQuestions(OURS)
    for second in range(4):
        for question, _ in QUESTIONS.values():
            questions.sent(question, float(second))
        for message in (*NO_ANSWERS, *(QUESTIONS[name][1] for name in answered)):
            questions.take(message, second + 0.1)
    assert {*questions.unknown(3.2)} == QUESTIONS.keys() - answered
    assert questions.is_unanswered(3.2) == (answered <= UNASKED)


@pytest.mark.parametrize('name', QUESTIONS)
def test_an_answer_grows_old_after_three_seconds_and_three_tries(name):
    (question, answer), questions = QUESTIONS[name], LinkQuestions(OURS)
    questions.sent(question, 0.0)
    questions.take(answer, 0.1)
    for time, unknown in ((1.0, []), (1.1, []), (1.2, []), (3.9, []), (4.1, [name])):
        if time < 2.0:
            questions.sent(question, time)
        assert questions.unknown(time) == unknown
        assert name in UNASKED or questions.is_unanswered(time) == bool(unknown)
    questions.pause()  # the link was lost: they count anew
    assert questions.unknown(9.0) == [] and not questions.is_unanswered(9.0)
    questions.begin_again()
    questions.sent(question, 9.0)
    assert questions.unknown(9.0) == [name]


def one_way(**options):
    return {**options, 'faults': [Fault('drop', 0.0, direction='received')]}


@BOTH
def test_line_dead_toward_autopilot_is_named_offboard_refused(
        personality):
    # With the check of the failsafe switched off, too.
    flight = Flight(personality, **one_way(bridge={'require_failsafe': False}))
    flight.fly(4.0)
    assert flight.bridge.alive(flight.now)
    assert flight.bridge.state(flight.now) == f'INACTIVE: {NO_ANSWER}'
    assert flight.bridge.refusal(flight.now) == NO_ANSWER
    assert flight.ask('offboard', True) == (False, f'offboard refused: {NO_ANSWER}')
    assert flight.bridge.unready(flight.now) is None
    flight.autopilot.faults.clear()
    flight.bridge.link.autopilot_signs = True
    assert flight.bridge.housekeeping.unreceived_reason(flight.now) == UNSIGNED


def test_a_line_that_breaks_in_flight_stops_no_flight():
    flight = Flight(faults=[Fault('drop', 6.0, direction='received', message=message) for message
                            in ('TIMESYNC', 'PARAM_REQUEST_READ', 'COMMAND_LONG')])
    flight.follow(9.0)
    assert flight.bridge.housekeeping.unreceived_reason(flight.now) == NO_ANSWER
    assert flight.bridge.state(flight.now) == 'ACTIVE' and flight.kinds(40) == {'command'}


@pytest.mark.parametrize(('dropped', 'unknown', 'options'), [
    ('TIMESYNC', {TIMESYNC}, {}),
    ('AUTOPILOT_VERSION', {'AUTOPILOT_VERSION'}, {}),
    ('HOME_POSITION', {'HOME_POSITION'}, {}),
    ('COMMAND_ACK', {RATES, REASONS}, {}),
    ('GPS_GLOBAL_ORIGIN', {'GPS_GLOBAL_ORIGIN'}, without_gps('px4')),
    ('PARAM_VALUE', {'parameter COM_OF_LOSS_T', 'parameter COM_OBL_RC_ACT',
                     'parameter MIS_TAKEOFF_ALT'}, {})])
def test_lost_answers_to_one_question_leave_others_known(
        dropped, unknown, options):
    flight = Flight(start='landed', **options, faults=[
        Fault('drop', 0.0, direction='sent', message=dropped)])
    flight.fly(3.5)
    assert {*flight.bridge.link.questions.unknown(flight.now)} == unknown
    assert flight.bridge.housekeeping.unreceived_reason(flight.now) == ''
    assert (flight.bridge.unready(flight.now) is None) == (dropped == 'COMMAND_ACK')
    if dropped == 'PARAM_VALUE':
        refusal = flight.bridge.refusal(flight.now)
        assert refusal.endswith(ASK) and ':=' not in refusal
