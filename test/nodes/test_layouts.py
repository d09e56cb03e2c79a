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

"""The layouts of viewers and the page about security name the topics and fields of the nodes."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import re
import time
from typing import Any
import xml.etree.ElementTree as ElementTree

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
import yaml

from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.support.conversions import message_class
from flock_follower.nodes.visualizer import Visualizer

CONFIG = Path(__file__).resolve().parents[2] / 'config'
#: What PlotJuggler makes of every quaternion.
ANGLES = {'roll', 'pitch', 'yaw'}
PAGE = CONFIG.parent / 'docs' / 'deploy.md'
OF_ALL = {'rosout', 'parameter_events', 'diagnostics'}
OF_PARAMETERS = ('_parameters', '_parameter_types', '_parameters_atomically', '_type_description')


@pytest.fixture(scope='module')
def graph(ros: Any) -> Iterator[Node]:
    """Return a node that sees all nodes of a follower."""
    nodes: list[Node] = [RelativePose(), Planner(), Visualizer(), MavlinkBridge(
        parameter_overrides=[Parameter('connection', value='udpin:127.0.0.1:0'),
                             Parameter('relative_flight', value=True)])]
    end = time.monotonic() + 10.0
    while not {'/mavlink/odom', '/visualizer/markers', '/odom'} <= dict(
            nodes[0].get_topic_names_and_types()).keys():
        assert time.monotonic() < end, 'waited in vain'
    yield nodes[0]
    for node in nodes:
        node.destroy_node()


def inputs_and_outputs(graph: Node, node: str) -> list[list[tuple[str, list[str]]]]:
    """Return what a node publishes, subscribes and serves, with the types."""
    return [ask(node, '/') for ask in (
        graph.get_publisher_names_and_types_by_node, graph.get_subscriber_names_and_types_by_node,
        graph.get_service_names_and_types_by_node)]


@pytest.fixture(scope='module')
def topics(graph: Node) -> dict[str, str]:
    """Return the topics of the nodes, and their types."""
    return {name: kinds[0] for node in ('relative_pose', 'planner', 'visualizer', 'mavlink_bridge')
            for found in inputs_and_outputs(graph, node)[:2] for name, kinds in found}


def test_the_table_from_which_a_policy_is_written_is_that_of_the_nodes(graph: Node) -> None:
    rows = re.findall(r'^\| `(\w+)` \|(.*)\|(.*)\|(.*)\|$', PAGE.read_text(), re.M)
    assert len(rows) == 3
    for node, *cells in rows:
        assert [set(re.findall('`(.+?)`', cell)) for cell in cells] == [
            {name.lstrip('/') for name, _ in names if not name.endswith(OF_PARAMETERS)} - OF_ALL
            for names in inputs_and_outputs(graph, node)]


def named_topics() -> list[str]:
    panels = json.loads((CONFIG / 'foxglove.json').read_text())['configById'].values()
    rviz = yaml.safe_load((CONFIG / 'follower.rviz').read_text())['Visualization Manager']
    return [*(topic for panel in panels for topic in panel.get('topics', {})),
            *(panel['imageMode']['imageTopic'] for panel in panels if 'imageMode' in panel),
            *(panel['topicToRender'] for panel in panels if 'topicToRender' in panel),
            *(shown['Topic']['Value'] for shown in rviz['Displays'] if 'Topic' in shown)]


def named_fields() -> list[tuple[str, str]]:
    """Return paths of a topic and its fields, and what separates them."""
    panels = json.loads((CONFIG / 'foxglove.json').read_text())['configById'].values()
    return [*((line['value'], '.') for panel in panels for line in panel.get('paths', [])),
            *((panel['topicPath'], '.') for panel in panels if 'topicPath' in panel),
            *((curve.get('name'), '/') for curve in ElementTree.parse(
                CONFIG / 'plotjuggler.xml').getroot().iter('curve'))]


def test_every_topic_of_a_layout_is_there(topics: dict[str, str]) -> None:
    assert len(named_topics()) > 5 and set(named_topics()) <= topics.keys()


@pytest.mark.parametrize(('path', 'separator'), named_fields())
def test_every_field_of_a_layout_is_there(
        path: str, separator: str, topics: dict[str, str]) -> None:
    topic = max((t for t in topics if path.startswith(t + separator)), key=len)
    kind = topics[topic]
    for part in path[len(topic) + 1:].split(separator):
        if kind.endswith('Quaternion') and part in ANGLES:
            return
        known = message_class(kind).get_fields_and_field_types()[part.partition('[')[0]]
        many = re.fullmatch(r'sequence<(.+?)(?:, \d+)?>|(.+)\[\d+\]', known)
        assert bool(many) == ('[' in part), f'{part} is {known}'
        kind = (many[1] or many[2]) if many else known
        kind = kind.replace('/', '/msg/')
    assert '/' not in kind, f'{path} is {kind}'
