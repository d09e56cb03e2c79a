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

"""The launch files: which nodes start, with which parameters, on which topics."""

from __future__ import annotations

import runpy
from typing import Any

from launch_files import Context, LAUNCH, launched, stand_ins
import pytest

from flock_follower.parameters import (
    black_box_table,
    mavlink_bridge_table,
    planner_table,
    relative_pose_table,
)

PAGE = (LAUNCH.parent / 'docs' / 'sensors.md').read_text(encoding='utf-8')
SPECS = {'relative_pose': relative_pose_table.SPECS, 'planner': planner_table.SPECS,
         'mavlink_bridge': mavlink_bridge_table.SPECS, 'black_box': black_box_table.SPECS}
RECIPES = sorted(path.name for path in LAUNCH.glob('*.launch.py')
                 if path.name not in (
                     'flock.launch.py', 'follower.launch.py', 'simulation.launch.py'))


def parameters(file: str, **arguments: str) -> dict[str, dict[str, Any]]:
    """Return what each node is given beside its file."""
    return {name: node.parameters[-1] for name, node in launched(file, **arguments)[0].items()}


def test_there_are_five_recipes() -> None:
    assert RECIPES == ['d435i_openvins.launch.py', 'd435i_rtabmap.launch.py',
                       'd435i_vins_fusion.launch.py', 't265.launch.py', 'usb_camera.launch.py']


@pytest.mark.parametrize('file', ['follower.launch.py', *RECIPES])
def test_every_node_knows_the_parameters_it_is_given(file: str) -> None:
    given = parameters(file)
    assert given.keys() == SPECS.keys()
    for node, values in given.items():
        known = {spec.name: spec for spec in SPECS[node]}
        assert values.pop('use_sim_time') is False
        for name, value in values.items():
            known[name].check(value)


def test_what_ends_is_started_again_unless_told_otherwise() -> None:
    nodes, _ = launched('follower.launch.py')
    assert all(node.respawn and 0.0 < node.respawn_delay < 3.0 for node in nodes.values())
    nodes, _ = launched('follower.launch.py', respawn='false')
    assert not any(node.respawn for node in nodes.values())


def test_only_the_bridge_is_started_by_the_command_that_is_given() -> None:
    nodes, _ = launched('follower.launch.py')
    assert not any(node.prefix for node in nodes.values())
    nodes, _ = launched('follower.launch.py', bridge_prefix='taskset -c 3')
    assert {name: node.prefix for name, node in nodes.items()} == {
        'relative_pose': None, 'planner': None, 'mavlink_bridge': 'taskset -c 3',
        'black_box': None}


def test_the_visualizer_starts_when_it_is_asked_for_and_asks_the_others_for_the_rest() -> None:
    assert 'visualizer' not in launched('follower.launch.py')[0]
    nodes, _ = launched('follower.launch.py', visualize='true', cameras='/mine/two.yaml',
                        camera_rpy='[0, 0.2, 0]', odom='/vio/odom')
    node = nodes['visualizer']
    assert node.parameters == [{'use_sim_time': False}]
    assert ('odom', '/vio/odom') in node.remappings


def column(**arguments: str) -> list[dict[str, str]]:
    """Return what launch/flock.launch.py gives each follower."""
    with stand_ins():
        start = runpy.run_path(str(LAUNCH / 'flock.launch.py'))['start']
        return [dict(included.launch_arguments) for included in start(Context({
            'followers': '2', 'scenario': 'indoor', 'seed': '0', 'port': '14540', **arguments}))]


def test_a_column_gives_out_namespaces_ids_and_ports() -> None:
    given = column(followers='3', seed='7')
    assert [g['namespace'] for g in given] == ['follower_1', 'follower_2', 'follower_3']
    assert [g['system'] for g in given] == ['1', '2', '3']
    assert [g['port'] for g in given] == ['14540', '14541', '14542']
    assert [g['seed'] for g in given] == ['7', '8', '9']
    assert [g['leader_topic'] for g in given] == [
        '', '/follower_1/truth/motion', '/follower_2/truth/motion']


@pytest.mark.parametrize('followers', ['0', '9', 'two'])
def test_a_column_of_another_length_is_refused(followers: str) -> None:
    with pytest.raises(ValueError, match=r'must be an integer in \[1, 8\]'):
        column(followers=followers)


def test_what_is_not_given_is_left_to_the_parameter_files() -> None:
    nodes, _ = launched('follower.launch.py', config='/mine')
    assert {name: node.parameters for name, node in nodes.items()} == {
        'relative_pose': ['/mine/follower.yaml', {
            'image_transport': 'raw', 'neighbors_file': '/mine/neighbors.yaml',
            'use_sim_time': False}],
        'planner': ['/mine/follower.yaml', {
            'neighbors_file': '/mine/neighbors.yaml', 'use_sim_time': False}],
        'mavlink_bridge': ['/mine/follower.yaml', {
            'connection': 'udpin:127.0.0.1:14540', 'use_sim_time': False}],
        'black_box': [{'image_transport': 'raw', 'use_sim_time': False}]}
    for node in nodes.values():
        assert all(name == other for name, other in node.remappings)


def test_every_launch_records_unless_told_otherwise() -> None:
    nodes, _ = launched('follower.launch.py', record='false')
    assert nodes.keys() == SPECS.keys() - {'black_box'}
    given = parameters('follower.launch.py', record_folder='/mine', record_images='none',
                       image_transport='compressed', disk_used='500')['black_box']
    assert given == {'record_folder': '/mine', 'record_images': 'none', 'use_sim_time': False,
                     'image_transport': 'compressed', 'disk_used': 500}


@pytest.mark.parametrize(('argument', 'text', 'expected'), [
    ('disk_used', '500.5', 500.5), ('disk_used', '2e4', 20000.0), ('disk_used', '500', 500),
    ('record_folder', '2026', '2026'), ('target_system', '7', 7)])
def test_a_number_is_given_as_a_number_and_a_name_as_a_string(
        argument: str, text: str, expected: object) -> None:
    node = 'mavlink_bridge' if argument == 'target_system' else 'black_box'
    given = parameters('follower.launch.py', **{argument: text})[node][argument]
    assert (given, type(given)) == (expected, type(expected))
    next(spec for spec in SPECS[node] if spec.name == argument).check(given)


def test_what_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match='disk_used:=8GB: must be a number'):
        launched('follower.launch.py', disk_used='8GB')


@pytest.mark.parametrize('argument', ['record', 'respawn', 'visualize', 'use_sim_time'])
def test_what_is_neither_true_nor_false_is_refused(argument: str) -> None:
    with pytest.raises(ValueError, match=f'{argument}:=yes: must be true or false'):
        launched('follower.launch.py', **{argument: 'yes'})


def test_what_is_given_reaches_every_node_that_takes_it() -> None:
    given = parameters('follower.launch.py', odom_child_rpy='[-1.5708, 0, -1.5708]',
                       camera_rpy='[0, 0.2, 0]', odom_twist_frame='odom', use_sim_time='true')
    for node, values in given.items():
        assert values['use_sim_time'] is True
        if node == 'black_box':
            continue
        assert values['odom_child_rpy'] == [-1.5708, 0.0, -1.5708]
        assert values['odom_twist_frame'] == 'odom'
        assert values.get('camera_rpy') == (
            [0.0, 0.2, 0.0] if node in ('relative_pose', 'planner') else None)


def test_limits_are_given_once_for_planner_and_bridge() -> None:
    given = parameters('follower.launch.py', a_max='2', v_max='0.4')
    limits = {node: (values.get('a_max'), values.get('v_max')) for node, values in given.items()}
    assert limits == {
        'relative_pose': (None, None), 'planner': (2.0, 0.4), 'mavlink_bridge': (2.0, 0.4),
        'black_box': (None, None)}


def test_a_file_of_several_cameras_reaches_those_who_take_it() -> None:
    nodes, _ = launched('follower.launch.py', config='/mine', cameras='/mine/two.yaml')
    for name, node in nodes.items():
        beside = [] if name == 'mavlink_bridge' else ['/mine/two.yaml']
        own = [] if name == 'black_box' else ['/mine/follower.yaml']
        assert node.parameters[:-1] == [*own, *beside]


@pytest.mark.parametrize('file', RECIPES)
def test_a_recipe_takes_every_argument_and_its_own_topics(file: str) -> None:
    nodes, said = launched(file, odom='/mine/odom', namespace='drone1', connection='tcp:a:1')
    for node in nodes.values():
        assert dict(node.remappings) == {
            'image_raw': said['image'], 'image_raw/compressed': f'{said["image"]}/compressed',
            'camera_info': said['camera_info'], 'odom': '/mine/odom'}
        assert node.namespace == 'drone1'
    assert nodes['mavlink_bridge'].parameters[-1]['connection'] == 'tcp:a:1'


@pytest.mark.parametrize('file', RECIPES)
def test_the_page_about_odometry_tells_of_every_recipe(file: str) -> None:
    assert f'`launch/{file}`' in PAGE
