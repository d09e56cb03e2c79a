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

"""What a node prints for ``--help``: what it is, how to start it, and its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from flock_follower.parameters.spec import Spec
from flock_follower.resources import resource

_HOW = """\
Usage: {name} [--ros-args -p NAME:=VALUE -r FROM:=TO --params-file FILE]
  -p NAME:=VALUE      sets a parameter; more of them, each with its own -p
  --params-file FILE  sets those of a YAML file, such as {file}
  -r FROM:=TO         connects a topic to another name; -r __ns:=/drone1 puts all in a namespace

Parameters, of which `ros2 param set` changes those marked * in flight; see {page}:"""


def asked_for(arguments: Sequence[str]) -> bool:
    """Return whether a command line asks for help, before what is ROS's."""
    own = _before_ros(arguments)
    return '-h' in own or '--help' in own


def misplaced(arguments: Sequence[str]) -> str:
    """
    Return the first option or NAME:=VALUE that stands before ``--ros-args``, '' for none.

    ROS skips such an argument without a word: the parameter that it sets would keep its default.
    """
    return next((argument for argument in _before_ros(arguments)
                 if argument.startswith('-') or ':=' in argument), '')


def _before_ros(arguments: Sequence[str]) -> list[str]:
    own = list(arguments)
    return own[:own.index('--ros-args')] if '--ros-args' in own else own


def usage(module: ModuleType) -> str:
    """Return the help of a node: its module holds the description and ``SPECS``."""
    specs: Sequence[Spec] = getattr(module, 'SPECS', ())
    how = _HOW.format(name=Path(module.__file__ or '').stem.removesuffix('_node'),
                      page=_shown('config/PARAMETERS.md'),
                      file=_shown('config/follower.yaml'))
    rows = (f'  {spec.name:<26}{"*" if spec.live else " "} {spec.meaning}; '
            f'{spec.constraint}; default {_default(spec)}' for spec in specs)
    return '\n'.join([(module.__doc__ or '').strip().replace('``', ''), '', how, *rows])


def _default(spec: Spec) -> str:
    if spec.default in ('', ['']):
        return 'empty'
    return str(spec.default).lower() if isinstance(spec.default, bool) else str(spec.default)


def _shown(name: str) -> str:
    try:
        return str(resource(name))
    except OSError:
        return name
