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
ROS messages of any type with any content: what a broken, or a hostile, publisher could send.

Everything stays within what the type can carry over the wire; nothing stays within reason.
"""

from __future__ import annotations

from importlib import import_module
import math
import random
import re

NASTY_FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1.7e308, -1.7e308, 1e155, 5e-324, 1e-9,
                1.0, -1.0)
NASTY_FLOATS32 = (math.nan, math.inf, -math.inf, 0.0, 3e38, -3e38, 1e-45, 1.0)
NASTY_STRINGS = (
    '', 'odom', 'map', 'base_link', 'leader', 'plumb_bob', 'fisheye', 'mono8', 'bgr8', 'mono16',
    'bayer_rggb8', 'yuv422_yuy2', 'jpeg', 'x' * 300, 'z\u00fc\u2028r\n', ' ', '../../etc',
    '%s%n{}')
_INTEGERS = {f'{sign}int{bits}': (0 if sign else -2**(bits - 1), 2**(bits - (not sign)) - 1)
             for sign in ('', 'u') for bits in (8, 16, 32, 64)}
_INTEGERS |= {'octet': (0, 255), 'byte': (0, 255), 'char': (0, 255)}
_ARRAY = re.compile(r'(.*)\[(\d+)\]')
_SEQUENCE = re.compile(r'sequence<(.*?)(?:, *(\d+))?>')


class MessageFuzzer:
    """Makes and spoils messages, by a seed."""

    def __init__(self, seed):
        self.random = random.Random(seed)

    def any_message(self, message_class):
        """Return a message all of whose fields are by lot."""
        message = message_class()
        for name, kind in message_class.get_fields_and_field_types().items():
            setattr(message, name, self.value(kind))
        return message

    def value(self, kind):
        """Return a value of a type, as get_fields_and_field_types names it."""
        r = self.random
        if match := _SEQUENCE.fullmatch(kind):
            longest = min(int(match[2] or 4), 4)
            return self._several(match[1], r.randint(0, longest))
        if match := _ARRAY.fullmatch(kind):
            return self._several(match[1], int(match[2]))
        if kind in ('double', 'float'):
            nasty = NASTY_FLOATS if kind == 'double' else NASTY_FLOATS32
            return r.choice(nasty) if r.random() < 0.4 else r.gauss(0.0, 10.0 ** r.randint(-3, 3))
        if kind in _INTEGERS:
            low, high = _INTEGERS[kind]
            value = r.choice((low, high, 0, 1, r.randint(low, high), r.randint(0, min(high, 99))))
            return bytes([value]) if kind in ('octet', 'byte') else value
        if kind == 'boolean':
            return r.random() < 0.5
        if kind.startswith('string'):
            return r.choice(NASTY_STRINGS)
        return self.any_message(class_of(kind))

    def spoil(self, message, count=1):
        """Put a value by lot into ``count`` fields by lot, however deep."""
        for _ in range(count):
            self._spoil_one(message)
        return message

    def _spoil_one(self, message):
        r = self.random
        name, kind = r.choice(list(message.get_fields_and_field_types().items()))
        inner, array = getattr(message, name), _ARRAY.fullmatch(kind)
        part = r.choice(inner) if isinstance(inner, list) and inner else inner
        if hasattr(part, 'get_fields_and_field_types') and r.random() < 0.9:
            self._spoil_one(part)
            return
        value = self.value(kind)
        if array and r.random() < 0.7:
            value = list(inner)
            value[r.randrange(len(value))] = self.value(array[1])
        setattr(message, name, value)

    def _several(self, kind, count):
        if kind == 'uint8':
            return self.random.randbytes(count * self.random.choice((1, 1, 50)) if count else 0)
        return [self.value(kind) for _ in range(count)]


def class_of(kind):
    """Return the class of a type named 'package/Name'."""
    package, name = kind.split('/')
    return getattr(import_module(f'{package}.msg'), name)
