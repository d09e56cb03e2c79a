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

from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.mavlink import commands
from flock_follower.mavlink.commands import Request, Vehicle
from flock_follower.mavlink.dialects import ARDUPILOT, PX4
from flock_follower.mavlink.status_texts import StatusTexts

SET_MODE, TAKEOFF = mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_CMD_NAV_TAKEOFF
ACCEPTED, REJECTED, FAILED = 0, 1, 4


def climb(dialect):
    return commands.takeoff(dialect, 2.0, 0.0, 488.0, 0.0)


def arm(dialect, mode='', streaming=False):
    return commands.arm(dialect, True, mode, streaming)


def shows(mode, armed=True):
    return VehicleStatus(armed, mode, mode in ('OFFBOARD', 'GUIDED'))


HOLD, OFFBOARD, DISARMED = shows('AUTO.LOITER'), shows('OFFBOARD'), shows('AUTO.LOITER', False)
STABILIZE, GUIDED = shows('STABILIZE'), shows('GUIDED')
LANDED = shows('LAND', False)


def play(goal, script, *, dialect=PX4, streaming_for=5.0, altitude=0.0):
    """
    Return a request after a script, and the times and counts of the commands that it sent.

    An entry is a time, s, the status that HEARTBEAT shows, None where none is fresh, and what is
    answered: an ACK by its result, a STATUSTEXT by its text; a float is a new height, m.
    """
    request, texts, sent = Request(dialect, goal(dialect), 0.0), StatusTexts(), []
    texts.add(mavlink.MAVLink_statustext_message(2, b'Old news'), -1.0)
    for now, status, *answers in script:
        altitude = next((a for a in answers if isinstance(a, float)), altitude)
        vehicle = status and Vehicle(status, altitude)
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
    (commands.offboard, {}, [(0.0, HOLD, ACCEPTED), (0.2, HOLD), (0.8, OFFBOARD)],
     (True, 'offboard: HEARTBEAT shows OFFBOARD, armed, after 0.8 s')),
    (commands.land, {}, [(0.0, HOLD), (0.5, shows('AUTO.LAND'))],
     (True, 'land: HEARTBEAT shows AUTO.LAND, armed, after 0.5 s')),
    (arm, {}, [(0.0, OFFBOARD)],
     (True, 'arm: HEARTBEAT shows OFFBOARD, armed, already')),
    # A refusal waits for the words that explain it.
    (commands.offboard, {}, [(0.0, HOLD, ACCEPTED, REJECTED, 'No offboard signal\t'), (0.4, HOLD)],
     None),
    (commands.offboard, {}, [(0.0, HOLD, ACCEPTED, REJECTED, 'No offboard signal\t'), (0.6, HOLD)],
     (False, 'offboard refused: temporarily rejected: No offboard signal')),
    (arm, {}, [(0.0, DISARMED, ACCEPTED), (3.6, DISARMED)],
     (False, 'arm not reached within 3.5 s: HEARTBEAT shows AUTO.LOITER, disarmed')),
    (commands.hold, {}, every(OFFBOARD, 3.6),
     (False, 'hold: no answer to 4 commands: HEARTBEAT shows OFFBOARD, armed')),
    (commands.hold, {}, every(None, 3.6),
     (False, 'hold: no answer to 2 commands: no HEARTBEAT comes')),
    (climb, {}, every(None, 3.2), (False, 'takeoff: no HEARTBEAT from the autopilot')),
    (commands.hold, {}, every(OFFBOARD, 4.0, REJECTED), (False, '; '.join(
        f'{name} refused: temporarily rejected' for name in ('hold', 'POSCTL', 'AUTO.LAND'))
        + f': {PX4.no_reason}')),
    (commands.offboard, {'streaming_for': 0.0}, every(HOLD, 3.2),
     (False, 'offboard: no setpoint stream has been running for 1.5 s')),
    (commands.offboard, {'streaming_for': 1.4}, every(HOLD, 1.5), None),
    # ArduCopter takes off in GUIDED.
    (climb, {'dialect': ARDUPILOT}, [
        (0.0, STABILIZE, ACCEPTED), (0.5, GUIDED), (0.6, GUIDED, ACCEPTED), (5.0, GUIDED, 1.79)],
     None),
    (climb, {'dialect': ARDUPILOT}, [
        (0.0, STABILIZE, ACCEPTED), (0.5, GUIDED), (0.6, GUIDED, ACCEPTED), (6.0, GUIDED, 1.81)],
     (True, 'takeoff: HEARTBEAT shows GUIDED, armed, after 5.4 s')),
    (climb, {'dialect': ARDUPILOT}, [(0.0, STABILIZE, FAILED), (0.7, STABILIZE)],
     (False, 'offboard refused: failed')),
    (climb, {}, [(0.0, HOLD, ACCEPTED), (16.6, HOLD, 1.0)], None),
    (climb, {}, [(0.0, HOLD, ACCEPTED), (16.7, HOLD, 1.0)],
     (False, 'takeoff not reached within 16.7 s: HEARTBEAT shows AUTO.LOITER, armed')),
    (climb, {}, [(0.0, HOLD), (1.0, DISARMED)], (False, 'takeoff refused: disarmed meanwhile')),
    # The modes of a take-off are no interference, nor does its end end a request for offboard.
    (climb, {}, [(0.0, shows(mode)) for mode in ('POSCTL', 'AUTO.TAKEOFF', 'AUTO.LOITER')], None),
    (commands.offboard, {'streaming_for': 0.0},
     [(0.0, shows(mode)) for mode in ('AUTO.TAKEOFF', 'AUTO.LOITER')], None),
    # A pilot who switches the mode meanwhile ends the request.
    *((goal, {'dialect': dialect}, [(0.0, shows(dialect.hold)), (1.2, shows(mode))],
       (False, f'{name} refused: the mode was changed to {mode} meanwhile'))
      for goal, dialect, mode, name in (
          (commands.offboard, PX4, 'POSCTL', 'offboard'), (commands.land, PX4, 'POSCTL', 'land'),
          (climb, PX4, 'AUTO.RTL', 'takeoff'), (climb, ARDUPILOT, 'STABILIZE', 'takeoff')))])
def test_a_request_ends_as_the_vehicle_shows_it(goal, options, script, outcome):
    assert play(goal, script, **options)[0].outcome == outcome


def test_what_is_sent_and_how_often():
    assert play(commands.offboard, [(1.5, HOLD)], streaming_for=1.5)[1] == [(1.5, SET_MODE, 0)]
    assert commands.offboard(PX4).params == (1.0, 6.0, 0.0)
    for goal, *answers in ((commands.hold,), (commands.land, ACCEPTED)):
        # What ends a flight is sent again though it was acknowledged.
        sent = play(goal, every(OFFBOARD, 3.4, *answers))[1]
        assert [count for _, _, count in sent] == [0, 1, 2, 3]
    # What is accepted and not shown in time is replaced by the next mode.
    sent = play(commands.hold, every(OFFBOARD, 3.8, ACCEPTED))[1]
    assert [count for _, _, count in sent] == [0, 1, 2, 3, 0]
    assert play(climb, [(0.0, HOLD)])[1] == [(0.0, TAKEOFF, 0)] and climb(PX4).params[6] == 490.0
    sent = play(climb, [(0.0, STABILIZE, ACCEPTED), (0.5, GUIDED), (0.6, GUIDED)],
                dialect=ARDUPILOT)[1]
    assert sent == [(0.0, SET_MODE, 0), (0.6, TAKEOFF, 0)]


@pytest.mark.parametrize(('goal', 'script', 'modes', 'reason'), [
    # Accepted, and perhaps reached: no other mode is requested of a vehicle that is not received.
    (commands.hold, [(0.0, OFFBOARD, ACCEPTED), *((t, None) for t in (2.0, 3.6, 5.0))],
     ['AUTO.LOITER'], 'hold not reached within 3.5 s: no HEARTBEAT comes'),
    (commands.hold, [(0.0, OFFBOARD, REJECTED), (0.6, None), (1.2, None)],
     ['AUTO.LOITER'], 'hold refused: temporarily rejected'),
    # A pilot has taken over meanwhile.
    (climb, [(0.0, shows('AUTO.TAKEOFF'), ACCEPTED), (16.8, None), (16.9, None),
             (18.0, shows('POSCTL')), (19.0, shows('POSCTL'))],
     [], 'takeoff refused: the mode was changed to POSCTL meanwhile')])
def test_no_mode_is_requested_against_what_was_not_received(goal, script, modes, reason):
    request, sent = play(goal, script)
    assert [request.current.modes[0] for _, command, _ in sent if command == SET_MODE] == modes
    assert not request.outcome.success and request.outcome.message.endswith(reason)


def test_next_mode_is_not_requested_once_vehicle_is_lost():
    script = [(0.0, OFFBOARD, ACCEPTED, REJECTED), (0.6, OFFBOARD), (0.7, None), (4.0, None)]
    request, sent = play(commands.hold, script)
    assert len(sent) == 1 and not request.outcome.success


def test_reports_before_the_command_do_not_count():
    request = Request(PX4, commands.land(PX4), 0.0)
    for now, shown, sent in ((0.0, -0.1, 0), (0.3, -0.1, None), (0.6, 0.5, None)):
        assert request.outcome is None
        assert request.step(Vehicle(shows('AUTO.LAND'), None, shown), streaming_for=0.0,
                            texts=StatusTexts(), now=now) == sent
    assert request.outcome.success
    # Nor does a mode that a request under way is about to change.
    hold = Request(PX4, commands.hold(PX4), 0.0, superseded=commands.offboard(PX4))
    assert hold.step(Vehicle(HOLD), streaming_for=0.0, texts=StatusTexts(), now=0.0) == 0


def reported(request, script):
    """Return the times, s, at which commands are sent; an entry is a time and a report's mode."""
    sent, newest = [], (-1.0, 'POSCTL')
    for tenth in range(round(10 * script[-1][0]) + 1):
        now = tenth / 10
        for time, *modes in script:
            if time == now:
                for mode in modes:
                    request.observe(mode)
                newest = (now + 0.01, modes[-1]) if modes else newest
        vehicle = Vehicle(shows(newest[1]), None, newest[0])
        if request.step(vehicle, streaming_for=0.0, texts=StatusTexts(), now=now) is not None:
            sent.append(now)
    return sent


def test_a_command_is_sent_again_only_at_a_new_report():
    """A pilot may have switched since an older one."""
    request = Request(PX4, commands.land(PX4), 0.0)
    assert reported(request, [(0.0, 'POSCTL'), (0.9, 'POSCTL'), (1.6, 'POSCTL'), (2.4, 'POSCTL'),
                              (2.7, 'POSCTL'), (3.4,)]) == [0.0, 1.0, 2.4]


@pytest.mark.parametrize('modes', [('AUTO.LAND', 'POSCTL'), ('POSCTL', 'OFFBOARD', 'POSCTL')])
def test_mode_that_was_left_and_is_back_is_the_pilots(modes):
    """Reports that were held up arrive together; the pilot's mode is the one at the beginning."""
    request = Request(PX4, commands.land(PX4), 0.0, superseded=commands.offboard(PX4))
    assert reported(request, [(0.0, 'POSCTL'), (0.9, *modes), (3.0,)]) == [0.0]
    assert request.outcome.message.endswith('the mode was changed to POSCTL meanwhile')


@pytest.mark.parametrize(('mode', 'times'), [('POSCTL', 1), ('OFFBOARD', 4)])
def test_accepted_command_is_repeated_against_setpoints_only(mode, times):
    _, sent = play(commands.land, every(shows(mode), 3.4, ACCEPTED))
    assert len(sent) == times


def test_acks_of_other_commands_are_not_taken():
    request, _ = play(arm, [(0.0, DISARMED)])
    assert not request.acknowledge(SET_MODE, FAILED, 0.1)
    assert request.acknowledge(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, FAILED, 0.1)


@pytest.mark.parametrize(('dialect', 'modes'), [
    (PX4, ('AUTO.LOITER', 'POSCTL', 'AUTO.LAND')), (ARDUPILOT, ('BRAKE', 'LAND'))])
def test_refused_hold_is_followed_by_next_mode_and_reported(dialect, modes):
    flying = shows(dialect.offboard)
    script = every(flying, 0.6 * (len(modes) - 1), REJECTED)
    now = script[-1][0] + 0.2
    request, sent = play(commands.hold, [*script, (now, flying), (now + 1.0, shows(modes[-1]))],
                         dialect=dialect)
    assert len(sent) == len(modes) and request.current.params == (
        dialect.set_mode_parameters(modes[-1]))
    assert request.outcome.success
    *refused, last = request.outcome.message.split('; ')
    assert refused == [f'{name} refused: temporarily rejected' for name in ('hold', *modes[1:-1])]
    assert last.startswith(f'{modes[-1]}: HEARTBEAT shows {modes[-1]}, armed')


@pytest.mark.parametrize(('dialect', 'mode', 'streaming', 'before'), [
    (ARDUPILOT, 'LAND', False, 'GUIDED'), (ARDUPILOT, 'STABILIZE', False, ''),
    (PX4, 'OFFBOARD', False, 'AUTO.LOITER'), (PX4, 'OFFBOARD', True, ''),
    (PX4, 'AUTO.LAND', True, 'AUTO.LOITER'), (PX4, 'POSCTL', False, '')])
def test_mode_that_does_not_arm_is_left_before_arming(
        dialect, mode, streaming, before):
    ready = shows(before or mode, False)
    request, sent = play(lambda dialect: arm(dialect, mode, streaming), [
        (0.0, shows(mode, False)), (0.2, ready), (0.3, ready)], dialect=dialect)
    assert request.current is request.goal and len(sent) == 1 + bool(before)
    first = request.goal.before
    assert (first.params if first else ()) == (
        dialect.set_mode_parameters(before) if before else ())


@pytest.mark.parametrize(('dialect', 'climbing', 'land'), [
    (PX4, 'AUTO.TAKEOFF', 'AUTO.LAND'), (ARDUPILOT, 'GUIDED', 'LAND')])
def test_take_off_beyond_its_time_ends_in_landing_and_fails(
        dialect, climbing, land):
    # The height that it is told has jumped.
    script = [*every(shows(climbing), 17.3, ACCEPTED), (18.0, shows(land)), (18.1, shows(land))]
    request, sent = play(climb, script, dialect=dialect, altitude=-486.0)
    begun = next(now for now, command, _ in sent if command == TAKEOFF)
    landed = next(now for now, command, _ in sent if command == SET_MODE and now > begun)
    assert landed - begun == pytest.approx(16.7, abs=0.15)
    success, message = request.outcome
    assert not success and message.startswith('takeoff not reached within 16.7 s')
    assert f'; land: HEARTBEAT shows {land}, armed' in message
