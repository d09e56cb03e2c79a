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

"""The stream's thread: cycles on time, actions at once, and errors that stop neither."""

from functools import partial
import socket
import threading
import time

import numpy as np
import pytest

from flock_follower.mavlink.setpoint_thread import SetpointThread, SHORTEST_PERIOD

pytestmark = pytest.mark.ros  # in real time: beside what computes it would be starved
DEADLINE = 5.0
NEVER = 10 * DEADLINE


class Bridge:
    """A bridge, its gate, link and transport in one, which notes its calls."""

    def __init__(self):
        self.gate = self.commands = self.link = self.transport = self
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.fault, self.broken, self.is_new = '', False, False
        self.calls = []
        self.send_odometry, self.stop, self.finish = (
            partial(self.note, name) for name in ('odometry', 'stop', 'finish'))

    def fileno(self):
        return -1 if self.fault else self.ours.fileno()

    def times(self, name):
        return [now for called, now in self.calls if called == name]

    def wait_for(self, name, more):
        count, end = len(self.times(name)) + more, time.monotonic() + DEADLINE
        while len(self.times(name)) < count:
            assert time.monotonic() < end, self.calls
            time.sleep(0.001)

    def note(self, name, now=0.0):
        self.calls.append((name, now))

    def receive(self, now):
        if not self.fault:
            self.ours.recv(100)
        self.note('receive', now)
        return ['a message']

    def take_command(self):
        self.is_new = True
        self.note('command', time.monotonic())

    def cycle(self, now):
        self.is_new = False
        self.note('cycle', now)
        if self.broken:
            raise RuntimeError('broken')
        return 'a cycle'

    def has_stopped(self, now):
        return True


@pytest.fixture
def make_stream():
    streams = []

    def make(period):
        """Return a bridge, its stream after the first cycle, and the arguments of callbacks."""
        bridge, passed = Bridge(), {'messages': [], 'cycles': [], 'errors': []}
        stream = SetpointThread(
            bridge, period, lambda messages, now: passed['messages'].append(messages),
            lambda cycle, now: passed['cycles'].append((cycle, now)), passed['errors'].append)
        streams.append(stream)
        stream.start()
        end = time.monotonic() + DEADLINE
        while not passed['cycles']:
            assert time.monotonic() < end, passed['errors']
            time.sleep(0.001)
        return bridge, stream, passed
    yield make
    for stream in streams:
        stream.stop()


def test_arrivals_and_actions_are_done_at_once_in_one_thread(make_stream):
    bridge, stream, passed = make_stream(NEVER)
    bridge.theirs.send(b'x')
    bridge.wait_for('receive', 1 - len(bridge.times('receive')))
    threads = []
    for action in (lambda: threads.append(threading.current_thread().name), lambda: 1 / 0,
                   lambda: bridge.note('forward')):
        assert stream.submit(action)
    time.sleep(2 * SHORTEST_PERIOD)
    assert threads == ['stream'] and passed['messages'] == [['a message']]
    assert [str(error) for error in passed['errors']] == ['division by zero']
    # No cycle without a new command; what was submitted may have been odometry.
    assert len(bridge.times('cycle')) == 1 and bridge.calls[-1][0] == 'odometry'


def test_new_command_is_sent_at_once_next_cycle_a_period_later(make_stream):
    bridge, stream, _ = make_stream(0.5)
    time.sleep(0.1)
    stream.submit(bridge.take_command)
    bridge.wait_for('cycle', 2)
    taken, (_, early, regular) = bridge.times('command')[0], bridge.times('cycle')[:3]
    # Well before the regular one, which was due 0.4 s after the command.
    assert 0.0 <= early - taken < 0.2 and regular - early >= 0.5


@pytest.mark.parametrize('period', [NEVER, 0.01])
def test_new_commands_make_at_most_one_setpoint_per_20_ms(make_stream, period):
    bridge, stream, _ = make_stream(period)
    end = time.monotonic() + 0.3
    while time.monotonic() < end:
        stream.submit(bridge.take_command)
        time.sleep(0.001)
    begun = bridge.times('cycle')
    # A shorter period is kept, and commands add no cycle to it.
    assert 5 <= len(begun) <= (begun[-1] - begun[0]) / min(period, SHORTEST_PERIOD) + 2
    assert period < SHORTEST_PERIOD or min(np.diff(begun)) >= SHORTEST_PERIOD


def test_flood_of_actions_neither_starves_cycle_nor_grows(make_stream):
    bridge, stream, _ = make_stream(0.01)
    refused = threading.Event()

    def again():  # each brings two more, so that the inbox never gets empty
        time.sleep(1e-4)
        for _ in range(2):
            if not refused.is_set() and not stream.submit(again):
                refused.set()
    stream.submit(again)
    assert refused.wait(DEADLINE)
    bridge.wait_for('cycle', 20)


def test_every_action_taken_is_run_or_refused_at_end(make_stream):
    bridge, stream, _ = make_stream(0.01)
    answers = []

    def submit(n):
        return stream.submit(lambda: answers.append(n), lambda: answers.append(-n))

    def finish(now):  # the last thing the thread does
        bridge.note('finish', now)
        assert submit(1)
    bridge.finish = finish
    taken = [n for n in range(2, 500) if submit(n)]
    stream.stop()
    assert -1 in answers and sorted(map(abs, answers)) == [1, *taken]
    assert [name for name, _ in bridge.calls if name != 'odometry'][-2:] == ['stop', 'finish']
    assert not submit(501)


def test_missing_device_or_raising_cycle_ends_no_cycles(make_stream):
    bridge, _, passed = make_stream(0.01)
    bridge.fault, bridge.broken = 'unplugged', True
    bridge.wait_for('receive', 3)
    bridge.wait_for('cycle', 3)
    bridge.broken = False
    bridge.wait_for('cycle', 3)
    assert {str(error) for error in passed['errors']} == {'broken'} and len(passed['errors']) >= 2
    # The callback gets the time of the end of the cycle, not of its beginning.
    assert passed['cycles'][0][1] >= bridge.times('cycle')[0]
