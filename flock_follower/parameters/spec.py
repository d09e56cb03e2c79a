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
A parameter as a table row: name, default, meaning and valid values.

The nodes declare these tables to ROS; ``evaluate`` reads the same values from a file. Every value
passes the same checks, and every refusal names the parameter, its value and the valid range.
Unknown names are refused.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
import re
from typing import Any, TypeVar

from flock_follower.ranges import Checked, Range, suggestion

#: The parameter that lists the names of cameras. A parameter with the word EACH in its name exists
#: once for each camera: the camera's name replaces the word, also in the default.
CAMERAS, EACH = 'cameras', 'NAME'
#: Parameters that every ROS node has.
OF_EVERY_NODE = frozenset({'use_sim_time', 'start_type_description_service'})
#: Parameters of earlier versions, and the reason or the replacement.
REMOVED = {
    'altitude_hold': 'it is now altitude_mode: hold for true, or follow',
    'setpoint_mode': 'setpoints have acceleration and yaw, which both autopilots obey',
    'j_max': 'the jerk of setpoints is not limited: remove the line',
    'check_parameters': 'they are always compared: remove the line',
    'range_max': 'the bridge bounds the distance: set radius_max of mavlink_bridge',
    'silent_at_rest': 'the bridge requests hold mode 3 s after the last command',
    'paused': 'call replay/pause',
    'remap': 'remap as ROS does: -r odom:=vio',
    'wait_for': 'replay waits for a subscriber of each topic that it plays',
    'odom_tf': 'the visualizer broadcasts no transforms: remove the line',
    'rate': 'the visualizer always draws at 10 Hz: remove the line',
    **dict.fromkeys((
        'sigma', 'theta', 'T_g', 'handover_time', 'max_position_std', 'max_velocity_std',
        'angular_noise', 'attitude_noise', 'max_gap', 'max_extrapolation',
        'speed_horizon', 'blind_timeout', 'target_component', 'source_component',
        'position_std_max', 'yaw_std_max', 'word_age_max', 'clock_tolerance', 'seen_timeout',
        'position_drift', 'yaw_drift', 'odometry_noise', 'sighting_noise', 'tellers_max',
        'period', 'heard_timeout', 'brake_time_constant', 'response_time', 'altitude_frequency',
        'max_vertical_acceleration', 'jpeg_quality', 'file_size', 'kept'),
        'it is a constant now: remove the line')}
Value = bool | int | float | str | list[float] | list[str]


@dataclass(frozen=True)
class Spec:
    """
    One parameter: its name, default, meaning and valid values.

    The type of ``default`` is the parameter's type; integers are accepted for a float. ``valid``
    is the range of a number or of each number in a list, or the choices of a text. With
    ``fixed_length`` a list must be as long as its default. ``live`` parameters can be changed in
    flight, others only at the start.
    """

    name: str
    default: Value
    meaning: str
    valid: Range | tuple[str, ...] | None = None
    fixed_length: bool = False
    live: bool = False

    def named(self, name: str) -> Spec:
        """Return the declaration for the camera with a name."""
        default = self.default
        if isinstance(default, str):
            default = default.replace(EACH, name)
        return replace(self, name=self.name.replace(EACH, name), default=default)

    @cached_property
    def range(self) -> Range:
        """Return the valid values of a number, or of each number in a list."""
        valid = self.valid if isinstance(self.valid, Range) else Range()
        return replace(valid, whole=True) if isinstance(self.default, int) else valid

    @property
    def constraint(self) -> str:
        """Return the valid values in words, as used in errors and descriptors."""
        if isinstance(self.valid, tuple):
            return 'one of ' + ', '.join(self.valid)
        one = {bool: 'true or false', str: 'a string'}.get(type(self._example), str(self.range))
        if not isinstance(self.default, list):
            return one
        size = f'{len(self.default)} ' if self.fixed_length else ''
        several = re.sub('a (finite )?(number|string)', r'\1\2s', one)
        return f'a list of {size}{several}'

    @property
    def _example(self) -> bool | int | float | str:
        """Return the default, of a list its first element."""
        return self.default[0] if isinstance(self.default, list) else self.default

    def check(self, value: Any) -> Value:
        """
        Return the value, converted to the parameter's type.

        :raises ValueError: naming the parameter, the value and the valid range.
        """
        kind: Any = type(self._example)
        if not isinstance(self.default, list):
            if self._holds(value):
                return kind(value)
        elif hasattr(value, '__iter__') and not isinstance(value, (str, bytes)):
            items = list(value)
            length = len(self.default) if self.fixed_length else len(items)
            if len(items) == length and all(map(self._holds, items)):
                return [kind(item) for item in items]
        raise ValueError(f'{self.name} = {value!r}: must be {self.constraint}')

    def _holds(self, value: Any) -> bool:
        """Return whether a value, or an element of a list, is valid."""
        if isinstance(self._example, bool):
            return isinstance(value, bool)
        if isinstance(self._example, str):
            return isinstance(value, str) and (
                not isinstance(self.valid, tuple) or value in self.valid)
        return self.range.holds(value)


CAMERA_NAMES = Spec(
    CAMERAS, [''],
    'names of several cameras, each with parameters camera.NAME...; empty: a single camera, with '
    'camera_rpy')


def specs_of(params: Checked, prefix: str = '') -> list[Spec]:
    """
    Return a parameter for each declared field of ``params`` and of its parts.

    :param params: its values are the defaults.
    :param prefix: of the parameters' names.
    """
    found: list[Spec] = []
    for each in fields(params):  # type: ignore[arg-type]
        value, meta = getattr(params, each.name), each.metadata
        if isinstance(value, Checked):
            found += specs_of(value, prefix)
        elif meta.get('live') is not None:
            default = list(value) if isinstance(value, tuple) else value
            found.append(Spec(f'{prefix}{each.name}', default, meta['meaning'], meta['valid'],
                              isinstance(value, tuple), meta['live']))
    return found


P = TypeVar('P', bound=Checked)


def filled(params: P, values: Mapping[str, Any], prefix: str = '', **others: Any) -> P:
    """
    Return ``params`` and its parts with the values of a node's parameters.

    :param prefix: as in :func:`specs_of`.
    :param others: fields that are no parameters of a node.
    :raises ValueError: for values that are invalid, or contradict each other.
    """
    changes = dict(others)
    for each in fields(params):  # type: ignore[arg-type]
        part, name = getattr(params, each.name), f'{prefix}{each.name}'
        if isinstance(part, Checked):
            changes[each.name] = filled(part, values, prefix)
        elif name in values and each.metadata.get('live') is not None:
            value = values[name]
            changes[each.name] = tuple(value) if isinstance(part, tuple) else value
    return replace(params, **changes)  # type: ignore[type-var]


def check_values(specs: Sequence[Spec], values: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the value of every parameter, its default if none is given.

    :raises ValueError: for the first invalid value.
    """
    return {spec.name: spec.check(values.get(spec.name, spec.default))
            for spec in expanded(specs, values)}


def expanded(specs: Sequence[Spec], values: Mapping[str, Any]) -> list[Spec]:
    """
    Return the parameters, ``camera.NAME...`` replaced by those of each listed camera.

    :raises ValueError: if the list of names, among the values, is wrong.
    """
    if CAMERA_NAMES not in specs:
        return list(specs)
    cameras = _listed_cameras(values)
    return [spec if name is None else spec.named(name) for spec in specs
            for name in (cameras if EACH in spec.name else [None])]


def expanded_names(names: Iterable[str], values: Mapping[str, Any]) -> set[str]:
    """Return names of parameters as :func:`expanded` does; ValueError likewise."""
    cameras = _listed_cameras(values)
    return {name.replace(EACH, camera) for name in names
            for camera in (cameras if EACH in name else [EACH])}


def _listed_cameras(values: Mapping[str, Any]) -> list[str]:
    """Return the names of several cameras, [] of one; ValueError if the list is wrong."""
    value: Any = CAMERA_NAMES.check(values.get(CAMERAS, CAMERA_NAMES.default))
    names = [name for name in value if name]
    for name in names:
        if not re.fullmatch('[A-Za-z][A-Za-z0-9_]*', name) or names.count(name) > 1:
            raise ValueError(f'{CAMERAS} = {value}: {name!r} must be a letter, then letters, '
                             'digits and _, different from the others')
    return names


def refuse_unknown(names: Iterable[str], known: Collection[str], node: str) -> None:
    """
    Refuse names that are no parameters of a node: ROS would ignore these names.

    :raises ValueError: naming the parameter, and the most similar known name.
    """
    for name in sorted(names):
        if name in known or name in OF_EVERY_NODE or name.startswith('qos_overrides.'):
            continue
        hint = (f'it was removed, {REMOVED[name]}' if name in REMOVED else
                suggestion(name, known))
        raise ValueError(f'unknown parameter {name} for node {node}: {hint}')
