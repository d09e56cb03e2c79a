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
The house: what every room of the package may import, and that no two things bear one name.

A room is a folder of flock_follower (``simulation/camera`` is a room of its own), or a module that
stands beside the folders. ROOMS is the plan; each room's ``__init__.py`` repeats its row.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
import re
import sys
from typing import NamedTuple

from conftest import is_ros, loads_ros
import pytest

PACKAGE = Path(__file__).resolve().parents[1] / 'flock_follower'
EVERYWHERE = {'geometry', 'ranges'}  # all rooms may import them
SERVE_ALL = EVERYWHERE | {'resources', 'whole_file'}  # too many arrows for a picture

# Room: the rooms that it may import; the libraries. `ROS` is rclpy and all packages of messages.
ROOMS = {
    'geometry': ('', 'numpy'),
    'ranges': ('', ''),
    'messages': ('', 'numpy'),
    'flocking': ('', 'numpy'),
    'resources': ('', 'ament_index_python'),
    'whole_file': ('', ''),
    'flock': ('flocking messages', 'numpy'),
    'planner': ('flock flocking messages', 'numpy'),
    'odometry': ('messages', 'numpy'),
    'perception': ('messages odometry', 'cv2 numpy yaml'),
    # The planner, for its limits: the gate holds every setpoint to them once more.
    'mavlink': ('messages planner', 'numpy pymavlink'),
    # An autopilot elsewhere: where its vehicle is, for flights on the desk.
    'external': ('mavlink', 'numpy pymavlink'),
    'bags': ('', 'numpy rosbags'),
    # Defaults and ranges stand in the classes that they are for.
    'parameters': ('flock flocking mavlink odometry perception planner resources', 'yaml'),
    # What is drawn of a flight in viewers.
    'visualization': ('messages planner', 'numpy'),
    # What was seen, live or in a bag, judged in plain words.
    'checks': ('messages odometry parameters perception', 'cv2 numpy'),
    'pipeline': ('flock mavlink messages perception planner', ''),
    'flocks': ('flock flocking', 'numba numpy scipy'),
    # Not mavlink: what the bridge gets wrong the simulated vehicle would get wrong as well.
    'simulation.vehicles': ('', 'numpy pymavlink yaml'),
    'simulation.scenarios': ('flocking planner resources', 'numpy yaml'),
    'simulation.camera': ('perception', 'cv2 numpy'),
    'simulation.sensors': ('perception simulation.scenarios', 'numpy'),
    'simulation.closed_loop': (
        'external flock mavlink messages pipeline planner simulation.camera '
        'simulation.scenarios simulation.sensors simulation.vehicles whole_file', 'numpy'),
    'simulation': ('mavlink simulation.vehicles', ''),  # the embedded autopilot as a program
    # pymavlink, for the names of severities and commands.
    'nodes.support': ('checks external mavlink messages odometry parameters resources '
                      'simulation.closed_loop simulation.sensors', 'ROS numpy pymavlink'),
    'nodes': ('bags checks external mavlink messages nodes.support parameters perception '
              'flock planner resources simulation simulation.camera simulation.closed_loop '
              'simulation.scenarios simulation.sensors visualization', 'ROS numpy'),
    # cv2 draws and encodes the pictures of reports and printed markers.
    'tools': ('bags checks flocking flocks mavlink messages odometry parameters perception '
              'pipeline planner resources simulation.camera simulation.closed_loop '
              'simulation.scenarios simulation.sensors whole_file',
              'cv2 distributed matplotlib mpl_toolkits numpy yaml'),
}
LARGEST = 0.25  # share of the package's lines
MOST_LOOSE = 6
SAME_NAME = {
    'planner': 'the node of the planner, and the room it runs',
    'flock': 'several followers: the room, and the part of a scenario',
    'camera': 'the camera as a model in perception, and the rendered one',
}
HEAVY = {'matplotlib', 'mpl_toolkits', 'numba', 'scipy'}  # not installed on a drone
IN_FLIGHT = ('nodes.planner', 'nodes.relative_pose', 'nodes.mavlink_bridge',
             'nodes.sharing')


class Import(NamedTuple):
    """One module that another one imports."""

    name: str  # of a module of ours without 'flock_follower.', or of a library
    ours: bool
    at_start: bool  # not only when a function runs, or where it is installed


class Module(NamedTuple):
    path: Path
    tree: ast.Module
    room: str
    imports: list[Import]


def module_names() -> dict[str, Path]:
    """Return the file of every module, by its name without 'flock_follower.'."""
    names = {}
    for path in sorted(PACKAGE.rglob('*.py')):
        parts = path.relative_to(PACKAGE).with_suffix('').parts
        names['.'.join(parts[:-1] if parts[-1] == '__init__' else parts)] = path
    return names


def imports_of(tree: ast.Module, names: dict[str, Path]) -> Iterator[Import]:
    def resolved(full: str, at_start: bool) -> Import:
        library, _, name = full.partition('.')
        if library != PACKAGE.name:
            return Import(library, False, at_start)
        while name not in names:  # what is left is the name of a class or function
            name = name.rpartition('.')[0]
        return Import(name, True, at_start)

    def visit(node: ast.AST, at_start: bool) -> Iterator[Import]:
        if isinstance(node, ast.Import):
            yield from (resolved(alias.name, at_start) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, 'relative imports hide what they import'
            yield from (resolved(f'{node.module}.{a.name}', at_start) for a in node.names)
        later = isinstance(node, ast.FunctionDef | ast.Try)
        for child in ast.iter_child_nodes(node):
            yield from visit(child, at_start and not later)

    return visit(tree, True)


def room_of(name: str, names: dict[str, Path]) -> str:
    """Return the innermost folder that holds a module, or the module if it stands loose."""
    is_folder = names[name].name == '__init__.py'
    return name if is_folder or '.' not in name else name.rpartition('.')[0]


def read_house() -> dict[str, Module]:
    names = module_names()
    house = {}
    for name, path in names.items():
        tree = ast.parse(path.read_text())
        house[name] = Module(path, tree, room_of(name, names), list(imports_of(tree, names)))
    return house


HOUSE = read_house()
ROOM_NAMES = sorted({module.room for module in HOUSE.values()} - {''})


def arrows() -> dict[tuple[str, str], list[str]]:
    """
    Return which modules of one room import from another one.

    What stands in the ``__init__.py`` around a room is left out: Python loads that in any case,
    and none of them imports anything of ours.
    """
    found = defaultdict(list)
    for name, module in HOUSE.items():
        for target in module.imports:
            around = HOUSE[target.name].path.parent if target.ours else None
            if not target.ours or HOUSE[target.name].room == module.room:
                continue
            if HOUSE[target.name].path.name == '__init__.py' and around in module.path.parents:
                continue
            found[module.room, HOUSE[target.name].room].append(f'{name} -> {target.name}')
    return dict(found)


ARROWS = arrows()


def row(room: str) -> tuple[set[str], set[str]]:
    ours, libraries = ROOMS[room]
    return set(ours.split()), set(libraries.split())


def test_every_room_is_on_the_plan_and_no_other():
    assert not set(ROOM_NAMES) - ROOMS.keys(), 'write a row in ROOMS'
    assert not ROOMS.keys() - set(ROOM_NAMES), 'such a row has no room'


@pytest.mark.parametrize('room', sorted(ROOMS))
def test_a_room_imports_only_what_it_may(room):
    may = row(room)[0] | EVERYWHERE
    wrong = [arrow for (source, target), modules in ARROWS.items()
             if source == room and target not in may
             for arrow in modules]
    assert not wrong


@pytest.mark.parametrize('room', sorted(ROOMS))
def test_a_room_uses_only_the_libraries_it_may(room):
    _, may = row(room)
    for name, module in HOUSE.items():
        for target in module.imports:
            if module.room == room and not target.ours and (
                    target.name not in sys.stdlib_module_names):
                library = 'ROS' if is_ros(target.name) else target.name
                assert library in may, f'{name} imports {target.name}'


def test_the_file_around_other_modules_imports_none_of_them():
    for name, module in HOUSE.items():
        if module.path.name == '__init__.py':
            assert not [target.name for target in module.imports if target.ours], name


def test_no_rooms_import_each_other_in_a_circle():
    graph = defaultdict(set)
    for source, target in ARROWS:
        graph[source].add(target)
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_the_picture_of_the_house_shows_what_rooms_import_and_nothing_else():
    """An arrow that follows from others is left out, see docs/architecture.md."""
    text = (PACKAGE.parent / 'docs' / 'architecture.md').read_text()
    drawn = set(re.findall(r'^ +(\w+) -->(?:\|.*\|)? (\w+)$', text, re.M))
    boxes = set(re.findall(r'^ +(\w+)\[', text, re.M))
    imports = {(source.partition('.')[0], target.partition('.')[0]) for source, target in ARROWS}
    wanted = {(a, b) for a, b in imports if a != b and b not in SERVE_ALL}
    assert boxes == {room for arrow in wanted for room in arrow}

    def reached(room: str, by: set[tuple[str, str]]) -> set[str]:
        found: set[str] = set()
        waiting = {room}
        while waiting:
            waiting = {b for a, b in by if a in waiting} - found
            found |= waiting
        return found

    direct = {(a, b) for a, b in wanted if b not in reached(a, wanted - {(a, b)})}
    assert not drawn ^ direct, f'draw {direct - drawn}, erase {drawn - direct}'


@pytest.mark.parametrize('room', [n for n in ROOM_NAMES if HOUSE[n].path.name == '__init__.py'])
def test_a_room_says_what_it_holds_and_what_it_may_import(room):
    said = ' '.join((ast.get_docstring(HOUSE[room].tree) or '').split())
    ours, libraries = (', '.join(sorted(names, key=str.lower)) for names in row(room))
    assert said.partition('. ')[0] and 'May import:' not in said.partition('. ')[0]
    assert f'May import: {"; ".join(filter(None, (ours, libraries)))}.' in said


def test_the_package_says_what_every_room_may_import():
    said = ast.get_docstring(HOUSE[''].tree) or ''
    assert all(f'``{name}``' in said for name in EVERYWHERE)


def test_few_modules_stand_beside_the_rooms():
    loose = [name for name in ROOM_NAMES if HOUSE[name].path.name != '__init__.py']
    assert len(loose) <= MOST_LOOSE, loose


def test_no_room_is_above_a_quarter_of_the_house():
    lines: dict[str, int] = defaultdict(int)
    for module in HOUSE.values():
        lines[module.room.partition('.')[0]] += len(module.path.read_text().splitlines())
    house = sum(lines.values())
    larger = {room: round(n / house, 3) for room, n in lines.items() if n > LARGEST * house}
    assert not larger, f'{larger} of {house} lines'


def test_no_two_classes_have_one_name():
    places = defaultdict(list)
    for name, module in HOUSE.items():
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(name)
    assert not {name: where for name, where in places.items() if len(where) > 1}


def test_no_two_modules_or_rooms_have_one_name():
    places = defaultdict(list)
    for name in HOUSE:
        places[name.rpartition('.')[2]].append(name)
    twice = {name: where for name, where in places.items() if len(where) > 1}
    assert not {name: where for name, where in twice.items() if name not in SAME_NAME}
    mended = SAME_NAME.keys() - twice.keys()
    assert not mended, 'take them off the list'


@pytest.mark.parametrize('node', IN_FLIGHT)
def test_what_flies_loads_no_simulation_no_tools_and_no_heavy_library(node):
    loaded: dict[str, Import] = {}
    waiting = [Import(node, True, True)]
    while waiting:
        target = waiting.pop()
        if target.at_start and target.name not in loaded:
            loaded[target.name] = target
            waiting += HOUSE[target.name].imports if target.ours else []
    assert len(loaded) > 10
    wrong = {'simulation', 'tools', 'bags', *HEAVY}
    assert not [name for name in loaded if name.partition('.')[0] in wrong]


def test_the_tests_mirror_the_rooms():
    folders = {path.name for path in Path(__file__).parent.iterdir() if any(path.glob('*.py'))}
    beside_the_package = {'deploy'}  # folders of the top level
    assert folders - beside_the_package <= {room for room in ROOM_NAMES if '.' not in room}


def test_a_test_is_told_to_need_ros_by_what_it_imports(request):
    here = Path(__file__).parent
    assert loads_ros(here / 'nodes' / 'test_planner_node.py')
    assert loads_ros(here / 'nodes' / 'test_fuzz_nodes.py') and loads_ros(here / 'fuzz.py')
    assert not loads_ros(Path(__file__)) and not loads_ros(here / 'conftest.py')
    assert request.node.get_closest_marker('unit')
