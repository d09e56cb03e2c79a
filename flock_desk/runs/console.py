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


"""Commands on the console: the ranges of their options, exit codes, progress, tables."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from flock_desk.runs.processes import TOO_BUSY_EXIT_CODE, TooBusyError
from flock_follower.bags.live_line import LOG_PERIOD, TERMINAL_PERIOD
from flock_follower.ranges import Range

if TYPE_CHECKING:
    from tqdm import tqdm

LINE_WIDTH = 100  # characters of a line


def within(valid: Range) -> Callable[[str], float]:
    """Return the type of an option for ``add_argument``: a number in a range."""
    def number(text: str) -> float:
        try:
            value = int(text) if valid.whole else float(text)
            valid.check('the value', value)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return value
    return number


def guarded(command: Callable[[], int], refused: int = 1,
            hint: Callable[[], str] = str) -> int:
    """
    Run a command and return its exit code; an error is one line on stderr.

    :param refused: the exit code of an error: a wrong file, an option, a machine that is too busy.
    :param hint: returns a place to look, or '', for an error that is no wrong value.
    """
    below = '\n' if sys.stderr.isatty() else ''  # the live line
    try:
        return command()
    except TooBusyError as error:
        print(f'\ntoo busy: {error}', file=sys.stderr)
        return TOO_BUSY_EXIT_CODE
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        more = '' if isinstance(error, ValueError) else hint()
        print(f'{below}error: {explained(error)}{more}', file=sys.stderr)
        return refused
    except KeyboardInterrupt:
        print(f'{below}interrupted', file=sys.stderr)
        return 130


def logs_in(folder: Path) -> str:
    """Return the place of the logs; '' without logs, as in a read-only folder."""
    return f'; the logs of every process are in {folder}' if any(folder.rglob('*.log')) else ''


def explained(error: Exception) -> str:
    """Return an error as one line; the line names the file if the error has one."""
    if isinstance(error, OSError) and error.filename:
        return f'{error.filename}: {error.strerror}'
    return ' '.join(str(error).split())


def aligned(rows: Sequence[Sequence[str]], left: int = 2) -> str:
    """Return rows as lines of columns two apart, the first ``left`` of them flush left."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return '\n'.join('  '.join(
        cell.ljust(width) if n < left else cell.rjust(width)
        for n, (cell, width) in enumerate(zip(row, widths))).rstrip() for row in rows)


def progress(jobs: int) -> tqdm[None]:
    """Return a bar on stderr for a number of jobs, also in a pipe; ``desc`` names the present."""
    from tqdm import tqdm
    return tqdm(total=jobs, file=sys.stderr, ncols=LINE_WIDTH,
                mininterval=TERMINAL_PERIOD if sys.stderr.isatty() else LOG_PERIOD,
                bar_format='{desc}: {percentage:3.0f} % |{bar}| {elapsed}<{remaining}')
