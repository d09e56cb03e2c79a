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

"""The differences between two sets of parameters, as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: More differences of two sets of parameters than this are counted, not listed.
MAX_LISTED = 5


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return the parameters that differ, with both values: 'v_max 0.5 -> 1.0'; '' if none do."""
    changed = [f'{name} {before.get(name, "not set")} -> {after.get(name, "not set")}'
               for name in sorted({*before, *after}) if before.get(name) != after.get(name)]
    more = len(changed) - MAX_LISTED
    return ', '.join([*changed[:MAX_LISTED], *([f'and {more} more'] if more > 0 else [])])
