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

"""The choice between odometry and the motion without it."""

from __future__ import annotations

from flock_follower.messages import MAX_JUMP, NANOSECONDS, OdometryState, RELATIVE

#: s without a message in the frame ``RELATIVE`` after which odometry is used again.
RELATIVE_SILENCE = 0.15


class OdometryChoice:
    """Selects the odometry to use: the one in the frame ``RELATIVE`` while it is received."""

    def __init__(self) -> None:
        self._newest: int | None = None

    def takes(self, state: OdometryState) -> bool:
        """Return whether to use a state."""
        if state.frame == RELATIVE:
            self._newest = state.stamp
        if self._newest is None or state.frame == RELATIVE:
            return True
        later = (state.stamp - self._newest) / NANOSECONDS
        return not -MAX_JUMP <= later <= RELATIVE_SILENCE
