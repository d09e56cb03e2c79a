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

"""How far something is: on a terminal one line all the time, elsewhere one now and then."""

from __future__ import annotations

import time
from typing import TextIO

from flock_follower.live_line import LiveLine

_COLUMNS = 30


class Progress:
    """
    The progress through a number of jobs of equal weight, printed to a stream.

    A terminal shows a bar; elsewhere each job is a line of its own, and one every 5 s.
    """

    def __init__(self, jobs: int, stream: TextIO) -> None:
        self.jobs, self.done, self.name = jobs, 0, ''
        self._line = LiveLine(stream)

    def start(self, name: str) -> None:
        """Begin the next job, the one before being done."""
        if self.name:
            self.done += 1
        self.name = name
        self._line.due(time.monotonic())
        self._show(0.0, f'[{self.done + 1}/{self.jobs}] {name}')

    def share(self, share: float) -> None:
        """Show that a share, 0 to 1, of the present job is done."""
        if self._line.due(time.monotonic()):
            percent = 100.0 * (self.done + share) / self.jobs
            self._show(share, f'[{self.done + 1}/{self.jobs}] {self.name}: {percent:.0f} %')

    def finish(self) -> None:
        """End the last job."""
        self.done, self.name = self.jobs, 'done'
        self._show(0.0, 'done')
        self._line.end()

    def _show(self, share: float, text: str) -> None:
        if self._line.on_terminal:
            done = (self.done + share) / self.jobs
            bar = ('#' * int(_COLUMNS * done)).ljust(_COLUMNS, '.')
            text = f'[{bar}] {int(100.0 * done):3d} %  {self.name:<40.40}'
        self._line.show(text)
