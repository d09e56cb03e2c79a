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

"""The layouts for Foxglove, RViz and PlotJuggler name only topics and fields that there are."""

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

pytestmark = pytest.mark.usefixtures('ros')
CONFIG = Path(__file__).resolve().parents[2] / 'config'
#: What PlotJuggler makes of every quaternion.
ANGLES = {'roll', 'pitch', 'yaw'}
#: Which of RViz's displays, and of Foxglove's panels, show which type.
SHOWN = {'MarkerArray': 'visualization_msgs/msg/MarkerArray', 'Image': 'sensor_msgs/msg/Image',
         'Odometry': 'nav_msgs/msg/Odometry'}


@pytest.fixture(scope='module')
def topics(ros: Any) -> Iterator[dict[str, str]]:
    """Return the topics of the nodes, and their types."""
    nodes: list[Node] = [RelativePose(), Planner(), Visualizer(), MavlinkBridge(
        parameter_overrides=[Parameter('connection', value='udpin:127.0.0.1:0')])]
    found: dict[str, str] = {}
    end = time.monotonic() + 10.0
    while not {'/mavlink/odom', '/visualizer/markers', '/odom'} <= found.keys():
        assert time.monotonic() < end, f'waited in vain; found {sorted(found)}'
        for node in nodes:
            for ask in (node.get_publisher_names_and_types_by_node,
                        node.get_subscriber_names_and_types_by_node):
                found |= {name: kinds[0] for name, kinds in ask(
                    node.get_name(), node.get_namespace())}
    yield found
    for node in nodes:
        node.destroy_node()


def check_field(kind: str, parts: list[str]) -> None:
    """Fail where a message of a type has no number, or text, at a path such as [a, b[0], c]."""
    for k, part in enumerate(parts):
        fields = message_class(kind.replace('/msg/', '/').replace('/', '/msg/'))
        name, index = re.fullmatch(r'(\w+)((?:\[\d+\])?)', part).groups()
        known = fields.get_fields_and_field_types()
        if kind.endswith('Quaternion') and name in ANGLES:
            return
        assert name in known, f'{".".join(parts)}: {kind} has no {name}'
        many = re.fullmatch(r'sequence<(.+?)(?:, \d+)?>|(.+)\[\d+\]', known[name])
        assert bool(many) == bool(index), f'{".".join(parts)}: {name} is {known[name]}'
        kind = (many[1] or many[2]) if many else known[name]
        assert ('/' in kind) == (k + 1 < len(parts)), f'{".".join(parts)}: {name} is {kind}'


def check_path(path: str, separator: str, topics: dict[str, str]) -> None:
    """Fail where a path, of topic and field, leads nowhere."""
    topic = max((t for t in topics if path.startswith(t + separator)), key=len, default=None)
    assert topic is not None, f'{path}: no such topic'
    check_field(topics[topic], path[len(topic) + 1:].split(separator))


def foxglove() -> dict[str, Any]:
    return json.loads((CONFIG / 'foxglove.json').read_text(encoding='utf-8'))


def test_the_foxglove_layout_shows_what_there_is(topics: dict[str, str]) -> None:
    panels = foxglove()['configById']
    checked = 0
    for name, panel in panels.items():
        for line in panel.get('paths', []):
            check_path(line['value'], '.', topics)
            checked += 1
        if 'topicPath' in panel:
            check_path(panel['topicPath'], '.', topics)
        for topic in panel.get('topics', {}):
            assert topics[topic] == SHOWN['MarkerArray']
        if name.startswith('Image!'):
            assert topics[panel['imageMode']['imageTopic']] == SHOWN['Image']
        if name.startswith('Diagnostic'):
            assert topics[panel['topicToRender']] == 'diagnostic_msgs/msg/DiagnosticArray'
    assert checked > 12


def test_every_foxglove_panel_has_its_place() -> None:
    document = foxglove()

    def placed(part: Any) -> list[str]:
        if isinstance(part, str):
            return [part]
        assert part['direction'] in ('row', 'column') and 0 < part['splitPercentage'] < 100
        return placed(part['first']) + placed(part['second'])

    assert sorted(placed(document['layout'])) == sorted(document['configById'])
    kinds = {name.partition('!')[0] for name in document['configById']}
    assert kinds == {'3D', 'Image', 'Plot', 'StateTransitions', 'RawMessages',
                     'DiagnosticSummary'}


def test_the_rviz_file_shows_what_there_is(topics: dict[str, str]) -> None:
    manager = yaml.safe_load(
        (CONFIG / 'follower.rviz').read_text(encoding='utf-8'))['Visualization Manager']
    shown = [(display['Class'].rpartition('/')[2], display['Topic'])
             for display in manager['Displays'] if 'Topic' in display]
    assert {kind for kind, _ in shown} == SHOWN.keys()
    for kind, topic in shown:
        assert topics[topic['Value']] == SHOWN[kind]
    # Best effort hears everybody; markers are reliable, as the node sends them.
    assert {topic['Reliability Policy'] for kind, topic in shown if kind != 'MarkerArray'} == {
        'Best Effort'}


def test_the_plotjuggler_layout_shows_what_there_is(topics: dict[str, str]) -> None:
    root = ElementTree.parse(CONFIG / 'plotjuggler.xml').getroot()
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert len(curves) > 20
    for curve in curves:
        check_path(curve, '/', topics)
    for splitter in root.iter('DockSplitter'):
        assert int(splitter.get('count')) == len(splitter) == len(
            splitter.get('sizes').split(';'))


@pytest.mark.parametrize(('path', 'separator'), [
    ('/odom.pose.pose.position.w', '.'), ('/odom.pose.pose.position', '.'),
    ('/odometry.pose.pose.position.x', '.'), ('/odom.pose[0].pose.position.x', '.'),
    ('/command/trajectory/points/accelerations[0]/linear/x', '/')])
def test_what_there_is_not_is_found(path: str, separator: str, topics: dict[str, str]) -> None:
    with pytest.raises(AssertionError):
        check_path(path, separator, topics)
