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

"""Texts of the autopilot, joined from their chunks, and reports to the ground station."""

import json
import math

import px4_events
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.status_texts import (
    ACTION,
    CHECK,
    CHUNK_TIMEOUT,
    event_number,
    EventMessage,
    GroundStationReport,
    OTHER,
    read_events,
    StatusTexts,
)

INFO, WARNING, CRITICAL = (mavlink.MAV_SEVERITY_INFO, mavlink.MAV_SEVERITY_WARNING,
                           mavlink.MAV_SEVERITY_CRITICAL)


def statustext(text, severity=CRITICAL, number=0, chunk=0):
    return mavlink.MAVLink_statustext_message(severity, text.encode(), number, chunk)


A, B = 'a' * 50, 'b' * 50


@pytest.mark.parametrize(('chunks', 'whole'), [
    # (number, chunk, text); PX4 ends its texts with a tab.
    ([(0, 0, 'Takeoff detected\t')], ['Takeoff detected']),
    ([(3, 0, A), (3, 1, B), (3, 2, 'end\t')], [A + B + 'end']),
    # A beginning, a middle or an end is lost.
    ([(3, 1, 'end')], ['end']), ([(3, 0, A), (3, 2, 'end')], [A, 'end']),
    ([(3, 0, A), (4, 0, B), (4, 1, 'end')], [A, B + 'end']), ([(3, 0, A)], [A])])
def test_texts_are_joined_from_their_chunks_and_reported_once(chunks, whole):
    texts = StatusTexts()
    for number, chunk, text in chunks:
        texts.add(statustext(text, number=number, chunk=chunk), 1.0)
    assert texts.new(1.0) + texts.new(1.1 + CHUNK_TIMEOUT) == [
        (1.0, CRITICAL, text) for text in whole]
    assert texts.new(9.0) == [] and texts.since(1.0) == whole and texts.since(1.1) == []


def test_control_characters_reach_no_terminal():
    texts = StatusTexts()
    texts.add(statustext('bad \x1b[2J\x07\nend\r.'), 1.0)
    (text,) = texts.new(1.0)
    assert text.text == 'bad ?[2J??end?.'


def test_a_refusal_is_explained_by_more_than_information():
    texts = StatusTexts()
    texts.add(statustext('merely information', INFO), 1.0)
    assert texts.new(1.0) == [(1.0, INFO, 'merely information')] and texts.since(1.0) == []


def test_arming_obstacle_is_kept_until_its_next_report_is_due():
    texts = StatusTexts()
    for time, text in ((1.0, 'PreArm: Hardware safety switch'), (1.5, 'EKF3 IMU0 is using GPS'),
                       (2.0, 'PreArm: RC not found')):
        texts.add(statustext(text), time)
    assert [texts.unready(now, 'STABILIZE') for now in (30.0, 36.5, 40.0)] == [
        'Hardware safety switch; RC not found', 'RC not found', '']


# Events of PX4.

AUTOPILOT, COMMON = 1 << 24, 0


def event(name, level=CRITICAL, component=AUTOPILOT, arguments=()):
    """Return an EVENT, by its name or its number."""
    number = event_number(name) if isinstance(name, str) else name
    return EventMessage(
        component | number, 0, 0, 0, 0, level, bytes([*arguments]).ljust(40, b'\0'))


def told(*events):
    """Return the texts of events, and the failed checks against offboard."""
    texts = StatusTexts()
    for each in events:
        texts.add_event(each, 1.0)
    return [text.text for text in texts.new(1.0)], texts.against('OFFBOARD')


OTHERS = sorted(name for name, row in read_events().items() if row.kind == OTHER)
BEGIN, END = 'commander_arming_check_summary', 'commander_health_summary'
OFFBOARD_BIT = (1 << 14).to_bytes(4, 'little')


@pytest.mark.parametrize(('name', 'reason'), [
    ('check_modes_offboard_signal', 'no setpoint stream'),
    ('check_modes_offboard_signal_lost', 'no setpoint stream'),  # 1.18
    ('check_modes_offboard_no_local_velocity', 'no velocity estimate for offboard'),
    ('check_motor_overcurrent', 'motor overcurrent'), (4711, 'event 4711')])
def test_a_failed_check_has_its_text_or_its_number(name, reason):
    report = event(BEGIN), event(name, arguments=OFFBOARD_BIT), event(END)
    assert told(*report) == ([], [reason])


@pytest.mark.parametrize(('number', 'component', 'texts'), [
    ('commander_arm_denied_throttle_unsafe', AUTOPILOT,
     ['arming denied: throttle not where it is safe']),
    ('check_estimator_position_failure_imminent', AUTOPILOT,
     ['estimator position failure imminent']),
    (4711, AUTOPILOT, ['event 4711']), (1100, COMMON, []), (OTHERS[0], AUTOPILOT, [])])
def test_commander_event_is_named_by_text_or_number(number, component, texts):
    assert told(event(number, component=component)) == (texts, [])


def test_another_event_within_a_report_is_no_failed_check():
    other = event(OTHERS[0], arguments=OFFBOARD_BIT)
    assert told(event(BEGIN), other, event(END)) == ([], [])


def metadata(folder, *names, action='hold'):
    """Write the metadata of a version of PX4; return the version as the script reads it."""
    path = folder / px4_events.METADATA
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({'components': {'1': {
        'event_groups': {'health': {'events': {
            str(event_number(name)): {'name': name} for name in names}}},
        'enums': {'failsafe_action_t': {'entries': {'5': {'name': action}}}}}}}))
    return px4_events.read_version(folder)


def test_the_events_are_read_from_the_sources_of_each_version(tmp_path):
    old = metadata(tmp_path, 'check_baro_missing', 'check_modes_offboard_signal')
    new = metadata(tmp_path, 'check_baro_missing', 'navigator_x')
    lines = px4_events.render({'1.16': old, '1.18': new}).splitlines()
    assert [line for line in lines if not line.startswith('#')] == [
        'check_baro_missing | 1.16 1.18 | check | baro missing',
        'check_modes_offboard_signal | 1.16 | check | no setpoint stream',
        'failsafe_action_5 | 1.16 1.18 | action | Hold',
        'navigator_x | 1.18 | other | navigator x']
    with pytest.raises(ValueError, match="failsafe_action_5: .*'Hold'.*, but .*'Land'.* in 1.18"):
        px4_events.render({'1.16': old, '1.18': metadata(tmp_path, action='land')})


def test_the_shipped_events_are_those_that_the_script_writes():
    rows = read_events()
    versions = {version: {name: (row.kind, row.text) for name, row in rows.items()
                          if version in row.versions} for version in ('1.16', '1.18')}
    # No text was changed by hand.
    assert px4_events.render(versions) == px4_events.PATH.read_text(encoding='utf-8')
    assert {name: row.text for name, row in rows.items() if row.kind != ACTION} == {
        name: px4_events.row_of(name, '')[1] for name, row in rows.items() if row.kind != ACTION}
    assert {*px4_events.TEXTS} <= {*rows}
    for found in versions.values():
        kinds = [kind for kind, _ in found.values()]
        assert kinds.count(CHECK) > 120 and kinds.count(ACTION) == 11


# Reports to the ground station.

def sent_texts(report, now):
    return [(m.severity, m.text.rstrip('\0')) for m in report.due(0, now)
            if m.get_type() == 'STATUSTEXT']


def test_a_state_is_reported_once_after_it_has_lasted_a_second():
    report = GroundStationReport()
    report.take_state('TRACK', 10.0)
    report.take_distance('Gänsegeier', 1.94, 10.9)
    assert sent_texts(report, 10.9) == []
    assert sent_texts(report, 11.0) == [(INFO, 'flock: TRACK G?nsegeier 1.9 m')]
    report.take_state('COAST', 14.0)
    report.take_state('TRACK', 14.5)  # back before it was worth a text
    assert sent_texts(report, 16.0) == []
    report.take_state('HOLD', 20.0)
    assert sent_texts(report, 21.0) == [(WARNING, 'flock: HOLD')]


def test_one_text_at_most_in_two_seconds_handover_first():
    report = GroundStationReport()
    report.take_state('SEARCH', 0.0)
    assert sent_texts(report, 1.0) == [(INFO, 'flock: SEARCH')]
    report.take_state('HOLD', 1.1)
    report.take_handover('no command for 3 s')
    assert sent_texts(report, 2.9) == []
    assert sent_texts(report, 3.0) == [(CRITICAL, 'flock: hands over: no command for 3 s')]
    assert sent_texts(report, 4.9) == [] and sent_texts(report, 5.0) == [(WARNING, 'flock: HOLD')]


def test_distances_are_sent_each_second_while_new_and_finite():
    report, sent = GroundStationReport(), []
    for k in range(100):
        now = 0.1 * k
        if now < 5.0:
            report.take_distance('leader', math.nan if 2.0 < now < 4.0 else now, now)
        sent += [(m.name.rstrip('\0'), round(m.value, 1)) for m in report.due(0, now)]
    assert sent == [('flock_dist', value) for value in (0.0, 1.0, 2.0, 4.0, 4.9)]
