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
phase        what the bridge sends               announced on ``mavlink_bridge/state`` as
===========  ==================================  ================================================
INACTIVE     nothing                             INACTIVE
READY        what holds the vehicle still        READY
ACTIVE       the planner's commands, limited     ACTIVE
GIVING_BACK  what brakes the vehicle             READY
TAKEN_OVER   nothing                             TAKEN_OVER
===========  ==================================  ================================================

Whatever the phase, NO_AUTOPILOT is announced while no autopilot is connected; the phase does not
change, because the vehicle may still fly our setpoints. ``docs/fly.md`` has a diagram.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import enum
import math
from typing import Final

from flock_follower.mavlink.dialects import VehicleStatus

NO_AUTOPILOT: Final[str] = 'NO_AUTOPILOT'
NOT_REQUESTED: Final[str] = 'offboard was not requested'
ON_GROUND: Final[str] = 'on the ground'
FELL_SILENT: Final[str] = 'fell silent'
#: After a takeover offboard is refused for this long, s: another program must not undo it.
TAKEOVER_TIME: Final[float] = 10.0
TWO_COMMAND: Final[str] = 'two nodes command'
#: If two messages with the mode (HEARTBEAT, CURRENT_MODE) are further apart than this, s, the
#: pilot may have taken over in between.
LONGEST_SILENCE: Final[float] = 5.0


class Phase(enum.Enum):
    """What may be sent; the value is the word that is announced."""

    INACTIVE = 'INACTIVE'
    READY = 'READY'
    ACTIVE = 'ACTIVE'
    GIVING_BACK = 'READY: giving back'
    TAKEN_OVER = 'TAKEN_OVER'


@dataclass(frozen=True)
class Permission:
    """The state of the machine."""

    phase: Phase = Phase.INACTIVE
    reason: str = NOT_REQUESTED
    """Why it is not ACTIVE, as text; '' if it is."""
    since: float = math.inf
    """When offboard was last requested, s; earlier HEARTBEATs are ignored."""
    received: float = math.inf
    """When the newest message with the mode was received since then, s, if any."""
    obeyed: bool = False
    """Whether the vehicle has been in the mode that obeys setpoints since then."""

    @property
    def streams(self) -> bool:
        """Return whether setpoints may go out at all."""
        return self.phase in (Phase.READY, Phase.ACTIVE, Phase.GIVING_BACK)

    @property
    def flies(self) -> bool:
        """Return whether the vehicle, as far as known, obeys the setpoints."""
        return self.streams and self.obeyed

    def taken_over(self, now: float) -> str:
        """Return that the pilot took over too recently for offboard at ``now``, s, or ''."""
        if self.phase is not Phase.TAKEN_OVER or now - self.received >= TAKEOVER_TIME:
            return ''
        return (f'the pilot took over {max(now - self.received, 0.0):.0f} s ago: refused for '
                f'{TAKEOVER_TIME:g} s; hold and land stay available')

    def announced(self) -> str:
        """Return the text of ``mavlink_bridge/state`` while the autopilot is connected."""
        return ': '.join(filter(None, [self.phase.value, self.reason]))


@dataclass(frozen=True)
class OffboardRequested:
    """Someone called ``mavlink_bridge/offboard`` with true, at a time, s, and it may be tried."""

    time: float


@dataclass(frozen=True)
class OffboardFailed:
    """The vehicle did not take the mode, or not in time, or was not asked; ``why`` in words."""

    why: str
    asked: bool = True


@dataclass(frozen=True)
class EndRequested:
    """Hold, land, disarm or the end of the bridge was asked for; ``why`` in words."""

    why: str


@dataclass(frozen=True)
class SecondCommander:
    """Two nodes give commands at once; ``who`` in words."""

    who: str


@dataclass(frozen=True)
class Blinded:
    """No valid velocity for too long: only silence starts the autopilot's failsafe."""

    why: str


@dataclass(frozen=True)
class Landed:
    """The vehicle has been on the ground for long enough."""


@dataclass(frozen=True)
class Restarted:
    """The autopilot rebooted, or was replaced: it has received no request."""

    why: str


@dataclass(frozen=True)
class Seen:
    """What HEARTBEAT or CURRENT_MODE, which came at the time ``received``, s, shows."""

    status: VehicleStatus
    received: float
    airborne: bool | None
    """Whether it reports that it flies: on the ground setpoints could start a take-off. None: it
    does not report, which permits nothing."""


Event = (OffboardRequested | OffboardFailed | EndRequested | SecondCommander | Blinded | Landed
         | Restarted | Seen)


def next_permission(now: Permission, event: Event) -> Permission:
    """Return the permission after an event; a pure function."""
    phase = now.phase
    match event:
        case OffboardRequested(time):
            return now if phase is Phase.ACTIVE else Permission(
                Phase.READY, 'waiting for offboard mode', time)
        case OffboardFailed(why, asked):
            if not asked and now.streams:
                return Permission(reason=why)
            # Should the mode come late, nothing is to follow from it.
            return Permission(reason=why) if phase is Phase.READY and not now.obeyed else now
        case EndRequested(why):
            if phase is Phase.READY and not now.obeyed:
                return Permission(reason=why)
            return replace(now, phase=Phase.GIVING_BACK, reason=why) if now.streams else now
        case SecondCommander(who):
            return replace(now, phase=Phase.GIVING_BACK, reason=f'{TWO_COMMAND}: {who}') if (
                phase is Phase.ACTIVE) else now
        case Blinded(why):
            # Setpoints alone would end the failsafe of PX4, should a velocity come back.
            return Permission(reason=f'{FELL_SILENT}: {why}') if now.streams else now
        case Landed():
            return Permission(reason=ON_GROUND) if now.streams else now
        case Restarted(why):
            return Permission(reason=why)
    return _seen(now, event)


def _seen(now: Permission, seen: Seen) -> Permission:
    if not now.streams or seen.received <= now.since:
        return now
    status, silence = seen.status, seen.received - now.received
    now = replace(now, received=seen.received)
    if now.obeyed and status.offboard and status.armed and silence > LONGEST_SILENCE:
        return replace(now, phase=Phase.GIVING_BACK,
                       reason=f'no HEARTBEAT for {silence:.0f} s, the pilot may have taken '
                              'over')
    if now.phase is Phase.GIVING_BACK:
        if status.offboard and status.armed:
            return replace(now, obeyed=True)
        return Permission(reason=f'given back ({now.reason})')
    if now.phase is Phase.READY and (not status.armed or seen.airborne is False):
        return Permission(reason=ON_GROUND if status.armed else 'disarmed')
    if not status.offboard:
        return Permission(Phase.TAKEN_OVER, f'offboard was left for {status.mode}',
                          received=seen.received) if now.obeyed else now
    if now.phase is Phase.ACTIVE:
        return now if status.armed else Permission(reason='disarmed')
    if seen.airborne is None:
        return replace(now, obeyed=True, reason=f'{status.mode}, not reported to fly')
    return replace(now, phase=Phase.ACTIVE, reason='', obeyed=True)
