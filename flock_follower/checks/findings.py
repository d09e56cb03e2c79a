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

"""What a check has found: one line a tired reader gets at once, and what to do about it."""

from __future__ import annotations

from typing import Final, NamedTuple

OK: Final = 'ok'
WARNING: Final = 'warning'
ERROR: Final = 'error'
LEVELS: Final = (OK, WARNING, ERROR)


class Finding(NamedTuple):
    """One thing that was looked at: ``level`` is one of ``LEVELS``; the rest is for people."""

    level: str
    what: str
    """What was looked at, as 'odom rate'."""
    measured: str
    wanted: str
    """What it should be."""
    advice: str = ''
    """What to do; '' where it is as it should be."""

    @property
    def line(self) -> str:
        """Return all of it in one line."""
        told = f'{self.level}: {self.what}: {self.measured}; should be: {self.wanted}'
        return f'{told}; do: {self.advice}' if self.advice else told


def ok(what: str, measured: str, wanted: str) -> Finding:
    """Return that something is as it should be."""
    return Finding(OK, what, measured, wanted)


def warning(what: str, measured: str, wanted: str, advice: str) -> Finding:
    """Return that something could be better; it flies nevertheless."""
    return Finding(WARNING, what, measured, wanted, advice)


def error(what: str, measured: str, wanted: str, advice: str) -> Finding:
    """Return that something keeps it from flying."""
    return Finding(ERROR, what, measured, wanted, advice)


def ready(findings: list[Finding]) -> bool:
    """Return whether nothing that was found keeps it from flying, or a bag from being used."""
    return all(finding.level != ERROR for finding in findings)
