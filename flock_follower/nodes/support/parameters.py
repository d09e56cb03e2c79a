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
Parameters of a node: declared in one table, validated in one place, settable while flying.

A node has a table of ``Spec``, and a ``build`` function that makes one frozen object of the pure
core from the values; both are in the folder of the code that they configure. Every value, from the
command line, a file or ``ros2 param set``, passes the same checks. A change is applied completely,
or refused with the parameter, its value and the valid range.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
import math
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from flock_follower.parameters.spec import (
    check_values,
    expanded,
    refuse_unknown,
    Spec,
)

T = TypeVar('T')


def descriptor(spec: Spec) -> ParameterDescriptor:
    """Return the descriptor that ``ros2 param describe`` shows."""
    unit = f' [{spec.range.unit}]' if spec.range.unit else ''
    # Dynamic typing leaves the type check to Spec.check, which accepts 2 for 2.0.
    return ParameterDescriptor(
        name=spec.name, description=spec.meaning + unit, read_only=not spec.live,
        additional_constraints=f'must be {spec.constraint}', dynamic_typing=True)


def refuse_in_flight(start: Mapping[str, Any], now: Mapping[str, Any],
                     changes: Mapping[str, Any], flying: bool) -> None:
    """
    Refuse changes that would loosen the limits of a flight.

    ``a_max`` and ``v_max`` never exceed their values at the start; while flying they can only be
    lowered. ``guard`` cannot be switched off while flying.

    :param start: values at the start of the node; :param now: values before the change.
    :raises ValueError: naming the parameter, its value and the valid range.
    """
    most, why = (now, 'in flight it can only be lowered') if flying else (
        start, 'its value at the start: restart the node to raise it')
    for name in ('a_max', 'v_max'):
        if changes.get(name, 0.0) > most.get(name, math.inf):
            raise ValueError(f'{name} = {changes[name]!r}: must be at most {most[name]!r}: {why}')
    if flying and now.get('guard') and not changes.get('guard', True):
        raise ValueError('guard = False: must be true: it cannot be switched off in flight')


class Parameters(Generic[T]):
    """
    The declared parameters of a node and the object built from them.

    ``values`` is the dictionary of the current values, ``current`` the result of ``build``.
    ``build`` raises ValueError for values that contradict each other (d0 above d1); the change is
    then refused with this reason.

    :param flying: returns whether the vehicle flies by this node; see ``refuse_in_flight``.
    :param elsewhere: names of other nodes' parameters that a parameter file sets for all nodes;
        this node does not declare them.
    :raises ValueError: at construction, for an invalid or an unknown parameter override.
    """

    def __init__(self, node: Node, specs: Sequence[Spec], build: Callable[[dict[str, Any]], T],
                 flying: Callable[[], bool], elsewhere: Collection[str]) -> None:
        overrides = node.get_parameters_by_prefix('')
        given = {name: parameter.value for name, parameter in overrides.items()}
        self._specs = {spec.name: spec for spec in expanded(specs, given)}
        self._build, self._flying = build, flying
        of_others = overrides.keys() & elsewhere - self._specs.keys()
        refuse_unknown(overrides.keys() - of_others, self._specs, node.get_name())
        for name in of_others:
            node.undeclare_parameter(name)
        self.values: dict[str, Any] = check_values(specs, given)
        self.current: T = build(self.values)
        self._start = dict(self.values)
        for name, spec in self._specs.items():
            if node.has_parameter(name):
                node.undeclare_parameter(name)
            node.declare_parameter(
                name, self.values[name], descriptor(spec), ignore_override=True)
        node.add_post_set_parameters_callback(self._apply)

    def check(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """
        Return the parameters converted to their declared types.

        :raises ValueError: if a parameter is invalid, or the parameters contradict each other.
        """
        # Of the others rclpy refuses those that are unknown or not live.
        changes = {p.name: self._specs[p.name].check(p.value) for p in parameters
                   if p.name in self._specs and self._specs[p.name].live}
        if changes:
            refuse_in_flight(self._start, self.values, changes, self._flying())
            self._build({**self.values, **changes})
        return [Parameter(p.name, value=changes[p.name]) if p.name in changes else p
                for p in parameters]

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        changes = {p.name: p.value for p in parameters if p.name in self._specs}
        if changes:
            values = {**self.values, **changes}
            self.current, self.values = self._build(values), values


_HOW = """\
Usage: {name} [--ros-args -p NAME:=VALUE -r FROM:=TO --params-file FILE]
  -p NAME:=VALUE      sets a parameter; more of them, each with its own -p
  --params-file FILE  sets those of a YAML file, such as config/follower.yaml
  -r FROM:=TO         connects a topic to another name; -r __ns:=/drone1 puts all in a namespace

Parameters; `ros2 param set` changes those marked * in flight; see config/PARAMETERS.md:"""


def usage(module: ModuleType) -> str:
    """Return the text of a node's ``--help``: its module holds the description and ``SPECS``."""
    name = Path(module.__file__ or '').stem.removesuffix('_node')
    specs: Sequence[Spec] = getattr(module, 'SPECS', ())
    rows = (f'  {spec.name:<26}{"*" if spec.live else " "} {spec.meaning}; '
            f'{spec.constraint}; default {spec.default!r}' for spec in specs)
    return '\n'.join([(module.__doc__ or '').strip().replace('``', ''), '',
                      _HOW.format(name=name), *rows])
