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

"""Requests to the autopilot: believed only when HEARTBEAT shows them, refused with the reason."""

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink import commands
from flock_follower.mavlink.commands import Request, result_words, Vehicle
from flock_follower.mavlink.dialects import ARDUPILOT, PX4, VehicleStatus
from flock_follower.mavlink.status_texts import StatusTexts

HOLD = VehicleStatus(True, 'AUTO.LOITER', 'active', False)
OFFBOARD = VehicleStatus(True, 'OFFBOARD', 'active', True)
SET_MODE = mavlink.MAV_CMD_DO_SET_MODE


def statustext(text, severity=mavlink.MAV_SEVERITY_CRITICAL, number=0, chunk=0):
    return mavlink.MAVLink_statustext_message(severity, text.encode(), number, chunk)


def step(request, now, status=HOLD, streaming_for=5.0, texts=None, altitude=None, dialect=None):
    vehicle = None if status is None else Vehicle(dialect or PX4, status, altitude)
    return request.step(
        vehicle, streaming_for=streaming_for, texts=texts or StatusTexts(), now=now)


def test_offboard_waits_for_a_stream_of_one_second_with_a_margin():
    request = Request(commands.OFFBOARD, 0.0)
    assert step(request, 0.0, streaming_for=0.0) is None
    assert step(request, 1.4, streaming_for=1.4) is None
    assert step(request, 1.5, streaming_for=1.5) == 0
    assert request.goal.params(PX4) == (1.0, 6.0, 0.0)


def test_the_first_ack_is_not_believed_the_heartbeat_is():
    request = Request(commands.OFFBOARD, 0.0)
    assert step(request, 0.0) == 0
    request.acknowledge(SET_MODE, 0, 0.1)
    step(request, 0.2)
    assert request.outcome is None
    step(request, 0.8, OFFBOARD)
    assert request.outcome == (
        True, 'offboard: HEARTBEAT shows OFFBOARD, armed, after 0.8 s')


def test_a_refusal_reports_the_result_and_the_words_of_the_autopilot():
    request, texts = Request(commands.OFFBOARD, 0.0), StatusTexts()
    texts.add(statustext('Old news'), -1.0)
    assert step(request, 0.0) == 0
    request.acknowledge(SET_MODE, 0, 0.1)
    request.acknowledge(SET_MODE, 1, 0.11)
    texts.add(statustext('No offboard signal\t'), 0.2)
    step(request, 0.3, texts=texts)
    assert request.outcome is None
    step(request, 0.7, texts=texts)
    assert request.outcome == (
        False, 'offboard refused: temporarily rejected: No offboard signal')


def test_acks_without_a_change_are_no_success():
    request = Request(commands.arm(True), 0.0)
    disarmed = HOLD._replace(armed=False)
    assert step(request, 0.0, disarmed) == 0
    request.acknowledge(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0.1)
    step(request, 3.6, disarmed)
    assert request.outcome == (False, 'arm not reached within 3.5 s: '
                                      'HEARTBEAT shows AUTO.LOITER, disarmed')


def test_an_unanswered_command_is_sent_again_and_then_given_up():
    request = Request(commands.HOLD, 0.0)
    sent = [step(request, now / 10, OFFBOARD) for now in range(36)]
    assert [count for count in sent if count is not None] == [0, 1, 2, 3]
    assert request.outcome == (False, 'hold: no answer to 4 commands')


@pytest.mark.parametrize(('dialect', 'modes'), [
    (PX4, ('AUTO.LOITER', 'POSCTL', 'AUTO.LAND')), (ARDUPILOT, ('BRAKE', 'LAND'))])
def test_where_hold_is_refused_the_next_mode_is_asked_for_and_told(dialect, modes):
    request, flying = Request(commands.HOLD, 0.0), OFFBOARD._replace(mode=dialect.offboard)
    now, asked = 0.0, []
    while request.outcome is None:
        if step(request, now, flying, dialect=dialect) is not None:
            asked.append(request.current.params(dialect))
            if len(asked) == len(modes):
                flying = VehicleStatus(True, modes[-1], 'active', False)
            else:
                request.acknowledge(SET_MODE, 1, now)
        now += 0.1
    assert asked == [dialect.set_mode_parameters(mode) for mode in modes]
    assert request.outcome.success
    *refused, last = request.outcome.message.split('; ')
    assert refused == [f'{name} refused: temporarily rejected'
                       for name in ('hold', *modes[1:-1])]
    assert last.startswith(f'{modes[-1]}: HEARTBEAT shows {modes[-1]}, armed')


def test_what_is_refused_down_to_the_last_is_told_whole():
    request, now = Request(commands.HOLD, 0.0), 0.0
    while request.outcome is None:
        if step(request, now, OFFBOARD) is not None:
            request.acknowledge(SET_MODE, 1, now)
        now += 0.1
    assert request.outcome == (False, '; '.join(
        [*(f'{name} refused: temporarily rejected' for name in ('hold', 'POSCTL', 'AUTO.LAND')),
         PX4.no_reason]))


@pytest.mark.parametrize(('dialect', 'mode', 'streaming', 'before'), [
    (ARDUPILOT, 'LAND', False, 'GUIDED'), (ARDUPILOT, 'STABILIZE', False, ''),
    (PX4, 'OFFBOARD', False, 'AUTO.LOITER'), (PX4, 'OFFBOARD', True, ''),
    (PX4, 'AUTO.LAND', True, 'AUTO.LOITER'), (PX4, 'POSCTL', False, '')])
def test_out_of_a_mode_that_does_not_arm_it_is_brought_before_arming(
        dialect, mode, streaming, before):
    request = Request(commands.arm(True, streaming), 0.0)
    landed = VehicleStatus(False, mode, 'standby', mode == dialect.offboard)
    assert step(request, 0.0, landed, dialect=dialect) == 0
    if before:
        assert request.current.params(dialect) == dialect.set_mode_parameters(before)
        ready = landed._replace(mode=before)
        vehicle = Vehicle(dialect, ready, None, heard=0.2)
        request.step(vehicle, streaming_for=0.0, texts=StatusTexts(), now=0.2)
        assert request.step(vehicle, streaming_for=0.0, texts=StatusTexts(), now=0.3) == 0
    assert request.current is request.goal


def test_acks_of_other_commands_are_not_taken():
    request = Request(commands.arm(True), 0.0)
    step(request, 0.0, HOLD._replace(armed=False))
    request.acknowledge(SET_MODE, 4, 0.1)
    step(request, 0.9, HOLD._replace(armed=False))
    assert request.outcome is None


def test_what_is_already_so_is_not_asked_for():
    request = Request(commands.arm(True), 0.0)
    assert step(request, 0.0, OFFBOARD) is None
    assert request.outcome == (True, 'arm: HEARTBEAT shows OFFBOARD, armed, already')


def test_without_heartbeat_or_stream_nothing_is_asked():
    request = Request(commands.arm(True), 0.0)
    assert [step(request, now, None) for now in (0.0, 1.0, 3.1)] == [None] * 3
    assert request.outcome == (False, 'arm: no HEARTBEAT from the autopilot')
    request = Request(commands.OFFBOARD, 0.0)
    assert [step(request, now, streaming_for=0.0) for now in (0.0, 3.1)] == [None] * 2
    assert request.outcome == (
        False, 'offboard: no setpoint stream has been running for 1.5 s')


@pytest.mark.parametrize(('result', 'words'), [
    (0, 'accepted'), (1, 'temporarily rejected'), (2, 'denied'), (99, 'result 99')])
def test_results_have_words(result, words):
    assert result_words(result) == words


GROUND = VehicleStatus(True, 'STABILIZE', 'standby', False)
GUIDED = VehicleStatus(True, 'GUIDED', 'active', True)
TAKEOFF = mavlink.MAV_CMD_NAV_TAKEOFF


def test_a_take_off_of_arducopter_asks_for_guided_first():
    request = Request(commands.takeoff(2.0, 0.1, None, 0.0), 0.0)
    assert step(request, 0.0, GROUND, dialect=ARDUPILOT, altitude=0.1) == 0
    assert request.current.command == SET_MODE
    request.acknowledge(SET_MODE, 0, 0.1)
    assert step(request, 0.5, GUIDED, dialect=ARDUPILOT, altitude=0.1) is None
    assert request.current.command == TAKEOFF
    assert step(request, 0.6, GUIDED, dialect=ARDUPILOT, altitude=0.1) == 0
    request.acknowledge(TAKEOFF, 0, 0.7)
    assert step(request, 5.0, GUIDED, dialect=ARDUPILOT, altitude=1.89) is None
    assert request.outcome is None
    step(request, 6.0, GUIDED, dialect=ARDUPILOT, altitude=1.91)
    assert request.outcome == (True, 'takeoff: HEARTBEAT shows GUIDED, armed, after 5.4 s')


def test_where_guided_is_refused_there_is_no_take_off():
    request = Request(commands.takeoff(2.0, 0.0, None, 0.0), 0.0)
    step(request, 0.0, GROUND, dialect=ARDUPILOT, altitude=0.0)
    request.acknowledge(SET_MODE, 4, 0.1)
    step(request, 0.7, GROUND, dialect=ARDUPILOT, altitude=0.0)
    assert request.outcome == (False, 'offboard refused: failed')


def test_a_take_off_of_px4_is_one_command_and_waits_for_the_height():
    request = Request(commands.takeoff(2.0, 0.0, 488.0, 0.0), 0.0)
    assert step(request, 0.0, HOLD, altitude=0.0) == 0
    assert request.current.params(PX4)[6] == 490.0
    request.acknowledge(TAKEOFF, 0, 0.1)
    step(request, 16.6, HOLD, altitude=1.0)
    assert request.outcome is None
    step(request, 16.7, HOLD, altitude=1.0)
    assert request.outcome == (
        False, 'takeoff not reached within 16.7 s: HEARTBEAT shows AUTO.LOITER, armed')


@pytest.mark.parametrize(('dialect', 'climbing', 'land'), [
    (PX4, 'AUTO.TAKEOFF', 'AUTO.LAND'), (ARDUPILOT, 'GUIDED', 'LAND')])
def test_a_take_off_that_climbs_on_beyond_its_time_ends_in_a_landing_and_has_failed(
        dialect, climbing, land):
    request = Request(commands.takeoff(2.0, 0.0, 488.0, 0.0), 0.0)
    status = VehicleStatus(True, climbing, 'active', climbing == 'GUIDED')
    sent = {}
    for tenth in range(1, 200):  # the height that it is told has jumped
        confirmation = step(request, tenth / 10, status, dialect=dialect, altitude=-486.0)
        if confirmation is not None:
            sent.setdefault(request.current.name, tenth / 10)
            request.acknowledge(request.current.command, 0, tenth / 10)
        if 'land' in sent and tenth / 10 >= sent['land'] + 0.5:
            status = VehicleStatus(True, land, 'active', False)
    assert sent['land'] - sent['takeoff'] == pytest.approx(16.7, abs=0.15)
    success, message = request.outcome
    assert not success and message.startswith('takeoff not reached within 16.7 s')
    assert f'; land: HEARTBEAT shows {land}, armed' in message


def test_a_take_off_that_is_not_answered_ends_as_soon_as_any_other_request():
    request = Request(commands.takeoff(2.0, 0.0, 488.0, 0.0), 0.0)
    sent = [step(request, now / 10, HOLD, altitude=0.0) for now in range(36)]
    assert [count for count in sent if count is not None] == [0, 1, 2, 3]
    assert request.outcome == (False, 'takeoff: no answer to 4 commands')


def test_landing_is_reached_when_the_vehicle_descends():
    request = Request(commands.LAND, 0.0)
    assert step(request, 0.0) == 0
    step(request, 0.5, VehicleStatus(True, 'AUTO.LAND', 'active', False))
    assert request.outcome == (True, 'land: HEARTBEAT shows AUTO.LAND, armed, after 0.5 s')


@pytest.mark.parametrize(('goal', 'dialect', 'mode'), [
    (commands.OFFBOARD, PX4, 'POSCTL'), (commands.LAND, PX4, 'POSCTL'),
    (commands.takeoff(2.0, 0.0, None, 0.0), PX4, 'AUTO.RTL'),
    (commands.takeoff(2.0, 0.0, None, 0.0), ARDUPILOT, 'STABILIZE')])
def test_a_pilot_who_switches_the_mode_meanwhile_ends_the_request(goal, dialect, mode):
    request = Request(goal, 0.0)
    start = VehicleStatus(True, dialect.hold, 'active', False)
    assert step(request, 0.0, start, altitude=0.0, dialect=dialect) == 0
    switched = VehicleStatus(True, mode, 'active', False)
    assert step(request, 1.2, switched, altitude=0.0, dialect=dialect) is None
    name = 'offboard' if goal.needs_stream else goal.name
    assert request.outcome.message == f'{name} refused: the mode was changed to {mode} meanwhile'


def test_the_modes_of_a_take_off_are_no_interference():
    request = Request(commands.takeoff(2.0, 0.0, None, 0.0), 0.0)
    for mode in ('POSCTL', 'AUTO.TAKEOFF', 'AUTO.LOITER'):
        step(request, 0.0, VehicleStatus(True, mode, 'active', False), altitude=0.5)
    assert request.outcome is None


def test_a_take_off_that_ends_meanwhile_does_not_end_the_request_for_offboard():
    request = Request(commands.OFFBOARD, 0.0)
    for mode in ('AUTO.TAKEOFF', 'AUTO.LOITER'):
        step(request, 0.0, VehicleStatus(True, mode, 'active', False), streaming_for=0.0)
    assert request.outcome is None


def test_a_vehicle_that_disarms_meanwhile_does_not_take_off():
    request = Request(commands.takeoff(2.0, 0.0, None, 0.0), 0.0)
    assert step(request, 0.0, HOLD, altitude=0.0) == 0
    step(request, 1.0, HOLD._replace(armed=False), altitude=0.0)
    assert request.outcome == (False, 'takeoff refused: disarmed meanwhile')
