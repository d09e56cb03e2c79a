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

"""What another node's parameters are, as it says when it is asked."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python

from flock_follower.nodes.support.runtime import FlockNode


class RemoteParameters:
    """
    Some parameters of another node of one's namespace; ``values`` is None until it has answered.

    :param changed: is called with the values when they are others than before.
    """

    def __init__(self, node: FlockNode, other: str,
                 changed: Callable[[dict[str, Any]], None] = lambda _: None) -> None:
        self.values: dict[str, Any] | None = None
        self._node, self._other = node, other
        self._client = node.create_client(GetParameters, f'{other}/get_parameters')
        self._changed = changed

    def ask(self, names: Iterable[str]) -> None:
        """Ask for parameters; does nothing while that node is not there."""
        if self._client.service_is_ready():
            self._client.call_async(GetParameters.Request(names=list(names))).add_done_callback(
                partial(self._take, list(names)))

    def _take(self, names: list[str], future: Any) -> None:
        try:
            values = {name: parameter_value_to_python(value)
                      for name, value in zip(names, future.result().values)}
            if values != self.values:
                self.values = values
                self._changed(values)
        except Exception as error:  # would end the executor
            self._node.diagnostics.internal_error(f'on parameters of {self._other}', error)
