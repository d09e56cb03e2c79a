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

"""
What a launch file starts, where ROS's ``launch`` is not installed.

Stand-ins for the little of ``launch`` and ``launch_ros`` that follower.launch.py and the recipes
use. An argument that was given, or declared before, keeps its value in a file that is included.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import runpy
import sys
from types import ModuleType
from typing import Any

LAUNCH = Path(__file__).resolve().parents[1] / 'launch'


class Context(dict[str, str]):
    """The values of the launch arguments."""


class LaunchConfiguration(namedtuple('LaunchConfiguration', 'name')):
    def perform(self, context: Context) -> str:
        return context[self.name]


class FindPackageShare(namedtuple('FindPackageShare', 'package')):
    def perform(self, context: Context) -> str:
        assert self.package == 'flock_follower'
        return str(LAUNCH.parent)


class PathJoinSubstitution(namedtuple('PathJoinSubstitution', 'parts')):
    def perform(self, context: Context) -> str:
        return '/'.join(text(part, context) for part in self.parts)


DeclareLaunchArgument = namedtuple('DeclareLaunchArgument', 'name default_value description')
PythonLaunchDescriptionSource = namedtuple('PythonLaunchDescriptionSource', 'path')
IncludeLaunchDescription = namedtuple('IncludeLaunchDescription', 'source launch_arguments',
                                      defaults=((),))
OpaqueFunction = namedtuple('OpaqueFunction', 'function')
#: A node as launch_ros takes it; ``parameters`` are files, and values that beat them.
Node = namedtuple('Node', 'package executable exec_name output namespace parameters remappings '
                          'respawn respawn_delay prefix', defaults=((), False, 0.0, ''))


def ignored(*_: Any, **__: Any) -> None:
    """Stand in for what acts only while nodes run."""


def text(value: Any, context: Context) -> str:
    return value if isinstance(value, str) else value.perform(context)


@contextmanager
def stand_ins() -> Iterator[None]:
    """Have the modules of launch imported from here."""
    holding: dict[str, dict[str, Any]] = {
        'launch': {'LaunchContext': Context, 'LaunchDescription': list},
        'launch.actions': {
            'DeclareLaunchArgument': DeclareLaunchArgument,
            'IncludeLaunchDescription': IncludeLaunchDescription,
            'OpaqueFunction': OpaqueFunction,
            'EmitEvent': ignored, 'RegisterEventHandler': ignored},
        'launch.event_handlers': {'OnProcessExit': ignored},
        'launch.events': {'Shutdown': ignored},
        'launch.events.process': {'ProcessExited': ignored},
        'launch_ros.parameter_descriptions': {'ParameterValue': ignored},
        'launch.launch_description_sources': {
            'PythonLaunchDescriptionSource': PythonLaunchDescriptionSource},
        'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration,
                                 'PathJoinSubstitution': PathJoinSubstitution},
        'launch_ros': {},
        'launch_ros.actions': {'Node': Node},
        'launch_ros.substitutions': {'FindPackageShare': FindPackageShare}}
    modules = {name: ModuleType(name) for name in holding}
    for name, members in holding.items():
        vars(modules[name]).update(members)
    before = {name: sys.modules[name] for name in modules if name in sys.modules}
    sys.modules.update(modules)  # modules that a launch file imports stay imported
    try:
        yield
    finally:
        for name in modules:
            del sys.modules[name]
        sys.modules.update(before)


def launched(file: str, **arguments: str) -> tuple[dict[str, Node], Context]:
    """Return the nodes that launch/``file`` starts, by executable, and all arguments."""
    context, nodes = Context(arguments), {}
    with stand_ins():
        for node in _nodes(LAUNCH / file, context):
            nodes[node.executable] = node
    return nodes, context


def _nodes(path: Path, context: Context) -> Iterator[Node]:
    entities = list(runpy.run_path(str(path))['generate_launch_description']())
    while entities:
        entity = entities.pop(0)
        if isinstance(entity, Node):
            yield entity
        elif isinstance(entity, DeclareLaunchArgument):
            if entity.default_value is not None:
                context.setdefault(entity.name, text(entity.default_value, context))
        elif isinstance(entity, IncludeLaunchDescription):
            yield from _nodes(Path(entity.source.path), context)
        else:
            entities[:0] = entity.function(context)
