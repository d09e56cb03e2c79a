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

"""The parameters of another node, by its services."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from flock_follower.nodes.support.diagnostics import internal_error
from flock_follower.nodes.support.runtime import FlockNode


class RemoteParameters:
    """
    Parameters of another node; ``values`` is None until it has answered.

    :param other: its name, in the namespace of ``node`` unless it begins with /.
    :param changed: is called with the values if they differ from those before.
    """

    def __init__(self, node: Node, other: str,
                 changed: Callable[[dict[str, Any]], None] = lambda _: None) -> None:
        self.values: dict[str, Any] | None = None
        self._node, self._other, self._changed = node, other, changed
        self._get = node.create_client(GetParameters, f'{other}/get_parameters')
        self._list: Client | None = None  # each client costs time whenever the executor waits

    def ask(self, names: Collection[str] = ()) -> bool:
        """
        Ask for parameters, for all if no names are given.

        Returns False if the other node was not found; one just started is found a moment later.
        """
        if not names and self._list is None:
            self._list = self._node.create_client(
                ListParameters, f'{self._other}/list_parameters')
        client = self._get if names else self._list
        assert client is not None
        if not (client.service_is_ready() and self._get.service_is_ready()):
            return False
        if names:
            self._get.call_async(GetParameters.Request(names=[*names])).add_done_callback(
                partial(self._take_values, [*names]))
        else:
            client.call_async(ListParameters.Request()).add_done_callback(self._take_names)
        return True

    def _take_names(self, future: Any) -> None:
        self.ask(future.result().result.names)

    def _take_values(self, names: list[str], future: Any) -> None:
        try:
            values = {name: parameter_value_to_python(value)
                      for name, value in zip(names, future.result().values)}
            if values != self.values:
                self.values = values
                self._changed(values)
        except Exception as error:  # would end the executor
            where = f'on parameters of {self._other}'
            if isinstance(self._node, FlockNode):
                self._node.diagnostics.internal_error(where, error)
            else:
                self._node.get_logger().error(internal_error(error, where))
