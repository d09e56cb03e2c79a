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

Those of other nodes are read by their services.

A node has its parameters as a table of ``Spec`` and gives a ``build`` function that turns the
values into one frozen object of the pure core; both are in ``flock_follower.parameters``. Every
value, from the command line, a file or ``ros2 param set``, passes the same checks; a change is
taken whole or refused with a reason that names the parameter, its value and the valid range.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
import math
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, ClassVar, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
import yaml

from flock_follower.checks.topic_names import full_name
from flock_follower.files import resource
from flock_follower.nodes.support.diagnostics import internal_error
from flock_follower.parameters.files import FLOWN, shared, unheeded
from flock_follower.parameters.spec import (
    check_values,
    expanded,
    refuse_unknown,
    Spec,
)

T = TypeVar('T')
_NEIGHBORS = 'neighbors_file'


def descriptor(spec: Spec) -> ParameterDescriptor:
    """Return the descriptor that ``ros2 param describe`` shows."""
    valid = spec.range
    unit = f' [{valid.unit}]' if valid.unit else ''
    # Dynamic typing leaves the type check to Spec.check, which accepts 2 for 2.0.
    described = ParameterDescriptor(
        name=spec.name, description=spec.meaning + unit, read_only=not spec.live,
        additional_constraints=f'must be {spec.constraint}', dynamic_typing=True)
    if isinstance(spec.default, bool) or math.isinf(valid.low) or math.isinf(valid.high):
        return described
    if isinstance(spec.default, int):
        described.integer_range = [
            IntegerRange(from_value=int(valid.low), to_value=int(valid.high), step=0)]
    elif isinstance(spec.default, float):
        described.floating_point_range = [
            FloatingPointRange(from_value=valid.low, to_value=valid.high, step=0.0)]
    return described


def refuse_in_flight(start: Mapping[str, Any], now: Mapping[str, Any],
                     changes: Mapping[str, Any], flying: bool) -> None:
    """
    Refuse changes that would loosen the limits of a flight.

    ``a_max`` and ``v_max`` never exceed their values at the start, and are only lowered while
    flying. ``guard`` is not switched off while flying.

    :param start: values at the start of the node; :param now: values before the change.
    :raises ValueError: naming the parameter, its value and the valid range.
    """
    for name in ('a_max', 'v_max'):
        value = changes.get(name, 0.0)
        if value > start.get(name, math.inf):
            raise ValueError(f'{name} = {value!r}: must be at most {start[name]!r}, its value at '
                             'the start: restart the node to raise it')
        if flying and value > now.get(name, math.inf):
            raise ValueError(f'{name} = {value!r}: must be at most {now[name]!r}: in flight it '
                             'can only be lowered')
    if flying and now.get('guard') and not changes.get('guard', True):
        raise ValueError('guard = False: must be true: it cannot be switched off in flight')


class Parameters(Generic[T]):
    """
    The declared parameters of a node and the object built from them.

    ``values`` is the dictionary of the current values, ``current`` the result of ``build``.
    ``build`` raises ValueError for values that do not fit together (d0 above d1); the change is
    then refused with that reason.

    :param shared: values of the section ``follower`` in parameter files; the overrides of the
        node's own win.
    :raises ValueError: at construction, for an invalid or an unknown parameter override.
    """

    def __init__(self, node: Node, specs: Sequence[Spec], build: Callable[[dict[str, Any]], T],
                 flying: Callable[[], bool] | None = None,
                 shared: Mapping[str, Any] = MappingProxyType({})) -> None:
        given = {**shared, **{name: parameter.value for name, parameter
                              in node.get_parameters_by_prefix('').items()}}
        specs = expanded(specs, given)
        self._specs = {spec.name: spec for spec in specs}
        self._build = build
        refuse_unknown(node.get_parameters_by_prefix(''), self._specs, node.get_name())
        self.values: dict[str, Any] = check_values(specs, given)
        self.current: T = build(self.values)
        self._start = dict(self.values)
        self._flying = flying
        for spec in specs:
            if node.has_parameter(spec.name):
                node.undeclare_parameter(spec.name)
            node.declare_parameter(
                spec.name, self.values[spec.name], descriptor(spec), ignore_override=True)
        node.add_post_set_parameters_callback(self._apply)

    def check(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """
        Return the parameters converted to their declared types.

        :raises ValueError: if one is invalid, or they do not fit together.
        """
        checked = []
        changes: dict[str, Any] = {}
        for parameter in parameters:
            spec = self._specs.get(parameter.name)
            if spec is None or not spec.live:
                checked.append(parameter)  # rclpy refuses it
                continue
            changes[spec.name] = spec.check(parameter.value)
            checked.append(Parameter(spec.name, value=changes[spec.name]))
        if changes:
            if self._flying is not None:
                refuse_in_flight(self._start, self.values, changes, self._flying())
            self._build({**self.values, **changes})
        return checked

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        changes = {p.name: p.value for p in parameters if p.name in self._specs}
        if changes:
            values = {**self.values, **changes}
            self.current, self.values = self._build(values), values


class ValidatedNode(Node):
    """
    A node whose parameters pass a :class:`Parameters` table before rclpy sees them.

    ``parameter_files`` are those of the command line; ``runtime.run`` sets them. rclpy is silent
    if none of their sections is for the node.
    """

    parameter_files: ClassVar[Sequence[str]] = ()

    def __init__(self, name: str, **kwargs: Any) -> None:
        self._table: Parameters[Any] | None = None
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **kwargs)

    def declare(self, specs: Sequence[Spec], build: Callable[[dict[str, Any]], T],
                flying: Callable[[], bool] | None = None) -> Parameters[T]:
        """
        Declare the node's parameters; see :class:`Parameters`.

        :param flying: returns whether the vehicle flies by this node. If it is given, the changes
            that :func:`refuse_in_flight` names are refused.
        :raises ValueError: also for a parameter file that seems to mean the node and misses it.
        """
        for path in self.parameter_files:
            if warning := unheeded(path, self.get_fully_qualified_name()):
                self.get_logger().warning(warning)
        table = Parameters(self, specs, build, flying, shared(
            self.parameter_files, self.get_fully_qualified_name()))
        self._table = table
        return table

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all or none; the reason of a refusal names parameter, value and range."""
        if self._table is not None:
            try:
                parameter_list = self._table.check(parameter_list)
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(parameter_list)

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """Set one by one; see :meth:`set_parameters_atomically`."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]


class RemoteParameters:
    """
    Parameters of another node; ``values`` is None until it has answered.

    :param other: its name, in the namespace of ``node`` unless it begins with /.
    :param changed: is called with the values if they differ from those before.
    """

    def __init__(self, node: Node, other: str,
                 changed: Callable[[dict[str, Any]], None] = lambda _: None) -> None:
        self.values: dict[str, Any] | None = None
        self._node, self._other, self._changed = node, other, changed
        self._get = node.create_client(GetParameters, f'{other}/get_parameters')
        self._list: Client | None = None  # each client costs time whenever the executor waits

    def ask(self, names: Collection[str] = ()) -> bool:
        """
        Ask for parameters, for all if no names are given.

        Returns False if the other node was not found; one just started is found a moment later.
        """
        if not names and self._list is None:
            self._list = self._node.create_client(
                ListParameters, f'{self._other}/list_parameters')
        client = self._get if names else self._list
        assert client is not None
        if not (client.service_is_ready() and self._get.service_is_ready()):
            return False
        if names:
            self._get.call_async(GetParameters.Request(names=[*names])).add_done_callback(
                partial(self._take_values, [*names]))
        else:
            client.call_async(ListParameters.Request()).add_done_callback(
                lambda future: self.ask(future.result().result.names))
        return True

    def _take_values(self, names: list[str], future: Any) -> None:
        try:
            found = map(parameter_value_to_python, future.result().values)
            values = {name: list(value) if isinstance(value, array) else value
                      for name, value in zip(names, found)}
            if values != self.values:
                self.values = values
                self._changed(values)
        except Exception as error:  # would end the executor
            where = f'on parameters of {self._other}'
            if hasattr(self._node, 'diagnostics'):
                self._node.diagnostics.internal_error(where, error)
            else:
                self._node.get_logger().error(internal_error(error, where))


class FlownParameters:
    """
    Parameters of flying nodes as a parameter file for ``evaluate``; read again after each change.

    :param nodes: their names, in the namespace of ``node``.
    :param note: called with the name and the text of each new file.
    """

    def __init__(self, node: Node, nodes: Collection[str],
                 note: Callable[[str, str], None]) -> None:
        self._note = note
        full_names = [full_name(name, node.get_namespace()) for name in nodes]
        self._remote = {name: RemoteParameters(node, name, self._write) for name in full_names}
        self._due = set(full_names)

    def changed(self, name: str) -> None:
        """Take it that the node of a full name has new parameters, or has been started."""
        if name in self._remote:
            self._due.add(name)

    def ask(self) -> None:
        """Ask those nodes whose parameters are not known, if they run."""
        for name in sorted(self._due):
            self._due.discard(name)
            if not self._remote[name].ask():
                self._due.add(name)

    def _write(self, _: dict[str, Any]) -> None:
        """Write the files: the neighbours beside the parameters, which name them there."""
        files: dict[str, str] = {}
        by_node = {}
        for name, remote in sorted(self._remote.items()):
            if remote.values is None:
                continue
            own = {key: value for key, value in remote.values.items() if value is not None}
            if _NEIGHBORS in own and (own[_NEIGHBORS] or name.endswith('/relative_pose')):
                path = Path(own[_NEIGHBORS] or resource('config/neighbors.yaml'))
                with suppress(OSError, UnicodeDecodeError):  # its node reports that, if it must
                    text = path.read_text(encoding='utf-8')
                    file = next((key for key in files if files[key] == text),
                                f'neighbors{len(files) or ""}.yaml')
                    files[file], own[_NEIGHBORS] = text, file
            by_node[name.rsplit('/', 1)[-1]] = {'ros__parameters': own}
        for file, text in files.items():
            self._note(file, text)
        self._note(FLOWN, '# The parameters flown, as the nodes had them last.\n' + yaml.safe_dump(
            by_node, default_flow_style=False, allow_unicode=True))


_HOW = """\
Usage: {name} [--ros-args -p NAME:=VALUE -r FROM:=TO --params-file FILE]
  -p NAME:=VALUE      sets a parameter; more of them, each with its own -p
  --params-file FILE  sets those of a YAML file, such as {file}
  -r FROM:=TO         connects a topic to another name; -r __ns:=/drone1 puts all in a namespace

Parameters, of which `ros2 param set` changes those marked * in flight; see {page}:"""


def usage(module: ModuleType) -> str:
    """Return the text of a node's ``--help``: its module holds the description and ``SPECS``."""
    specs: Sequence[Spec] = getattr(module, 'SPECS', ())
    how = _HOW.format(name=Path(module.__file__ or '').stem.removesuffix('_node'),
                      page=_path_shown('config/PARAMETERS.md'),
                      file=_path_shown('config/follower.yaml'))
    rows = (f'  {spec.name:<26}{"*" if spec.live else " "} {spec.meaning}; '
            f'{spec.constraint}; default {_default_shown(spec)}' for spec in specs)
    return '\n'.join([(module.__doc__ or '').strip().replace('``', ''), '', how, *rows])


def _default_shown(spec: Spec) -> str:
    if spec.default in ('', ['']):
        return 'empty'
    return str(spec.default).lower() if isinstance(spec.default, bool) else str(spec.default)


def _path_shown(name: str) -> str:
    try:
        return str(resource(name))
    except OSError:
        return name
