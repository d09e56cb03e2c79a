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

from flock_follower.mavlink.dialect import VehicleStatus
from flock_follower.mavlink.permission import (
    Blinded,
    Event,
    next_permission,
    ON_GROUND,
    Permission,
    Phase,
    Seen,
)
from flock_follower.mavlink.setpoint_gate import AcceptedCommand, SetpointGate
from flock_follower.mavlink.setpoint_rules import NONE, Setpoint
from flock_follower.messages import Command


class SetpointControl:
    """
    Permission and setpoint gate of one follower.

    ``gate`` takes odometry, the autopilot's estimate and limits directly.

    :param quiet_on_ground: whether a vehicle on the ground or taking off gets no setpoint.
    """

    def __init__(self, gate: SetpointGate, quiet_on_ground: bool = False) -> None:
        self.gate = gate
        self.permission = Permission()
        self.quiet_on_ground = quiet_on_ground
        self._status: VehicleStatus | None = None
        self._on_ground = False

    def permit(self, event: Event) -> None:
        """Let the permission follow a request, or what became of it."""
        before, self.permission = self.permission, next_permission(self.permission, event)
        if (before.phase is Phase.ACTIVE) != (self.permission.phase is Phase.ACTIVE):
            self.gate.forget_command()

    def see(self, status: VehicleStatus, heard: float, on_ground: bool) -> None:
        """Take what HEARTBEAT or CURRENT_MODE, which came at the time ``heard``, s, shows."""
        self._status, self._on_ground = status, on_ground
        self.permit(Seen(status, heard, on_ground))

    def take_command(self, command: Command, age: float, now: float,
                     source_age: float | None = None) -> str:
        """Take a command, see ``SetpointGate.accept_command``; return '' or why it is refused."""
        if self.permission.phase is not Phase.ACTIVE:
            return f'while {self.permission.phase.name}'
        return self.gate.accept_command(command, age, now, source_age)

    @property
    def flies(self) -> bool:
        """Return whether the vehicle, as far as known, flies our setpoints."""
        # A lost link leaves it flying them: its last word counts.
        return self._status is not None and self._status.armed and self.permission.flies

    @property
    def withheld(self) -> str:
        """Return why no setpoint may go out, or ''."""
        if not self.permission.streams:
            return self.permission.reason
        return ON_GROUND if self.quiet_on_ground and self._on_ground else ''

    def decide(self, now: float, link_age: float = 0.0, withheld: str = ''
               ) -> tuple[Setpoint, AcceptedCommand | None]:
        """
        Return what to send at ``now``, s, and the command it comes from, if any.

        :param link_age: how long the autopilot has been missing, s.
        :param withheld: a reason of the caller's own to send nothing.
        """
        status, withheld = self._status, withheld or self.withheld
        setpoint, command = self.gate.decide(
            now, link_age=link_age, offboard=status is not None and status.offboard,
            armed=status is not None and status.armed, withheld=withheld,
            grounded=self._on_ground)
        if setpoint.kind == NONE and not withheld and self.gate.blind(now):
            self.permit(Blinded(setpoint.reason))
        return setpoint, command
