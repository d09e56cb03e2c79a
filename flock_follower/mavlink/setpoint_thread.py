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

"""
The setpoint thread: receives the autopilot's messages, and runs the cycles of the bridge.

The thread uses the monotonic clock, and waits for neither a ROS executor nor ``/clock``. If the
thread blocks, its HEARTBEATs also stop, so the autopilot detects the fault.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import contextlib
import math
import select
import socket
import threading
import time
from typing import Any, Final, TypeVar

from flock_follower.mavlink.bridge import Bridge, Cycle

T = TypeVar('T')
#: A new command is sent at once, but never sooner than this after the cycle before, s: at most
#: 50 setpoints per second, whatever the planner sends.
SHORTEST_PERIOD: Final[float] = 0.02
#: Time to brake, hand over and end, s.
EXIT_TIMEOUT: Final[float] = 1.7
#: Most submitted actions that wait.
MOST_WAITING: Final[int] = 1000
#: Most of them that run before the cycle has its turn.
MOST_AT_ONCE: Final[int] = 50


class SetpointThread:
    """
    Runs a bridge until stopped, a cycle each period and at once for a new command.

    The thread owns the bridge; other threads ``submit`` actions on it. The thread calls
    ``on_messages(messages, now)`` with messages of the autopilot, ``on_cycle(cycle, now)`` after
    each cycle and ``on_error(error)`` for an exception. If receiving fails, the cycle still runs,
    and vice versa.
    """

    def __init__(self, bridge: Bridge, period: float,
                 on_messages: Callable[[list[Any], float], None],
                 on_cycle: Callable[[Cycle, float], None],
                 on_error: Callable[[Exception], None]) -> None:
        self._bridge = bridge
        self._period = period
        self._on_messages = on_messages
        self._on_cycle = on_cycle
        self._on_error = on_error
        self._quit = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name='stream', daemon=True)
        self._submitted: deque[tuple[Callable[[], object], Callable[[], object]]] = deque()
        # A byte sent into one end of it ends the thread's wait for the autopilot.
        self._wake_receiver, self._wake_sender = socket.socketpair()
        for end in (self._wake_receiver, self._wake_sender):
            end.setblocking(False)
        self._last_cycle = -math.inf

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def submit(self, action: Callable[[], object],
               refuse: Callable[[], object] = lambda: None) -> bool:
        """
        Run an action in the thread at once, before the next cycle.

        Callable from any thread; it never waits. An exception of the action is passed to
        ``on_error``.

        :param refuse: called instead of the action if the thread ends before the action runs.
        :return: False if the action is dropped: too many wait, or the thread has ended.
        """
        if len(self._submitted) >= MOST_WAITING or self._ended.is_set():
            return False
        self._submitted.append((action, refuse))
        self._wake()
        if self._ended.is_set():  # perhaps after it has refused the rest
            self._refuse_submitted()
        return True

    def stop(self) -> None:
        """Brake, hand the vehicle over, and wait for the end; callbacks end at once."""
        self._quit.set()
        self._wake()
        end = time.monotonic() + EXIT_TIMEOUT
        while not self._ended.is_set() and time.monotonic() < end:
            try:
                # Not join(): if it is interrupted, it counts the thread as ended.
                self._ended.wait(max(0.0, end - time.monotonic()))
            except KeyboardInterrupt:
                continue  # a second Ctrl-C must not prevent braking

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # full: it wakes all the same
            self._wake_sender.send(b'.')

    def _run(self) -> None:
        next_cycle = time.monotonic()
        try:
            while not self._quit.is_set():
                next_cycle = self._turn(next_cycle)
            self._bridge.stop(time.monotonic())
            end = time.monotonic() + EXIT_TIMEOUT
            while not self._bridge.has_stopped(time.monotonic()) and time.monotonic() < end:
                next_cycle = self._turn(next_cycle)
            self._guard(lambda: self._bridge.finish(time.monotonic()))
        finally:
            self._ended.set()
            self._refuse_submitted()

    def _turn(self, next_cycle: float) -> float:
        """Listen until a cycle is due, run it, and return the time of the next cycle."""
        wait = 0.0 if self._submitted else max(0.0, next_cycle - time.monotonic())
        if not self._guard(lambda: self._listen(wait)):
            # Otherwise listening that fails at once would be repeated without a pause.
            time.sleep(min(0.1 * self._period, max(0.0, next_cycle - time.monotonic())))
        # Of a flood only so many actions that the cycle is not delayed.
        if count := min(len(self._submitted), MOST_AT_ONCE):
            for _ in range(count):
                self._guard(self._submitted.popleft()[0])
            # One of them may have brought odometry to forward.
            self._guard(lambda: self._bridge.send_odometry(time.monotonic()))
        now = time.monotonic()
        if self._bridge.gate.commands.is_new:
            next_cycle = min(next_cycle, max(now, self._last_cycle + SHORTEST_PERIOD))
        if now < next_cycle:
            return next_cycle
        self._last_cycle = now
        next_cycle += self._period
        if next_cycle < now:  # more than a period late
            next_cycle = now + self._period
        cycle = self._guard(lambda: self._bridge.cycle(now))
        if cycle is not None and not self._quit.is_set():
            # Read the clock again: deciding, packing and writing took time.
            self._guard(lambda: self._on_cycle(cycle, time.monotonic()))
        return next_cycle

    def _guard(self, action: Callable[[], T]) -> T | None:
        """Run an action; return its result, or None if it raised, which is reported."""
        try:
            return action()
        except Exception as error:
            self._on_error(error)
            return None

    def _refuse_submitted(self) -> None:
        with contextlib.suppress(IndexError):  # two threads may do so at once
            while True:
                self._guard(self._submitted.popleft()[1])

    def _listen(self, wait: float) -> bool:
        """Receive for at most ``wait``, s; return True."""
        transport = self._bridge.link.transport
        ends: list[Any] = [self._wake_receiver]
        if transport.fileno() >= 0:
            ends.append(transport)
        ready = select.select(ends, [], [], wait)[0]
        now = time.monotonic()
        if self._wake_receiver in ready:
            self._wake_receiver.recv(4096)
        if transport in ready or transport.fault:
            messages = self._bridge.receive(now)
            if messages and not self._quit.is_set():
                self._on_messages(messages, now)
        return True
