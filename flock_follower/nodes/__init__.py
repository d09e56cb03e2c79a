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
Thin rclpy nodes: parameters, topics, diagnostics; no mathematics.

Where a node runs as a program, Ctrl-C raises no KeyboardInterrupt, which a callback of the import
system can swallow and which can cut a shutdown short. Before rclpy is up it ends the process;
afterwards it is left to rclpy, whose own handler shuts the context down.
"""

import os
from pathlib import Path
import signal
import sys

_left_to_rclpy = False


def leave_interrupts_to_rclpy() -> None:
    """Say that rclpy is up."""
    global _left_to_rclpy
    _left_to_rclpy = True


def _on_interrupt(*_: object) -> None:
    if not _left_to_rclpy:
        os._exit(128 + signal.SIGINT)


def _runs_as_a_program() -> bool:
    name = Path(sys.argv[0]).name if sys.argv else ''
    return name == '-m' or Path(__file__).with_name(f'{name}.py').exists()


if _runs_as_a_program():
    signal.signal(signal.SIGINT, _on_interrupt)
