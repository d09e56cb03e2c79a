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
Ends a flight: when the bridge itself requests the autopilot's hold mode, and a landing.

The bridge hands over a vehicle that flies our setpoints if no command came for COMMAND_TIMEOUT, if
the vehicle is outside the envelope, if its sources contradict each other, if its hover thrust is
wrong, or if the battery is low. A landing follows only if a parameter requests it, and only while
the autopilot stays in the hold mode: any other mode is a person's decision. While the autopilot is
not received, its mode is unknown, and nothing is requested. Time is an argument; no clock is read.

``CommandSources`` detects that two nodes publish commands. rclpy does not report the publisher of
a message, but the middleware numbers the messages of each publisher upwards from 1
(publication_sequence_number) and delivers those of one publisher in order. A number that is not
above the last one therefore comes from another publisher.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Final, NamedTuple

from flock_follower.gate.permission import Cause
from flock_follower.gate.vehicle_status import VehicleStatus
from flock_follower.ranges import Checked, parameter, Range

#: s without a command after which its publisher has stopped: three ticks of the planner, so that
#: a late tick is no pause; a planner that was killed takes longer than that to start again.
FELL_SILENT_AFTER: Final[float] = 0.3


class CommandSources:
    """Detects a second publisher of commands by its sequence numbers."""

    def __init__(self) -> None:
        self._number = 0
        self._time = -math.inf

    def another(self, number: int | None, time: float) -> bool:
        """
        Take a command; return whether it shows that two publishers command.

        A publisher that replaces a silent publisher does not count as a second one.

        :param number: its sequence number, from 1; None if the middleware has no numbers.
        :param time: its time of arrival, s on a monotonic clock.
        """
        if number is None:
            return False
        another = number <= self._number and time - self._time < FELL_SILENT_AFTER
        self._number, self._time = number, time
        return another


HOLD, LAND = ACTIONS = ('hold', 'land')
#: After the first command of an ACTIVE phase the vehicle is handed over without one for this, s.
COMMAND_TIMEOUT: Final[float] = 3.0
#: The battery has to be low for this long, s: a climb lowers its voltage.
BATTERY_TIME: Final[float] = 5.0
#: A report of the battery older than this, s, is not used.
BATTERY_TIMEOUT: Final[float] = 30.0
#: A handover that failed is requested again after this, s.
RETRY_PERIOD: Final[float] = 2.0
#: The autopilot keeps its hold mode for this long, s, before the landing: time for the pilot.
LANDING_DELAY: Final[float] = 2.0


@dataclass(frozen=True)
class EndParams(Checked):
    """When a flight ends, and how; ValueError names parameter, value and range."""

    engage_timeout: float = parameter(
        60.0, Range(1.0, 3600.0, 's'),
        'time from ACTIVE without a first command, after which the bridge requests the hold mode '
        'of the autopilot', live=False)
    battery_low: float = parameter(
        0.2, Range(0.0, 1.0),
        'share of the charge below which, after 5 s, the bridge takes battery_action and refuses '
        'offboard; 0: never', live=False)
    leader_lost_action: str = parameter(
        HOLD, ACTIONS,
        'action 3 s after the last command: the hold mode of the autopilot; land: also a landing '
        'after that', live=False)
    battery_action: str = parameter(HOLD, ACTIONS, 'action at a low battery', live=False)
    stick_override: float = parameter(
        0.3, Range(0.2, 0.6),
        'share of full deflection by which a stick must move from its position at offboard, so '
        'that the bridge requests the Position mode; on PX4 1.18 and later, whose own takeover '
        'ignores slow sticks', live=False)


class Handover(NamedTuple):
    """Why the bridge itself hands the vehicle over, and what follows."""

    why: str = ''
    """Reason as text; '' if there is no handover."""
    action: str = HOLD
    """HOLD, or LAND for a landing after the hold mode."""
    cause: Cause = Cause.ENDED
    """The reason as a value, for the permission."""


NO_HANDOVER: Final[Handover] = Handover()


class FlightEnd:
    """Tracks the flights of one bridge, and requests their end; times are monotonic, s."""

    def __init__(self, params: EndParams | None = None) -> None:
        self.params = params or EndParams()
        self.handover = NO_HANDOVER
        """The handover since offboard was last requested, if any."""
        self._asked = -math.inf
        self._held_since = math.inf
        self._low_since = math.inf
        self._battery: tuple[float, float] = math.nan, -math.inf

    def take_battery(self, remaining: float, now: float) -> None:
        """Take the share of the battery that remains; NaN if the autopilot does not know it."""
        self._battery = remaining, now
        low = remaining < self.params.battery_low  # False for NaN
        self._low_since = min(self._low_since, now) if low else math.inf

    def battery_low(self, now: float) -> str:
        """Return the reason to end the flight if the battery has been low for a time, or ''."""
        return '' if now - self._low_since < BATTERY_TIME else (
            f'battery at {100.0 * self._battery[0]:.0f} %: below battery_low = '
            f'{100.0 * self.params.battery_low:.0f} %')

    def battery_unknown(self, now: float) -> bool:
        """Return whether the battery is unknown; then ``battery_low`` cannot end a flight."""
        remaining, time = self._battery
        return self.params.battery_low > 0.0 and (
            math.isnan(remaining) or now - time > BATTERY_TIMEOUT)

    def begin(self) -> None:
        """Reset after a request of an operator."""
        self.handover, self._held_since, self._asked = NO_HANDOVER, math.inf, -math.inf

    @property
    def why(self) -> str:
        """Return why the bridge has handed over since the last request of offboard, or ''."""
        return self.handover.why

    def reason(self, active_since: float, command_time: float, handover: str,
               now: float) -> Handover:
        """
        Return whether a vehicle that flies our setpoints must be handed over, and the reason.

        :param active_since: time from which it has been ACTIVE, s; infinite while it is not.
        :param command_time: time of the last accepted command, s.
        :param handover: the gate's reason for a handover, or ''.
        """
        if handover:
            return Handover(handover)
        if low := self.battery_low(now):
            return Handover(low, self.params.battery_action)
        late, why = now - command_time > COMMAND_TIMEOUT, f'no command for {COMMAND_TIMEOUT:g} s'
        if command_time < active_since:
            timeout = self.params.engage_timeout
            late = now - active_since > timeout
            why = f'no command within engage_timeout = {timeout:g} s'
        return Handover(why, self.params.leader_lost_action) if late else NO_HANDOVER

    def step(self, flies: bool, pending: bool, handover: Handover, held_mode: str,
             status: VehicleStatus, now: float) -> str:
        """
        Return the request to the autopilot at ``now``: HOLD, LAND or '' for none.

        :param flies: whether the vehicle, as far as known, flies our setpoints.
        :param pending: whether a request that ends the flight has no answer yet.
        :param handover: the present result of ``reason``.
        :param held_mode: the mode that the handover requested and reached, or ''.
        :param status: of the vehicle.
        """
        if flies:
            handover = handover if handover.why else self.handover
            if not handover.why or pending or now - self._asked < RETRY_PERIOD:
                return ''
            self.handover, self._asked = handover, now
            self._held_since = math.inf
            return HOLD
        if not self.why or self.handover.action != LAND or pending:
            return ''
        self._held_since = min(self._held_since, now)
        if status.mode != held_mode or not status.armed:
            self._keep_hold()  # an operator has decided otherwise
        elif now - self._held_since >= LANDING_DELAY:
            self._keep_hold()
            return LAND
        return ''

    def _keep_hold(self) -> None:
        """Cancel the landing that would follow the hold mode."""
        self.handover = self.handover._replace(action=HOLD)
