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

"""Writes the parameters of the flying nodes to a parameter file for ``evaluate``."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
import yaml

from flock_follower.checks.topic_names import full_name
from flock_follower.parameters.files import FLOWN
from flock_follower.resources import resource

_NEIGHBORS = 'neighbors_file'


class FlownParameters:
    """
    Requests the parameters of nodes, again after each change that they report.

    :param nodes: their names, in the namespace of ``node``.
    :param note: called with the name and the text of each new file.
    """

    def __init__(self, node: Node, nodes: Collection[str],
                 note: Callable[[str, str], None]) -> None:
        self._node, self._note = node, note
        self._clients = {full_name(name, node.get_namespace()): AsyncParameterClient(
            node, full_name(name, node.get_namespace())) for name in nodes}
        self._due = set(self._clients)
        self._values: dict[str, dict[str, Any]] = {}

    def changed(self, name: str) -> None:
        """Take it that the node of a full name has new parameters, or has been started."""
        if name in self._clients:
            self._due.add(name)

    def ask(self) -> None:
        """Ask those nodes whose parameters are not known, where they are there."""
        for name in sorted(self._due):
            client = self._clients[name]
            if client.services_are_ready():
                self._due.discard(name)
                client.list_parameters(callback=partial(self._take_names, name))

    def _take_names(self, name: str, future: Any) -> None:
        names = list(future.result().result.names)
        self._clients[name].get_parameters(names, partial(self._take_values, name, names))

    def _take_values(self, name: str, names: list[str], future: Any) -> None:
        values = map(parameter_value_to_python, future.result().values)
        self._values[name] = {key: list(value) if isinstance(value, array) else value
                              for key, value in zip(names, values)}
        self._write()

    def _write(self) -> None:
        """Write the files down: the neighbours beside the parameters, which name them there."""
        files: dict[str, str] = {}
        by_node = {}
        for name, values in sorted(self._values.items()):
            own = {key: value for key, value in values.items() if value is not None}
            if _NEIGHBORS in own and (own[_NEIGHBORS] or name.endswith('/relative_pose')):
                path = Path(own[_NEIGHBORS] or resource('config/neighbors.yaml'))
                try:
                    text = path.read_text(encoding='utf-8')
                except (OSError, UnicodeDecodeError):
                    pass  # its node complains, if it has to
                else:
                    if text not in files.values():
                        files[f'neighbors{len(files) or ""}.yaml'] = text
                    own[_NEIGHBORS] = next(key for key in files if files[key] == text)
            by_node[name.rsplit('/', 1)[-1]] = own
        for file, text in files.items():
            self._note(file, text)
        self._note(FLOWN, '# The parameters flown, as the nodes had them last.\n' + yaml.safe_dump(
            {node: {'ros__parameters': values} for node, values in by_node.items()},
            default_flow_style=False, allow_unicode=True))
