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

"""The steps of the command ``follow``, in made-up time: what is requested when, and why."""

from __future__ import annotations

from typing import Any

import pytest

from flock_follower.nodes.flight_steps import (
    DISCOVERY,
    Flight,
    INTERRUPTED,
    loopback,
    NODES,
    Reports,
    SILENCE,
)

GROUND = {'armed': 'False', 'flying': 'False'}
ARMED, AIR = {**GROUND, 'armed': 'True'}, {'armed': 'True', 'flying': 'True'}
HOVER = 'INACTIVE: offboard was not requested'
TAKEN_OVER = 'TAKEN_OVER: offboard was left for POSCTL'
ALL = ['disengage', 'hand over']
#: What the nodes report once a step has been reached.
REACHED = {'arm': (ARMED, ''), 'takeoff': (AIR, ''), 'offboard': (None, 'ACTIVE')}


class Desk:
    """A flight, and the nodes' reports of it, in made-up time."""

    def __init__(self, vehicle: dict[str, str] = AIR, bridge: str = HOVER, confirm: bool = True,
                 until: str = 'check') -> None:
        self.now = 100.0
        self.flight, self.reports = Flight(self.now, confirm), Reports()
        self.engaged = 'False'
        self.begun = self.report(vehicle, bridge)
        for each in ('check', 'arm', 'takeoff', 'offboard', 'engage'):
            if each == until:
                break
            if self.press(each[0]):
                self.answer(each)
                self.engaged = str(each == 'engage')
                self.report(*REACHED.get(each, (None, '')))
        if until != 'check':
            self.shown()

    def report(self, vehicle: dict[str, str] | None = None, bridge: str = '') -> list[str]:
        """Let a second pass, have every node report, and return what is requested then."""
        self.now += 1.0
        known = self.reports.nodes.get('mavlink_bridge', (0.0, {}))[1]
        values: dict[str, Any] = {
            'relative_pose': {}, 'planner': {'engaged': self.engaged, 'state': 'IDLE'},
            'mavlink_bridge': vehicle or known}
        self.reports.bridge = bridge or self.reports.bridge
        for node in NODES:
            self.reports.nodes[node] = self.now, values[node]
        return self.flight.step(self.reports, self.now)

    def press(self, keys: str) -> list[str]:
        return [step for key in keys for step in self.flight.press(key, self.reports)]

    def answer(self, step: str, success: bool = True, message: str = 'done') -> list[str]:
        return self.flight.answer(step, success, message, self.reports, self.now)

    def end(self, insist: bool = True) -> list[str]:
        return self.flight.end(INTERRUPTED, self.reports, insist)

    def shown(self) -> str:
        """Return the last line, and forget all."""
        lines, self.flight.lines = self.flight.lines, []
        return lines[-1] if lines else ''


def test_each_step_waits_for_its_key_and_for_the_report_that_it_came_about() -> None:
    desk = Desk(GROUND)
    for step, vehicle, bridge in (('check', GROUND, HOVER), ('arm', ARMED, HOVER),
                                  ('takeoff', AIR, HOVER), ('offboard', AIR, 'ACTIVE')):
        assert desk.shown().endswith(f'press {step[0]} for {step}')
        assert desk.report() == [] and desk.shown() == ''  # it waits, and asks once
        others = 'caotelx\n '.replace(step[0], '')
        assert desk.press(others if vehicle is GROUND else 'x') == []  # only the key that is due
        assert desk.press(step[0]) == [step]
        assert desk.press(step[0]) == [] and desk.report() == []  # until it is answered
        desk.answer(step)
        # An old report does not ask again for what was just done.
        assert desk.flight.step(desk.reports, desk.now + 0.5) == [] and desk.shown() == 'done'
        assert desk.report(vehicle, bridge) == []
    assert desk.press('e') == ['engage']
    desk.answer('engage')
    desk.engaged = 'True'
    desk.report()
    assert desk.shown().startswith('the follower flies') and desk.flight.code is None


def test_what_is_reached_already_is_left_out() -> None:
    desk = Desk(until='arm')
    desk.report()
    assert desk.press('a') == [] and desk.press('o') == ['offboard']


@pytest.mark.parametrize(('step', 'vehicle'), [('check', AIR), ('arm', GROUND)])
def test_a_refusal_shows_the_reason_and_goes_no_further(
        step: str, vehicle: dict[str, str]) -> None:
    desk = Desk(vehicle, until=step)
    desk.press(step[0])
    assert desk.answer(step, False, 'refused: compass') == []
    assert desk.shown() == 'refused: compass'
    desk.report()
    assert desk.shown().endswith(f'press {step[0]} for {step}')


def test_after_a_takeover_offboard_is_due_again_by_its_key_only() -> None:
    desk = Desk(until='')
    desk.engaged = 'False'
    assert desk.report(bridge=TAKEN_OVER) == []
    assert desk.shown() == f'{TAKEN_OVER}: press o for offboard'
    assert desk.press('e') == [] and desk.press('o') == ['offboard']


@pytest.mark.parametrize(('bridge', 'requested'), [
    ('ACTIVE', ALL), ('READY: waiting', ALL), ('NO_AUTOPILOT: lost, ACTIVE before', ALL),
    ('NO_AUTOPILOT: lost, INACTIVE: on the ground before', ['disengage']),
    (HOVER, ['disengage']), (TAKEN_OVER, ['disengage'])])
def test_ctrl_c_takes_the_vehicle_from_nobody_but_the_follower(
        bridge: str, requested: list[str]) -> None:
    desk = Desk(until='')
    desk.report(bridge=bridge)
    assert desk.end() == requested
    assert desk.flight.code is None and desk.press('cl') == [] and desk.report() == []
    for step in requested:
        desk.answer(step)
    assert desk.flight.code == INTERRUPTED


@pytest.mark.parametrize(('step', 'vehicle'), [('takeoff', ARMED), ('offboard', AIR)])
def test_ctrl_c_ends_what_is_under_way(step: str, vehicle: dict[str, str]) -> None:
    desk = Desk(vehicle, until=step)
    assert desk.press(step[0]) == [step] and desk.end() == ALL
    desk.answer(step, False, 'superseded by hold')
    desk.answer('disengage')
    assert desk.flight.code is None
    desk.answer('hand over', False, 'hold refused')
    assert desk.flight.code == 1


def test_a_second_ctrl_c_ends_without_the_answer_and_a_second_hangup_does_not() -> None:
    desk = Desk(GROUND)
    assert desk.end() == [] and desk.flight.code == INTERRUPTED  # on the ground at once
    desk = Desk(bridge='ACTIVE')
    desk.end()
    assert desk.end(insist=False) == [] and desk.flight.code is None
    assert desk.end() == [] and desk.flight.code == INTERRUPTED


def test_l_lands_from_any_step_in_the_air_and_ends_when_it_is_disarmed() -> None:
    desk = Desk(ARMED, until='takeoff')
    assert desk.press('l') == []  # on the ground
    assert desk.press('tl') == ['takeoff', 'disengage', 'land']
    desk = Desk()
    assert desk.press('l') == ['disengage', 'land'] and desk.press('ll') == []
    desk.answer('disengage')
    desk.answer('land', False, 'land refused')
    desk.report()
    assert desk.press('l') == ['disengage', 'land']
    for step in ('land', 'disengage'):
        desk.answer(step)
    for vehicle in (AIR, {**AIR, 'armed': ''}):  # lost, not disarmed
        desk.report(vehicle)
        assert desk.flight.code is None
    desk.report(GROUND)
    assert desk.flight.code == 0
    desk = Desk()
    desk.press('l')
    assert desk.end() == []  # the landing goes on


def test_without_keys_each_step_is_requested_once() -> None:
    desk = Desk(GROUND, confirm=False)
    requested = list(desk.begun)
    for vehicle, bridge in ((GROUND, HOVER), (ARMED, HOVER), (AIR, HOVER), (AIR, 'ACTIVE')):
        assert desk.report(vehicle, bridge) == []  # before the answer
        desk.answer(requested[-1])
        requested += desk.report(vehicle, bridge)
    assert requested == ['check', 'arm', 'takeoff', 'offboard', 'engage']
    desk.answer('engage')
    desk.engaged = 'True'
    assert desk.report() == [] and desk.shown().startswith('the follower flies')
    desk.engaged = 'False'
    assert desk.report(bridge='TAKEN_OVER: offboard was left') == []
    assert 'offboard is due again' in desk.shown() and desk.flight.code == 1


def test_without_keys_a_refusal_ends_it_and_hands_over() -> None:
    desk = Desk(confirm=False)
    assert desk.answer('check', False, 'not ready') == [] and desk.flight.code == 1
    desk = Desk(bridge='ACTIVE', confirm=False)
    desk.answer('check')
    assert desk.report() == ['engage']
    assert desk.answer('engage', False, 'no answer') == ALL


def test_missing_nodes_are_named_once_and_end_it_before_the_first_step() -> None:
    desk = Desk()
    del desk.reports.nodes['planner']
    assert desk.flight.step(desk.reports, 100.0 + SILENCE) == [] and desk.flight.code is None
    desk.flight.lines.clear()
    desk.reports.nodes['relative_pose'] = desk.reports.nodes['mavlink_bridge'] = (109.0, {})
    assert desk.flight.step(desk.reports, 101.0 + DISCOVERY) == [] and desk.flight.code == 1
    assert desk.shown().startswith('missing: planner (no diagnostics for 3 s)')


@pytest.mark.parametrize(('confirm', 'requested'), [(True, []), (False, ALL)])
def test_a_node_that_dies_in_flight_is_named_and_keys_still_work(
        confirm: bool, requested: list[str]) -> None:
    desk = Desk(until='')
    desk.flight._confirm = confirm
    late = desk.now + DISCOVERY + 1.0
    for node in ('planner', 'mavlink_bridge'):
        desk.reports.nodes[node] = late, desk.reports.nodes[node][1]
    assert desk.flight.step(desk.reports, late) == requested
    assert desk.flight.code is None
    assert any(line.startswith('missing: relative_pose') for line in desk.flight.lines)
    assert desk.press('l') == (['disengage', 'land'] if confirm else [])


def test_while_the_autopilot_is_not_received_nothing_is_due() -> None:
    desk = Desk(until='')
    assert desk.report({'armed': '', 'flying': ''}, 'NO_AUTOPILOT: lost, ACTIVE before') == []
    assert desk.shown() == '' and desk.press('a') == []


def test_the_live_line_shows_states_distance_battery_and_reasons() -> None:
    reports = Reports(bridge='READY: waiting for offboard mode', battery='battery 87 %')
    reports.nodes['planner'] = 9.5, {'state': 'IDLE', 'reason': 'not engaged'}
    reports.distance = 10.0, 'leader 1.92 m'
    assert reports.line(10.5) == ('READY   IDLE   leader 1.92 m   battery 87 %   '
                                  'waiting for offboard mode; not engaged')
    assert 'leader' not in reports.line(12.0)


def test_the_state_of_a_silent_node_is_shown_with_its_age() -> None:
    reports = Reports(bridge='ACTIVE')  # latched: it stays when the bridge is killed
    for node in ('planner', 'mavlink_bridge'):
        reports.nodes[node] = 10.0, {'state': 'TRACK'}
    assert reports.line(11.4).startswith('ACTIVE   TRACK')
    reports.nodes['planner'] = 11.5, {'state': 'TRACK'}
    assert reports.line(11.6).startswith('ACTIVE (2 s ago)   TRACK')


@pytest.mark.parametrize(('connection', 'own'), [
    ('udpin:127.0.0.1:14540', True), ('tcp:localhost:5760', True), ('udpout:127.1.2.3:1', True),
    ('udpin:0.0.0.0:14540', False), ('udpout:10.0.0.2:14550', False), ('/dev/ttyACM0', False),
    ('tcp:localhost.example.com:5760', False), ('udpin:127.0.0.1', False), ('', False)])
def test_only_an_address_of_this_machine_is_loopback(connection: str, own: bool) -> None:
    assert loopback(connection) is own
