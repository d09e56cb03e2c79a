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

"""Messages that wait until they are taken, instead of waking an executor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup


class Waiting(CallbackGroup):
    """
    Of subscriptions that an executor serves only while ``awaited``.

    Else their messages wait until they are taken. What ``awaited`` returns may change in the
    executor's thread only: it is asked each time before the executor waits.
    """

    def __init__(self, awaited: Callable[[], bool] = lambda: False) -> None:
        super().__init__()
        self._awaited = awaited

    def can_execute(self, entity: Any) -> bool:
        """Return whether messages are awaited."""
        return self._awaited()

    def beginning_execution(self, entity: Any) -> bool:
        """Return True: the only one that executes is the executor's own thread."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""
