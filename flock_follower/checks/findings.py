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

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

OK: Final = 'ok'
WARNING: Final = 'warning'
ERROR: Final = 'error'
UNMEASURED: Final = 'not measured'
LEVELS: Final = (OK, WARNING, ERROR, UNMEASURED)
#: Without a measurement of these nothing is ready; all else may be measured on the next occasion.
ESSENTIAL: Final = frozenset({
    'images rate', 'odom rate', 'relative_pose says', 'planner says', 'mavlink_bridge says',
    'ready to arm'})
_CAMERA: Final = ('images', 'camera_info', 'calibration')
#: What follows from what: a row is left out if one of its causes is an error.
CAUSES: Final[Mapping[str, tuple[str, ...]]] = {
    'odom ahead': (*_CAMERA, 'odom', 'odom up'),
    'camera time offset': (*_CAMERA, 'odom', 'odom up', 'odom ahead'),
    'marker size': (*_CAMERA, 'odom', 'odom up', 'odom ahead'),
    'camera mounting': (*_CAMERA, 'odom', 'odom up', 'odom ahead'),
    'images rate': ('images',), 'odom rate': ('odom',),
    'images processed': (*_CAMERA, 'odom'),
    'relative_pose says': (*_CAMERA, 'odom'),
    'planner says': (*_CAMERA, 'odom', 'relative_pose says'),
    'mavlink_bridge says': ('autopilot',),
}


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


def unmeasured(what: str, why: str, wanted: str) -> Finding:
    """Return that something could not be measured, and why."""
    return Finding(UNMEASURED, what, why, wanted)


def without_consequences(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings without those that only follow from another one."""
    findings = list(findings)
    faulty = {finding.what for finding in findings if finding.level == ERROR}
    return [finding for finding in findings if not faulty.intersection(
        set(CAUSES.get(finding.what, ())) - {finding.what})]


def still_needed(findings: Iterable[Finding]) -> list[str]:
    """Return the names of what was not measured, and has to be."""
    return [finding.what for finding in findings
            if finding.level == UNMEASURED and finding.what in ESSENTIAL]


def ready(findings: Sequence[Finding]) -> bool:
    """Return whether nothing keeps it from flying, or a bag from being used, as far as needed."""
    return not still_needed(findings) and all(finding.level != ERROR for finding in findings)
