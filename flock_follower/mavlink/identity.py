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
Identity of senders: devices that are no autopilot, and two vehicles with one system id.

MAVLink distinguishes vehicles by their system ids alone. Two vehicles with one id are detected by
values that are steady for one vehicle and alternate for two: the time of boot, the position, and
the sequence numbers of the messages. Times are s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Any, Final, Generic, TypeVar

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import enum_name, VTOL_TYPES

T = TypeVar('T')
#: Two sources that send in turn so many times are two.
TURNS: Final[int] = 6
#: A source that was silent for longer than this, s, is forgotten.
MEMORY: Final[float] = 3.0
#: A finding lasts this long, s.
FINDING: Final[float] = 5.0
#: Times of boot that differ by more than this, s, are those of two vehicles; the delay of a line
#: varies by less from message to message.
BOOTS_DIFFER: Final[float] = 1.0
#: Those of one vehicle that arrives by another way differ by less, s.
SAME_BOOT: Final[float] = 0.3
#: The least of this many times of boot counts, which excludes delays.
_BOOTS: Final[int] = 20
#: Positions further apart than this, m, plus the way since, are those of two vehicles. A single
#: faster one never returns to where it was before.
POSITIONS_DIFFER: Final[float] = 0.5
#: Speed of that way, m/s.
FLOWN: Final[float] = 5.0
#: Messages of one sender that may be lost, or arrive in another order, in a row.
MISSING_MOST: Final[int] = 16
#: Most senders that are stored.
_MOST_PEERS: Final[int] = 16
#: HEARTBEATs of ours that may be echoed.
_ECHOES: Final[int] = 5
#: HEARTBEATs of another program that show it.
_RIVAL_BEATS: Final[int] = 3
TWO_VEHICLES: Final[str] = 'two vehicles send with one system id'
SECOND_BRIDGE: Final[str] = 'another program sends with the ids of this bridge'
_REMEDY: Final[str] = 'give each its own (MAV_SYS_ID, MAV_SYSID), and set target_system'
FORWARD_FLIGHT: Final[str] = 'a VTOL that does not hover (EXTENDED_SYS_STATE.vtol_state)'

_BY_COMPONENT: Final[dict[int, str]] = {component: name for name, components in (
    ('a telemetry radio', (mavlink.MAV_COMP_ID_TELEMETRY_RADIO,)),
    ('a camera', range(mavlink.MAV_COMP_ID_CAMERA, mavlink.MAV_COMP_ID_CAMERA6 + 1)),
    ('a gimbal', (mavlink.MAV_COMP_ID_GIMBAL, *range(
        mavlink.MAV_COMP_ID_GIMBAL2, mavlink.MAV_COMP_ID_GIMBAL6 + 1))),
    ('a companion computer', range(
        mavlink.MAV_COMP_ID_ONBOARD_COMPUTER, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER4 + 1)),
    ('a ground station', (mavlink.MAV_COMP_ID_MISSIONPLANNER,))) for component in components}
_BY_TYPE: Final[dict[int, str]] = {
    mavlink.MAV_TYPE_CAMERA: 'a camera', mavlink.MAV_TYPE_GIMBAL: 'a gimbal',
    mavlink.MAV_TYPE_GCS: 'a ground station', mavlink.MAV_TYPE_ADSB: 'an ADS-B receiver',
    mavlink.MAV_TYPE_ONBOARD_CONTROLLER: 'a companion computer'}


def device(message: Any) -> str:
    """Return the name of the device that sends a message, '' if it may be an autopilot."""
    if message.get_type().startswith('RADIO'):  # RADIO_STATUS, and RADIO of older ones
        return 'a telemetry radio'
    by_type = _BY_TYPE.get(message.type, '') if message.get_type() == 'HEARTBEAT' else ''
    return _BY_COMPONENT.get(message.get_srcComponent(), by_type)


def not_hovering(vehicle_type: int | None, vtol_state: int | None) -> str:
    """
    Return why a vehicle is not a hovering multicopter or VTOL, or ''.

    :param vehicle_type: MAV_TYPE. :param vtol_state: MAV_VTOL_STATE; None: not reported.
    """
    if vtol_state == mavlink.MAV_VTOL_STATE_MC or (
            vehicle_type not in VTOL_TYPES and vtol_state in (
                None, mavlink.MAV_VTOL_STATE_UNDEFINED)):
        return ''
    state = 'not reported' if vtol_state is None else enum_name('MAV_VTOL_STATE', vtol_state)
    return f'{FORWARD_FLIGHT}: {state}'


@dataclass
class _Source(Generic[T]):
    value: T
    time: float


class TwoSources(Generic[T]):
    """
    Detects values that come alternately from two sources.

    :param distance: returns the distance between two values. :param most: returns the largest
        distance between two values of one source, from the time between them, s.
    """

    def __init__(self, distance: Callable[[T, T], float],
                 most: Callable[[float], float]) -> None:
        self._distance, self._most = distance, most
        self._sources: list[_Source[T]] = []  # the newest last
        self._turns = 0
        self.found = -math.inf
        """Time of the last detection of two sources, s."""

    def take(self, value: T, now: float) -> None:
        """Take a value."""
        known = [each for each in self._sources if now - each.time <= MEMORY]
        near = min(known, key=lambda each: self._distance(each.value, value), default=None)
        if near is None or not self._distance(near.value, value) <= self._most(now - near.time):
            self._sources, self._turns = [*known[-1:], _Source(value, now)], 0
            return
        if near is not known[-1]:
            self._turns += 1
            if self._turns >= TURNS:
                self.found = now
        # Two that one value fits are one, as two counters are that pass each other.
        apart = [each for each in known if each is not near
                 and self._distance(each.value, value) > self._most(now - each.time)]
        self._turns = self._turns if apart else 0
        near.value, near.time = value, now
        self._sources = [*apart, near]


def _steps_apart(one: int, other: int) -> float:
    """Return the number of messages between two sequence numbers, which begin again at 256."""
    return abs((other - one + 128) % 256 - 128)


@dataclass
class _Peer:
    """One address, and the vehicle behind it."""

    boots: deque[float]
    """The newest times of boot on our clock, s, each from one message."""
    place: tuple[float, tuple[float, ...], float] | None = None
    """Time, s, local position, m, and speed, m/s."""


class Identity:
    """The vehicles that send with the system id of one autopilot, from all addresses."""

    def __init__(self) -> None:
        self._boots: TwoSources[float] = TwoSources(
            lambda one, other: abs(other - one), lambda _: BOOTS_DIFFER)
        self._places: TwoSources[tuple[float, ...]] = TwoSources(
            math.dist, lambda passed: POSITIONS_DIFFER + FLOWN * passed)
        self._numbers: TwoSources[int] = TwoSources(_steps_apart, lambda _: MISSING_MOST)
        self._addresses: TwoSources[Any] = TwoSources(
            lambda one, other: float(one != other), lambda _: 0.0)
        self._peers: dict[Any, _Peer] = {}
        self._beats: deque[int] = deque(maxlen=_ECHOES)  # sequence numbers of our HEARTBEATs
        self._rivals: deque[float] = deque(maxlen=_RIVAL_BEATS)  # when another's arrived, s

    def sent_heartbeat(self, number: int) -> None:
        """Take the sequence number of our own HEARTBEAT, which a line may echo."""
        self._beats.append(number)

    def take_own(self, message: Any, now: float) -> None:
        """Take a message with our own ids."""
        if message.get_type() == 'HEARTBEAT' and message.get_seq() not in self._beats:
            self._rivals.append(now)

    def take(self, message: Any, peer: Any, answered: bool, now: float) -> None:
        """Take a message of the autopilot; ``answered``: whether our messages go to its sender."""
        kind = message.get_type()
        if peer not in self._peers:
            if len(self._peers) >= _MOST_PEERS:
                del self._peers[next(iter(self._peers))]
            self._peers[peer] = _Peer(deque(maxlen=_BOOTS))
        known = self._peers[peer]
        if answered:
            self._numbers.take(message.get_seq(), now)
        if kind == 'HEARTBEAT':
            # Of an address whose vehicle is known by its time of boot that one decides.
            if answered or not known.boots:
                self._addresses.take(peer, now)
        elif kind == 'ATTITUDE_QUATERNION' and message.time_boot_ms:
            boot = now - message.time_boot_ms * 1e-3
            known.boots.append(boot)
            self._boots.take(boot, now)
        elif kind == 'LOCAL_POSITION_NED':
            place = message.x, message.y, message.z
            if all(map(math.isfinite, place)):
                known.place = now, place, math.hypot(message.vx, message.vy, message.vz)
                self._places.take(place, now)

    def conflict(self, now: float) -> str:
        """Return the evidence that two vehicles, or two bridges, send, or ''."""
        if len(self._rivals) == _RIVAL_BEATS and now - self._rivals[0] <= FINDING:
            return (f'{SECOND_BRIDGE}: stop one of them (a second mavlink_bridge, or '
                    'MAVROS), or give this one another source_system')
        evidence = [name for name, sources in (
            ('times of boot', self._boots), ('positions', self._places),
            ('sequence numbers', self._numbers), ('addresses', self._addresses))
            if now - sources.found <= FINDING]
        return f'{TWO_VEHICLES}, by their {" and ".join(evidence)}: {_REMEDY}' if evidence else ''

    def is_same(self, before: Any, peer: Any) -> bool:
        """Return whether a sender is the known vehicle at another address (a restarted router)."""
        old, new = self._peers.get(before), self._peers.get(peer)
        if old is None or new is None or not old.boots or not new.boots:
            return False
        if abs(min(old.boots) - min(new.boots)) > SAME_BOOT:
            return False
        if old.place is None or new.place is None:
            return False
        (then, place, speed), (now, other, _) = old.place, new.place
        return math.dist(place, other) <= POSITIONS_DIFFER + (speed + 1.0) * max(now - then, 0.0)
