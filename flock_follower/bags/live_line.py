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

"""The current state as one line: overwritten on a terminal, repeated at intervals in a log."""

from __future__ import annotations

import math
import shutil
import sys
from typing import TextIO

TERMINAL_PERIOD = 0.1  # s between lines on a terminal
LOG_PERIOD = 5.0  # s between lines in a log


class LiveLine:
    """Prints a line to a stream, by default stdout; times are s on a monotonic clock."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdout
        self.on_terminal = self._stream.isatty()
        self._next = -math.inf

    def due(self, now: float) -> bool:
        """Return whether it is time for the next line."""
        if now < self._next:
            return False
        self._next = now + (TERMINAL_PERIOD if self.on_terminal else LOG_PERIOD)
        return True

    def show(self, line: str) -> None:
        """Print the line."""
        if self.on_terminal:
            width = shutil.get_terminal_size().columns - 1
            print(f'\r{line[:width]}\x1b[K', end='', file=self._stream, flush=True)
        else:
            print(line, file=self._stream, flush=True)

    def print_above(self, text: str) -> None:
        """Print text that stays above the line."""
        print(f'\r\x1b[K{text}' if self.on_terminal else text, file=self._stream, flush=True)

    def end(self) -> None:
        """Leave the line on the terminal as it is."""
        if self.on_terminal:
            print(file=self._stream, flush=True)


def bar(share: float, width: int = 20) -> str:
    """Return a bar of characters that is filled up to a share, 0 to 1."""
    filled = round(width * min(1.0, max(0.0, share)))
    return f'[{"#" * filled}{"." * (width - filled)}]'
