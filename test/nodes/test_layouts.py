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

"""The layouts of viewers and the page about security name the topics of the nodes."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import re
from typing import Any

from driven import overrides
import pytest
from rclpy.node import Node
import yaml

from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.planner import Planner
from flock_follower.nodes.relative_pose import RelativePose
from flock_follower.nodes.visualizer import Visualizer

VIEWS = Path(__file__).resolve().parents[2] / 'config' / 'views'
PAGE = VIEWS.parents[1] / 'docs' / 'deploy.md'
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


def test_policy_table_is_that_of_the_nodes(
        nodes: dict[str, Node]) -> None:
    rows = re.findall(r'^- `(\w+)` publishes\s+(.*?);\s+subscribes\s+(.*?);\s+serves\s+(.*?)\.$',
                      PAGE.read_text(), re.M | re.S)
    assert len(rows) == 3
    for name, *cells in rows:
        node = nodes[name]
        assert [set(re.findall('`(.+?)`', cell.replace('NAME', 'leader'))) for cell in cells] == [
            {each.lstrip('/') for each in names if not each.endswith(OF_PARAMETERS)} - OF_ALL
            for names in ([p.topic_name for p in node.publishers],
                          [s.topic_name for s in node.subscriptions],
                          [s.srv_name for s in node.services])]


def named_topics() -> list[str]:
    panels = json.loads((VIEWS / 'foxglove.json').read_text())['configById'].values()
    rviz = yaml.safe_load((VIEWS / 'follower.rviz').read_text())['Visualization Manager']
    return [*(topic for panel in panels for topic in panel.get('topics', {})),
            *(panel['imageMode']['imageTopic'] for panel in panels if 'imageMode' in panel),
            *(panel['topicToRender'] for panel in panels if 'topicToRender' in panel),
            *(shown['Topic']['Value'] for shown in rviz['Displays'] if 'Topic' in shown)]


def test_every_topic_of_a_layout_is_there(topics: dict[str, Any]) -> None:
    assert len(named_topics()) > 5 and set(named_topics()) <= topics.keys()
