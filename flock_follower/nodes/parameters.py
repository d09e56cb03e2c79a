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

A node lists its parameters as :class:`Spec` and gives a ``build`` function that turns the values
into one frozen object of the pure core. Every value, from the command line, a file or
``ros2 param set``, passes the same checks; a change is taken whole or refused with a reason that
names the parameter, its value and the valid range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import difflib
import math
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

Value = bool | int | float | str | list[float] | list[str]
T = TypeVar('T')


@dataclass(frozen=True)
class Spec:
    """
    One parameter: its name, default, meaning, unit and valid values.

    The type of ``default`` is the parameter's type; integers are accepted for a float.
    ``low`` and ``high`` bound a number inclusively. A list default fixes the length where
    ``fixed_length`` is set. ``read_only`` parameters are settable at start only.
    """

    name: str
    default: Value
    description: str
    unit: str = ''
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    fixed_length: bool = False
    read_only: bool = False

    @property
    def constraint(self) -> str:
        """Return the valid values in words, as used in errors and descriptors."""
        unit = f' {self.unit}' if self.unit else ''
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if isinstance(self.default, bool):
            return 'true or false'
        if isinstance(self.default, (int, float)):
            kind = 'an integer' if isinstance(self.default, int) else 'a number'
            return f'{kind} in [{self.low:g}, {self.high:g}]{unit}'
        if isinstance(self.default, list):
            size = f'{len(self.default)} ' if self.fixed_length else ''
            kind = 'strings' if self._holds_strings() else 'finite numbers'
            return f'a list of {size}{kind}{unit}'
        return 'a string'

    def _holds_strings(self) -> bool:
        return bool(isinstance(self.default, list) and self.default
                    and isinstance(self.default[0], str))

    def check(self, value: Any) -> Value:
        """
        Return the value in the parameter's type.

        :raises ValueError: naming the parameter, the value and what is valid.
        """
        checked = self._convert(value)
        if checked is None:
            raise ValueError(f'{self.name} = {value!r}: must be {self.constraint}')
        return checked

    def _convert(self, value: Any) -> Value | None:
        default = self.default
        if isinstance(default, bool):
            return value if isinstance(value, bool) else None
        if isinstance(default, str):
            valid = isinstance(value, str) and (not self.choices or value in self.choices)
            return value if valid else None
        if isinstance(default, list):
            return self._convert_list(value)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        if isinstance(default, int) and not isinstance(value, int):
            return None
        if not math.isfinite(value) or not self.low <= value <= self.high:
            return None
        return type(default)(value)

    def _convert_list(self, value: Any) -> Value | None:
        assert isinstance(self.default, list)
        if isinstance(value, (str, bytes)) or not hasattr(value, '__iter__'):
            return None
        items = list(value)
        if self.fixed_length and len(items) != len(self.default):
            return None
        if self._holds_strings():
            return items if all(isinstance(i, str) for i in items) else None
        numeric = all(isinstance(i, (int, float)) and not isinstance(i, bool)
                      and math.isfinite(i) for i in items)
        return [float(i) for i in items] if numeric else None

    def descriptor(self) -> ParameterDescriptor:
        """Return the descriptor that ``ros2 param describe`` shows."""
        unit = f' [{self.unit}]' if self.unit else ''
        # Dynamic typing leaves the type check to Spec.check, which accepts 2 for 2.0.
        descriptor = ParameterDescriptor(
            name=self.name, description=self.description + unit, read_only=self.read_only,
            additional_constraints=f'must be {self.constraint}', dynamic_typing=True)
        if isinstance(self.default, bool) or math.isinf(self.low) or math.isinf(self.high):
            return descriptor
        if isinstance(self.default, int):
            descriptor.integer_range = [
                IntegerRange(from_value=int(self.low), to_value=int(self.high), step=0)]
        elif isinstance(self.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=self.low, to_value=self.high, step=0.0)]
        return descriptor


class Parameters(Generic[T]):
    """
    The declared parameters of a node and the object built from them.

    ``values`` is the dictionary of the current values, ``current`` what ``build`` made of it.
    ``build`` raises ValueError for values that do not fit together (d0 above d1); the change is
    then refused with that reason and nothing is altered.

    :raises ValueError: at construction, for an invalid or an unknown parameter override.
    """

    def __init__(self, node: Node, specs: Sequence[Spec],
                 build: Callable[[dict[str, Any]], T]) -> None:
        self._specs = {spec.name: spec for spec in specs}
        self._build = build
        self._refuse_unknown(node)
        self.values: dict[str, Any] = {
            spec.name: spec.check(node.get_parameter(spec.name).value
                                  if node.has_parameter(spec.name) else spec.default)
            for spec in specs}
        self.current: T = build(self.values)
        for spec in specs:
            if node.has_parameter(spec.name):
                node.undeclare_parameter(spec.name)
            node.declare_parameter(
                spec.name, self.values[spec.name], spec.descriptor(), ignore_override=True)
        node.add_post_set_parameters_callback(self._apply)

    def _refuse_unknown(self, node: Node) -> None:
        # rclpy ignores overrides nobody declares: a mistyped a_max would silently do nothing.
        ours = set(self._specs)
        for name in sorted(node.get_parameters_by_prefix('')):
            if name in ours or name in _OF_RCLPY or name.startswith('qos_overrides.'):
                continue
            near = difflib.get_close_matches(name, ours, n=1)
            hint = f'did you mean {near[0]}?' if near else 'it has ' + ', '.join(sorted(ours))
            raise ValueError(f'unknown parameter {name} for node {node.get_name()}: {hint}')

    def check(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """
        Return the parameters converted to their declared types.

        :raises ValueError: where one is invalid, or they do not fit together.
        """
        checked = []
        changes: dict[str, Any] = {}
        for parameter in parameters:
            spec = self._specs.get(parameter.name)
            if spec is None or spec.read_only:
                checked.append(parameter)  # rclpy refuses it in its own words
                continue
            changes[spec.name] = spec.check(parameter.value)
            checked.append(Parameter(spec.name, value=changes[spec.name]))
        if changes:
            self._build({**self.values, **changes})
        return checked

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        changes = {p.name: p.value for p in parameters if p.name in self._specs}
        if changes:
            values = {**self.values, **changes}
            self.current, self.values = self._build(values), values


class ValidatedNode(Node):
    """A node whose parameters pass a :class:`Parameters` table before rclpy sees them."""

    def __init__(self, name: str, **kwargs: Any) -> None:
        self._table: Parameters[Any] | None = None
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **kwargs)

    def declare(self, specs: Sequence[Spec],
                build: Callable[[dict[str, Any]], T]) -> Parameters[T]:
        """Declare the node's parameters; see :class:`Parameters`."""
        table = Parameters(self, specs, build)
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


_OF_RCLPY = frozenset({'use_sim_time', 'start_type_description_service'})
