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


"""The teller: what one thread has to say is said in another, and a slow one holds nobody up."""

import threading
import time

import pytest

from flock_follower.nodes.support.teller import MOST_WAITING, Teller

DEADLINE = 5.0


@pytest.fixture
def errors():
    return []


@pytest.fixture
def teller(errors):
    teller = Teller(errors.append)
    teller.start()
    yield teller
    teller.stop()


def test_what_is_told_happens_in_order_in_the_thread_of_the_teller(teller):
    told, done = [], threading.Event()
    for number in range(50):
        teller.tell(lambda number=number: told.append((number, threading.current_thread().name)))
    teller.tell(done.set)
    assert done.wait(DEADLINE)
    assert told == [(number, 'teller') for number in range(50)] and teller.dropped == 0


def test_while_one_takes_long_the_oldest_are_dropped_and_counted(teller):
    begun, release, done, told = (
        threading.Event(), threading.Event(), threading.Event(), [])
    teller.tell(lambda: (begun.set(), release.wait(DEADLINE)))
    assert begun.wait(DEADLINE)
    start = time.monotonic()
    for number in range(3 * MOST_WAITING):
        teller.tell(lambda number=number: told.append(number))
    teller.tell(done.set)
    assert time.monotonic() - start < DEADLINE / 2  # nobody waited for the release
    assert teller.dropped == 2 * MOST_WAITING + 1 and not told
    release.set()
    assert done.wait(DEADLINE)
    assert told == list(range(2 * MOST_WAITING + 1, 3 * MOST_WAITING))


def test_what_raises_is_told_and_the_next_one_happens(teller, errors):
    done = threading.Event()
    teller.tell(lambda: 1 / 0)
    teller.tell(done.set)
    assert done.wait(DEADLINE)
    assert [str(error) for error in errors] == ['division by zero']


def test_the_end_tells_what_waits_but_does_not_wait_for_what_is_stuck(errors):
    told, teller = [], Teller(errors.append)
    teller.start()
    teller.tell(lambda: told.append(1))
    teller.stop()
    assert told == [1]
    stuck, release, teller = threading.Event(), threading.Event(), Teller(errors.append)
    teller.start()
    teller.tell(lambda: (stuck.set(), release.wait(DEADLINE)))
    assert stuck.wait(DEADLINE)
    start = time.monotonic()
    teller.stop()
    assert time.monotonic() - start < DEADLINE / 2
    release.set()
