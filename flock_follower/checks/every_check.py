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

"""All checks, in the order in which their findings should be fixed."""

from __future__ import annotations

from flock_follower.checks.findings import Finding, without_consequences
from flock_follower.checks.observations import Observations
from flock_follower.checks.own_motion import check_own_motion
from flock_follower.checks.pictures import check_pictures
from flock_follower.checks.system import check_diagnostics, check_machine
from flock_follower.checks.topics import check_nodes, check_topics


def judge_all(seen: Observations) -> list[Finding]:
    """Return the findings of every check, without those that only follow from another one."""
    if seen.live and not seen.nodes:
        return [check_nodes(seen)]
    return without_consequences(finding for check in (
        check_topics, check_pictures, check_own_motion, check_machine, check_diagnostics)
        for finding in check(seen))
