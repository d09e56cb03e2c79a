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

"""Reports to the ground station: which text is sent, when, and how often."""

import math

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.status_texts import GroundStationReport

INFO, WARNING, CRITICAL = (mavlink.MAV_SEVERITY_INFO, mavlink.MAV_SEVERITY_WARNING,
                           mavlink.MAV_SEVERITY_CRITICAL)


def texts(report, now):
    return [(m.severity, m.text.rstrip('\0')) for m in report.due(0, now)
            if m.get_type() == 'STATUSTEXT']


def test_a_state_is_reported_once_after_it_has_lasted_a_second():
    report = GroundStationReport()
    report.take_state('TRACK', 10.0)
    report.take_distance('Gänsegeier', 1.94, 10.9)
    assert texts(report, 10.9) == []
    assert texts(report, 11.0) == [(INFO, 'flock: TRACK G?nsegeier 1.9 m')]
    report.take_state('COAST', 14.0)
    report.take_state('TRACK', 14.5)  # back before it was worth a text
    assert texts(report, 16.0) == []
    report.take_state('HOLD', 20.0)
    assert texts(report, 21.0) == [(WARNING, 'flock: HOLD')]


def test_there_is_at_most_one_text_in_two_seconds_and_a_handover_goes_first():
    report = GroundStationReport()
    report.take_state('SEARCH', 0.0)
    assert texts(report, 1.0) == [(INFO, 'flock: SEARCH')]
    report.take_state('HOLD', 1.1)
    report.take_handover('no command for 3 s')
    assert texts(report, 2.9) == []
    assert texts(report, 3.0) == [(CRITICAL, 'flock: hands over: no command for 3 s')]
    assert texts(report, 4.9) == [] and texts(report, 5.0) == [(WARNING, 'flock: HOLD')]


def test_distances_are_sent_once_a_second_while_they_are_new_and_finite():
    report, sent = GroundStationReport(), []
    for k in range(100):
        now = 0.1 * k
        if now < 5.0:
            report.take_distance('leader', math.nan if 2.0 < now < 4.0 else now, now)
        sent += [(m.name.rstrip('\0'), round(m.value, 1)) for m in report.due(0, now)]
    assert sent == [('flock_dist', value) for value in (0.0, 1.0, 2.0, 4.0, 4.9)]
