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

"""The pilot's mode switch wins, and what it ended does not come back by itself."""

import pytest

from flock_follower.mavlink.authority import Authority, LEFT, NOT_REQUESTED
from flock_follower.mavlink.dialect import VehicleStatus

OURS = VehicleStatus(True, 'OFFBOARD', 'active', True)
HOLD = VehicleStatus(True, 'AUTO.LOITER', 'active', False)
PILOT = VehicleStatus(True, 'POSCTL', 'active', False)


def after(*statuses):
    authority = Authority()
    for status in statuses:
        authority.update(status)
    return authority


@pytest.mark.parametrize('statuses', [(), (HOLD,), (HOLD, PILOT), (HOLD, OURS), (OURS, OURS)])
def test_before_it_was_left_the_stream_may_flow_in_every_mode(statuses):
    assert after(*statuses).reason == ''


def test_once_left_nothing_is_sent_even_where_the_mode_comes_back():
    authority = after(OURS, PILOT)
    assert (authority.reason, authority.left_for) == (LEFT, 'POSCTL')
    for status in (HOLD, OURS, OURS, PILOT):
        authority.update(status)
        assert authority.reason == LEFT


def test_a_request_lets_the_stream_flow_and_a_refused_one_stops_it_again():
    authority = after(OURS, PILOT)
    authority.ask(True)
    assert authority.reason == ''
    authority.update(PILOT)
    authority.ask(False)
    assert authority.reason == LEFT


def test_a_request_that_the_vehicle_follows_ends_it():
    authority = after(OURS, PILOT)
    authority.ask(True)
    authority.update(OURS)
    authority.ask(False)
    assert (authority.reason, authority.left_for) == ('', '')
    authority.update(HOLD)
    assert (authority.reason, authority.left_for) == (LEFT, 'AUTO.LOITER')


def test_a_take_off_in_the_same_mode_waits_for_the_request():
    authority = after(HOLD)
    authority.wait_for_request()
    authority.update(OURS)
    assert authority.reason == NOT_REQUESTED
    authority.ask(True)
    authority.update(OURS)
    authority.ask(False)
    assert authority.reason == ''
