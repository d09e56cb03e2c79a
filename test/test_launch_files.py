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

from pathlib import Path
import re
import runpy
import sys
from typing import Any

from launch_files import Context, LAUNCH, launched, stand_ins
import pytest

from flock_follower.bags.parameter_table import BLACK_BOX
from flock_follower.mavlink.parameter_table import MAVLINK_BRIDGE
from flock_follower.perception.parameter_table import RELATIVE_POSE
from flock_follower.planner.parameter_table import PLANNER

PAGE = (LAUNCH.parent / 'docs' / 'sensors.md').read_text(encoding='utf-8')
SPECS = {'relative_pose': RELATIVE_POSE, 'planner': PLANNER, 'mavlink_bridge': MAVLINK_BRIDGE,
         'black_box': BLACK_BOX}
RECIPES = ('d435i_openvins', 'd435i_vins_fusion', 'd435i_rtabmap', 't265', 'usb_camera')
FOLLOWER, CAMERA = 'follower.launch.py', 'camera.launch.py'
END_WITH_LAUNCH = ['setpriv', '--pdeathsig', 'TERM']


def parameters(file: str, **arguments: str) -> dict[str, dict[str, Any]]:
    """Return the parameters of each node beside those of files."""
    return {name: node.parameters[-1] for name, node in launched(file, **arguments)[0].items()}


@pytest.mark.parametrize(('file', 'arguments'), [
    (FOLLOWER, {}), *((CAMERA, {'recipe': recipe}) for recipe in RECIPES)])
def test_every_node_has_the_parameters_that_it_is_given(
        file: str, arguments: dict[str, str]) -> None:
    given = parameters(file, **arguments)
    assert given.keys() == SPECS.keys()
    for node, values in given.items():
        known = {spec.name: spec for spec in SPECS[node]}
        assert values.pop('use_sim_time') is False
        for name, value in values.items():
            known[name].check(value)


@pytest.mark.parametrize('recipe', RECIPES)
def test_a_recipe_takes_every_argument_and_has_its_own_topics(recipe: str) -> None:
    nodes, values = launched(CAMERA, recipe=recipe, odom='/mine/odom', namespace='drone1',
                             connection='tcp:a:1')
    for node in nodes.values():
        assert dict(node.remappings) == {
            'image_raw': values['image'], 'image_raw/compressed': f'{values["image"]}/compressed',
            'camera_info': values['camera_info'], 'odom': '/mine/odom'}
        assert node.namespace == 'drone1'
    assert nodes['mavlink_bridge'].parameters[-1]['connection'] == 'tcp:a:1'
    assert f'`{recipe}`' in PAGE


@pytest.mark.parametrize(('file', 'valid', 'wrong', 'hint'), [
    (FOLLOWER, 'odom:=/vio', 'odm:=/vio', 'did you mean odom'),
    (FOLLOWER, 'record:=false', 'recipe:=t265', ''),
    (CAMERA, 'recipe:=t265', 'v_maxx:=1.0', 'did you mean v_max'),
    ('simulation.launch.py', 'v_max:=1.0', 'connection:=tcp:a:1', ''),
    ('flock.launch.py', 'followers:=3', 'namespace:=x', '')])
def test_unknown_argument_is_refused_with_nearest_name(
        monkeypatch: pytest.MonkeyPatch, file: str, valid: str, wrong: str, hint: str) -> None:
    def load(*command_line: str) -> None:
        monkeypatch.setattr(sys, 'argv', ['ros2', 'launch', *command_line])
        with stand_ins():
            runpy.run_path(str(LAUNCH / file))['generate_launch_description']()
    load('flock_follower', file, valid)
    load('mine.launch.py', wrong)  # an argument of the file that includes it
    with pytest.raises(ValueError, match=f'^{wrong}: unknown argument of {file}: .*{hint}'):
        load('flock_follower', file, valid, wrong)


def test_nodes_are_started_by_choice_and_with_given_command() -> None:
    nodes, _ = launched(FOLLOWER)
    assert all(node.respawn and 0.0 < node.respawn_delay < 3.0 for node in nodes.values())
    nodes, _ = launched(FOLLOWER, visualize='true', record='false', respawn='false',
                        odom='/vio/odom', bridge_prefix='taskset -c 3')
    assert nodes.keys() == {*SPECS, 'visualizer'} - {'black_box'}
    assert not any(node.respawn for node in nodes.values())
    assert {name: node.prefix.split() for name, node in nodes.items()} == {
        name: [*END_WITH_LAUNCH, *(['taskset', '-c', '3'] if name == 'mavlink_bridge' else [])]
        for name in nodes}
    assert ('odom', '/vio/odom') in nodes['visualizer'].remappings
    nodes, _ = launched(FOLLOWER, view='true')
    assert nodes.keys() == {*SPECS, 'view'}
    assert not nodes['view'].respawn  # if its port is busy, it would be refused for ever


def column(**arguments: str) -> list[dict[str, str]]:
    """Return the arguments that launch/flock.launch.py gives each follower."""
    with stand_ins():
        start = runpy.run_path(str(LAUNCH / 'flock.launch.py'))['start']
        return [dict(included.launch_arguments) for included in start(Context({
            'followers': '2', 'scenario': 'indoor', 'seed': '0', 'port': '14540', **arguments}))]


def test_a_column_gives_out_namespaces_ids_and_ports() -> None:
    assert column(followers='3', seed='7') == [
        {'namespace': f'follower_{i}', 'system': str(i), 'scenario': 'indoor',
         'seed': str(6 + i), 'port': str(14539 + i),
         'leader_topic': f'/follower_{i - 1}/truth/motion' if i > 1 else '',
         **({'view': 'false'} if i > 1 else {})} for i in (1, 2, 3)]
    for followers in ('0', '9', 'two'):
        with pytest.raises(ValueError, match=r'must be an integer in \[1, 8\]'):
            column(followers=followers)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Return a copy of the folder of parameters, with the file of two cameras."""
    for name in ('follower.yaml', 'neighbors.yaml', 'two_cameras.yaml'):
        (tmp_path / name).write_text((LAUNCH.parent / 'config' / name).read_text())
    return tmp_path


@pytest.mark.parametrize('name', ['follower.yaml', 'neighbors.yaml', 'two_cameras.yaml'])
@pytest.mark.parametrize('fault', ['missing', 'unreadable', 'a folder', 'no YAML'])
def test_parameter_file_is_refused_by_name_not_replaced(
        config: Path, name: str, fault: str) -> None:
    path = config / name
    arguments = {'config': str(config), 'cameras': str(config / 'two_cameras.yaml')}
    launched(FOLLOWER, **arguments)
    path.unlink()
    if fault == 'unreadable':
        path.symlink_to('/proc/self/mem')
    elif fault == 'a folder':
        path.mkdir()
    elif fault == 'no YAML':
        path.write_text('{')
    with pytest.raises((OSError, ValueError)) as error:
        launched(FOLLOWER, **arguments)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(('argument', 'text', 'said'), [
    ('connection', 'udp:nowhere', "connection = 'udp:nowhere': must be udpin:"),
    ('connection', '/dev/ttyACM0:1234567', 'baud rate must be one of'),
    ('v_max', '-1.0', 'v_max = -1.0: must be'), ('camera_rpy', '[0.0]', 'camera_rpy = '),
    ('image_transport', 'jpg', "image_transport = 'jpg': must be one of"),
    ('target_system', '300', 'target_system = 300: must be')])
def test_value_that_no_node_takes_ends_launch_without_respawn(
        argument: str, text: str, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        launched(FOLLOWER, **{argument: text})


@pytest.mark.parametrize(('node', 'setting', 'arguments', 'said'), [
    ('planner', 'd0: 9.0', {}, 'd0 = 9.0'),
    ('planner', 'v_max: 1.5', {'a_max': '1.5'}, 'a_max = 1.5'),
    ('mavlink_bridge', 'v_max: 1.5', {'a_max': '1.5'}, 'a_max = 1.5'),
    ('mavlink_bridge', 'signing_key_file: /nowhere', {}, "signing_key_file = '/nowhere'"),
    ('mavlink_bridge', 'global_origin: [91.0, 8.5, 4.0]', {}, 'latitude'),
    ('relative_pose', 'odometry: none', {'cameras': '{}/two_cameras.yaml'}, 'odometry = none')])
def test_what_would_end_a_node_at_each_start_ends_the_launch(
        config: Path, node: str, setting: str, arguments: dict[str, str], said: str) -> None:
    given = {name: text.format(config) for name, text in arguments.items()}
    own = config / 'follower.yaml'
    text = own.read_text()
    for vehicle in ('other', 'mine'):  # what another vehicle has ends nothing
        own.write_text(f'{text}/{vehicle}/{node}: {{ros__parameters: {{{setting}}}}}\n')
        if vehicle == 'other':
            launched(FOLLOWER, config=str(config), namespace='mine', **given)
    with pytest.raises(ValueError, match=re.escape(said)):
        launched(FOLLOWER, config=str(config), namespace='mine', **given)


def test_empty_argument_leaves_parameter_to_files(config: Path) -> None:
    own, two = str(config / 'follower.yaml'), str(config / 'two_cameras.yaml')
    nodes, _ = launched(FOLLOWER, config=str(config), cameras=two)
    neighbors = str(config / 'neighbors.yaml')
    assert {name: node.parameters for name, node in nodes.items()} == {
        'relative_pose': [own, two, {
            'image_transport': 'raw', 'neighbors_file': neighbors,
            'use_sim_time': False}],
        'planner': [own, two, {
            'neighbors_file': neighbors, 'use_sim_time': False}],
        'mavlink_bridge': [own, {
            'connection': 'udpin:127.0.0.1:14540', 'use_sim_time': False}],
        'black_box': [two, {'image_transport': 'raw', 'use_sim_time': False}]}
    for node in nodes.values():
        assert all(name == other for name, other in node.remappings)


def test_an_argument_reaches_every_node_that_takes_it() -> None:
    given = parameters(
        FOLLOWER, odom_child_rpy='[-1.5708, 0, -1.5708]', camera_rpy='[0, 0.2, 0]',
        odom_twist_frame='odom', use_sim_time='true', a_max='2', v_max='0.4',
        record_folder='/mine', record_images='none', image_transport='compressed')
    odometry = {'odom_child_rpy': [-1.5708, 0.0, -1.5708], 'odom_twist_frame': 'odom'}
    limits, camera = {'a_max': 2.0, 'v_max': 0.4}, {'camera_rpy': [0.0, 0.2, 0.0]}
    common = {'neighbors_file', 'use_sim_time', 'connection'}
    assert all(values['use_sim_time'] is True for values in given.values())
    assert {node: {name: value for name, value in values.items() if name not in common}
            for node, values in given.items()} == {
        'relative_pose': {**odometry, **camera, 'image_transport': 'compressed'},
        'planner': {**odometry, **camera, **limits}, 'mavlink_bridge': {**odometry, **limits},
        'black_box': {'image_transport': 'compressed', 'record_folder': '/mine',
                      'record_images': 'none'}}


@pytest.mark.parametrize(('argument', 'text', 'expected'), [
    ('disk_used', '2e4', 20000.0), ('disk_used', '500', 500), ('record_folder', '2026', '2026')])
def test_a_number_is_given_as_a_number_and_a_name_as_a_string(
        argument: str, text: str, expected: object) -> None:
    given = parameters(FOLLOWER, **{argument: text})['black_box'][argument]
    assert (given, type(given)) == (expected, type(expected))


@pytest.mark.parametrize(('file', 'argument', 'text', 'valid'), [
    (FOLLOWER, 'disk_used', '8GB', 'a number'), (FOLLOWER, 'record', 'yes', 'true or false'),
    (CAMERA, 'recipe', 't256', 'one of d435i_openvins, ')])
def test_an_invalid_value_is_refused(file: str, argument: str, text: str, valid: str) -> None:
    with pytest.raises(ValueError, match=f'{argument}:={text}: must be {valid}'):
        launched(file, **{argument: text})


def test_detector_launch_starts_perception_without_odometry() -> None:
    nodes, _ = launched('detector.launch.py', image='/cam/image', camera_info='/cam/info',
                        namespace='lab')
    assert nodes.keys() == {'relative_pose'}
    node, known = nodes['relative_pose'], {spec.name: spec for spec in RELATIVE_POSE}
    for name, value in node.parameters[-1].items():
        known[name].check(value)
    assert node.parameters[-1]['odometry'] == 'none' and node.namespace == 'lab'
    assert dict(node.remappings)['image_raw/compressed'] == '/cam/image/compressed'
    with pytest.raises(OSError):
        launched('detector.launch.py', neighbors_file='/none.yaml')
