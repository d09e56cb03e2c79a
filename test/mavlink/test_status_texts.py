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

"""The autopilot's texts are kept and reported once."""

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.status_texts import StatusTexts

CRITICAL, INFO = mavlink.MAV_SEVERITY_CRITICAL, mavlink.MAV_SEVERITY_INFO


def statustext(text, severity=CRITICAL, number=0, chunk=0):
    return mavlink.MAVLink_statustext_message(severity, text.encode(), number, chunk)


def test_texts_are_reported_once_and_a_refusal_is_explained_by_more_than_information():
    texts = StatusTexts()
    # PX4 ends its texts with a tab; each chunk of a long one is a text.
    for text, chunk in (('Takeoff detected\t', 0), ('a' * 50, 0), ('end', 1)):
        texts.add(statustext(text, number=7 * (chunk > 0), chunk=chunk), 1.0)
    texts.add(statustext('merely information', INFO), 1.0)
    whole = ['Takeoff detected', 'a' * 50, 'end']
    assert texts.new() == [*((1.0, CRITICAL, text) for text in whole),
                           (1.0, INFO, 'merely information')]
    assert texts.new() == [] and texts.since(1.0) == whole and texts.since(1.1) == []


def test_what_keeps_ardupilot_from_arming_is_kept_until_it_would_have_said_it_again():
    texts = StatusTexts()
    for time, text in ((1.0, 'PreArm: Hardware safety switch'), (1.5, 'EKF3 IMU0 is using GPS'),
                       (2.0, 'PreArm: RC not found')):
        texts.add(statustext(text), time)
    assert [texts.unready(now, 'STABILIZE') for now in (30.0, 36.5, 40.0)] == [
        'Hardware safety switch; RC not found', 'RC not found', '']
