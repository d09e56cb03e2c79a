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
The command ``flock_follower`` of a pip installation: starts a node or a command by its name.

``ros2 run flock_follower NAME`` does the same with ROS. The parameters of every node as Markdown:
``python -m flock_desk.program --parameters > config/PARAMETERS.md``.
"""

from __future__ import annotations

from importlib import import_module
import sys
import textwrap
from typing import Final

from flock_follower.parameters.spec import Spec

#: The module of each program; all programs of `ros2 run`, and a few more.
PROGRAMS: Final = {
    **{name: f'flock_follower.nodes.{name}' for name in (
        'relative_pose', 'planner', 'mavlink_bridge', 'flock', 'sharing', 'replay', 'black_box',
        'visualizer', 'view', 'call')},
    'simulator': 'flock_desk.simulator_node', 'recorder': 'flock_desk.recorder_node',
    'check': 'flock_follower.check', 'follow': 'flock_follower.follow',
    **{name: f'flock_desk.{name}' for name in (
        'demo', 'evaluate', 'figures', 'flights', 'fly', 'marker')},
}
#: The nodes on the page of parameters.
NODES: Final = ('relative_pose', 'planner', 'mavlink_bridge', 'flock', 'replay', 'simulator',
                'black_box', 'visualizer', 'view')
INTRODUCTION: Final = """\
# Parameters

Set one at start with `--ros-args -p NAME:=VALUE`, or with a file (`--params-file`, see the files
beside this one). Those marked live can be set while the node runs:
`ros2 param set /planner v_max 0.4`. A value out of range, or a name no node knows, is refused with
the reason.

This page is made by `python -m flock_desk.program --parameters`.
"""


def usage() -> str:
    """Return the usage of the command, with the programs."""
    names = textwrap.fill(' '.join(PROGRAMS), initial_indent='  ', subsequent_indent='  ')
    return f'usage: flock_follower NAME [ARGUMENT ...], where NAME is one of\n{names}'


def main() -> int:
    """Start the program that the first argument names, and return its exit code."""
    name = sys.argv[1] if len(sys.argv) > 1 else '--help'
    if name in ('-h', '--help'):
        print(usage())
        return 0
    if name == '--parameters':
        print(markdown(), end='')
        return 0
    if name not in PROGRAMS:
        print(f'error: {name}: no such program\n{usage()}', file=sys.stderr)
        return 2
    sys.argv = [f'flock_follower {name}', *sys.argv[2:]]
    try:
        program = import_module(PROGRAMS[name])
    except ModuleNotFoundError as error:
        if (error.name or 'flock_desk').startswith(('flock_follower', 'flock_desk')):
            raise
        print(f'error: {name} needs {error.name}, which is not installed: in the folder of the '
              "package run pip install '.[runtime]'; with ROS, source its setup.bash",
              file=sys.stderr)
        return 1
    code: int = program.main()
    return code


def markdown() -> str:
    """Return the page of all parameters, from the tables that the nodes use."""
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
    sys.exit(main())
