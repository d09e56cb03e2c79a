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
The command ``flock_follower``: starts a node or a command by its name, where pip installed it.

``ros2 run flock_follower NAME`` does the same with ROS.
"""

from __future__ import annotations

from importlib import import_module
import sys
import textwrap
from typing import Final

#: The module of each program; all programs of `ros2 run`, and a few more.
PROGRAMS: Final = {
    **{name: f'flock_follower.nodes.{name}' for name in (
        'relative_pose', 'planner', 'mavlink_bridge', 'flock', 'sharing', 'replay', 'black_box',
        'visualizer', 'call')},
    'simulator': 'flock_desk.simulator_node', 'recorder': 'flock_desk.recorder_node',
    'check': 'flock_follower.check', 'follow': 'flock_follower.follow',
    **{name: f'flock_desk.{name}' for name in (
        'demo', 'evaluate', 'figures', 'flights', 'fly', 'marker')},
}


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


if __name__ == '__main__':
    sys.exit(main())
