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
The parameters of every node as Markdown, from the tables the nodes themselves use.

``python -m flock_desk.parameter_tables > config/PARAMETERS.md``
"""

from __future__ import annotations

from importlib import import_module

from flock_desk.program import PROGRAMS
from flock_follower.parameters.spec import Spec

NODES = ('relative_pose', 'planner', 'mavlink_bridge', 'flock', 'replay', 'simulator',
         'black_box', 'visualizer')
INTRODUCTION = """\
# Parameters

Set one at start with `--ros-args -p NAME:=VALUE`, or with a file (`--params-file`, see the files
beside this one). Those marked live can be set while the node runs:
`ros2 param set /planner v_max 0.4`. A value out of range, or a name no node knows, is refused with
the reason.

This page is made by `python -m flock_desk.parameter_tables`.
"""


def markdown() -> str:
    """Return the page."""
    sections = [INTRODUCTION]
    for node in NODES:
        specs: list[Spec] = import_module(PROGRAMS[node]).SPECS
        sections.append('\n'.join([
            f'## {node}\n', '| parameter | default | valid | live | meaning |',
            '|---|---|---|---|---|', *(_row(spec) for spec in specs), '']))
    return '\n'.join(sections)


def _row(spec: Spec) -> str:
    default = ('empty' if spec.default in ('', ['']) else
               str(spec.default).lower() if isinstance(spec.default, bool) else
               f'{spec.default:g}' if isinstance(spec.default, float) else str(spec.default))
    live = 'yes' if spec.live else ''
    return f'| `{spec.name}` | {default} | {spec.constraint} | {live} | {spec.meaning} |'


if __name__ == '__main__':
    print(markdown(), end='')
