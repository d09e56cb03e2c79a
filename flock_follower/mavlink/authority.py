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
Who flies: whether our setpoints may go out at all.

The pilot's mode switch wins. Once the vehicle has left the mode that obeys us, whoever asked for
it, nothing is sent until offboard is requested again: switched back by the transmitter, it holds
or is refused, but does not follow a command that has meanwhile become another.
"""

from __future__ import annotations

from typing import Final

from flock_follower.mavlink.dialect import VehicleStatus

LEFT: Final[str] = 'offboard was left'
NOT_REQUESTED: Final[str] = 'offboard was not requested'


class Authority:
    """Follows the vehicle's mode and the requests for it; ``withheld`` says why not to send."""

    def __init__(self) -> None:
        self.withheld = ''
        """'' where setpoints may go out; else why not."""
        self.left_for = ''
        """The mode the vehicle left us for, where it has."""
        self.granted = False
        """Whether it obeys because offboard was requested."""
        self._obeyed = False
        self._asking = False

    def update(self, status: VehicleStatus) -> None:
        """Take what the newest HEARTBEAT says."""
        if status.offboard:
            # Without a request, what was left stays left.
            if self._asking or not self.withheld:
                self._obeyed, self.withheld, self.left_for = True, '', ''
                self.granted = self.granted or self._asking
        elif self._obeyed:
            self._obeyed = self.granted = False
            self.withheld, self.left_for = LEFT, status.mode

    def ask(self, asking: bool) -> None:
        """Note that offboard is being requested, or that the request has ended."""
        if self._asking and not asking and not self.granted:
            # It was told to have failed: should the mode come late, nothing is to follow from it.
            self.wait_for_request()
        self._asking = asking

    @property
    def reason(self) -> str:
        """Return why no setpoint may go out now, or ''."""
        # An autopilot takes offboard mode only where setpoints already come.
        return '' if self._asking else self.withheld

    def wait_for_request(self) -> None:
        """Send nothing until offboard is requested, though nobody has left it."""
        self.withheld, self.granted = self.withheld or NOT_REQUESTED, False
