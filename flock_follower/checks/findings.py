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

"""The result of one check: a row that names the property, its value and the action to take."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

OK: Final = 'ok'
WARNING: Final = 'warning'
ERROR: Final = 'error'
UNMEASURED: Final = 'not measured'
#: A measured error counts if it exceeds so many of its deviations.
SIGNIFICANT_SIGMAS: Final = 3.0
#: The system is not ready while one of these is unmeasured. All others may be measured later.
ESSENTIAL: Final = frozenset({
    'images rate', 'odom rate', 'relative_pose status', 'planner status', 'mavlink_bridge status',
    'ready to arm', 'ready for offboard'})
_CAMERA: Final = ('images', 'camera_info', 'calibration')
_AXES: Final = (*_CAMERA, 'odom', 'odom positions', 'odom up', 'odom ahead')
#: The causes of each property: its row is left out if one of them is an error.
CAUSES: Final[Mapping[str, tuple[str, ...]]] = {
    'odom velocity': ('odom positions',), 'odom ahead': (*_CAMERA, 'odom', 'odom up'),
    'camera time offset': _AXES, 'marker size': (*_AXES, 'focal length'),
    'focal length': _AXES, 'camera mounting': _AXES,
    'images rate': ('images',), 'odom rate': ('odom',),
    'relative_pose status': (*_CAMERA, 'odom'),
    'planner status': (*_CAMERA, 'odom', 'relative_pose status'),
    'mavlink_bridge status': ('autopilot',),
}


class Finding(NamedTuple):
    """
    One row: ``level`` is OK, WARNING, ERROR or UNMEASURED.

    ``what`` is the property, as 'odom rate'; ``wanted`` is the value that it should have;
    ``advice`` is the action to take, '' if there is none.
    """

    level: str
    what: str
    measured: str
    wanted: str
    advice: str = ''

    @property
    def line(self) -> str:
        """Return the row as one line."""
        line = f'{self.level}: {self.what}: {self.measured}; should be: {self.wanted}'
        return f'{line}; do: {self.advice}' if self.advice else line


def grade(bad: bool, poor: bool, what: str, measured: str, wanted: str,
          advice: str) -> Finding:
    """Return an error if ``bad``, else a warning if ``poor``, else OK without advice."""
    if bad or poor:
        return Finding(ERROR if bad else WARNING, what, measured, wanted, advice)
    return Finding(OK, what, measured, wanted)


def first(what: str, wanted: str, *cases: tuple[Any, str, str, str]) -> Finding:
    """
    Return the finding of the first case whose condition is true; one condition must be true.

    :param cases: each has the condition, the level, the measured value, and the advice, '' if OK.
    """
    return next(Finding(level, what, measured, wanted, advice)
                for holds, level, measured, advice in cases if holds)


def without_consequences(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings without the findings that only result from another finding."""
    findings = list(findings)
    faulty = {finding.what for finding in findings if finding.level == ERROR}
    return [finding for finding in findings if not faulty.intersection(
        CAUSES.get(finding.what, ()))]


def still_needed(findings: Iterable[Finding]) -> list[str]:
    """Return the essential properties that were not measured."""
    return [finding.what for finding in findings
            if finding.level == UNMEASURED and finding.what in ESSENTIAL]


def ready(findings: Sequence[Finding]) -> bool:
    """Return whether nothing prevents a flight, or the use of a bag."""
    return not still_needed(findings) and all(finding.level != ERROR for finding in findings)
