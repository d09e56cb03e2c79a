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

"""
Keys of the diagnostics of the bridge, which writes them; ``check`` and ``follow`` read them.

The values are texts; for a truth value other code calls ``read_flag``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

PARAMETER: Final = 'parameter '
MISSING: Final = 'missing parameter '
UNPROVEN: Final = 'unproven firmware'
NOT_READY: Final = 'not ready to arm'
UNREAD: Final = 'parameters unread'
#: That the autopilot answers nothing, or ''; the questions that have no answer.
NO_ANSWERS: Final = 'no answers'
UNANSWERED: Final = 'unanswered questions'
REFUSED: Final = 'offboard would be refused'
LINK_FAULT: Final = 'link fault'
ARMED: Final = 'armed'
#: Whether the autopilot reports that the vehicle is in the air.
FLYING: Final = 'flying'


def read_flag(values: Mapping[str, str], key: str) -> bool | None:
    """Return a value of the diagnostics as True or False; None if the value is unknown."""
    return {'True': True, 'False': False}.get(values.get(key, ''))
