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


"""Actions of one thread run in another, and a slow one holds nobody up."""

import threading
import time

import pytest

from flock_follower.nodes.support.publisher_thread import MOST_WAITING, PublisherThread

DEADLINE = 5.0


@pytest.fixture
def errors():
    return []


@pytest.fixture
def publisher(errors):
    publisher = PublisherThread(errors.append)
    publisher.start()
    yield publisher
    publisher.stop()


def test_actions_run_in_order_in_the_publisher_thread(publisher):
    told, done = [], threading.Event()
    for number in range(50):
        publisher.submit(
            lambda number=number: told.append((number, threading.current_thread().name)))
    publisher.submit(done.set)
    assert done.wait(DEADLINE)
    assert told == [(number, 'publisher') for number in range(50)] and publisher.dropped == 0


def test_while_one_takes_long_the_oldest_are_dropped_and_counted(publisher):
    begun, release, done, told = (
        threading.Event(), threading.Event(), threading.Event(), [])
    publisher.submit(lambda: (begun.set(), release.wait(DEADLINE)))
    assert begun.wait(DEADLINE)
    start = time.monotonic()
    for number in range(3 * MOST_WAITING):
        publisher.submit(lambda number=number: told.append(number))
    publisher.submit(done.set)
    assert time.monotonic() - start < DEADLINE / 2  # nobody waited for the release
    assert publisher.dropped == 2 * MOST_WAITING + 1 and not told
    release.set()
    assert done.wait(DEADLINE)
    assert told == list(range(2 * MOST_WAITING + 1, 3 * MOST_WAITING))


def test_an_action_that_raises_is_reported_and_the_next_one_runs(publisher, errors):
    done = threading.Event()
    publisher.submit(lambda: 1 / 0)
    publisher.submit(done.set)
    assert done.wait(DEADLINE)
    assert [str(error) for error in errors] == ['division by zero']


def test_the_end_tells_what_waits_but_does_not_wait_for_what_is_stuck(errors):
    told, publisher = [], PublisherThread(errors.append)
    publisher.start()
    publisher.submit(lambda: told.append(1))
    publisher.stop()
    assert told == [1]
    stuck, release = threading.Event(), threading.Event()
    publisher = PublisherThread(errors.append)
    publisher.start()
    publisher.submit(lambda: (stuck.set(), release.wait(DEADLINE)))
    assert stuck.wait(DEADLINE)
    start = time.monotonic()
    publisher.stop()
    assert time.monotonic() - start < DEADLINE / 2
    release.set()
