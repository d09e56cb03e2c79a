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

"""Thin rclpy nodes: parameters, topics, diagnostics; no mathematics."""

from collections.abc import Callable
import contextlib
import os
import signal
import threading

from flock_follower.signals import AS_A_PROGRAM, ending, hang_up_as_terminate

#: A signaled process has ended after this, s; the bridge has braked and ended its stream before.
SHUTDOWN_TIMEOUT = 1.8

_shut_down: Callable[[], object] | None = None
without_deadline = False
"""Whether the process may need a long time to finish its files, see ``exit_deadline``."""


def on_signal(shut_down: Callable[[], object]) -> None:
    """Set the function that a signal calls; without one a signal ends the process at once."""
    global _shut_down
    _shut_down = shut_down


def set_deadline() -> None:
    """
    End the process by SIGALRM if it still runs after SHUTDOWN_TIMEOUT.

    About once in some thousand shutdowns Fast DDS loops for ever while it destroys a node, and
    holds the GIL: neither a thread nor a Python handler can end the process then.
    """
    if AS_A_PROGRAM and not without_deadline and not signal.getitimer(signal.ITIMER_REAL)[0]:
        signal.setitimer(signal.ITIMER_REAL, SHUTDOWN_TIMEOUT)


def ignore_signals() -> None:
    """Ignore further signals, so that a signal during the exit does not change the exit code."""
    if AS_A_PROGRAM:
        for number in ending():
            signal.signal(number, signal.SIG_IGN)


def _handle(number: int, _: object) -> None:
    if _shut_down is None:
        os._exit(128 + number)
    set_deadline()
    # In a thread: the interrupted code may hold a lock that shutting down needs.
    threading.Thread(target=_shut_down_context, daemon=True).start()


def _shut_down_context() -> None:
    assert _shut_down is not None
    # rclpy's own handler may have shut it down, and removed it, before this thread runs.
    with contextlib.suppress(Exception):
        _shut_down()


if AS_A_PROGRAM:
    signal.signal(signal.SIGINT, _handle)
    signal.signal(signal.SIGTERM, _handle)
    hang_up_as_terminate()
