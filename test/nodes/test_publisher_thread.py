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


def test_actions_run_in_order_in_publisher_thread_errors_shown(
        publisher, errors):
    reported, done = [], threading.Event()
    publisher.submit(lambda: 1 / 0)
    for number in range(50):
        publisher.submit(
            lambda number=number: reported.append((number, threading.current_thread().name)))
    publisher.submit(done.set)
    assert done.wait(DEADLINE)
    assert reported == [(number, 'publisher') for number in range(50)] and publisher.dropped == 0
    assert [str(error) for error in errors] == ['division by zero']


def test_slow_one_drops_oldest_and_delays_no_other(publisher):
    begun, release, reported = threading.Event(), threading.Event(), []
    publisher.submit(lambda: (begun.set(), release.wait(DEADLINE)))
    assert begun.wait(DEADLINE)
    start = time.monotonic()
    for number in range(3 * MOST_WAITING):
        publisher.submit(lambda number=number: reported.append(number))
    publisher.stop()
    assert time.monotonic() - start < DEADLINE / 2 and not reported
    release.set()
    publisher.stop()
    # The end counts as an action, too; what waits is run before it.
    assert publisher.dropped == 2 * MOST_WAITING and reported == list(
        range(2 * MOST_WAITING, 3 * MOST_WAITING))
