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

"""A line that says how it goes: on a terminal the same one all the time, else one now and then."""

import math
import shutil
import sys

TERMINAL_PERIOD, LOG_PERIOD = 0.1, 5.0  # s between lines


class LiveLine:
    """Prints to stdout; times are s on a monotonic clock."""

    def __init__(self) -> None:
        self._on_terminal = sys.stdout.isatty()
        self._next = -math.inf

    def due(self, now: float) -> bool:
        """Return whether it is time for the next line."""
        if now < self._next:
            return False
        self._next = now + (TERMINAL_PERIOD if self._on_terminal else LOG_PERIOD)
        return True

    def show(self, line: str) -> None:
        """Print the line."""
        if self._on_terminal:
            width = shutil.get_terminal_size().columns - 1
            print(f'\r{line[:width]}\x1b[K', end='', flush=True)
        else:
            print(line, flush=True)

    def end(self) -> None:
        """Leave the line on the terminal as it is."""
        if self._on_terminal:
            print()
