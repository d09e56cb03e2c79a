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

"""ROS 2 parameter files, read for all nodes at once."""

from __future__ import annotations

from pathlib import Path
import re
from typing import Any

import pytest
import yaml

from flock_follower.parameters import neighbors_file
from flock_follower.parameters.files import parse_parameters, read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.parameters.sections import files_in, ignored_sections, names_for_any_node
from flock_follower.parameters.spec import Spec
from flock_follower.planner.parameter_table import planner_params
from flock_follower.planner.params import Member, RADIUS, ROLES
from flock_follower.system.files import resource


def of(node: str, **values: Any) -> dict[str, Any]:
    return {node: {'ros__parameters': values}}


@pytest.mark.parametrize('section', ['planner', '/planner', '/drone1/planner', '/**/planner'])
def test_section_sets_its_parameters_others_have_defaults(section: str) -> None:
    values = parse_parameters(of(section, v_max=1, use_sim_time=True, qos_overrides={
        '/odom': {'depth': 5}}), TABLE)
    assert values['planner']['v_max'] == 1.0 and values['planner']['a_max'] == 2.5
    assert set(values) == {'relative_pose', 'planner', 'mavlink_bridge'}
    assert values['relative_pose']['camera_position'] == [0.1, 0.0, 0.0]


def test_common_file_holds_defaults_and_names_they_know() -> None:
    path = resource('config/follower.yaml')
    sections = yaml.safe_load(path.read_text())
    assert list(sections) == ['/**', *(f'/**/{node}' for node in TABLE)]
    defaults = parse_parameters(of('/**'), TABLE)
    assert read_parameters(path, TABLE) == defaults


def test_a_shared_parameter_holds_until_a_later_section_sets_it() -> None:
    values = parse_parameters({**of('/**', v_max=0.3, K=2.0), **of('planner', v_max=0.7)}, TABLE)
    assert values['planner']['v_max'] == 0.7 and values['planner']['K'] == 2.0
    assert values['mavlink_bridge']['v_max'] == 0.3


def test_a_node_knows_the_shared_names_of_its_namespace(tmp_path: Path) -> None:
    first, second = tmp_path / 'first.yaml', tmp_path / 'second.yaml'
    first.write_text(yaml.safe_dump({**of('/**', K=2.0, use_sim_time=True), **of('planner', m=1),
                                     **of('/other/*', connection='x')}))
    second.write_text(yaml.safe_dump(of('/drone1/**', **{'cameras': ['a'], 'camera.a.image': 'b'},
                                        depth=3)))
    flock = [Spec('depth', 1, 'queue depth')]
    assert names_for_any_node([first, second], '/drone1/flock', flock) == {
        'K', 'cameras', 'camera.a.image', 'depth'}
    assert names_for_any_node([first, second], '/flock', flock) == {'K'}
    second.write_text(yaml.safe_dump(of('/**', vmax=0.4)))
    with pytest.raises(ValueError, match='second.yaml: unknown parameter vmax .* mean v_max'):
        names_for_any_node([first, second], '/flock', flock)


@pytest.mark.parametrize(('document', 'message'), [
    (of('planner', vmax=1.0), 'unknown parameter vmax for node planner: did you mean v_max?'),
    (of('/**', amax=1.0), 'unknown parameter amax .*did you mean a_max?'),
    *((of(section, a_max=2.0), '/follower: no node has this name: .* shared parameters /[*][*],')
      for section in ('follower', '/**/follower')),
    (of('planner', v_max='fast'), "planner: v_max = 'fast': must be a number in "),
    (of('planner', connection='x'), 'unknown parameter connection for node planner'),
    (of('planer', v_max=1.0), 'unknown node /planer: did you mean planner?'),
    ({**of('relative_pose', cameras=['a']), **of('planner', cameras=['b'])},
     r"cameras = \['a'\] for relative_pose and \['b'\] for planner: must be the same$"),
    (of('planner', odom_twist_frame='odom'), "^odom_twist_frame = .*'odom' for planner.*same$"),
    ({**of('/**', cameras=['a']), **of('planner', **{'camera.a.rpy': [0.0, 0.0, 2.0]})},
     r'^camera.a.rpy = .* and \[0.0, 0.0, 2.0\] for planner: must be the same$'),
    *((of('/**', **{name: 0.1}), f'unknown parameter {name} .*: it was removed, ')
      for name in ('period', 'check_parameters', 'altitude_hold', 'j_max')),
    ({**of('/**', a_max=1.0), 'planner': {'v_max': 1.0}}, '^/planner/v_max = 1.0: must be below'),
    ({'planner': {'ros__parameters': 3}}, '^/planner/ros__parameters = 3: must be below'),
    *((document, '^the file = .*: must be below ros__parameters') for document in ('text', None)),
    (of('camera_driver', fps=30), 'holds ros__parameters neither of /[*][*] nor of relative')])
def test_what_is_wrong_is_named(document: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_parameters(document, TABLE)


def test_a_file_that_is_no_yaml_is_named_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    for content in (b'a: [', b'\xff\xfe\x00'):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f'^{re.escape(str(path))}: ') as error:
            read_parameters(path, TABLE)
        assert len(str(error.value).splitlines()) == 1


def test_command_line_files_are_those_of_ros_args() -> None:
    assert files_in(['planner', '--params-file', 'no.yaml', '--ros-args', '-p', 'v_max:=1.0',
                     '--params-file', 'a.yaml', '--', '--params-file', 'no.yaml', '--ros-args',
                     '--params-file', 'b.yaml']) == ['a.yaml', 'b.yaml']
    assert files_in(['planner']) == []


PARAMETERS = {'ros__parameters': {'v_max': 0.4}}


@pytest.mark.parametrize(('sections', 'node', 'said'), [
    (['plannner'], '/planner', 'error holds parameters for /plannner, but none for /planner: '
                               'name the section /planner, or /**/planner'),
    (['planner'], '/planner1', 'error holds parameters for /planner, but none for /planner1: '
                               'name the section /planner1, or /**/planner1'),
    (['planner', 'camera'], '/drone1/planner',
     'error holds parameters for /planner, but none for /drone1/planner: name the section '
     '/drone1/planner, or /**/planner'),
    (['/drone1/planner', '/drone2/planner'], '/drone2/planner', ''),
    (['/drone1/planner', '/**'], '/drone2/planner', ''),
    (['/**', 'plannner'], '/planner', '/plannner is another node: did you mean /planner?'),
    (['relative_pose', 'planner_server', 'camera'], '/planner',
     'holds no parameters for /planner, only for /camera, /drone3/camera, '
     '/planner_server, /relative_pose'),
    (['relative_pose', 'planner', 'camera', 'plannner'], '/planner', ''),
    ([], '/planner', 'holds no parameters for /planner, only for no node')])
def test_a_file_that_means_another_node_is_reported(
        tmp_path: Path, sections: list[str], node: str, said: str) -> None:
    path = tmp_path / 'x.yaml'
    nested = {'drone3': {'camera': PARAMETERS}} if sections else {}
    path.write_text(yaml.safe_dump({**dict.fromkeys(sections, PARAMETERS), **nested}))
    try:
        reported = ignored_sections(path, node)
    except ValueError as error:
        reported = f'error {error}'
    assert reported.replace(f'{path}: ', '') == said


def test_planner_reads_flock_members_from_neighbors_file(tmp_path: Path) -> None:
    document = yaml.safe_load(resource('config/neighbors.yaml').read_text())
    (leader,) = document['neighbors']
    document['neighbors'] += [{**leader, 'name': 'tower', 'marker_id': 1, 'role': 'avoid',
                               'radius': 0.5}]
    path = tmp_path / 'neighbors.yaml'
    path.write_text(yaml.safe_dump(document))
    values = parse_parameters(of('/**', neighbors_file=str(path), radius=0.2), TABLE)['planner']
    params = planner_params(values)
    assert params.vehicles == {'leader': Member(), 'tower': Member('avoid', 0.5)}
    assert params.radius == 0.2
    assert planner_params(values, 'tower').vehicles == {'leader': Member()}  # all but oneself
    path.unlink()  # a parameter that is set in flight does not read it again
    assert planner_params({**values, 'v_max': 0.3}).vehicles == params.vehicles
    assert planner_params({**values, 'neighbors_file': ''}).vehicles == {}
    with pytest.raises(FileNotFoundError):
        planner_params({**values, 'neighbors_file': '/nowhere.yaml'})


def test_planner_and_neighbors_file_know_same_roles_and_radii() -> None:
    assert (neighbors_file.ROLES, neighbors_file.RADII) == (ROLES, RADIUS)
    assert neighbors_file.MarkedNeighbor('x', ()).role == Member().role
