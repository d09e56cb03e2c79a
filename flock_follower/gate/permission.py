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

While no autopilot is connected, NO_AUTOPILOT is announced in every phase; the phase does not
change, because the vehicle may still fly our setpoints. ``docs/fly.md`` has a diagram.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import enum
import math
from typing import Final, NamedTuple

from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.messages import bridge_state

NOT_REQUESTED: Final[str] = 'offboard was not requested'
ON_GROUND: Final[str] = 'on the ground'
#: After a takeover offboard is refused for this long, s: another program must not undo it.
TAKEOVER_TIME: Final[float] = 10.0
#: The vehicle is braked if no message with the mode (HEARTBEAT, CURRENT_MODE) came for this, s.
MODE_TIMEOUT: Final[float] = 3.0
#: After this long without the mode, s, the permission ends: the pilot may have taken over.
LONGEST_SILENCE: Final[float] = 5.0


class Cause(enum.Enum):
    """Why the permission is not ACTIVE."""

    NOT_REQUESTED = enum.auto()
    WAITING = enum.auto()
    """Offboard was requested, but the vehicle is not in the mode yet."""
    FAILED = enum.auto()
    """The vehicle refused the request, or did not execute it in time."""
    ENDED = enum.auto()
    """A request ended the flight: hold, land, disarm or the end of the bridge."""
    STICK = enum.auto()
    """A request ended the flight because the pilot moved a stick."""
    CONTESTED = enum.auto()
    """Two nodes publish commands."""
    SILENT = enum.auto()
    """The bridge stopped sending, because no velocity was valid."""
    MODE_UNKNOWN = enum.auto()
    LANDED = enum.auto()
    DISARMED = enum.auto()
    RESTARTED = enum.auto()
    GIVEN_BACK = enum.auto()
    """The vehicle has left the mode after the flight was ended."""
    TAKEN = enum.auto()
    """The pilot, or a failsafe, left the mode."""


class Taker(NamedTuple):
    """Who or what has changed the mode."""

    text: str
    pilot: bool
    """Whether the taker is a pilot, or may be a pilot."""


UNKNOWN: Final[Taker] = Taker('pilot or failsafe: unknown', True)
STICK: Final[Taker] = Taker('the pilot moved a stick', True)


class Phase(enum.Enum):
    """A phase of the permission; its value is announced."""

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
    """Why the permission is not ACTIVE, as text; '' if it is."""
    since: float = math.inf
    """Time of the last request of offboard, s; earlier HEARTBEATs are ignored."""
    received: float = math.inf
    """Time of the newest message with the mode since ``since``, s, if any."""
    obeyed: bool = False
    """Whether the vehicle has been in the offboard mode since ``since``."""
    unseen: bool = False
    """Whether the bridge fell silent while the mode was unknown: the next mode shows whether the
    pilot has switched."""
    cause: Cause | None = Cause.NOT_REQUESTED
    """Why the permission is not ACTIVE, as a value; None if it is."""
    taker: Taker = UNKNOWN
    """While TAKEN_OVER, who changed the mode; after a moved stick STICK, until a request."""
    left_for: str = ''
    """While TAKEN_OVER, the mode that was flown instead."""
    mode: str = ''
    """While TAKEN_OVER, the newest mode: the pilot may switch again."""

    @property
    def streams(self) -> bool:
        """Return whether setpoints may be sent at all."""
        return self.phase in (Phase.READY, Phase.ACTIVE, Phase.GIVING_BACK)

    @property
    def flies(self) -> bool:
        """Return whether the vehicle, as far as known, obeys the setpoints."""
        return self.streams and self.obeyed

    def takeover_refusal(self, now: float) -> str:
        """Return the refusal if a pilot took over shortly before ``now``, s, or ''."""
        taken = self.phase is Phase.TAKEN_OVER or self.taker == STICK
        if not taken or not self.taker.pilot or now - self.received >= TAKEOVER_TIME:
            return ''
        who = 'the pilot, or a failsafe,' if self.taker == UNKNOWN else 'the pilot'
        return (f'{who} took over {max(now - self.received, 0.0):.0f} s ago: refused for '
                f'{TAKEOVER_TIME:g} s; hold and land stay available')

    def announcement(self) -> str:
        """Return the text of ``mavlink_bridge/state`` while the autopilot is connected."""
        return ': '.join(filter(None, [self.phase.value, self.reason]))

    # The permission after an event.

    def request(self, time: float) -> Permission:
        """Permit setpoints after a request of ``offboard`` at a time, s."""
        return self if self.phase is Phase.ACTIVE else Permission(
            Phase.READY, 'waiting for offboard mode', time, cause=Cause.WAITING)

    def fail(self, why: str) -> Permission:
        """End a request that the vehicle refused, or did not execute in time."""
        # A mode that is reached late has no effect then.
        ends = self.phase is Phase.READY and not self.obeyed
        return Permission(reason=why, cause=Cause.FAILED) if ends else self

    def end(self, why: str, cause: Cause = Cause.ENDED) -> Permission:
        """Brake after a request for hold, land, disarm or the end of the bridge."""
        if self.phase is Phase.READY and not self.obeyed:
            return Permission(reason=why, cause=cause)
        if self.streams:
            return self._giving_back(why, cause)
        # A stick that moved as the bridge stopped sending counts, too.
        return replace(self, taker=STICK) if cause is Cause.STICK and (
            self.phase is Phase.INACTIVE and math.isfinite(self.received)) else self

    def _giving_back(self, why: str, cause: Cause) -> Permission:
        # Another request does not undo a takeover, or that one may have gone unseen.
        unseen = self.phase is Phase.GIVING_BACK and self.cause is Cause.MODE_UNKNOWN
        return replace(self, phase=Phase.GIVING_BACK, reason=why,
                       cause=Cause.MODE_UNKNOWN if unseen else cause,
                       taker=STICK if cause is Cause.STICK else self.taker)

    def _stop_sending(self, why: str, cause: Cause, unseen: bool = False) -> Permission:
        """
        Return the permission that sends nothing; a stick that was moved still counts.

        :param unseen: whether the pilot may have switched unseen: the next mode shows it.
        """
        return Permission(reason=why, since=self.since if unseen else math.inf,
                          received=self.received, unseen=unseen, cause=cause, taker=self.taker)

    def contest(self, who: str) -> Permission:
        """Brake, because two nodes publish commands."""
        return self if self.phase is not Phase.ACTIVE else self._giving_back(
            f'two nodes command: {who}', Cause.CONTESTED)

    def fall_silent(self, why: str, mode_age: float) -> Permission:
        """
        Stop sending, because no velocity is valid; the autopilot's failsafe then starts.

        :param mode_age: time since a message last had the mode, s.
        """
        # Setpoints alone would end the failsafe of PX4 if a velocity returned.
        unseen = self.obeyed and (mode_age > MODE_TIMEOUT or self.cause is Cause.MODE_UNKNOWN)
        return self if not self.streams else self._stop_sending(
            f'fell silent: {why}', Cause.SILENT, unseen)

    def follow_silence(self, silence: float) -> Permission:
        """Brake until offboard is requested again: no mode was reported for a time, s."""
        flown = self.phase in (Phase.READY, Phase.ACTIVE) and self.obeyed
        return self if not flown or silence <= LONGEST_SILENCE else self._giving_back(
            f'mode unknown for {silence:.0f} s, the pilot may have taken over',
            Cause.MODE_UNKNOWN)

    def land(self) -> Permission:
        """End a flight after a landing."""
        return self._stop_sending(ON_GROUND, Cause.LANDED) if self.streams else self

    def reset(self, why: str) -> Permission:
        """Reset: a rebooted or replaced autopilot has not received the request."""
        return Permission(reason=why, cause=Cause.RESTARTED)

    def leave_mode(self, status: VehicleStatus, taker: Taker = UNKNOWN) -> Permission:
        """End a flight after the pilot or the autopilot has changed the mode."""
        return Permission(Phase.TAKEN_OVER, _left_reason(status.mode, taker),
                          received=self.received, cause=Cause.TAKEN, taker=taker,
                          left_for=status.mode, mode=status.mode)

    def name_taker(self, taker: Taker, now: float) -> Permission:
        """Set who took over, known at ``now``, s; the wait after a pilot begins at ``now``."""
        if self.phase is not Phase.TAKEN_OVER or taker == self.taker:
            return self
        return replace(self, reason=_left_reason(self.left_for, taker), taker=taker, received=(
            now if taker.pilot and not self.taker.pilot else self.received))

    def follow_status(self, status: VehicleStatus, received: float,
                      airborne: bool | None) -> Permission:
        """
        Follow a HEARTBEAT or CURRENT_MODE that was received at the time ``received``, s.

        :param airborne: whether the vehicle reports that it flies: on the ground setpoints could
            start a take-off. None: no report, so nothing is permitted.
        """
        if self.phase is Phase.TAKEN_OVER and self.taker.pilot and status.mode != self.mode:
            return replace(self, received=received, mode=status.mode)
        if not (self.streams or self.unseen) or received <= self.since:
            return self
        now = replace(self.follow_silence(received - self.received), received=received)
        if now.phase is Phase.GIVING_BACK or now.unseen:
            if status.offboard and status.armed:
                return replace(now, obeyed=True)
            if status.armed and (
                    now.taker == STICK or now.unseen or now.cause is Cause.MODE_UNKNOWN):
                return now.leave_mode(status, now.taker)
            return now._stop_sending(f'given back ({now.reason})', Cause.GIVEN_BACK)
        if now.phase is Phase.READY and (not status.armed or airborne is False):
            return _end_on_ground(status)
        if not status.offboard:
            return now.leave_mode(status) if now.obeyed else now
        if now.phase is Phase.ACTIVE:
            return now if status.armed else _end_on_ground(status)
        if airborne is None:
            return replace(now, obeyed=True, reason=f'{status.mode}, not reported to fly')
        return replace(now, phase=Phase.ACTIVE, reason='', cause=None, obeyed=True)


def _left_reason(mode: str, taker: Taker) -> str:
    return f'offboard was left for {mode}: {taker.text}'


def _end_on_ground(status: VehicleStatus) -> Permission:
    """Return the permission after the vehicle has landed, or is disarmed."""
    if not status.armed:
        return Permission(reason='disarmed', cause=Cause.DISARMED)
    return Permission(reason=ON_GROUND, cause=Cause.LANDED)
