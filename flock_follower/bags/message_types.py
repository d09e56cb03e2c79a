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

"""Message types of ROS 2 Jazzy without ROS, and the conversion of ROS 1 types."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

_ZEROS: dict[str, Any] = {'string': '', 'bool': False, 'float32': 0.0, 'float64': 0.0}
_BYTES = dict.fromkeys(('byte', 'octet', 'char'), 'uint8')


@cache
def typestore() -> Typestore:
    """Return the store of ROS 2 Jazzy's message types; its ``types`` has them by name."""
    return get_typestore(Stores.ROS2_JAZZY)


def empty(msgtype: str) -> Any:
    """Return a message of the type store with every field zero or empty."""
    return _maker(msgtype)()


@cache
def _maker(msgtype: str) -> Callable[[], Any]:
    """Return a function that makes empty messages of a type."""
    fields = [_zero(description) for _, description in typestore().fielddefs[msgtype][1]]
    makers = [(k, field) for k, field in enumerate(fields) if callable(field)]
    message_type = typestore().types[msgtype]

    def make() -> Any:
        values = fields.copy()
        for k, field in makers:
            values[k] = field()
        return message_type(*values)
    return make


def _zero(description: Any) -> Any:
    """Return the empty value of a field, or a function that makes a mutable one."""
    kind, detail = description
    if kind == Nodetype.NAME:
        return _maker(detail)
    if kind == Nodetype.BASE:
        return _ZEROS.get(detail[0], 0)
    element, length = detail
    count = length if kind == Nodetype.ARRAY else 0
    if element[0] == Nodetype.BASE and element[1][0] != 'string':
        return np.zeros(count, _BYTES.get(element[1][0], element[1][0])).copy
    one = _zero(element)
    return lambda: [one() if callable(one) else one for _ in range(count)]


def migration_obstacle(msgtype: str, definition: str) -> str | None:
    """
    Return why a ROS 1 message type cannot become its ROS 2 Jazzy type, or None.

    :param definition: the recorded definition of the type, and of the types of its fields.
    """
    if msgtype not in typestore().types:
        return f'type {msgtype} does not exist in ROS 2 Jazzy'
    source = get_typestore(Stores.EMPTY)
    try:
        source.register(get_types_from_msg(definition, msgtype))
        same = _layout(source, msgtype) == _layout(typestore(), msgtype)
    except Exception as error:  # the definition is the recorder's text: anything can be wrong
        return f'definition of {msgtype} not understood ({type(error).__name__})'
    return None if same else f'type {msgtype} has other fields in ROS 2 Jazzy'


def _layout(types: Typestore, msgtype: str) -> list[Any]:
    """Return lower-case names and shapes of all fields in order, without ROS 1's Header.seq."""
    return [
        (name.lower(), _shape(types, description))
        for name, description in types.fielddefs[msgtype][1]
        if (msgtype, name) != ('std_msgs/msg/Header', 'seq')
    ]


def _shape(types: Typestore, description: Any) -> Any:
    kind, detail = description
    if kind == Nodetype.NAME:
        return _layout(types, detail)
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        element, length = detail
        return kind, _shape(types, element), length
    return detail
