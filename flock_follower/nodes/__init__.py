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

from collections.abc import Callable, Iterator
import contextlib
import os
from pathlib import Path
import signal
import sys
import threading
from types import TracebackType

#: A signalled process has ended after this, s; the bridge has braked and ended its stream before.
SHUTDOWN_TIMEOUT = 1.8

_shut_down: Callable[[], object] | None = None
_unhurried = False


def on_signal(shut_down: Callable[[], object]) -> None:
    """Set the function that a signal calls; before, a signal ends the process at once."""
    global _shut_down
    _shut_down = shut_down


def set_deadline() -> None:
    """
    End the process by SIGALRM if it still runs after SHUTDOWN_TIMEOUT.

    Once in some thousand times Fast DDS spins for ever while it destroys a node, and holds the
    GIL: no thread and no handler of Python can end that.
    """
    if _AS_A_PROGRAM and not _unhurried and not signal.getitimer(signal.ITIMER_REAL)[0]:
        signal.setitimer(signal.ITIMER_REAL, SHUTDOWN_TIMEOUT)


@contextlib.contextmanager
def unhurried() -> Iterator[None]:
    """Set no deadline inside the block, which may take long to finish its files."""
    global _unhurried
    _unhurried = True
    try:
        yield
    finally:
        _unhurried = False


def ignore_signals() -> None:
    """Ignore further signals: one during the interpreter's exit must not change the exit code."""
    if _AS_A_PROGRAM:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


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


def _runs_as_a_program() -> bool:
    path = Path(sys.argv[0] if sys.argv else '')
    return (path.name == '-m' or path.parent.name in ('flock_follower', 'flock_desk')
            or Path(__file__).with_name(f'{path.name}.py').exists())


def _report_missing_package(kind: type[BaseException], error: BaseException,
                            trace: TracebackType | None) -> None:
    if isinstance(error, ModuleNotFoundError):
        print(f'error: {error}: source ROS 2 (/opt/ros/.../setup.bash) and install every '
              'package in package.xml', file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


_AS_A_PROGRAM = _runs_as_a_program()
if _AS_A_PROGRAM:
    signal.signal(signal.SIGINT, _handle)
    signal.signal(signal.SIGTERM, _handle)
    sys.excepthook = _report_missing_package
