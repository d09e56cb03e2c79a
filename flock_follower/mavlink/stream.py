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
The thread that keeps the setpoints flowing: listens to the autopilot, and runs the cycles.

It runs on the monotonic clock and waits for neither a ROS executor nor ``/clock``. When it hangs
all the same, the HEARTBEATs it sends stop too, so that the autopilot notices.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import select
import socket
import threading
import time
from typing import Any, Final

from flock_follower.mavlink.bridge import Bridge, Cycle

#: Time to brake, hand over and end, s.
EXIT_TIMEOUT: Final[float] = 1.7


class Stream:
    """
    Runs a bridge at a fixed period until stopped.

    The callbacks come from the thread: ``on_messages(messages, now)`` with what the autopilot
    said, ``on_cycle(cycle, now)`` after each cycle, ``on_error(error)`` for an exception. What
    fails, listening or a cycle, does not keep the other from its turn.
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
        # Bytes in it end a wait for the autopilot.
        self._bell, self._bell_rope = socket.socketpair()
        for end in (self._bell, self._bell_rope):
            end.setblocking(False)
        self.late = 0
        """How many cycles began more than a period late."""

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def wake(self) -> None:
        """Make the thread send the odometry that waits, rather than at its next cycle."""
        with contextlib.suppress(OSError):  # full: it will wake all the same
            self._bell_rope.send(b'.')

    def stop(self) -> None:
        """Brake, hand the vehicle over, and wait for the end; callbacks end at once."""
        self._quit.set()
        self.wake()
        end = time.monotonic() + EXIT_TIMEOUT
        while not self._ended.is_set() and time.monotonic() < end:
            try:
                # Not join(): interrupted, it takes the thread for dead.
                self._ended.wait(max(0.0, end - time.monotonic()))
            except KeyboardInterrupt:
                continue  # a second Ctrl-C must not keep the vehicle from braking

    def _run(self) -> None:
        next_cycle = time.monotonic()
        try:
            while not self._quit.is_set():
                next_cycle = self._turn(next_cycle)
            self._bridge.stop(time.monotonic())
            end = time.monotonic() + EXIT_TIMEOUT
            while not self._bridge.stopped(time.monotonic()) and time.monotonic() < end:
                next_cycle = self._turn(next_cycle)
            self._guarded(lambda: self._bridge.finish(time.monotonic()))
        finally:
            self._ended.set()

    def _turn(self, next_cycle: float) -> float:
        """Listen until the next cycle is due, run it, and return when the one after is."""
        if not self._guarded(lambda: self._listen(max(0.0, next_cycle - time.monotonic()))):
            # What failed at once would otherwise fail again at once, and leave no time.
            time.sleep(min(0.1 * self._period, max(0.0, next_cycle - time.monotonic())))
        now = time.monotonic()
        if now < next_cycle:
            return next_cycle
        next_cycle += self._period
        if next_cycle < now:
            self.late += 1
            next_cycle = now + self._period
        self._guarded(lambda: self._cycle(now))
        return next_cycle

    def _guarded(self, action: Callable[[], None]) -> bool:
        """Run an action, report what it raises, and return whether it went well."""
        try:
            action()
        except Exception as error:
            self._on_error(error)
            return False
        return True

    def _cycle(self, now: float) -> None:
        cycle = self._bridge.cycle(now)
        if not self._quit.is_set():
            # Now again: what was due had to be decided, packed and written first.
            self._on_cycle(cycle, time.monotonic())

    def _listen(self, wait: float) -> None:
        transport = self._bridge.link.transport
        ends: list[Any] = [self._bell]
        if transport.fileno() >= 0:
            ends.append(transport)
        ready = select.select(ends, [], [], wait)[0]
        now = time.monotonic()
        if self._bell in ready:
            self._bell.recv(4096)
            self._bridge.send_odometry(now)
        if transport in ready or transport.fault:
            messages = self._bridge.receive(now)
            if messages and not self._quit.is_set():
                self._on_messages(messages, now)
