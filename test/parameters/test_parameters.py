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

"""The parameter table: pure checks, then a node that holds one."""

import pytest

from flock_follower.parameters.sections import ignored_sections
from flock_follower.parameters.spec import Spec
from flock_follower.ranges import Range

A_MAX = Spec('a_max', 2.5, 'largest acceleration', Range(0.1, 20.0, 'm/s^2'), live=True)
LOW = Spec('low', 1.0, 'lower bound', Range(0.0, 100.0, 'm'), live=True)
HIGH = Spec('high', 2.0, 'upper bound', Range(0.0, 100.0, 'm'), live=True)
FIXED = Spec('depth', 3, 'queue depth', Range(1, 10, whole=True))
SPECS = (A_MAX, LOW, HIGH, FIXED)


@pytest.mark.parametrize('spec, value, expected', [
    (A_MAX, 2, 2.0),
    (Spec('on', True, ''), False, False),
    (Spec('n', 1, '', Range(0, 5, whole=True)), 4, 4),
    (Spec('mode', 'a', '', ('a', 'b')), 'b', 'b'),
    (Spec('path', '', ''), 'x', 'x'),
    (Spec('rpy', [0.0, 0.0, 0.0], '', fixed_length=True), [1, 2, 3], [1.0, 2.0, 3.0]),
    (Spec('topics', [''], ''), ['a', 'b'], ['a', 'b']),
])
def test_a_valid_value_is_returned_in_the_declared_type(spec, value, expected):
    checked = spec.check(value)
    assert checked == expected and type(checked) is type(expected)


@pytest.mark.parametrize('spec, value', [
    (Spec('on', True, ''), 1),
    (Spec('n', 1, '', Range(0, 5, whole=True)), 2.5),
    (Spec('mode', 'a', '', ('a', 'b')), 'c'),
    (Spec('path', '', ''), 3),
    (Spec('rpy', [0.0, 0.0, 0.0], '', fixed_length=True), [1.0, 2.0]),
    (Spec('rpy', [0.0], ''), [float('nan')]),
    (Spec('topics', [''], ''), 'ab'),
    (Spec('topics', [''], ''), [1]),
])
def test_a_value_of_the_wrong_type_or_choice_is_refused(spec, value):
    with pytest.raises(ValueError, match=f'^{spec.name} = .*: must be '):
        spec.check(value)


def ordered(values):
    if values['low'] >= values['high']:
        raise ValueError(f'low = {values["low"]}: must be below high = {values["high"]}')
    return (values['a_max'], values['low'], values['high'])


@pytest.fixture
def make_node(ros):
    import rclpy

    from flock_follower.nodes.support.runtime import FlockNode
    nodes = []

    def make(*arguments):
        context = rclpy.Context()
        rclpy.init(args=['--ros-args', *arguments], context=context)
        node = FlockNode('tested', context=context)
        nodes.append(node)
        return node, node.declare(SPECS, ordered)

    yield make
    for node in nodes:
        context = node.context
        node.destroy_node()
        context.try_shutdown()


def test_live_change_is_applied_and_refused_one_changes_nothing(make_node):
    from rclpy.parameter import Parameter
    node, table = make_node('-p', 'a_max:=3')
    assert table.current == (3.0, 1.0, 2.0)
    assert node.set_parameters([Parameter('a_max', value=2)])[0].successful
    assert table.current == (2.0, 1.0, 2.0)
    for bad, reason in ((Parameter('a_max', value=99.0), 'a_max = 99.0: must be a number in'),
                        (Parameter('low', value=2.0), 'low = 2.0: must be below high = 2.0')):
        result = node.set_parameters([bad])[0]
        assert not result.successful and result.reason.startswith(reason)
    assert not node.set_parameters([Parameter('depth', value=6)])[0].successful  # not live
    assert table.current == (2.0, 1.0, 2.0)
    assert node.get_parameter('a_max').value == 2.0 and node.get_parameter('depth').value == 3
    assert node.set_parameters_atomically(
        [Parameter('low', value=10.0), Parameter('high', value=20.0)]).successful
    assert table.current == (2.0, 10.0, 20.0)  # which only fit together
    descriptor = node.describe_parameter('a_max')
    assert descriptor.description == 'largest acceleration [m/s^2]'
    assert descriptor.additional_constraints == 'must be a number in [0.1, 20] m/s^2'


@pytest.mark.ros
@pytest.mark.parametrize('namespace', ['/', '/drone1', '/a/b'])
@pytest.mark.parametrize('section', [
    'tested', '/tested', '/**', '/*', '**', '/**/tested', '/*/tested', 'drone1/tested',
    '/drone1/*', '/drone1/**', '/*/**', '/a/**/tested', '/testd'])
def test_what_is_told_of_a_file_is_what_ros_does_with_it(tmp_path, section, namespace):
    import rclpy

    from flock_follower.nodes.support.runtime import FlockNode
    path = tmp_path / 'x.yaml'
    path.write_text(f'{section!r}: {{ros__parameters: {{a_max: 3.0}}}}')
    context = rclpy.Context()
    rclpy.init(args=['--ros-args', '--params-file', str(path)], context=context)
    node = FlockNode('tested', namespace=namespace, context=context)
    try:
        silent = not ignored_sections(path, node.get_fully_qualified_name())
    except ValueError:
        silent = False
    assert node.has_parameter('a_max') == silent
    node.destroy_node()
    context.try_shutdown()
