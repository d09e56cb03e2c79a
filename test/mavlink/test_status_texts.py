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

import math

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.status_texts import (
    CHUNK_TIMEOUT,
    GroundStationReport,
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


def test_a_refusal_is_explained_by_more_than_information():
    texts = StatusTexts()
    texts.add(statustext('merely information', INFO), 1.0)
    assert texts.new(1.0) == [(1.0, INFO, 'merely information')] and texts.since(1.0) == []


def test_what_keeps_ardupilot_from_arming_is_kept_until_it_would_have_said_it_again():
    texts = StatusTexts()
    for time, text in ((1.0, 'PreArm: Hardware safety switch'), (1.5, 'EKF3 IMU0 is using GPS'),
                       (2.0, 'PreArm: RC not found')):
        texts.add(statustext(text), time)
    assert [texts.unready(now, 'STABILIZE') for now in (30.0, 36.5, 40.0)] == [
        'Hardware safety switch; RC not found', 'RC not found', '']


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


def test_there_is_at_most_one_text_in_two_seconds_and_a_handover_goes_first():
    report = GroundStationReport()
    report.take_state('SEARCH', 0.0)
    assert sent_texts(report, 1.0) == [(INFO, 'flock: SEARCH')]
    report.take_state('HOLD', 1.1)
    report.take_handover('no command for 3 s')
    assert sent_texts(report, 2.9) == []
    assert sent_texts(report, 3.0) == [(CRITICAL, 'flock: hands over: no command for 3 s')]
    assert sent_texts(report, 4.9) == [] and sent_texts(report, 5.0) == [(WARNING, 'flock: HOLD')]


def test_distances_are_sent_once_a_second_while_they_are_new_and_finite():
    report, sent = GroundStationReport(), []
    for k in range(100):
        now = 0.1 * k
        if now < 5.0:
            report.take_distance('leader', math.nan if 2.0 < now < 4.0 else now, now)
        sent += [(m.name.rstrip('\0'), round(m.value, 1)) for m in report.due(0, now)]
    assert sent == [('flock_dist', value) for value in (0.0, 1.0, 2.0, 4.0, 4.9)]
