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

"""How far a long computation is: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

from typing import TextIO

_COLUMNS = 30


class Progress:
    """
    The progress through a number of jobs of equal weight, printed to a stream.

    On a terminal one line is drawn over and over; elsewhere each job is a line of its own.
    """

    def __init__(self, jobs: int, stream: TextIO) -> None:
        self.jobs, self.stream = jobs, stream
        self.done = 0
        self.name = ''
        self._drawn = -1

    def start(self, name: str) -> None:
        """Begin the next job, the one before being done."""
        if self.name:
            self.done += 1
        self.name = name
        if self.stream.isatty():
            self.share(0.0)
        else:
            print(f'[{self.done + 1}/{self.jobs}] {name}', file=self.stream, flush=True)

    def share(self, share: float) -> None:
        """Show that a share, 0 to 1, of the present job is done."""
        permille = round(1000 * (self.done + share) / self.jobs)
        if self.stream.isatty() and permille != self._drawn:
            self._drawn = permille
            bar = ('#' * (_COLUMNS * permille // 1000)).ljust(_COLUMNS, '.')
            print(f'\r[{bar}] {permille // 10:3d} %  {self.name:<40.40}', end='',
                  file=self.stream, flush=True)

    def finish(self) -> None:
        """End the last job."""
        self.done, self.name = self.jobs, 'done'
        self.share(0.0)
        if self.stream.isatty():
            print(file=self.stream, flush=True)
