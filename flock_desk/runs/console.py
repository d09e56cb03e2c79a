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


"""Commands on the console: their options, errors and exit codes, progress, tables."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
import sys
from typing import Any

from flock_desk.runs.processes import TOO_BUSY_EXIT_CODE, TooBusyError
from flock_follower.bags.live_line import LOG_PERIOD, TERMINAL_PERIOD
from flock_follower.ranges import Range

WIDTH = 100  # characters of a bar
Options = Mapping[str, Mapping[str, Any]]


def parsed(parser: argparse.ArgumentParser, args: Sequence[str] | None,
           options: Options, groups: Mapping[str, Options] | None = None,
           valid: Mapping[str, Range] | None = None) -> argparse.Namespace:
    """
    Return the values of a command's options; a wrong one ends the program with exit code 2.

    :param options: what ``add_argument`` takes, by the name of the option.
    :param groups: likewise more options, by the title of their group in the help.
    :param valid: the values of a number, by the name of the option without dashes.
    """
    sections: list[tuple[Any, Options]] = [
        (parser, options),
        *((parser.add_argument_group(title), rows) for title, rows in (groups or {}).items())]
    for section, rows in sections:
        for name, row in rows.items():
            section.add_argument(name, **row)
    values = parser.parse_args(args)
    try:
        for name, numbers in (valid or {}).items():
            numbers.check(f'--{name}', getattr(values, name))
    except ValueError as error:
        parser.error(str(error))
    return values


def guarded(command: Callable[[], int], refused: int = 1, hint: str = '') -> int:
    """
    Run a command and return its exit code; an error is one line on stderr.

    :param refused: the exit code of an error: a wrong file, an option, a machine that is too busy.
    :param hint: where to look for more, if the error is not a wrong value.
    """
    below = '\n' if sys.stderr.isatty() else ''  # the live line
    try:
        return command()
    except TooBusyError as error:
        print(f'\ntoo busy: {error}', file=sys.stderr)
        return TOO_BUSY_EXIT_CODE
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        more = '' if isinstance(error, ValueError) else hint
        print(f'{below}error: {explained(error)}{more}', file=sys.stderr)
        return refused
    except KeyboardInterrupt:
        print(f'{below}interrupted', file=sys.stderr)
        return 130


def explained(error: Exception) -> str:
    """Return an error in one line, that of a file with the file's name."""
    if isinstance(error, OSError) and error.filename:
        return f'{error.filename}: {error.strerror}'
    return ' '.join(str(error).split())


def aligned(rows: Sequence[Sequence[str]], left: int = 2) -> list[str]:
    """Return rows as lines of columns two apart, the first ``left`` of them flush left."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return ['  '.join(cell.ljust(width) if n < left else cell.rjust(width)
                      for n, (cell, width) in enumerate(zip(row, widths))).rstrip()
            for row in rows]


class Progress:
    """The progress through a number of jobs of equal weight: a bar on stderr, also in a pipe."""

    def __init__(self, jobs: int) -> None:
        from tqdm import tqdm
        period = TERMINAL_PERIOD if sys.stderr.isatty() else LOG_PERIOD
        self._bar = tqdm(
            total=jobs, file=sys.stderr, mininterval=period, ncols=WIDTH, desc='begin',
            bar_format='{desc}: {percentage:3.0f} % |{bar}| {elapsed}<{remaining}')
        self._done = -1

    def start(self, name: str) -> None:
        """Begin the next job, the one before being done."""
        self._done += 1
        self._bar.set_description_str(name, refresh=False)
        self.share(0.0)

    def share(self, share: float) -> None:
        """Show that a share, 0 to 1, of the present job is done, if it is time for it."""
        self._bar.update(self._done + share - self._bar.n)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        """End the last job; after an error leave the bar: later output begins on a new line."""
        if error is None:
            self.share(1.0)
        self._bar.close()
