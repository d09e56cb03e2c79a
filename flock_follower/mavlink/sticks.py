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
The pilot's sticks: whether the pilot has moved one since ``offboard`` was granted.

From PX4 1.18 on MAN_OVERRIDE_SPD replaces COM_RC_OVERRIDE: PX4 ends offboard only if a stick moves
fast. With these versions the bridge hands over if a stick has moved far, however slowly. The
throttle has no fixed rest position: it counts only if it has moved away from its position at
``offboard`` and then comes to its center, where Position mode keeps the height. Time is an
argument; no clock is read.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

from flock_follower.mavlink.dialects import Dialect
from flock_follower.mavlink.parameter_check import ParameterCheck

#: From this version on PX4 takes over for fast sticks only.
FAST_STICKS_SINCE: Final[tuple[int, int]] = (1, 18)
#: Consecutive messages in which a stick must have moved.
MOVED_MESSAGES: Final[int] = 2
#: Two messages further apart than this, s, are not consecutive: the transmitter was lost between.
STICK_GAP: Final[float] = 1.0
#: The throttle is at its center within this share of full deflection.
CENTER: Final[float] = 0.1
#: Pulse lengths of a working receiver, us.
_PULSES: Final = range(800, 2201)
#: Pulse length of the center, us.
_PULSE_CENTER: Final[float] = 1500.0
#: From there to an end, us.
_PULSE_RANGE: Final[float] = 500.0
#: Full deflection in MANUAL_CONTROL.
_FULL: Final[float] = 1000.0
#: Sources of the sticks; the first one counts alone once it was received: it ends with the
#: transmitter, while RC_CHANNELS goes on with the values that the receiver is set to.
KINDS: Final[tuple[str, str]] = ('MANUAL_CONTROL', 'RC_CHANNELS')


class Sticks(NamedTuple):
    """Deflections as shares of full deflection, in [-1, 1]."""

    roll: float
    pitch: float
    yaw: float
    throttle: float


def needs_stick_handover(dialect: Dialect | None, parameters: ParameterCheck) -> bool:
    """Return whether the bridge must hand over: the autopilot ignores a slowly moved stick."""
    version = parameters.version
    if dialect is None or not dialect.stick_speed:
        return False
    return dialect.stick_speed in parameters.values if version is None else (
        version[:2] >= FAST_STICKS_SINCE)


def read_sticks(message: Any) -> Sticks | None:
    """Return the sticks in a MANUAL_CONTROL or RC_CHANNELS; None if its values are not valid."""
    if message.get_type() == 'MANUAL_CONTROL':
        # PX4 sends the throttle in [0, 1000].
        values = (message.y, message.x, message.r, 2 * message.z - _FULL)
        valid = all(abs(value) <= _FULL for value in values)
        return Sticks(*(value / _FULL for value in values)) if valid else None
    # Roll, pitch, throttle, yaw, as transmitters of PX4 are usually set. Without a signal PX4
    # reports a strength of 0.
    roll, pitch, throttle, yaw = pulses = (
        message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
    if message.rssi == 0 or message.chancount < 4 or not all(each in _PULSES for each in pulses):
        return None
    return Sticks(*(min(max((each - _PULSE_CENTER) / _PULSE_RANGE, -1.0), 1.0)
                    for each in (roll, pitch, yaw, throttle)))


class StickWatch:
    """
    Detects that the pilot has moved a stick; times are s.

    :param threshold: share of full deflection by which a stick must have moved.
    """

    def __init__(self, threshold: float) -> None:
        self.has_moved = False
        """Whether a stick has moved since ``begin``."""
        self._threshold = threshold
        self._kind = KINDS[1]
        self._newest: Sticks | None = None
        self._time = -math.inf
        self._rest: Sticks | None = None
        self._counts = {'stick': 0, 'throttle away': 0, 'throttle back': 0}

    def begin(self, now: float) -> None:
        """Take the positions at ``now``, or the next positions received, as the rest positions."""
        self.has_moved = False
        self._rest = self._newest if now - self._time <= STICK_GAP else None
        self._counts = dict.fromkeys(self._counts, 0)

    def take(self, message: Any, now: float, lost: bool = False) -> None:
        """
        Take a MANUAL_CONTROL or RC_CHANNELS.

        :param lost: whether the autopilot reports that the transmitter is lost.
        """
        kind, sticks = message.get_type(), read_sticks(message)
        if kind != self._kind:
            if kind != KINDS[0]:
                return
            self._kind, self._newest, self._rest = kind, None, None
        if lost or sticks is None:
            self._newest, self._time = None, -math.inf
            self._restart()
            return
        if now - self._time > STICK_GAP:
            self._restart()
        self._newest, self._time = sticks, now
        if self._rest is None:
            self._rest = sticks
        self._count(sticks, self._rest)

    def _restart(self) -> None:
        """Count anew; a throttle that was away stays so."""
        away = self._counts['throttle away']
        self._counts = dict.fromkeys(self._counts, 0)
        self._counts['throttle away'] = away if away >= MOVED_MESSAGES else 0

    def _count(self, sticks: Sticks, rest: Sticks) -> None:
        way = [abs(now - before) for now, before in zip(sticks, rest)]
        counts = self._counts
        away = counts['throttle away'] >= MOVED_MESSAGES or way[-1] > self._threshold
        for name, true in (('stick', max(way[:-1]) > self._threshold), ('throttle away', away),
                           ('throttle back', away and abs(sticks.throttle) <= CENTER)):
            counts[name] = counts[name] + 1 if true else 0
        back = min(counts['throttle away'], counts['throttle back'])
        self.has_moved |= max(counts['stick'], back) >= MOVED_MESSAGES
