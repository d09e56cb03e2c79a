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
The house: what every room may import. A room is a folder of flock_follower or of flock_desk.

ROOMS is the plan. A module that stands beside the folders is named with its package.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
import subprocess
import sys
from typing import NamedTuple

from conftest import is_ros
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ('flock_follower', 'flock_desk')
#: The modules beside the folders, and the folder, that every room may import.
SHARED = {'geometry', 'ranges', 'signals', 'system'}
#: Modules that are rooms of their own: the simulated vehicles share the frames of MAVLink with the
#: bridge, and nothing else; no node loads the tables of all nodes.
APART = {'flock_follower.mavlink.ned', 'flock_follower.parameters.flight_parameters'}
# Room: the rooms that it may import; the libraries. `ROS` is rclpy and all packages of messages.
ROOMS = {
    'messages': ('', 'numpy'),
    'flocking': ('', 'numpy'),
    # NED is inside what speaks MAVLink.
    'ned': ('', 'numpy'),
    'odometry': ('messages', 'numpy'),
    # Tables, defaults and ranges stand with what they are for.
    'parameters': ('odometry', 'yaml'),
    'flock': ('flocking messages', 'numpy'),
    'planner': ('flock flocking messages odometry parameters', 'numpy'),
    'perception': ('messages odometry parameters', 'cv2 numpy'),
    # The planner, for its limits: the gate holds every setpoint to them once more.
    'gate': ('messages planner', 'numpy'),
    'mavlink': ('gate messages ned odometry parameters', 'numpy pymavlink'),
    'bags': ('parameters', 'backports compression mcap numpy rosbags yaml'),
    'flight_parameters': ('mavlink parameters perception planner', ''),
    'checks': ('bags messages odometry parameters perception', 'cv2 numpy'),
    'check': ('bags checks flight_parameters messages nodes parameters', ''),
    'follow': ('check checks messages nodes', ''),
    # The page of a flight, without ROS: what it shows, and its server.
    'view': ('messages odometry parameters perception planner',
             'aiohttp cv2 numpy'),
    'support': ('gate mavlink messages odometry parameters perception', 'ROS numpy'),
    'nodes': ('bags checks flock gate mavlink messages odometry parameters perception planner '
              'support view',
              'ROS numpy yaml'),
    # Not mavlink: a fault of the bridge would be a fault of the simulated vehicle, too.
    'vehicles': ('ned', 'numpy pymavlink'),
    'external': ('mavlink ned', 'numpy pymavlink'),
    'scenarios': ('flocking parameters planner', 'numpy yaml'),
    'camera': ('perception', 'cv2 numpy'),
    'follower': ('flock gate messages perception planner', ''),
    'sensors': ('scenarios', 'numpy'),
    'closed_loop': ('camera external flock flocking follower gate mavlink messages odometry '
                    'parameters perception planner scenarios sensors vehicles', 'numpy'),
    'flocks': ('flock flocking', 'numpy scipy'),
    'runs': ('bags camera checks closed_loop flocking flocks follower gate mavlink messages '
             'odometry parameters perception planner scenarios',
             'PIL cv2 distributed matplotlib numpy tqdm yaml'),
    # Commands, and the two nodes of the desk.
    'flock_desk': ('bags camera checks closed_loop external flight_parameters flocks mavlink '
                   'messages nodes parameters perception planner runs scenarios sensors support '
                   'vehicles',
                   'ROS cv2 matplotlib numpy'),
}

#: The libraries that each node that flies may load, itself or by what it imports.
FLIES = {
    'relative_pose': 'ROS ament_index_python cv2 numpy yaml',
    'planner': 'ROS ament_index_python numpy yaml',
    'mavlink_bridge': 'ROS ament_index_python numpy pymavlink yaml',
    'flock': 'ROS ament_index_python numpy yaml',
}
_ALL_LOAD = 'messages nodes odometry parameters support'
#: The rooms that each of them loads.
LOADED_ROOMS = {
    'relative_pose': f'perception {_ALL_LOAD}',
    'planner': f'flock flocking planner {_ALL_LOAD}',
    'mavlink_bridge': f'gate mavlink ned planner {_ALL_LOAD}',
    'flock': f'flock {_ALL_LOAD}',
}
#: The messages that each of them loads, and whether the file of the neighbors: the markers by name
#: and size alone.
LOADED_PARTS = {
    'relative_pose': 'neighbors_file poses state_reader state_writer',
    'planner': 'accelerations bridge_reading bridge_state command_writer commands jumps '
               'neighbors_file state_reader',
    'mavlink_bridge': 'bridge_diagnostics bridge_state command_reader commands jumps state_writer',
    'flock': 'jumps state_reader state_writer',
}
#: What the gate needs of the planner.
LIMITS = {'flock_follower.planner', 'flock_follower.planner.limits',
          'flock_follower.planner.projection'}
#: The most statements that each of them may load, without docstrings and imports. What each loads,
#: by rooms, about:
#:
#: - relative_pose: perception 3400, nodes 780, odometry 650, parameters 340, messages 150;
#: - planner: planner 1600, nodes 780, odometry 460, parameters 420, messages 160, flock and the
#:   law 100;
#: - mavlink_bridge: mavlink 2400, gate 1300, nodes 1000, odometry 450, parameters 240, the
#:   planner's limits 170, messages 130;
#: - flock: nodes 560, flock 490, odometry 450, parameters 170, messages 90;
#: - each, of geometry, ranges, signals and system, 220.
#:
#: Each of them reads the odometry of any source by itself: one node that did this for all would
#: add a hop, and its end would end all. The bridge's rose by 15 for a pilot whom no repeated
#: command overrules, and by 55 for a height whose odometry diverges slowly, or whose barometer
#: fails, too.
MOST_STATEMENTS = {
    'relative_pose': 5577, 'planner': 3719, 'mavlink_bridge': 5953, 'flock': 1965}


class Module(NamedTuple):
    room: str
    ours: set[str]
    """Modules of the packages that it imports."""
    libraries: set[str]


def module_names() -> dict[str, Path]:
    """Return the file of every module."""
    return {'.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): path
            for package in PACKAGES for path in sorted((ROOT / package).rglob('*.py'))}


def imports_of(path: Path) -> Iterator[str]:
    """Yield the names that a module imports anywhere, of modules or of what they hold."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, 'a relative import hides the module'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def room_of(name: str, path: Path) -> str:
    """
    Return the innermost folder of a module; of a module beside the folders its own name.

    The modules beside the folders of the desk are commands, one room. A module whose own imports
    differ from those of its folder is a room of its own: ``APART``.
    """
    own = name.rpartition('.')[2]
    package, *folders = name.split('.') if path.stem == '__init__' else name.split('.')[:-1]
    if folders and name not in APART:
        return folders[-1]
    return own if package == 'flock_follower' or own in ROOMS else package


@cache
def read_house() -> dict[str, Module]:
    """Return the modules by name; the first test reads them, not every worker that loads this."""
    names, house = module_names(), {}
    for name, path in names.items():
        house[name] = Module(room_of(name, path), set(), set())
        for target in imports_of(path):
            if target.partition('.')[0] not in PACKAGES:
                house[name].libraries.add(target.partition('.')[0])
                continue
            while target not in names:  # the rest is the name of a class or function
                target = target.rpartition('.')[0]
            house[name].ours.add(target)
    return house


def loaded(name: str) -> set[str]:
    """Return the modules of the packages that Python loads with one of them."""
    found, waiting = set(), [name]
    while waiting:
        module = waiting.pop()
        if module not in found:
            found.add(module)
            waiting += read_house()[module].ours
            if '.' in module:  # the packages around it
                waiting.append(module.rpartition('.')[0])
    return found


@cache
def arrows() -> dict[tuple[str, str], list[str]]:
    """
    Return which modules of one room import from another one.

    The ``__init__.py`` of a folder around a module is left out: Python loads it in any case.
    """
    found = defaultdict(list)
    for name, module in read_house().items():
        for target in module.ours:
            room = read_house()[target].room
            if room != module.room and not name.startswith(f'{target}.'):
                found[module.room, room].append(f'{name} -> {target}')
    return dict(found)


def test_every_room_is_on_the_plan_and_no_other():
    rooms = {module.room for module in read_house().values()}
    assert sorted(ROOMS) == sorted(rooms - SHARED - {'flock_follower'})


@pytest.mark.parametrize('room', sorted(ROOMS))
def test_a_room_imports_only_what_it_may(room):
    may = {*ROOMS[room][0].split()} | SHARED
    assert not [arrow for (source, target), modules in arrows().items()
                if source == room and target not in may for arrow in modules]


@pytest.mark.parametrize('room', sorted(ROOMS))
def test_a_room_uses_only_the_libraries_it_may(room):
    for name, module in read_house().items():
        if module.room == room:
            used = {'ROS' if is_ros(library) else library
                    for library in module.libraries - sys.stdlib_module_names}
            assert used <= {*ROOMS[room][1].split()}, name


def test_what_flies_imports_nothing_of_the_desk():
    assert not [f'{name} -> {target}' for name, module in read_house().items()
                for target in module.ours
                if name.startswith('flock_follower') and target.startswith('flock_desk')]


def test_no_rooms_import_each_other_in_a_circle():
    graph = defaultdict(set)
    for source, target in arrows():
        graph[source].add(target)
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize('node', FLIES)
def test_a_node_that_flies_loads_only_the_libraries_it_may(node):
    libraries = set().union(*(read_house()[name].libraries
                              for name in loaded(f'flock_follower.nodes.{node}')))
    assert {'ROS' if is_ros(library) else library
            for library in libraries - sys.stdlib_module_names} == {*FLIES[node].split()}


@pytest.mark.parametrize('node', FLIES)
def test_a_flight_node_loads_only_the_rooms_of_its_work(node):
    rooms = {read_house()[name].room for name in loaded(f'flock_follower.nodes.{node}')}
    assert rooms - SHARED - {'flock_follower'} == {*LOADED_ROOMS[node].split()}


@pytest.mark.parametrize('node', FLIES)
def test_a_flight_node_loads_only_the_messages_of_its_work(node):
    parts = {name.rpartition('.')[2] for name in loaded(f'flock_follower.nodes.{node}')
             if name.startswith('flock_follower.messages.')
             or name == 'flock_follower.parameters.neighbors_file'}
    assert parts == {*LOADED_PARTS[node].split()}


def test_the_bridge_loads_only_the_limits_of_the_planner():
    of_planner = {name for name in loaded('flock_follower.nodes.mavlink_bridge')
                  if read_house()[name].room == 'planner'}
    assert of_planner == LIMITS


def count_statements(path: Path) -> int:
    return sum(isinstance(each, ast.stmt) and not isinstance(each, (ast.Import, ast.ImportFrom))
               and not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant))
               for each in ast.walk(ast.parse(path.read_text())))


@pytest.mark.parametrize('node', FLIES)
def test_a_flight_node_loads_no_more_than_now(node):
    names = module_names()
    total = sum(count_statements(names[name])
                for name in loaded(f'flock_follower.nodes.{node}'))
    most = MOST_STATEMENTS[node]
    assert total <= most, (
        f'{node} loads {total} statements, at most {most}: is each module that it loads part of '
        'its work? For a new behavior shorten other code, or raise MOST_STATEMENTS and say why')


def test_no_node_loads_the_tables_of_all():
    assert not [name for name, module in read_house().items()
                if module.room in ('nodes', 'support')
                and 'flock_follower.parameters.flight_parameters' in loaded(name)]


def test_the_law_loads_geometry_and_ranges_alone():
    assert loaded('flock_follower.flocking') == {'flock_follower', *(
        f'flock_follower.{name}' for name in ('flocking', 'geometry', 'ranges', 'signals'))}


@pytest.mark.ros
@pytest.mark.parametrize('node', FLIES)
def test_flight_node_starts_without_libraries_of_others(node):
    missing = {'cv2', 'pymavlink', 'rosbags', 'mcap', 'scipy', 'matplotlib'} - {
        *FLIES[node].split()}
    code = (f'import sys; sys.modules.update(dict.fromkeys({sorted(missing)}));'
            f'from flock_follower.nodes.{node} import main; sys.exit(main())')
    ran = subprocess.run([sys.executable, '-c', code, '--ros-args', '-p', 'unknown:=1'],
                         capture_output=True, text=True, check=False)
    assert ran.returncode == 1 and f'unknown parameter unknown for node {node}' in ran.stderr


def mutated() -> dict[str, tuple[Path, ...]]:
    """Return the tests of each module that ``make mutation`` mutates."""
    rows = (line.split() for line in (ROOT / '.ci/mutation').read_text().splitlines())
    return {row[0]: tuple(ROOT / 'test' / f'{name}.py' for name in row[3:])
            for row in rows if len(row) > 3 and row[1].isdecimal()}


@pytest.mark.parametrize('module', mutated())
def test_mutation_installs_all_that_its_tests_load(module: str) -> None:
    waiting, ours, libraries = [*mutated()[module]], set(), set()
    for path in waiting:
        for name in imports_of(path):
            top = name.partition('.')[0]
            helper = next(iter((ROOT / 'test').rglob(f'{top}.py')), None)
            if top in PACKAGES:
                ours.add(name if name in read_house() else name.rpartition('.')[0])
            elif helper is None:
                libraries.add(top)
            elif helper not in waiting:
                waiting.append(helper)
    for name in set().union(*map(loaded, ours)):
        libraries |= read_house()[name].libraries
    installed = {{'opencv-python-headless': 'cv2', 'pyyaml': 'yaml'}.get(name, name) for name in (
        line.partition('==')[0]
        for line in (ROOT / 'requirements/mutation.in').read_text().splitlines())}
    lazy = {'ament_index_python', 'distributed', 'tqdm'}  # imported where they are used
    assert not {each for each in libraries - sys.stdlib_module_names - installed - lazy
                if not is_ros(each)}
