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

"""The autopilot's texts are joined from their chunks, kept, and reported once."""

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.status_texts import CHUNK_TIMEOUT, StatusTexts

CRITICAL, INFO = mavlink.MAV_SEVERITY_CRITICAL, mavlink.MAV_SEVERITY_INFO


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
