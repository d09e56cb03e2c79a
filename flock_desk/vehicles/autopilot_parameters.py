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
The parameters of the embedded autopilot, served the way PX4 and ArduPilot each serve them.

PARAM_VALUE carries every parameter in a float. PX4 puts the four bytes of an integer there
(MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE), ArduPilot the number itself. A decoder that uses
the wrong encoding reads 1 as 1.4e-45.
"""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import struct
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from flock_desk.vehicles.profiles import FLOAT, INT8, INT16, INT32, Profile
from flock_follower.ranges import Range

_LIMITS: Final[Mapping[int, int]] = {INT8: 2**7, INT16: 2**15, INT32: 2**31}
_UNKNOWN_INDEX: Final[int] = 65535


class AutopilotParameters:
    """The parameters of a profile and their MAVLink protocol."""

    def __init__(self, profile: Profile) -> None:
        self._types = {name: kind for name, (kind, _) in profile.parameters.items()}
        self._values = {name: float(value) for name, (_, value) in profile.parameters.items()}
        self._bytewise = profile.px4

    def __getitem__(self, name: str) -> float:
        """Return a value by its name."""
        return self._values[name]

    def set(self, name: str, value: float) -> None:
        """
        Set a value.

        :raises ValueError: for an unknown name, or a value that its type cannot hold.
        """
        if name not in self._values:
            raise ValueError(f'{name}: must be one of {", ".join(self._values)}')
        limit = _LIMITS.get(self._types[name])
        valid = Range() if limit is None else Range(-limit, limit - 1, whole=True)
        whole = limit is not None and float(value).is_integer()
        valid.check(name, int(value) if whole else value)
        self._values[name] = float(value)

    def handle(self, message: Any) -> list[Any]:
        """Answer PARAM_REQUEST_READ by name and PARAM_SET; unknown names silently."""
        name = str(message.param_id)
        if name not in self._values:
            return []
        if message.get_type() == 'PARAM_SET':
            with contextlib.suppress(ValueError):  # the answer then has the old value
                self.set(name, self._recode(message.param_value, name, '<f', '<i'))
        # ArduPilot does not look up the index of a parameter asked for by its name.
        return [self._message(name)]

    def _message(self, name: str) -> Any:
        return mavlink.MAVLink_param_value_message(
            name.encode(), self._recode(self._values[name], name, '<i', '<f'), self._types[name],
            len(self._values),
            list(self._values).index(name) if self._bytewise else _UNKNOWN_INDEX)

    def _recode(self, value: float, name: str, old: str, new: str) -> float:
        """Return the value whose bytes in one layout are those of another in the other."""
        if not self._bytewise or self._types[name] == FLOAT:
            return value
        number = int(value) if old == '<i' else value
        return float(struct.unpack(new, struct.pack(old, number))[0])
