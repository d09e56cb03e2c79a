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
Signals that end a program: Ctrl-C (SIGINT), SIGTERM, and SIGHUP, which a closed terminal sends.

Only our own programs change signals; in other programs this module changes none.
"""

from __future__ import annotations

import os
from pathlib import Path
import signal
import sys
import threading
from types import TracebackType


def ending() -> tuple[signal.Signals, ...]:
    """Return the signals that end this process; without SIGHUP under nohup."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *(() if ignored else (signal.SIGHUP,)))


def hang_up_as_terminate() -> None:
    """
    Make SIGHUP send SIGTERM to this process, at once; not under nohup.

    rclpy wakes its executors for SIGINT and SIGTERM only. A Python handler would wait for the main
    thread; the thread that sends SIGTERM does not wait.
    """
    if signal.SIGHUP not in ending():
        return
    received, written = os.pipe()
    os.set_blocking(written, False)
    signal.signal(signal.SIGHUP, lambda *_: None)  # Python writes the number to the pipe
    signal.set_wakeup_fd(written, warn_on_full_buffer=False)
    threading.Thread(target=_pass_on, args=(received,), daemon=True, name='hang-up').start()


def _pass_on(received: int) -> None:
    while numbers := os.read(received, 64):
        if signal.SIGHUP in numbers:
            os.kill(os.getpid(), signal.SIGTERM)


def _runs_as_a_program() -> bool:
    path = Path(sys.argv[0] if sys.argv else '')
    return (path.name == '-m' or path.name.startswith('flock_follower')
            or path.parent.name in ('flock_follower', 'flock_desk')
            or Path(__file__).with_name('nodes').joinpath(f'{path.name}.py').exists())


def show_error(kind: type[BaseException], error: BaseException,
               trace: TracebackType | None) -> None:
    """Show what ends a program: nothing for Ctrl-C, one line for a package that is missing."""
    if isinstance(error, ModuleNotFoundError):
        print(f'error: {error}: source ROS 2 (/opt/ros/.../setup.bash) and install every '
              'package in package.xml', file=sys.stderr)
    elif not isinstance(error, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)


AS_A_PROGRAM = _runs_as_a_program()
if AS_A_PROGRAM:
    sys.excepthook = show_error
