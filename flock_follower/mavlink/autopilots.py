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

"""Which autopilot is at the other end: told from HEARTBEAT."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.ardupilot import ArduPilot
from flock_follower.mavlink.dialect import Dialect
from flock_follower.mavlink.px4 import Px4

AUTO: Final[str] = 'auto'
DIALECTS: Final[Mapping[str, Dialect]] = MappingProxyType({
    dialect.name: dialect for dialect in (Px4(), ArduPilot())})
#: Values of the parameter ``autopilot``.
AUTOPILOTS: Final[tuple[str, ...]] = (AUTO, *DIALECTS)
_FIRMWARE: Final[Mapping[int, str]] = {
    mavlink.MAV_AUTOPILOT_PX4: 'px4', mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: 'ardupilot'}
# The numbers of ArduPilot's modes depend on the kind of vehicle; these are those of ArduCopter.
_MULTIROTORS: Final[frozenset[int]] = frozenset({
    mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_HEXAROTOR, mavlink.MAV_TYPE_OCTOROTOR, mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_DODECAROTOR, mavlink.MAV_TYPE_DECAROTOR})


def dialect_of(heartbeat: Any, autopilot: str = AUTO) -> Dialect | None:
    """
    Return the dialect of whoever sent a HEARTBEAT, None where it is not one that we speak.

    :param autopilot: 'auto' believes the HEARTBEAT; a name insists, and refuses firmware that
        says it is another one.
    :raises ValueError: for a value that is not in ``AUTOPILOTS``.
    """
    if autopilot not in AUTOPILOTS:
        raise ValueError(f'autopilot = {autopilot!r}: must be one of {", ".join(AUTOPILOTS)}')
    says = _FIRMWARE.get(heartbeat.autopilot)
    if says == 'ardupilot' and heartbeat.type not in _MULTIROTORS:
        return None
    wanted = (says or '') if autopilot == AUTO else autopilot
    return DIALECTS.get(wanted) if says in (None, wanted) else None


def describe(heartbeat: Any) -> str:
    """Return whom a HEARTBEAT comes from, for people: 'ARDUPILOTMEGA FIXED_WING'."""
    parts = []
    for enum, value in (('MAV_AUTOPILOT', heartbeat.autopilot), ('MAV_TYPE', heartbeat.type)):
        entry = mavlink.enums[enum].get(value)
        parts.append(entry.name.removeprefix(f'{enum}_') if entry else f'{enum} {value}')
    return ' '.join(parts)
