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

"""The stream's thread: cycles on time, odometry at once, and errors that stop neither."""

import socket
import threading
import time

import numpy as np
import pytest

from flock_follower.mavlink.setpoint_thread import SetpointThread, SHORTEST_PERIOD

pytestmark = pytest.mark.ros  # in real time: beside what computes it would be starved
DEADLINE = 5.0


class Transport:
    """A datagram socket that may be gone, and be broken."""

    def __init__(self):
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.fault = ''

    def fileno(self):
        return -1 if self.fault else self.ours.fileno()


class Bridge:
    """Notes who called it, and when."""

    def __init__(self):
        self.transport = self.link = Transport()
        self.link.transport = self.transport
        self.gate = self
        self.new_command = False
        self.calls = []
        self.called = threading.Condition()
        self.broken = False

    def note(self, name, now):
        with self.called:
            self.calls.append((name, now))
            self.called.notify_all()

    def wait_for(self, name, count=1):
        with self.called:
            assert self.called.wait_for(
                lambda: sum(n == name for n, _ in self.calls) >= count, DEADLINE), self.calls

    def receive(self, now):
        if not self.transport.fault:
            self.transport.ours.recv(100)
        self.note('receive', now)
        return ['a message']

    def send_odometry(self, now):
        self.note('odometry', now)

    def take_command(self):
        self.new_command = True
        self.note('command', time.monotonic())

    def cycle(self, now):
        self.new_command = False
        self.note('cycle', now)
        if self.broken:
            raise RuntimeError('broken')
        return 'a cycle'

    def stop(self, now):
        self.note('stop', now)

    def stopped(self, now):
        return True

    def finish(self, now):
        self.note('finish', now)


@pytest.fixture
def make_stream():
    streams = []

    def make(period):
        bridge, told = Bridge(), {'messages': [], 'cycles': [], 'errors': []}
        stream = SetpointThread(
            bridge, period, lambda messages, now: told['messages'].append(messages),
            lambda cycle, now: told['cycles'].append((cycle, now)), told['errors'].append)
        streams.append(stream)
        stream.start()
        return bridge, stream, told
    yield make
    for stream in streams:
        stream.stop()


def test_what_arrives_is_told_before_the_next_cycle(make_stream):
    bridge, _, told = make_stream(DEADLINE * 10)
    bridge.wait_for('cycle')
    bridge.transport.theirs.send(b'x')
    bridge.wait_for('receive')
    assert sum(name == 'cycle' for name, _ in bridge.calls) == 1
    assert [cycle for cycle, _ in told['cycles']] == ['a cycle']


def test_what_is_submitted_runs_at_once_in_the_thread_that_runs_the_cycles(make_stream):
    bridge, stream, _ = make_stream(DEADLINE * 10)
    bridge.wait_for('cycle')
    threads, run = [], threading.Event()
    assert stream.submit(lambda: threads.append(threading.current_thread()))
    assert stream.submit(lambda: (threads.append(threading.current_thread()), run.set()))
    assert run.wait(DEADLINE)
    assert [thread.name for thread in threads] == ['stream', 'stream']


def test_odometry_that_was_submitted_is_sent_without_waiting_for_the_next_cycle(make_stream):
    bridge, stream, _ = make_stream(DEADLINE * 10)
    bridge.wait_for('cycle')
    stream.submit(lambda: bridge.note('forward', 0.0))
    bridge.wait_for('odometry')
    names = [name for name, _ in bridge.calls]
    assert names.index('forward') < names.index('odometry')


def test_what_was_submitted_before_a_cycle_is_done_before_it_though_that_is_late(make_stream):
    bridge, stream, _ = make_stream(0.01)
    bridge.wait_for('cycle')
    receive, submitted = bridge.receive, threading.Event()

    def slow_receive(now):
        receive(now)
        assert submitted.wait(DEADLINE)
        time.sleep(0.03)  # so that a cycle is overdue
    bridge.receive = slow_receive
    bridge.transport.theirs.send(b'x')
    bridge.wait_for('receive')
    with bridge.called:
        before = len(bridge.calls)
    for _ in range(40):  # fewer than are run at once
        stream.submit(lambda: None)
    stream.submit(lambda: bridge.note('command', 0.0))
    submitted.set()
    bridge.wait_for('cycle', 1 + sum(name == 'cycle' for name, _ in bridge.calls))
    names = [name for name, _ in bridge.calls[before:]]
    assert names.index('command') < names.index('cycle')


def test_a_new_command_is_sent_at_once_and_the_next_cycle_comes_a_period_later(make_stream):
    bridge, stream, _ = make_stream(0.5)
    bridge.wait_for('cycle')
    time.sleep(0.1)
    stream.submit(bridge.take_command)
    bridge.wait_for('cycle', 3)
    taken = next(now for name, now in bridge.calls if name == 'command')
    _, early, regular = [now for name, now in bridge.calls if name == 'cycle'][:3]
    assert early >= taken
    # Well before the regular one, which was due 0.4 s after the command.
    assert early - taken < 0.2
    assert regular - early >= 0.5


def test_new_commands_make_at_most_one_setpoint_per_20_ms(make_stream):
    bridge, stream, _ = make_stream(DEADLINE * 10)
    bridge.wait_for('cycle')
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        stream.submit(bridge.take_command)
        time.sleep(0.001)
    bridge.wait_for('cycle', 5)
    begun = [now for name, now in bridge.calls if name == 'cycle']
    assert min(np.diff(begun)) >= SHORTEST_PERIOD
    assert len(begun) <= 1 + 0.5 / SHORTEST_PERIOD + 1


def test_a_period_below_20_ms_is_kept_and_commands_add_no_cycle_to_it(make_stream):
    bridge, stream, _ = make_stream(0.01)
    bridge.wait_for('cycle', 3)
    for _ in range(20):
        stream.submit(bridge.take_command)
        time.sleep(0.002)
    bridge.wait_for('cycle', 10)
    begun = [now for name, now in bridge.calls if name == 'cycle']
    assert len(begun) <= (begun[-1] - begun[0]) / 0.01 + 2


def test_what_is_submitted_without_a_new_command_adds_no_cycle(make_stream):
    bridge, stream, _ = make_stream(DEADLINE * 10)
    bridge.wait_for('cycle')
    for _ in range(20):
        stream.submit(lambda: bridge.note('refused', 0.0))
    bridge.wait_for('refused', 20)
    time.sleep(2 * SHORTEST_PERIOD)
    assert sum(name == 'cycle' for name, _ in bridge.calls) == 1


def test_an_action_that_raises_is_told_and_the_next_one_runs(make_stream):
    bridge, stream, told = make_stream(DEADLINE * 10)
    bridge.wait_for('cycle')
    stream.submit(lambda: 1 / 0)
    stream.submit(lambda: bridge.note('next', 0.0))
    bridge.wait_for('next')
    assert [str(error) for error in told['errors']] == ['division by zero']


def test_a_flood_of_actions_neither_starves_the_cycle_nor_grows_without_end(make_stream):
    bridge, stream, _ = make_stream(0.01)
    bridge.wait_for('cycle')
    stop, refused = threading.Event(), []

    def again():  # each brings two more, so that the inbox never gets empty
        time.sleep(1e-4)
        for _ in range(2):
            if not stop.is_set() and not stream.submit(again):
                refused.append(1)
    stream.submit(again)
    start = time.monotonic()
    while not refused and time.monotonic() < start + DEADLINE:
        bridge.wait_for('cycle', 1 + sum(name == 'cycle' for name, _ in bridge.calls))
    count = sum(name == 'cycle' for name, _ in bridge.calls)
    bridge.wait_for('cycle', count + 20)
    stop.set()
    assert refused


def test_after_the_end_nothing_is_taken(make_stream):
    bridge, stream, _ = make_stream(0.01)
    bridge.wait_for('cycle')
    stream.stop()
    assert not stream.submit(lambda: None)


def test_every_action_that_was_taken_is_run_or_refused_at_the_end(make_stream):
    bridge, stream, _ = make_stream(0.01)
    bridge.wait_for('cycle')
    answers, finishing = [], threading.Event()

    def submit(n):
        return stream.submit(lambda: answers.append((n, 'run')),
                             lambda: answers.append((n, 'refused')))

    def finish(now):  # the last thing the thread does
        assert submit('late')
        finishing.set()
    bridge.finish = finish
    taken = [n for n in range(500) if submit(n)]
    stopper = threading.Thread(target=stream.stop)
    stopper.start()
    while stopper.is_alive():
        taken.append(len(taken) + 1000)
        if not submit(taken[-1]):
            taken.pop()
    stopper.join()
    assert finishing.is_set() and ('late', 'refused') in answers
    assert sorted(n for n, _ in answers if n != 'late') == taken


def test_a_device_that_is_away_is_looked_after_each_cycle(make_stream):
    bridge, _, _ = make_stream(0.01)
    bridge.transport.fault = 'unplugged'
    bridge.wait_for('receive', 3)
    bridge.wait_for('cycle', 3)


def test_a_cycle_that_raises_is_told_and_the_next_one_runs(make_stream):
    bridge, _, told = make_stream(0.01)
    bridge.broken = True
    bridge.wait_for('cycle', 4)
    bridge.broken = False
    bridge.wait_for('cycle', 6)
    assert all(str(error) == 'broken' for error in told['errors']) and len(told['errors']) >= 2


def test_the_end_of_a_cycle_is_told_not_its_beginning(make_stream):
    bridge, _, told = make_stream(0.01)
    bridge.wait_for('cycle', 5)
    begun = [now for name, now in bridge.calls if name == 'cycle']
    assert all(end >= start for start, (_, end) in zip(begun, told['cycles']))


def test_stopping_says_the_last_words_at_once(make_stream):
    bridge, stream, _ = make_stream(0.01)
    bridge.wait_for('cycle')
    start = time.monotonic()
    stream.stop()
    assert time.monotonic() - start < DEADLINE
    assert [name for name, _ in bridge.calls][-2:] == ['stop', 'finish']
