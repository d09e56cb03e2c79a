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
The steps of a flight by the command ``follow``: which request is due, and which key confirms it.

The steps are arm, takeoff, offboard, engage; land at the end. The first step whose result the
nodes do not report is due: steps that are done already are skipped, and after a takeover offboard
is due again. No function reads a clock; times are s, monotonic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address
import math
from typing import Final

from flock_follower.mavlink.connection import parse_connection
from flock_follower.messages.bridge_diagnostics import ARMED, FLYING, read_flag
from flock_follower.messages.bridge_reading import BridgeState, parse
from flock_follower.messages.bridge_state import ACTIVE, NO_AUTOPILOT, READY

NODES: Final[tuple[str, ...]] = ('relative_pose', 'planner', 'mavlink_bridge')
#: Time to receive a report of every node at the start, s; each reports once per second.
DISCOVERY: Final[float] = 8.0
#: Only reports received this long after an answer show its effect, s.
SETTLING: Final[float] = 0.2
#: The state of a node whose last report is older, s, is shown as old.
OLD: Final[float] = 1.5
#: An older distance is not shown, s.
SHOWN: Final[float] = 1.0
INTERRUPTED: Final[int] = 130
#: The service of each request, and its value; None: it takes none.
SERVICES: Final[Mapping[str, tuple[str, bool | None]]] = {
    'arm': ('mavlink_bridge/arm', True), 'takeoff': ('mavlink_bridge/takeoff', None),
    'offboard': ('mavlink_bridge/offboard', True), 'engage': ('planner/engage', True),
    'disengage': ('planner/engage', False), 'hand over': ('mavlink_bridge/offboard', False),
    'land': ('mavlink_bridge/land', None)}


def loopback(connection: str) -> bool:
    """Return whether the bridge's ``connection`` is an address of this machine alone."""
    try:
        host = parse_connection(connection).host
        return host == 'localhost' or ip_address(host).is_loopback
    except ValueError:  # a serial port, or another name: it may be resolved to any address
        return False


@dataclass
class Reports:
    """The last report of each node."""

    bridge: str = ''
    """``mavlink_bridge/state``, after a loss of the autopilot also the state before; or ''."""
    nodes: dict[str, tuple[float, Mapping[str, str]]] = field(default_factory=dict)
    """The time of the last diagnostics of each node, s, and their values."""
    distance: tuple[float, str] = (-math.inf, '')
    """The time at which the distance to the leader was received, s, and its text."""
    battery: str = ''

    def value(self, node: str, key: str) -> str:
        """Return a value of a node's diagnostics, or ''."""
        return self.nodes[node][1].get(key, '') if node in self.nodes else ''

    def flag(self, node: str, key: str) -> bool | None:
        """Return a value of diagnostics as True or False, None if it is unknown."""
        return read_flag(self.nodes[node][1], key) if node in self.nodes else None

    def missing(self, since: float) -> list[str]:
        """Return the nodes that have not reported after a time, s."""
        return [node for node in NODES
                if node not in self.nodes or self.nodes[node][0] <= since]

    @property
    def vehicle_known(self) -> bool:
        """Return whether the bridge's state, and later its diagnostics, describe the vehicle."""
        return parse(self.bridge).name != NO_AUTOPILOT and None not in (
            self.flag('mavlink_bridge', ARMED), self.flag('mavlink_bridge', FLYING))

    @property
    def streams(self) -> bool:
        """Return whether the bridge sends setpoints, or sent them when the autopilot was lost."""
        return parse(self.bridge).last_known.name in (READY, ACTIVE)

    def due(self) -> str:
        """Return the first step whose result is not reported; '' while the vehicle follows."""
        reached = {'arm': self.flag('mavlink_bridge', ARMED),
                   'takeoff': self.flag('mavlink_bridge', FLYING),
                   'offboard': parse(self.bridge) == BridgeState(ACTIVE),
                   'engage': self.flag('planner', 'engaged')}
        return next((step for step, done in reached.items() if not done), '')

    def line(self, now: float) -> str:
        """Return the live line: states (with their age if old), distance, battery, reasons."""
        received, distance = self.distance
        word, _, why = self.bridge.partition(': ')
        reasons = '; '.join(filter(None, [why, self.value('planner', 'reason')]))
        return '   '.join(filter(None, [
            self._aged(word, 'mavlink_bridge', now),
            self._aged(self.value('planner', 'state'), 'planner', now),
            distance if now - received <= SHOWN else '', self.battery, reasons]))

    def _aged(self, state: str, node: str, now: float) -> str:
        """Return a state with the age of its node's last report if it is old."""
        age = now - self.nodes[node][0] if node in self.nodes else 0.0
        return f'{state} ({age:.0f} s ago)' if state and age > OLD else state


class Flight:
    """
    Decides on requests; a method returns the requests to make now, keys of ``SERVICES``.

    :param confirm: whether a key confirms each step; if not, each step is requested once, and a
        refusal ends the flight.
    :param ready: False if ``check`` forbids a flight: then the only requests are to land or to
        hand over, which need only the bridge.
    """

    def __init__(self, now: float, confirm: bool = True, ready: bool = True) -> None:
        self.code: int | None = None
        """The exit code, once the flight has ended."""
        self.lines: list[str] = []
        """Lines to print; the caller empties the list."""
        self._answered = now  # of the last answer, s
        self._landing = False
        self._ending: int | None = None
        self._question: str | None = None
        self._pending: set[str] = set()
        self._confirm, self._requested, self._ready = confirm, set[str](), ready

    def step(self, reports: Reports, now: float) -> list[str]:
        """Ask for the key of the next step, or request the step; end after a landing."""
        if self._pending or self._ending is not None:
            return []
        due = reports.due() if self._ready else ''
        missing = [node for node in reports.missing(self._answered + SETTLING)
                   if self._ready or node == 'mavlink_bridge']
        if self._landing:
            if 'mavlink_bridge' not in missing and (
                    reports.flag('mavlink_bridge', ARMED) is False):
                self.lines.append('landed and disarmed')
                self.code = 0
        elif missing:
            if now - self._answered > DISCOVERY and not self._requested:
                self.lines.append(f'missing: {", ".join(missing)}: '
                                  'ros2 launch flock_follower follower.launch.py starts it')
                self.code = 1
        elif due != self._question and reports.vehicle_known:
            self._question = due
            if due in self._requested and not self._confirm:
                self.lines.append(f'{due} is due again ({reports.bridge}), but --yes requests '
                                  'each step only once')
                return self.end(1, reports)
            if due and not self._confirm:
                return self._request(due)
            self.lines.append(
                f'{reports.bridge}: press {due[0]} for {due}' if due else
                f'{"the follower flies" if self._ready else "not ready to fly, but in the air"}: '
                'press l to land; Ctrl-C brakes and hands over')
        return []

    def press(self, key: str, reports: Reports) -> list[str]:
        """Take a key: the key of the due step confirms this step; l lands at any step."""
        if self._ending is not None:
            return []
        airborne = reports.flag('mavlink_bridge', FLYING) is not False
        if key == 'l' and 'land' not in self._pending and (airborne or 'takeoff' in self._pending):
            self._landing = True
            return self._request('disengage', 'land')
        if self._question and key == self._question[0] and not (self._pending or self._landing):
            return self._request(self._question)
        return []

    def answer(self, step: str, success: bool, message: str, reports: Reports,
               now: float) -> list[str]:
        """Take the answer to a request."""
        self._pending.discard(step)
        self._answered, self._question = now, None
        self.lines.append(message)
        if step == 'land' and not success:
            self._landing = False
        if step == 'hand over' and not success:
            self._ending = 1
        if self._ending is not None and not self._pending:
            self.code = self._ending
        if self._ending is None and not (success or self._confirm or self._landing):
            return self.end(1, reports)
        return []

    def end(self, code: int, reports: Reports, insist: bool = True) -> list[str]:
        """
        Brake and hand over, then end with an exit code.

        The mode of the autopilot is changed only if the bridge sends setpoints, or if a take-off
        or offboard was requested and not answered yet: otherwise a pilot may be flying. A landing
        continues.

        :param insist: whether a second call ends at once, without waiting for the answers.
        """
        if self._ending is not None:
            self.code = self._ending if insist else self.code
            return []
        climbs = self._pending & {'takeoff', 'offboard'}
        self._ending, self._pending = code, set()
        if (reports.streams and not self._landing) or climbs:
            self.lines.append('brakes and hands over')
            return self._request('disengage', 'hand over')
        if reports.flag('planner', 'engaged'):
            return self._request('disengage')
        self.code = code
        return []

    def _request(self, *steps: str) -> list[str]:
        self._pending |= {*steps}
        self._requested |= {*steps}
        return list(steps)
