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

"""The messages of ``flock_follower.messages`` in rclpy's classes."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from builtin_interfaces.msg import Time

from flock_follower.messages import NANOSECONDS


@cache
def message_class(msgtype: str) -> Any:
    """
    Return the Python class of a message type such as 'nav_msgs/msg/Odometry'.

    :raises ValueError: if the name is malformed or its package is not installed.
    """
    package, _, name = msgtype.partition('/msg/')
    try:
        found = getattr(import_module(f'{package}.msg'), name)
        if not hasattr(found, 'SLOT_TYPES'):
            raise TypeError(f'{name} is no message')
        return found
    except (ImportError, AttributeError, TypeError, ValueError):
        raise ValueError(f'message type {msgtype!r}: not installed, or not PACKAGE/msg/NAME'
                         ) from None


def make(msgtype: str) -> Any:
    """Return an empty message of a type."""
    return message_class(msgtype)()


def nanoseconds_to_stamp(nanoseconds: int) -> Time:
    """Return a stamp message of integer nanoseconds."""
    return Time(sec=nanoseconds // NANOSECONDS, nanosec=nanoseconds % NANOSECONDS)
