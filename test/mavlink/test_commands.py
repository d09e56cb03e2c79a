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
from flock_follower.mavlink.commands import Request, Vehicle
from flock_follower.mavlink.dialects import ARDUPILOT, PX4, VehicleStatus
from flock_follower.mavlink.status_texts import StatusTexts

SET_MODE, TAKEOFF = mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_CMD_NAV_TAKEOFF
ACCEPTED, REJECTED, FAILED = 0, 1, 4
CLIMB = commands.takeoff(2.0, 0.0, 488.0, 0.0)


def shows(mode, armed=True):
    return VehicleStatus(armed, mode, 'active', mode in ('OFFBOARD', 'GUIDED'))


HOLD, OFFBOARD, DISARMED = shows('AUTO.LOITER'), shows('OFFBOARD'), shows('AUTO.LOITER', False)
STABILIZE, GUIDED = shows('STABILIZE'), shows('GUIDED')
LANDED = shows('LAND', False)


def play(goal, script, *, dialect=PX4, streaming_for=5.0, altitude=0.0):
    """
    Return a request after a script, and the times and counts of the commands that it sent.

    An entry is a time, s, the status that HEARTBEAT shows, None where none is fresh, and what is
    answered: an ACK by its result, a STATUSTEXT by its text; a float is a new height, m.
    """
    request, texts, sent = Request(goal, 0.0), StatusTexts(), []
    texts.add(mavlink.MAVLink_statustext_message(2, b'Old news'), -1.0)
    for now, status, *answers in script:
        altitude = next((a for a in answers if isinstance(a, float)), altitude)
        vehicle = status and Vehicle(dialect, status, altitude)
        count = request.step(vehicle, streaming_for=streaming_for, texts=texts, now=now)
        sent += [] if count is None else [(now, request.current.command, count)]
        for answer in answers:
            if isinstance(answer, str):
                texts.add(mavlink.MAVLink_statustext_message(2, answer.encode()), now)
            elif isinstance(answer, int):
                request.acknowledge(request.current.command, answer, now)
    return request, sent


def every(status, seconds, *answers):
    return [(tenth / 10, status, *answers) for tenth in range(round(10 * seconds))]


@pytest.mark.parametrize(('goal', 'options', 'script', 'outcome'), [
    # The first ACK is not believed, HEARTBEAT is.
    (commands.OFFBOARD, {}, [(0.0, HOLD, ACCEPTED), (0.2, HOLD), (0.8, OFFBOARD)],
     (True, 'offboard: HEARTBEAT shows OFFBOARD, armed, after 0.8 s')),
    (commands.LAND, {}, [(0.0, HOLD), (0.5, shows('AUTO.LAND'))],
     (True, 'land: HEARTBEAT shows AUTO.LAND, armed, after 0.5 s')),
    (commands.arm(True), {}, [(0.0, OFFBOARD)],
     (True, 'arm: HEARTBEAT shows OFFBOARD, armed, already')),
    # A refusal waits for the words that explain it.
    (commands.OFFBOARD, {}, [(0.0, HOLD, ACCEPTED, REJECTED, 'No offboard signal\t'), (0.4, HOLD)],
     None),
    (commands.OFFBOARD, {}, [(0.0, HOLD, ACCEPTED, REJECTED, 'No offboard signal\t'), (0.6, HOLD)],
     (False, 'offboard refused: temporarily rejected: No offboard signal')),
    (commands.arm(True), {}, [(0.0, DISARMED, ACCEPTED), (3.6, DISARMED)],
     (False, 'arm not reached within 3.5 s: HEARTBEAT shows AUTO.LOITER, disarmed')),
    (commands.HOLD, {}, every(OFFBOARD, 3.6), (False, 'hold: no answer to 4 commands')),
    (CLIMB, {}, every(HOLD, 3.6), (False, 'takeoff: no answer to 4 commands')),
    (commands.HOLD, {}, every(OFFBOARD, 4.0, REJECTED), (False, '; '.join(
        [*(f'{name} refused: temporarily rejected' for name in ('hold', 'POSCTL', 'AUTO.LAND')),
         PX4.no_reason]))),
    (commands.arm(True), {}, every(None, 3.2), (False, 'arm: no HEARTBEAT from the autopilot')),
    (commands.OFFBOARD, {'streaming_for': 0.0}, every(HOLD, 3.2),
     (False, 'offboard: no setpoint stream has been running for 1.5 s')),
    (commands.OFFBOARD, {'streaming_for': 1.4}, every(HOLD, 1.5), None),
    # ArduCopter takes off in GUIDED.
    (CLIMB, {'dialect': ARDUPILOT}, [
        (0.0, STABILIZE, ACCEPTED), (0.5, GUIDED), (0.6, GUIDED, ACCEPTED), (5.0, GUIDED, 1.79)],
     None),
    (CLIMB, {'dialect': ARDUPILOT}, [
        (0.0, STABILIZE, ACCEPTED), (0.5, GUIDED), (0.6, GUIDED, ACCEPTED), (6.0, GUIDED, 1.81)],
     (True, 'takeoff: HEARTBEAT shows GUIDED, armed, after 5.4 s')),
    (CLIMB, {'dialect': ARDUPILOT}, [(0.0, STABILIZE, FAILED), (0.7, STABILIZE)],
     (False, 'offboard refused: failed')),
    (CLIMB, {}, [(0.0, HOLD, ACCEPTED), (16.6, HOLD, 1.0)], None),
    (CLIMB, {}, [(0.0, HOLD, ACCEPTED), (16.7, HOLD, 1.0)],
     (False, 'takeoff not reached within 16.7 s: HEARTBEAT shows AUTO.LOITER, armed')),
    (CLIMB, {}, [(0.0, HOLD), (1.0, DISARMED)], (False, 'takeoff refused: disarmed meanwhile')),
    # The modes of a take-off are no interference, nor does its end end a request for offboard.
    (CLIMB, {}, [(0.0, shows(mode)) for mode in ('POSCTL', 'AUTO.TAKEOFF', 'AUTO.LOITER')], None),
    (commands.OFFBOARD, {'streaming_for': 0.0},
     [(0.0, shows(mode)) for mode in ('AUTO.TAKEOFF', 'AUTO.LOITER')], None),
    # A pilot who switches the mode meanwhile ends the request.
    *((goal, {'dialect': dialect}, [(0.0, shows(dialect.hold)), (1.2, shows(mode))],
       (False, f'{name} refused: the mode was changed to {mode} meanwhile'))
      for goal, dialect, mode, name in (
          (commands.OFFBOARD, PX4, 'POSCTL', 'offboard'), (commands.LAND, PX4, 'POSCTL', 'land'),
          (CLIMB, PX4, 'AUTO.RTL', 'takeoff'), (CLIMB, ARDUPILOT, 'STABILIZE', 'takeoff')))])
def test_a_request_ends_as_the_vehicle_shows_it(goal, options, script, outcome):
    assert play(goal, script, **options)[0].outcome == outcome


def test_what_is_sent_and_how_often():
    assert play(commands.OFFBOARD, [(1.5, HOLD)], streaming_for=1.5)[1] == [(1.5, SET_MODE, 0)]
    assert commands.OFFBOARD.params(PX4) == (1.0, 6.0, 0.0)
    for goal, *answers in ((commands.HOLD,), (commands.LAND, ACCEPTED)):
        # What ends a flight is sent again though it was acknowledged.
        sent = play(goal, every(OFFBOARD, 3.4, *answers))[1]
        assert [count for _, _, count in sent] == [0, 1, 2, 3]
    assert play(CLIMB, [(0.0, HOLD)])[1] == [(0.0, TAKEOFF, 0)] and CLIMB.params(PX4)[6] == 490.0
    sent = play(CLIMB, [(0.0, STABILIZE, ACCEPTED), (0.5, GUIDED), (0.6, GUIDED)],
                dialect=ARDUPILOT)[1]
    assert sent == [(0.0, SET_MODE, 0), (0.6, TAKEOFF, 0)]


def test_acks_of_other_commands_are_not_taken():
    request, _ = play(commands.arm(True), [(0.0, DISARMED)])
    assert not request.acknowledge(SET_MODE, FAILED, 0.1)
    assert request.acknowledge(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, FAILED, 0.1)


@pytest.mark.parametrize(('dialect', 'modes'), [
    (PX4, ('AUTO.LOITER', 'POSCTL', 'AUTO.LAND')), (ARDUPILOT, ('BRAKE', 'LAND'))])
def test_where_hold_is_refused_the_next_mode_is_asked_for_and_told(dialect, modes):
    flying = shows(dialect.offboard)
    script = every(flying, 0.6 * (len(modes) - 1), REJECTED)
    now = script[-1][0] + 0.2
    request, sent = play(commands.HOLD, [*script, (now, flying), (now + 1.0, shows(modes[-1]))],
                         dialect=dialect)
    assert len(sent) == len(modes) and request.current.params(dialect) == (
        dialect.set_mode_parameters(modes[-1]))
    assert request.outcome.success
    *refused, last = request.outcome.message.split('; ')
    assert refused == [f'{name} refused: temporarily rejected' for name in ('hold', *modes[1:-1])]
    assert last.startswith(f'{modes[-1]}: HEARTBEAT shows {modes[-1]}, armed')


@pytest.mark.parametrize(('dialect', 'mode', 'streaming', 'before'), [
    (ARDUPILOT, 'LAND', False, 'GUIDED'), (ARDUPILOT, 'STABILIZE', False, ''),
    (PX4, 'OFFBOARD', False, 'AUTO.LOITER'), (PX4, 'OFFBOARD', True, ''),
    (PX4, 'AUTO.LAND', True, 'AUTO.LOITER'), (PX4, 'POSCTL', False, '')])
def test_out_of_a_mode_that_does_not_arm_it_is_brought_before_arming(
        dialect, mode, streaming, before):
    goal, landed = commands.arm(True, streaming), shows(mode, False)
    request, _ = play(goal, [(0.0, landed)], dialect=dialect)
    assert request.current.params(dialect) == (
        dialect.set_mode_parameters(before) if before else (1.0,))
    ready = shows(before or mode, False)
    request, sent = play(goal, [(0.0, landed), (0.2, ready), (0.3, ready)], dialect=dialect)
    assert request.current is goal and len(sent) == 1 + bool(before)


@pytest.mark.parametrize(('dialect', 'climbing', 'land'), [
    (PX4, 'AUTO.TAKEOFF', 'AUTO.LAND'), (ARDUPILOT, 'GUIDED', 'LAND')])
def test_a_take_off_that_climbs_on_beyond_its_time_ends_in_a_landing_and_has_failed(
        dialect, climbing, land):
    # The height that it is told has jumped.
    script = [*every(shows(climbing), 17.3, ACCEPTED), (18.0, shows(land)), (18.1, shows(land))]
    request, sent = play(CLIMB, script, dialect=dialect, altitude=-486.0)
    begun = next(now for now, command, _ in sent if command == TAKEOFF)
    landed = next(now for now, command, _ in sent if command == SET_MODE and now > begun)
    assert landed - begun == pytest.approx(16.7, abs=0.15)
    success, message = request.outcome
    assert not success and message.startswith('takeoff not reached within 16.7 s')
    assert f'; land: HEARTBEAT shows {land}, armed' in message

