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

"""Parameters of other nodes, read by their services."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from flock_follower.nodes.support.diagnostics import STEADY
from flock_follower.parameters.differences import differences

WATCH_PERIOD = 2.0  # s between two requests for the parameters of a node that is watched


class RemoteParameters:
    """
    Parameters of another node; ``values`` is None until it has answered.

    :param other: the other node's name, in the namespace of ``node`` unless it begins with /.
    :param changed: is called with the values if they differ from the values before.
    """

    def __init__(self, node: Node, other: str,
                 changed: Callable[[dict[str, Any]], None] = lambda _: None) -> None:
        self.values: dict[str, Any] | None = None
        self._changed = changed
        self._list = node.create_client(ListParameters, f'{other}/list_parameters')
        self._get = node.create_client(GetParameters, f'{other}/get_parameters')

    def ask(self) -> bool:
        """Request all parameters; return False if the node was not found (yet)."""
        if not (self._list.service_is_ready() and self._get.service_is_ready()):
            return False
        self._list.call_async(ListParameters.Request()).add_done_callback(self._take_names)
        return True

    def _take_names(self, future: Any) -> None:
        names = future.result().result.names
        self._get.call_async(GetParameters.Request(names=names)).add_done_callback(
            partial(self._take_values, names))

    def _take_values(self, names: list[str], future: Any) -> None:
        found = map(parameter_value_to_python, future.result().values)
        values = {name: list(value) if isinstance(value, array) else value
                  for name, value in zip(names, found)}
        self.take(values)

    def take(self, values: dict[str, Any]) -> None:
        """Take all values of the other node."""
        if values != self.values:
            self.values = values
            self._changed(values)


class WatchedParameters(RemoteParameters):
    """
    Parameters of another node, read every ``WATCH_PERIOD``; a change in flight is a problem.

    The other node may have been restarted with another file.

    :param flying: whether the vehicle flies, or may fly.
    """

    def __init__(self, node: Node, other: str, flying: Callable[[], bool]) -> None:
        super().__init__(node, other)
        self._other, self._flying = other, flying
        self._difference = ''
        node.create_timer(WATCH_PERIOD, self.ask, clock=STEADY)

    def take(self, values: dict[str, Any]) -> None:
        """Take all values of the other node, and record changes in flight."""
        if self.values is not None and self.values != values and self._flying():
            self._difference = differences(self.values, values)
        super().take(values)

    def changed_in_flight(self, now: float) -> str:
        """Return the last change of this flight, with both values; '' if there was none."""
        if not self._flying():
            self._difference = ''
        return self._difference and (
            f'parameters of {self._other} changed in flight: {self._difference}')
