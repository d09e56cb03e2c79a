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

"""Publishes and logs for the setpoint thread, which must not wait for a publisher or a log."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import queue
import threading
from typing import Final

#: Actions that may wait; beyond these the oldest is dropped. Two seconds of odometry at 50 Hz.
MOST_WAITING: Final[int] = 100
#: Time for the actions that still wait at the end, s.
EXIT_TIMEOUT: Final[float] = 0.05


class PublisherThread:
    """
    Runs the actions that another thread submits, in order, in a separate thread.

    A publisher or a log line may wait for a socket, a disk or a lock of rclpy. ``submit`` does not
    wait: it takes no lock and makes no system call. (To wake an executor, a guard condition would
    take locks of rclpy and the middleware.) The thread has one limit: rclpy holds the GIL in
    ``publish`` and log calls, so the whole process stops if the middleware blocks a write.
    Publishers that keep the last few messages do not block.

    :param on_error: called in the thread with an exception that an action raises.
    """

    def __init__(self, on_error: Callable[[Exception], None]) -> None:
        self.dropped = 0
        """Number of actions dropped because earlier ones took too long."""
        self._on_error = on_error
        self._waiting: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name='publisher', daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def submit(self, action: Callable[[], None]) -> None:
        """Queue an action for the thread, without waiting; only one other thread may call this."""
        if self._waiting.qsize() >= MOST_WAITING:
            with contextlib.suppress(queue.Empty):
                self._waiting.get_nowait()
                self.dropped += 1
        self._waiting.put(action)

    def stop(self) -> None:
        """Run the queued actions, for at most EXIT_TIMEOUT, and end the thread."""
        self._waiting.put(None)
        self._thread.join(EXIT_TIMEOUT)

    def _run(self) -> None:
        while (action := self._waiting.get()) is not None:
            try:
                action()
            except Exception as error:
                self._on_error(error)
