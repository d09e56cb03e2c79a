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
Messages that autopilots send and pymavlink's ``common`` does not know: importing this adds them.

EVENT is in MAVLink's common.xml as work in progress, CURRENT_MODE has been since 2024, and
EKF_STATUS_REPORT is ArduPilot's own (ardupilotmega.xml). A pymavlink that knows one keeps its own.
"""

from __future__ import annotations

import struct
from typing import Any, ClassVar, Final

from pymavlink.dialects.v20 import common as mavlink

EVENT: Final[int] = 410
CURRENT_MODE: Final[int] = 436
EKF_STATUS_REPORT: Final[int] = 193


class _Message(mavlink.MAVLink_message):  # type: ignore[misc]
    """A message of fields that are numbers, or arrays of them, in the order of their sending."""

    id: ClassVar[int]
    msgname: ClassVar[str]
    ordered_fieldnames: ClassVar[list[str]]
    #: Whether the sender fills fields in another order than he sends them.
    fieldnames: ClassVar[list[str]]
    array_lengths: ClassVar[list[int]]
    crc_extra: ClassVar[int]
    unpacker: ClassVar[struct.Struct]
    # What pymavlink asks of every kind of message.
    fieldtypes: ClassVar[list[str]] = []
    fielddisplays_by_name: ClassVar[dict[str, str]] = {}
    fieldenums_by_name: ClassVar[dict[str, str]] = {}
    fieldunits_by_name: ClassVar[dict[str, str]] = {}
    orders: ClassVar[list[int]]
    lengths: ClassVar[list[int]]
    instance_field = None
    instance_offset = -1

    def __init__(self, *values: Any) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field, self._instance_offset = None, -1
        for name, value in zip(self.fieldnames, values, strict=True):
            setattr(self, name, value)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> Any:
        """Return the bytes that ``mav`` sends for it."""
        values: list[Any] = []
        for name, length in zip(self.ordered_fieldnames, self.array_lengths):
            value = getattr(self, name)
            values += value if length else [value]
        return self._pack(mav, self.crc_extra, self.unpacker.pack(*values), force_mavlink1)


def _define(number: int, name: str, layout: str, crc_extra: int, fields: str) -> Any:
    """
    Return the class of a message, and teach it to pymavlink.

    :param layout: of the payload, for ``struct``.
    :param fields: names in the order of the payload, an array's with its length: 'arguments*40'.
    """
    names, lengths = [], []
    for field in fields.split():
        field_name, _, length = field.partition('*')
        names.append(field_name)
        lengths.append(int(length or 0))
    kind = type(f'MAVLink_{name.lower()}_message', (_Message,), {
        'id': number, 'msgname': name, 'ordered_fieldnames': names, 'fieldnames': names,
        'array_lengths': lengths, 'lengths': [length or 1 for length in lengths],
        'orders': list(range(len(names))), 'crc_extra': crc_extra,
        'unpacker': struct.Struct(layout), 'native_format': bytearray(layout.encode())})
    return mavlink.mavlink_map.setdefault(number, kind)


#: id (of the component in the highest byte), event_time_boot_ms, sequence, ..., arguments (40,).
EventMessage: Final[Any] = _define(
    EVENT, 'EVENT', '<IIHBBB40B', 160,
    'id event_time_boot_ms sequence destination_component destination_system log_levels '
    'arguments*40')
#: custom_mode, and the one that the user asked for: another while a failsafe acts.
CurrentModeMessage: Final[Any] = _define(
    CURRENT_MODE, 'CURRENT_MODE', '<IIB', 193, 'custom_mode intended_custom_mode standard_mode')
#: Variances as shares of what is allowed, and flags (EKF_*).
EkfStatusReportMessage: Final[Any] = _define(
    EKF_STATUS_REPORT, 'EKF_STATUS_REPORT', '<fffffHf', 71,
    'velocity_variance pos_horiz_variance pos_vert_variance compass_variance '
    'terrain_alt_variance flags airspeed_variance')
