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

"""The table of docs/deploy.md, from which a policy is written, names what the nodes have."""

from __future__ import annotations

from pathlib import Path
import re

import pytest
import rclpy
from rclpy.node import Node

from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    wait_until,
)

pytestmark = pytest.mark.slow
PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'deploy.md'
DOMAIN = 87  # its own: who else is there would be named
OF_ALL = {'rosout', 'parameter_events', 'diagnostics'}
OF_PARAMETERS = ('_parameters', '_parameter_types', '_parameters_atomically', '_type_description')


def told() -> dict[str, list[set[str]]]:
    """Return what each node publishes, subscribes and serves, by the page."""
    rows = re.findall(r'^\| `(\w+)` \|(.*)\|(.*)\|(.*)\|$', PAGE.read_text(), re.M)
    return {node: [set(re.findall('`(.+?)`', cell)) for cell in cells] for node, *cells in rows}


def there(look: Node, node: str) -> list[set[str]]:
    """Return what it does, by the graph."""
    found = [ask(node, '/') for ask in (
        look.get_publisher_names_and_types_by_node, look.get_subscriber_names_and_types_by_node,
        look.get_service_names_and_types_by_node)]
    return [{name.lstrip('/') for name, _ in names if not name.endswith(OF_PARAMETERS)} - OF_ALL
            for names in found]


def test_the_table_is_what_the_nodes_have(tmp_path: Path) -> None:
    page = told()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    look = Node('look', context=context, start_parameter_services=False)
    seen: dict[str, list[set[str]]] = {}

    def as_told() -> bool:
        names = look.get_node_names()
        seen.update({node: there(look, node) for node in page if node in names})
        return seen == page
    try:
        with Processes(private_environment(DOMAIN), tmp_path) as processes:
            for node in page:
                more = ['--ros-args', '-p', f'connection:=udpin:127.0.0.1:{free_udp_port()}']
                processes.start(node, f'flock_follower.nodes.{node}',
                                more if node == 'mavlink_bridge' else [])
            try:
                wait_until(as_told, 15.0, 'the nodes')
            except TimeoutError:
                assert seen == page
    finally:
        look.destroy_node()
        context.shutdown()
    assert len(page) == 3
