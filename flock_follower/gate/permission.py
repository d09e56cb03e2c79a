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
State machine of the permission to fly: which setpoints the bridge may send.

Only the service ``mavlink_bridge/offboard`` gives permission. The permission ends with its flight.

===========  ==================================  ================================================
phase        the bridge sends                    announced on ``mavlink_bridge/state`` as
===========  ==================================  ================================================
INACTIVE     nothing                             INACTIVE
READY        setpoints that hold it still        READY
ACTIVE       the planner's commands, limited     ACTIVE
GIVING_BACK  braking setpoints                   READY
TAKEN_OVER   nothing                             TAKEN_OVER
===========  ==================================  ================================================

Whatever the phase, NO_AUTOPILOT is announced while no autopilot is connected; the phase does not
change, because the vehicle may still fly our setpoints. ``docs/fly.md`` has a diagram.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import enum
import math
from typing import Final, NamedTuple

from flock_follower import bridge_state
from flock_follower.gate.vehicle_status import VehicleStatus

NOT_REQUESTED: Final[str] = 'offboard was not requested'
ON_GROUND: Final[str] = 'on the ground'
FELL_SILENT: Final[str] = 'fell silent'
#: After a takeover offboard is refused for this long, s: another program must not undo it.
TAKEOVER_TIME: Final[float] = 10.0
TWO_COMMAND: Final[str] = 'two nodes command'
#: The vehicle is braked if no message with the mode (HEARTBEAT, CURRENT_MODE) came for this, s.
MODE_TIMEOUT: Final[float] = 3.0
#: After this long without the mode, s, the permission ends: the pilot may have taken over.
LONGEST_SILENCE: Final[float] = 5.0
MODE_UNKNOWN: Final[str] = 'mode unknown'


class Cause(NamedTuple):
    """Who or what has changed the mode."""

    text: str
    pilot: bool
    """Whether it is a pilot, or may be one."""


UNKNOWN: Final[Cause] = Cause('pilot or failsafe: unknown', True)
STICK: Final[Cause] = Cause('the pilot moved a stick', True)


class Phase(enum.Enum):
    """A phase; the value is announced."""

    INACTIVE = bridge_state.INACTIVE
    READY = bridge_state.READY
    ACTIVE = bridge_state.ACTIVE
    GIVING_BACK = f'{bridge_state.READY}: giving back'
    TAKEN_OVER = bridge_state.TAKEN_OVER


@dataclass(frozen=True)
class Permission:
    """The state of the machine, and its transitions: pure functions of an event."""

    phase: Phase = Phase.INACTIVE
    reason: str = NOT_REQUESTED
    """Why it is not ACTIVE, as text; '' if it is."""
    since: float = math.inf
    """When offboard was last requested, s; earlier HEARTBEATs are ignored."""
    received: float = math.inf
    """When the newest message with the mode was received since then, s, if any."""
    obeyed: bool = False
    """Whether the vehicle has been in the mode that obeys setpoints since then."""
    cause: Cause = UNKNOWN
    """While TAKEN_OVER, who has changed the mode."""

    @property
    def streams(self) -> bool:
        """Return whether setpoints may be sent at all."""
        return self.phase in (Phase.READY, Phase.ACTIVE, Phase.GIVING_BACK)

    @property
    def flies(self) -> bool:
        """Return whether the vehicle, as far as known, obeys the setpoints."""
        return self.streams and self.obeyed

    def taken_over(self, now: float) -> str:
        """Return that the pilot took over too recently for offboard at ``now``, s, or ''."""
        taken = self.phase is Phase.TAKEN_OVER or self.reason == STICK.text
        if not taken or not self.cause.pilot or now - self.received >= TAKEOVER_TIME:
            return ''
        unknown = self.cause == UNKNOWN and self.reason != STICK.text
        who = 'the pilot, or a failsafe,' if unknown else 'the pilot'
        return (f'{who} took over {max(now - self.received, 0.0):.0f} s ago: refused for '
                f'{TAKEOVER_TIME:g} s; hold and land stay available')

    def announced(self) -> str:
        """Return the text of ``mavlink_bridge/state`` while the autopilot is connected."""
        return ': '.join(filter(None, [self.phase.value, self.reason]))

    # The permission after an event.

    def requested(self, time: float) -> Permission:
        """Permit setpoints for a request of offboard at a time, s."""
        return self if self.phase is Phase.ACTIVE else Permission(
            Phase.READY, 'waiting for offboard mode', time)

    def failed(self, why: str) -> Permission:
        """End a request that the vehicle refused, or did not execute in time."""
        # A mode that is reached late has no effect then.
        ends = self.phase is Phase.READY and not self.obeyed
        return Permission(reason=why) if ends else self

    def ended(self, why: str) -> Permission:
        """Brake after a request for hold, land, disarm or the end of the bridge."""
        if self.phase is Phase.READY and not self.obeyed:
            return Permission(reason=why)
        return replace(self, phase=Phase.GIVING_BACK, reason=why) if self.streams else self

    def contested(self, who: str) -> Permission:
        """Brake, because two nodes give commands at once."""
        return self if self.phase is not Phase.ACTIVE else replace(
            self, phase=Phase.GIVING_BACK, reason=f'{TWO_COMMAND}: {who}')

    def blinded(self, why: str) -> Permission:
        """Fall silent without a valid velocity: only silence starts the failsafe."""
        # Setpoints alone would end the failsafe of PX4 if a velocity returned.
        return Permission(reason=f'{FELL_SILENT}: {why}') if self.streams else self

    def unseen(self, silence: float) -> Permission:
        """Brake for good after a time, s, without the mode: the pilot may have taken over."""
        flown = self.phase in (Phase.READY, Phase.ACTIVE) and self.obeyed
        return self if not flown or silence <= LONGEST_SILENCE else replace(
            self, phase=Phase.GIVING_BACK,
            reason=f'{MODE_UNKNOWN} for {silence:.0f} s, the pilot may have taken over')

    def landed(self) -> Permission:
        """End a flight after a landing."""
        return Permission(reason=ON_GROUND) if self.streams else self

    def restarted(self, why: str) -> Permission:
        """Reset: the autopilot, rebooted or replaced, has not received the request."""
        return Permission(reason=why)

    def left(self, status: VehicleStatus, cause: Cause = UNKNOWN) -> Permission:
        """End a flight whose mode the pilot or the autopilot has changed."""
        return Permission(Phase.TAKEN_OVER, f'offboard was left for {status.mode}: {cause.text}',
                          received=self.received, cause=cause)

    def attributed(self, cause: Cause, now: float) -> Permission:
        """Name the cause of a takeover, found at ``now``, s; the time of a pilot counts anew."""
        if self.phase is not Phase.TAKEN_OVER or cause == self.cause:
            return self
        left, _, _ = self.reason.partition(': ')
        return replace(self, reason=f'{left}: {cause.text}', cause=cause, received=(
            now if cause.pilot and not self.cause.pilot else self.received))

    def seen(self, status: VehicleStatus, received: float, airborne: bool | None) -> Permission:
        """
        Follow a HEARTBEAT or CURRENT_MODE that was received at the time ``received``, s.

        :param airborne: whether the vehicle reports that it flies: on the ground setpoints could
            start a take-off. None: it does not report, which permits nothing.
        """
        if not self.streams or received <= self.since:
            return self
        now = replace(self.unseen(received - self.received), received=received)
        if now.phase is Phase.GIVING_BACK:
            if status.offboard and status.armed:
                return replace(now, obeyed=True)
            if status.armed and now.reason == STICK.text:
                return now.left(status, STICK)
            if status.armed and now.reason.startswith(MODE_UNKNOWN):
                return now.left(status)
            return Permission(reason=f'given back ({now.reason})')
        if now.phase is Phase.READY and (not status.armed or airborne is False):
            return Permission(reason=ON_GROUND if status.armed else 'disarmed')
        if not status.offboard:
            return now.left(status) if now.obeyed else now
        if now.phase is Phase.ACTIVE:
            return now if status.armed else Permission(reason='disarmed')
        if airborne is None:
            return replace(now, obeyed=True, reason=f'{status.mode}, not reported to fly')
        return replace(now, phase=Phase.ACTIVE, reason='', obeyed=True)
