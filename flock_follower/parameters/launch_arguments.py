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

"""Refuses unknown arguments of launch files."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from flock_follower.ranges import suggestion

#: A launch that is terminated leaves its nodes running: the kernel ends each node with its launch.
END_WITH_LAUNCH = 'setpriv --pdeathsig TERM'


def refuse_arguments(command_line: Sequence[str], file: str, known: Collection[str]) -> None:
    """
    Refuse an argument that a launch file does not have: ROS would ignore it.

    Nothing is checked unless the command line names the file: another launch file that includes
    it may have arguments of its own.

    :param command_line: ``sys.argv``.
    :param file: path of the launch file; :param known: names of its arguments, and of the
        arguments of the files that it includes.
    :raises ValueError: naming the argument, and the most similar known name.
    """
    if not any(Path(word).name == Path(file).name for word in command_line):
        return
    for word in command_line:
        name, assigned, _ = word.partition(':=')
        if assigned and name not in known:
            raise ValueError(f'{word}: unknown argument of {Path(file).name}: '
                             f'{suggestion(name, known)}')
