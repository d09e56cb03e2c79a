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
What goes out to the autopilot: whether anything may (``permission``), and then what (``gate``).

The same object decides in the bridge, in ``evaluate`` and in ``flights``; nothing here knows
MAVLink messages or reads a clock.
"""

from __future__ import annotations

import math
from typing import Final

from flock_follower.mavlink.dialect import VehicleStatus
from flock_follower.mavlink.permission import (
    Blinded,
    Event,
    Landed,
    next_permission,
    Permission,
    Phase,
    Seen,
)
from flock_follower.mavlink.setpoint_gate import AcceptedCommand, SetpointGate
from flock_follower.mavlink.setpoint_rules import NONE, Setpoint
from flock_follower.messages import Command

#: A landed report below this height, m, that lasts this long, s, ends the permission. In flight a
#: false one must not remove thrust.
LANDED_HEIGHT: Final[float] = 0.3
LANDED_TIME: Final[float] = 1.0


class SetpointControl:
    """
    Permission and setpoint gate of one follower.

    ``gate`` takes odometry, the autopilot's estimate and limits directly.
    """

    def __init__(self, gate: SetpointGate) -> None:
        self.gate = gate
        self.permission = Permission()
        self.active_since = math.inf
        """Since when it is ACTIVE, s; infinite while it is not."""
        self._was_active = False  # since offboard was last requested
        self._status: VehicleStatus | None = None
        self._airborne: bool | None = None
        self._landed_since = math.inf

    def permit(self, event: Event) -> None:
        """Let the permission follow a request, or its result."""
        before, self.permission = self.permission, next_permission(self.permission, event)
        self._was_active = self.permission.phase is Phase.ACTIVE or (
            self._was_active and self.permission.phase is Phase.GIVING_BACK)
        if (before.phase is Phase.ACTIVE) != (self.permission.phase is Phase.ACTIVE):
            self.gate.forget_command()

    def see(self, status: VehicleStatus, received: float, airborne: bool | None = True) -> None:
        """
        Take the status that HEARTBEAT or CURRENT_MODE shows, received at a time, s.

        :param airborne: whether the autopilot reports that it flies; None if it does not report.
        """
        self._status, self._airborne = status, airborne
        self.permit(Seen(status, received, airborne))

    def take_command(self, command: Command, age: float, now: float,
                     source_age: float | None = None) -> str:
        """Take a command, see ``SetpointGate.accept_command``; return '' or why it is refused."""
        if self.permission.phase is not Phase.ACTIVE:
            return f'while {self.permission.phase.name}'
        return self.gate.accept_command(command, age, now, source_age)

    @property
    def flies(self) -> bool:
        """Return whether the vehicle, as far as known, flies our setpoints."""
        # A lost link leaves it flying them: the last report counts.
        return self._status is not None and self._status.armed and self.permission.flies

    @property
    def withheld(self) -> str:
        """Return why no setpoint may go out, or ''."""
        return '' if self.permission.streams else self.permission.reason

    def decide(self, now: float, link_age: float = 0.0, withheld: str = ''
               ) -> tuple[Setpoint, AcceptedCommand | None]:
        """
        Return what to send at ``now``, s, and the command it comes from, if any.

        :param link_age: how long the autopilot has been missing, s.
        :param withheld: a reason of the caller's own to send nothing.
        """
        self._notice_landing(now)
        active = self.permission.phase is Phase.ACTIVE
        self.active_since = min(self.active_since, now) if active else math.inf
        status, withheld = self._status, withheld or self.withheld
        setpoint, command = self.gate.decide(
            now, link_age=link_age, offboard=status is not None and status.offboard,
            armed=status is not None and status.armed, withheld=withheld,
            # In flight only the landing that lasts counts: a false report must not remove thrust.
            airborne=self._airborne is True or self._was_active)
        if setpoint.kind == NONE and not withheld and self.gate.blind(now):
            self.permit(Blinded(setpoint.reason))
        return setpoint, command

    def _notice_landing(self, now: float) -> None:
        height = self.gate.place(now).height
        down = self._airborne is False and (height is None or height < LANDED_HEIGHT)
        self._landed_since = min(self._landed_since, now) if down else math.inf
        if now - self._landed_since >= LANDED_TIME:
            self.permit(Landed())
