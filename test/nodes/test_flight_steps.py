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
)

GROUND = {'armed': 'False', 'flying': 'False'}
ARMED, AIR = {**GROUND, 'armed': 'True'}, {'armed': 'True', 'flying': 'True'}
HOVER = 'INACTIVE: offboard was not requested'
MODE_LEFT = 'offboard was left for POSCTL'
TAKEN_OVER = f'TAKEN_OVER: {MODE_LEFT}'
ALL = ['disengage', 'hand over']


class Desk:
    """A flight, and the nodes' reports of it, in made-up time."""

    def __init__(self, vehicle: dict[str, str] = AIR, bridge: str = 'ACTIVE',
                 engaged: bool = True) -> None:
        self.now = 100.0
        self.flight, self.reports = Flight(self.now), Reports()
        self.report(vehicle, bridge, engaged)

    def report(self, vehicle: dict[str, str], bridge: str, engaged: bool = False) -> str:
        """Let 2 s pass, have every node report, and return the last line printed."""
        self.now += 2.0
        values: dict[str, Any] = {'planner': {'engaged': str(engaged)}, 'mavlink_bridge': vehicle}
        self.reports.bridge = bridge
        for node in NODES:
            self.reports.nodes[node] = self.now, values.get(node, {})
        self.flight.lines.clear()
        self.flight.step(self.reports, self.now)
        return self.flight.lines[-1] if self.flight.lines else ''

    def press(self, keys: str) -> list[str]:
        return [step for key in keys for step in self.flight.press(key, self.reports)]

    def answer(self, step: str, success: bool = True) -> None:
        self.flight.answer(step, success, 'done', self.reports, self.now)

    def end(self, insist: bool = True) -> list[str]:
        return self.flight.end(INTERRUPTED, self.reports, insist)


def test_each_step_waits_for_its_key_and_its_report() -> None:
    desk = Desk(GROUND, HOVER, False)
    for step, before, after in (('arm', (GROUND, HOVER), (ARMED, HOVER)),
                                ('takeoff', (ARMED, HOVER), (AIR, HOVER)),
                                ('offboard', (AIR, HOVER), (AIR, 'ACTIVE')),
                                ('engage', (AIR, 'ACTIVE'), (AIR, 'ACTIVE', True))):
        assert desk.report(*before) == ''  # it has asked once
        others = 'atoex\n '.replace(step[0], '')
        assert desk.press(others) == [] and desk.press(step[0]) == [step]
        assert desk.press(step[0]) == [] and desk.report(*before) == ''  # until it is answered
        desk.answer(step, False)
        desk.flight.step(desk.reports, desk.now + 9.0)  # an old report does not ask again
        assert desk.flight.lines == ['done'] and desk.press(step[0]) == []
        assert desk.report(*before) == f'{before[1]}: press {step[0]} for {step}'
        assert desk.press(step[0]) == [step]
        desk.answer(step)
        line = desk.report(*after)
    assert line.startswith('the follower flies') and desk.flight.code is None
    assert desk.report(AIR, TAKEN_OVER) == f'{TAKEN_OVER}: press o for offboard'
    # The bridge names a failsafe a little later than the mode.
    assert desk.report(AIR, f'{TAKEN_OVER}: failsafe: fence') == ''
    assert f'{MODE_LEFT}: failsafe: fence' in desk.reports.line(desk.now)


def test_steps_without_keys_are_requested_once_refusal_ends() -> None:
    desk = Desk(GROUND, HOVER, False)
    desk.flight = Flight(desk.now, confirm=False)
    for step, before in (('arm', (GROUND, HOVER)), ('takeoff', (ARMED, HOVER)),
                         ('offboard', (AIR, HOVER)), ('engage', (AIR, 'ACTIVE'))):
        desk.report(*before)
        assert desk.flight._pending == {step}
        desk.answer(step)
    assert desk.report(AIR, 'ACTIVE', True).startswith('the follower flies')
    again = desk.report(AIR, TAKEN_OVER)
    assert 'only once' in again and TAKEN_OVER in again and desk.flight.code is not None
    refused = Desk(GROUND, HOVER, False)
    refused.flight = Flight(refused.now, confirm=False)
    refused.report(GROUND, HOVER)
    refused.answer('arm', False)
    assert refused.flight.code == 1


@pytest.mark.parametrize(('connection', 'own'), [
    ('udpin:127.0.0.1:14540', True), ('udpout:localhost:14540', True), ('tcp:127.0.0.2:1', True),
    ('udpin:0.0.0.0:14540', False), ('/dev/ttyACM0:57600', False), ('udpin:drone:14540', False),
    ('tcp:localhost.example.com:5760', False), ('udpin:127.0.0.1', False), ('', False),
    ('udpin:192.168.1.2:14540', False), ('udp://127.0.0.1:14540', True)])
def test_only_an_address_of_this_machine_is_loopback(connection: str, own: bool) -> None:
    assert loopback(connection) is own


@pytest.mark.parametrize(('bridge', 'requested'), [
    ('ACTIVE', ALL), ('READY: waiting', ALL), ('NO_AUTOPILOT: lost, ACTIVE before', ALL),
    ('NO_AUTOPILOT: lost, INACTIVE: on the ground before', ['disengage']),
    (HOVER, ['disengage']), (TAKEN_OVER, ['disengage'])])
def test_ctrl_c_takes_the_vehicle_from_nobody_but_the_follower(
        bridge: str, requested: list[str]) -> None:
    desk = Desk(bridge=bridge)
    assert desk.end() == requested
    assert desk.flight.code is None and desk.press('ol') == []
    for step in requested:
        desk.answer(step)
    assert desk.flight.code == INTERRUPTED


@pytest.mark.parametrize(('step', 'vehicle'), [('takeoff', ARMED), ('offboard', AIR)])
def test_ctrl_c_ends_what_is_under_way(step: str, vehicle: dict[str, str]) -> None:
    desk = Desk(vehicle, HOVER, False)
    assert desk.press(step[0]) == [step] and desk.end() == ALL
    desk.answer(step, False)
    desk.answer('disengage')
    assert desk.flight.code is None
    desk.answer('hand over', False)
    assert desk.flight.code == 1


def test_second_ctrl_c_ends_without_answer_second_hangup_not() -> None:
    desk = Desk(GROUND, HOVER, False)
    assert desk.end() == [] and desk.flight.code == INTERRUPTED  # on the ground at once
    desk = Desk()
    desk.end()
    assert desk.end(insist=False) == [] and desk.flight.code is None
    assert desk.end() == [] and desk.flight.code == INTERRUPTED


def test_l_lands_from_any_airborne_step_and_ends_disarmed() -> None:
    desk = Desk(ARMED, HOVER, False)
    assert desk.press('l') == []  # on the ground
    assert desk.press('tl') == ['takeoff', 'disengage', 'land']
    desk = Desk()
    assert desk.press('l') == ['disengage', 'land'] and desk.press('ll') == []
    desk.answer('disengage')
    desk.answer('land', False)
    assert desk.press('l') == ['disengage', 'land']
    for step in ('land', 'disengage'):
        desk.answer(step)
    for vehicle in (AIR, {**AIR, 'armed': ''}):  # lost, not disarmed
        desk.report(vehicle, HOVER)
        assert desk.flight.code is None
    desk.report(GROUND, HOVER)
    assert desk.flight.code == 0
    desk = Desk()
    desk.press('l')
    assert desk.end() == ['disengage']  # the landing goes on


def test_check_finding_in_the_air_only_lands_or_hands_over() -> None:
    """A second `follow` in flight had ended at the findings, without the key that lands."""
    desk = Desk(AIR, HOVER, False)
    desk.flight = Flight(desk.now, ready=False)
    for node in ('relative_pose', 'planner'):  # a likely finding: both are silent
        del desk.reports.nodes[node]
    desk.now += 9.0
    desk.reports.nodes['mavlink_bridge'] = desk.now, AIR
    desk.flight.step(desk.reports, desk.now)
    assert desk.flight.code is None
    assert desk.flight.lines[-1].startswith('not ready to fly, but in the air: press l')
    assert desk.press('atoe') == [] and desk.press('l') == ['disengage', 'land']
    desk.flight = Flight(desk.now, ready=False)
    desk.report(AIR, 'ACTIVE', True)
    assert desk.end() == ['disengage', 'hand over']


def test_missing_node_ends_it_without_autopilot_nothing_is_due() -> None:
    desk = Desk()
    assert desk.report(AIR, 'NO_AUTOPILOT: lost, ACTIVE before') == ''
    for vehicle in ({'armed': '', 'flying': ''}, {**ARMED, 'flying': ''}):
        assert desk.report(vehicle, HOVER) == ''  # the state is known before
    assert desk.press('a') == []
    flight = Flight(100.0)
    del desk.reports.nodes['planner']
    flight.step(desk.reports, 100.0 + DISCOVERY)
    assert flight.code is None
    flight.step(desk.reports, 100.1 + DISCOVERY)
    assert flight.code == 1 and flight.lines[0].startswith('missing: planner: ')


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
