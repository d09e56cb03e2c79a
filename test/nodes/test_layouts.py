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
from typing import Any
import xml.etree.ElementTree as ElementTree

from driven import overrides
import pytest
from rclpy.node import Node
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
def nodes(ros: Any) -> Iterator[dict[str, Node]]:
    """Return the nodes of a follower, by name."""
    made: list[Node] = [RelativePose(), Planner(), Visualizer(), MavlinkBridge(
        parameter_overrides=overrides(connection='udpin:127.0.0.1:0', relative_flight=True))]
    yield {node.get_name(): node for node in made}
    for node in made:
        node.destroy_node()


@pytest.fixture(scope='module')
def topics(nodes: dict[str, Node]) -> dict[str, Any]:
    """Return the topics of the nodes, and their types."""
    return {end.topic_name: end.msg_type for node in nodes.values()
            for end in (*node.publishers, *node.subscriptions)}


def test_the_table_from_which_a_policy_is_written_is_that_of_the_nodes(
        nodes: dict[str, Node]) -> None:
    rows = re.findall(r'^\| `(\w+)` \|(.*)\|(.*)\|(.*)\|$', PAGE.read_text(), re.M)
    assert len(rows) == 3
    for name, *cells in rows:
        node = nodes[name]
        assert [set(re.findall('`(.+?)`', cell)) for cell in cells] == [
            {each.lstrip('/') for each in names if not each.endswith(OF_PARAMETERS)} - OF_ALL
            for names in ([p.topic_name for p in node.publishers],
                          [s.topic_name for s in node.subscriptions],
                          [s.srv_name for s in node.services])]


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


def test_every_topic_of_a_layout_is_there(topics: dict[str, Any]) -> None:
    assert len(named_topics()) > 5 and set(named_topics()) <= topics.keys()


@pytest.mark.parametrize(('path', 'separator'), named_fields())
def test_every_field_of_a_layout_is_there(
        path: str, separator: str, topics: dict[str, Any]) -> None:
    topic = max((t for t in topics if path.startswith(t + separator)), key=len)
    kind = f'{topics[topic].__module__.split(".")[0]}/msg/{topics[topic].__name__}'
    for part in path[len(topic) + 1:].split(separator):
        if kind.endswith('Quaternion') and part in ANGLES:
            return
        known = message_class(kind).get_fields_and_field_types()[part.partition('[')[0]]
        many = re.fullmatch(r'sequence<(.+?)(?:, \d+)?>|(.+)\[\d+\]', known)
        assert bool(many) == ('[' in part), f'{part} is {known}'
        kind = (many[1] or many[2]) if many else known
        kind = kind.replace('/', '/msg/')
    assert '/' not in kind, f'{path} is {kind}'
