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

import numpy as np

_FLOATS = {
    'double': (math.nan, math.inf, -math.inf, 0.0, -0.0, 1.7e308, -1.7e308, 1e155, 5e-324, 1e-9,
               1.0, -1.0),
    'float': (math.nan, math.inf, -math.inf, 0.0, 3e38, -3e38, 1e-45, 1.0)}
NASTY_STRINGS = (
    '', 'odom', 'map', 'base_link', 'leader', 'plumb_bob', 'fisheye', 'mono8', 'bgr8', 'mono16',
    'bayer_rggb8', 'yuv422_yuy2', 'jpeg', 'x' * 300, 'z\u00fc\u2028r\n', ' ', '../../etc',
    '%s%n{}')
_INTEGERS = {f'{sign}int{bits}': (0 if sign else -2**(bits - 1), 2**(bits - (not sign)) - 1)
             for sign in ('', 'u') for bits in (8, 16, 32, 64)}
_INTEGERS |= {'octet': (0, 255), 'byte': (0, 255), 'char': (0, 255)}
#: An array of fixed length, or a sequence.
_SEVERAL = re.compile(r'(.*)\[(\d+)\]|sequence<(.*?)(?:, *\d+)?>')


class MessageFuzzer:
    """Makes and spoils messages, by a seed."""

    def __init__(self, seed):
        self.random = random.Random(seed)

    def any_message(self, message_class):
        """Return a message with a random value in every field."""
        message = message_class()
        for name, kind in message_class.get_fields_and_field_types().items():
            setattr(message, name, self.value(kind))
        return message

    def value(self, kind):
        """Return a value of a type, as get_fields_and_field_types names it."""
        r = self.random
        if match := _SEVERAL.fullmatch(kind):
            element, count = match[1] or match[3], int(match[2] or 0) or r.randint(0, 4)
            if element == 'uint8':
                return r.randbytes(count * r.choice((1, 1, 50)) if not match[2] else count)
            return [self.value(element) for _ in range(count)]
        if kind in _FLOATS:
            return r.choice(_FLOATS[kind]) if r.random() < 0.4 else (
                r.gauss(0.0, 10.0 ** r.randint(-3, 3)))
        if kind in _INTEGERS:
            low, high = _INTEGERS[kind]
            value = r.choice((low, high, 0, 1, r.randint(low, high), r.randint(0, min(high, 99))))
            return bytes([value]) if kind in ('octet', 'byte') else value
        if kind == 'boolean':
            return r.random() < 0.5
        if kind.startswith('string'):
            return r.choice(NASTY_STRINGS)
        package, name = kind.split('/')
        return self.any_message(getattr(import_module(f'{package}.msg'), name))

    def spoil(self, message, count=1):
        """Put a random value into ``count`` random fields, however deep."""
        r = self.random
        for _ in range(count):
            part = message
            while True:
                name, kind = r.choice(list(part.get_fields_and_field_types().items()))
                inner = getattr(part, name)
                inner = r.choice(inner) if isinstance(inner, list) and inner else inner
                if not hasattr(inner, 'get_fields_and_field_types') or r.random() < 0.1:
                    break
                part = inner
            value = self.value(kind)
            array = getattr(part, name)
            if isinstance(array, np.ndarray) and array.size and r.random() < 0.7:
                kept = np.arange(array.size) != r.randrange(array.size)
                value = np.where(kept, array, value).tolist()
            setattr(part, name, value)
        return message
