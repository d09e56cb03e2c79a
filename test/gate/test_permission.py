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

"""Who may fly: the state machine, its picture in docs/, and what holds for every history."""

from dataclasses import replace
from pathlib import Path
import re

from hypothesis import given
from hypothesis import strategies as st
import pytest

from flock_follower.gate.permission import (
    Cause,
    LONGEST_SILENCE,
    NOT_REQUESTED,
    Permission,
    Phase,
    STICK,
    Taker,
)
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.mavlink import takeover

DIAGRAM = Path(__file__).resolve().parents[2] / 'docs' / 'fly.md'
OURS = VehicleStatus(True, 'OFFBOARD', True)
DISARMED = OURS._replace(armed=False)
HOLD = VehicleStatus(True, 'AUTO.LOITER', False)
PILOT = VehicleStatus(True, 'POSCTL', False)
# Events: the name of the transition, and its arguments.
ASKED = 'request', 1.0
ENDED = 'end', 'hold requested'
MOVED = 'end', STICK.text, Cause.STICK
REBOOTED = 'reset', 'the autopilot rebooted'
SECOND = 'contest', '/planner, /other'
SILENT = 'fall_silent', 'no velocity', 0.1  # since the last message with the mode, s
LANDED = 'land',
GROUND = 'on the ground'


def seen(status, received=2.0, airborne=True):
    return 'follow_status', status, received, airborne


def next_permission(permission, event):
    name, *arguments = event
    return getattr(permission, name)(*arguments)


def after(*events):
    permission = Permission()
    for event in events:
        permission = next_permission(permission, event)
    return permission


@pytest.mark.parametrize('events', [
    (), (seen(HOLD),), (seen(OURS),), (seen(HOLD), seen(OURS), seen(OURS)),
    (LANDED, seen(OURS)), (ENDED, seen(OURS)),
    (REBOOTED, seen(OURS)), (('fail', 'late'), seen(OURS))])
def test_nothing_is_sent_before_offboard_in_any_mode(events):
    assert not after(*events).streams


def test_request_streams_and_mode_in_the_air_makes_it_active():
    assert (after(ASKED).phase, after(ASKED).reason) == (
        Phase.READY, 'waiting for offboard mode')
    waiting = after(ASKED, seen(HOLD), seen(OURS, airborne=None))
    assert waiting.announcement() == 'READY: OFFBOARD, not reported to fly'
    assert next_permission(waiting, seen(OURS)).announcement() == 'ACTIVE'


@pytest.mark.parametrize('status', [OURS, HOLD])
def test_on_the_ground_or_disarmed_a_request_ends(status):
    assert after(ASKED, seen(status, airborne=False)).announcement() == f'INACTIVE: {GROUND}'
    disarmed = after(ASKED, seen(status._replace(armed=False)), seen(OURS))
    assert disarmed.announcement() == 'INACTIVE: disarmed'


@pytest.mark.parametrize('events', [(), (seen(OURS),), (seen(OURS), ENDED)])
def test_a_landing_ends_the_permission(events):
    assert after(ASKED, *events, LANDED, seen(OURS)).announcement() == f'INACTIVE: {GROUND}'


def test_a_takeover_bars_offboard_for_ten_seconds():
    permission = after(ASKED, seen(OURS), seen(PILOT, 5.0))
    for now, seconds in ((4.0, 0), (5.0, 0), (11.0, 6)):
        assert permission.takeover_refusal(now).startswith(
            f'the pilot, or a failsafe, took over {seconds} s ago')
        by_stick = permission.name_taker(STICK, now)
        assert by_stick.takeover_refusal(now).startswith('the pilot took over')
        assert not by_stick.takeover_refusal(15.0)  # 10 s from the takeover
    assert permission.takeover_refusal(14.9)
    failed = permission.name_taker(takeover.failsafe('fence'), 6.0)
    assert not failed.takeover_refusal(6.0)
    assert failed.announcement() == 'TAKEN_OVER: offboard was left for POSCTL: failsafe: fence'
    assert failed.name_taker(takeover.PILOT, 16.0).takeover_refusal(25.9)  # a later pilot
    assert not permission.takeover_refusal(15.0) and not permission.takeover_refusal(60.0)
    assert not after(ASKED, seen(OURS), ENDED, seen(HOLD, 5.0)).takeover_refusal(5.0)  # our own


@pytest.mark.parametrize('later', [OURS, HOLD])
def test_ten_seconds_count_from_last_switch_of_pilot(later):
    """LOITER, GUIDED, LOITER: offboard was accepted 1 s after the last switch."""
    permission = after(ASKED, seen(OURS), seen(PILOT, 5.0), seen(later, 9.0), seen(PILOT, 14.0))
    assert permission.takeover_refusal(23.9) and not permission.takeover_refusal(24.0)
    assert permission.announcement().startswith('TAKEN_OVER: offboard was left for POSCTL: ')
    once = after(ASKED, seen(OURS), seen(PILOT, 5.0))
    assert not next_permission(once, seen(PILOT, 14.0)).takeover_refusal(15.0)
    # A failsafe may fly several modes.
    failed = next_permission(once.name_taker(takeover.failsafe('fence'), 6.0), seen(HOLD, 7.0))
    assert not failed.takeover_refusal(7.0)


@pytest.mark.parametrize('events', [(), (ASKED,), (ASKED, seen(OURS)), (ASKED, LANDED)])
def test_a_stick_takes_over_no_flight_that_none_took(events):
    assert after(*events).name_taker(STICK, 5.0) == after(*events)


@pytest.mark.parametrize('events', [
    (), (ENDED,), (('end', 'low battery'), seen(PILOT, 5.0)), (SILENT,),
    (ENDED, SILENT), (LANDED,), (seen(DISARMED, 5.0),)])
def test_nothing_but_a_request_undoes_a_moved_stick(events):
    permission = after(ASKED, seen(OURS, 5.0), MOVED, *events)
    assert permission.takeover_refusal(14.9).startswith('the pilot took over')
    assert not permission.takeover_refusal(15.0)
    assert not next_permission(permission, ('request', 15.0)).takeover_refusal(15.0)


def test_a_mode_left_after_a_moved_stick_is_a_takeover():
    assert after(ASKED, seen(OURS), MOVED, seen(PILOT, 5.0)).announcement() == (
        'TAKEN_OVER: offboard was left for POSCTL: the pilot moved a stick')


@pytest.mark.parametrize('ended', [
    (SILENT,), (ENDED, seen(HOLD, 5.0))])
def test_a_stick_moved_as_the_stream_ends_bars_offboard(ended):
    permission = after(ASKED, seen(OURS, 5.0), *ended, MOVED)
    assert permission.phase is Phase.INACTIVE
    assert permission.takeover_refusal(14.9).startswith('the pilot took over')
    assert not permission.takeover_refusal(15.0) and after(MOVED) == Permission()


UNSEEN = 'fall_silent', 'no velocity', 3.1


@pytest.mark.parametrize('events', [
    (UNSEEN,), (('follow_silence', 5.1), SILENT), (UNSEEN, ENDED)])
def test_silence_hides_no_switch_that_was_not_seen(events):
    silent = after(ASKED, seen(OURS), *events)
    assert silent.announcement() == 'INACTIVE: fell silent: no velocity'
    assert next_permission(silent, seen(OURS, 20.0)).phase is Phase.INACTIVE
    switched = after(ASKED, seen(OURS), *events, seen(OURS, 20.0), seen(PILOT, 21.0))
    assert switched.phase is Phase.TAKEN_OVER and switched.takeover_refusal(30.9)
    landed = next_permission(silent, seen(DISARMED, 20.0))
    assert not landed.takeover_refusal(20.0)
    assert next_permission(landed, seen(PILOT, 21.0)) is landed
    # Nothing is hidden if the mode was known, or had not been there yet.
    for known in (after(ASKED, seen(OURS), SILENT), after(ASKED, UNSEEN),
                  after(ASKED, seen(OURS), ('fall_silent', 'no velocity', 3.0))):
        assert next_permission(known, seen(PILOT, 20.0)) is known


def test_a_request_hides_no_possible_takeover_by_the_pilot():
    lost = after(ASKED, seen(OURS), ('follow_silence', 5.1), ENDED)
    assert lost.announcement() == 'READY: giving back: hold requested'
    assert next_permission(lost, seen(PILOT, 20.0)).takeover_refusal(20.0)


def test_a_second_end_of_a_flight_is_no_possible_takeover():
    giving = after(ASKED, seen(OURS), ENDED, ('end', 'low battery'))
    assert next_permission(giving, seen(PILOT, 20.0)).announcement() == (
        'INACTIVE: given back (low battery)')


@pytest.mark.parametrize(('events', 'flies'), [
    ((), False), ((ASKED,), False), ((ASKED, seen(HOLD)), False), ((ASKED, seen(DISARMED)), False),
    ((ASKED, seen(OURS, airborne=False)), False), ((ASKED, seen(OURS)), True),
    ((ASKED, seen(OURS, airborne=None)), True),
    ((ASKED, seen(OURS), ENDED), True), ((ASKED, seen(OURS), seen(DISARMED)), False),
    ((ASKED, seen(OURS), seen(PILOT)), False), ((ASKED, seen(OURS), REBOOTED), False),
    ((ASKED, seen(OURS), seen(PILOT), ('request', 3.0)), False)])
def test_it_flies_from_mode_report_until_stream_ends(events, flies):
    assert after(*events).flies is flies


@pytest.mark.parametrize('received', [0.5, 1.0])
def test_a_heartbeat_from_before_the_request_has_no_effect(received):
    assert after(ASKED, seen(OURS, received)) == after(ASKED, seen(HOLD, received)) == after(ASKED)


def test_refused_request_ends_and_stream_without_velocity_stops():
    assert after(ASKED, ('fail', 'refused')).announcement() == 'INACTIVE: refused'
    silent = after(ASKED, seen(OURS), SILENT)
    assert silent.announcement() == 'INACTIVE: fell silent: no velocity'
    for idle in (after(), after(ASKED, seen(OURS), seen(PILOT))):
        assert next_permission(idle, ('fail', 'refused')) is idle
        assert next_permission(idle, SILENT) is idle


def test_late_refusal_ends_nothing_that_vehicle_already_obeys():
    for obeying in (after(ASKED, seen(OURS)), after(ASKED, seen(OURS, airborne=None))):
        assert next_permission(obeying, ('fail', 'late')) is obeying
        assert next_permission(obeying, ENDED).phase is Phase.GIVING_BACK


@pytest.mark.parametrize('airborne', [False, True, None])  # a false report removes no thrust
def test_active_it_stays_from_heartbeat_to_heartbeat(airborne):
    active = after(ASKED, seen(OURS))
    assert next_permission(active, seen(OURS, 3.0, airborne)) == replace(active, received=3.0)


def test_giving_back_brakes_until_mode_is_left_then_stops():
    giving = after(ASKED, seen(OURS), ENDED, seen(OURS))
    assert giving.announcement() == 'READY: giving back: hold requested'
    assert giving.streams and giving.flies
    assert next_permission(giving, seen(HOLD)).announcement() == (
        'INACTIVE: given back (hold requested)')
    assert next_permission(giving, seen(DISARMED)).announcement() == (
        'INACTIVE: given back (hold requested)')
    assert after(ASKED, seen(HOLD), ENDED).announcement() == 'INACTIVE: hold requested'


def test_only_an_unknown_taker_may_be_a_failsafe():
    taken = after(ASKED, seen(OURS), seen(PILOT, 5.0)).name_taker(Taker('a pilot', True), 5.0)
    assert taken.takeover_refusal(5.0).startswith('the pilot took over')


def test_where_two_nodes_command_it_brakes_until_asked_again():
    braking = after(ASKED, seen(OURS), SECOND)
    assert braking.announcement() == 'READY: giving back: two nodes command: /planner, /other'
    assert braking.flies
    assert next_permission(braking, seen(OURS, 3.0)).phase is Phase.GIVING_BACK
    again = next_permission(braking, ('request', 4.0))
    assert next_permission(again, SECOND) is again  # it obeys no command yet
    assert next_permission(again, seen(OURS, 4.5)).phase is Phase.ACTIVE


def test_long_silence_may_hide_a_takeover_and_return():
    active = after(ASKED, seen(OURS, 2.0), seen(OURS, 2.0 + LONGEST_SILENCE))
    assert active.phase is Phase.ACTIVE
    lost = next_permission(active, seen(OURS, active.received + LONGEST_SILENCE + 0.1))
    assert lost.announcement() == (
        'READY: giving back: mode unknown for 5 s, the pilot may have taken over')
    assert active.follow_silence(LONGEST_SILENCE) is active
    assert active.follow_silence(LONGEST_SILENCE + 0.1).announcement() == lost.announcement()
    # Somebody has changed the mode meanwhile; a disarmed vehicle was landed.
    assert next_permission(lost, seen(PILOT, 20.0)).takeover_refusal(20.0)
    assert next_permission(lost, seen(DISARMED, 20.0)).phase is Phase.INACTIVE
    assert next_permission(lost, seen(OURS, 20.0)).phase is Phase.GIVING_BACK
    assert after(ASKED, seen(OURS, 2.0), seen(OURS, 20.0)).phase is Phase.GIVING_BACK
    assert after(ASKED, seen(OURS), seen(PILOT, 20.0)).phase is Phase.TAKEN_OVER
    again = next_permission(lost, ('request', 21.0))
    assert next_permission(again, seen(OURS, 21.5)).phase is Phase.ACTIVE
    # Before the mode was there nothing could be taken over.
    assert after(ASKED, seen(HOLD, 1.5), seen(OURS, 20.0)).phase is Phase.ACTIVE


STATUSES = [VehicleStatus(armed, mode, mode == 'OFFBOARD')
            for armed in (False, True) for mode in ('OFFBOARD', 'POSCTL', 'AUTO.LOITER')]
EVENTS = [('request', 1.0), ('follow_silence', 5.1), SILENT, UNSEEN,
          ('fail', 'late'), LANDED, ENDED, MOVED, REBOOTED, SECOND,
          *(seen(status, received, airborne) for status in STATUSES for received in (0.5, 2.0, 9.0)
            for airborne in (False, True, None))]


def edges():
    """Return every step from one phase to another that there is."""
    known, new, found = {Permission()}, [Permission()], set()
    while new:
        permission = new.pop()
        for event in EVENTS:
            then = next_permission(permission, event)
            found.add((permission.phase.name, then.phase.name))
            if then not in known:
                known.add(then)
                new.append(then)
    return {edge for edge in found if edge[0] != edge[1]}


def test_the_picture_shows_every_step_and_no_other():
    drawn = set(re.findall(r'^ +([A-Z_]+) --> ([A-Z_]+):', DIAGRAM.read_text(), re.M))
    assert drawn == edges()


@given(st.lists(st.sampled_from(EVENTS), max_size=30))
def test_only_a_request_begins_stream_only_active_flies_commands(events):
    permission = Permission()
    for event in events:
        before, permission = permission, next_permission(permission, event)
        name, status, received, airborne = (*event, None, None, None)[:4]
        new = name == 'follow_status' and received > before.since
        if permission.streams and not before.streams:
            assert name == 'request'
        if permission.phase is Phase.ACTIVE and before.phase is not Phase.ACTIVE:
            assert new and status.offboard and status.armed and airborne
        if new and before.phase is Phase.ACTIVE and not (status.offboard and status.armed):
            assert not permission.streams
        assert (permission.reason == '') == (permission.phase is Phase.ACTIVE)
        assert (permission.cause is None) == (permission.phase is Phase.ACTIVE)
        assert (permission.cause is Cause.TAKEN) == (permission.phase is Phase.TAKEN_OVER)
        assert permission.reason != NOT_REQUESTED or permission == Permission()
