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


"""The autopilot's texts are told whole, and none is lost with a chunk."""

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.status_texts import (
    CHUNK_TIMEOUT,
    MOST_CHUNKS,
    MOST_UNFINISHED,
    StatusTexts,
)


def statustext(text, severity=mavlink.MAV_SEVERITY_CRITICAL, number=0, chunk=0):
    return mavlink.MAVLink_statustext_message(severity, text.encode(), number, chunk)


def told(texts, now):
    return [text for _, _, text in texts.new(now)]


def test_long_texts_are_joined_from_their_chunks():
    texts = StatusTexts()
    assert texts.add(statustext('a' * 50, number=3), 1.0) is None
    assert texts.add(statustext('b' * 9, number=3, chunk=1), 1.0) == 'a' * 50 + 'b' * 9
    texts.add(statustext('merely information', mavlink.MAV_SEVERITY_INFO), 1.0)
    assert texts.since(1.0) == ['a' * 50 + 'b' * 9]


def test_a_lost_chunk_is_marked():
    texts = StatusTexts()
    texts.add(statustext('a' * 50, number=3), 1.0)
    assert texts.add(statustext('end', number=3, chunk=2), 1.0) == 'a' * 50 + '...end'


def test_a_text_is_told_once_and_without_the_tab_of_px4():
    texts = StatusTexts()
    assert told(texts, 0.0) == []
    texts.add(statustext('Takeoff detected\t', mavlink.MAV_SEVERITY_INFO), 1.0)
    assert texts.new(1.0) == [(1.0, mavlink.MAV_SEVERITY_INFO, 'Takeoff detected')]
    assert told(texts, 1.1) == []


def test_a_long_text_is_told_whole_and_with_its_severity():
    texts = StatusTexts()
    texts.add(statustext('a' * 50, mavlink.MAV_SEVERITY_ALERT, number=3), 1.0)
    assert told(texts, 1.0) == []
    texts.add(statustext('b\t', mavlink.MAV_SEVERITY_ALERT, number=3, chunk=1), 1.1)
    assert texts.new(1.1) == [(1.1, mavlink.MAV_SEVERITY_ALERT, 'a' * 50 + 'b')]


def test_the_chunks_of_two_texts_may_alternate():
    texts = StatusTexts()
    for number, chunk, text in ((1, 0, 'a' * 50), (2, 0, 'b' * 50), (1, 1, 'A'), (2, 1, 'B')):
        texts.add(statustext(text, number=number, chunk=chunk), 1.0)
    assert told(texts, 1.0) == ['a' * 50 + 'A', 'b' * 50 + 'B']


def test_a_text_whose_end_is_lost_is_told_after_a_while():
    texts = StatusTexts()
    texts.add(statustext('a' * 50, number=3), 1.0)
    assert told(texts, 1.0 + CHUNK_TIMEOUT) == []
    assert told(texts, 1.1 + CHUNK_TIMEOUT) == ['a' * 50 + '...']
    assert texts.since(1.0) == ['a' * 50 + '...']


def test_a_text_whose_end_is_lost_does_not_swallow_the_next_of_its_number():
    texts = StatusTexts()
    texts.add(statustext('a' * 50, number=3), 1.0)
    texts.add(statustext('b' * 50, number=3), 1.1)
    texts.add(statustext('end', number=3, chunk=1), 1.1)
    assert told(texts, 1.1) == ['a' * 50 + '...', 'b' * 50 + 'end']


def test_a_text_whose_beginning_is_lost_is_told():
    texts = StatusTexts()
    assert texts.add(statustext('end', number=3, chunk=1), 1.0) == '...end'


def test_a_series_of_chunks_that_never_ends_is_told_in_parts():
    texts, heard = StatusTexts(), ''
    for chunk in range(600):
        texts.add(statustext(f'{chunk:050}', number=3, chunk=chunk % 256), chunk * 0.1)
        new = told(texts, chunk * 0.1)
        assert all(len(text) <= 50 * MOST_CHUNKS + 6 for text in new)
        heard += ''.join(new)
    assert all(f'{chunk:050}' in heard for chunk in range(600 - MOST_CHUNKS))


def test_many_unfinished_texts_are_told_and_do_not_add_up():
    texts = StatusTexts()
    for number in range(1, 101):
        texts.add(statustext(f'{number:050}', number=number), 1.0)
    new = told(texts, 1.0)
    assert new == [f'{number:050}...' for number in range(1, 101 - MOST_UNFINISHED)]
    assert len(told(texts, 9.0)) == MOST_UNFINISHED and told(texts, 99.0) == []


@pytest.mark.parametrize('text', ['', '\t', '\0'])
def test_an_empty_text_is_no_error(text):
    assert StatusTexts().add(statustext(text), 1.0) == ''


def test_what_keeps_ardupilot_from_arming_is_kept_until_it_would_have_said_it_again():
    texts = StatusTexts()
    texts.add(statustext('PreArm: Hardware safety switch'), 1.0)
    texts.add(statustext('EKF3 IMU0 is using GPS'), 1.5)
    texts.add(statustext('PreArm: RC not found'), 2.0)
    assert texts.unready(30.0, 'STABILIZE') == 'Hardware safety switch; RC not found'
    assert texts.unready(36.5, 'STABILIZE') == 'RC not found'
    assert texts.unready(40.0, 'STABILIZE') == ''
