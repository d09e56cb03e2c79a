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
Start a column on the desk: a simulator and the three nodes for each of several followers.

Follower i has the namespace follower_i, the MAVLink system id i, and a UDP port of its own; its
leader is follower i - 1, that of the first one the scenario's. Arm, change to offboard mode and
engage from the last to the first: the first one flies off.
"""

from pathlib import Path
import runpy
import sys
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from flock_follower.parameters.launch_arguments import refuse_arguments

MOST = 8  # each takes about one core
EACH = {'namespace', 'target_system', 'connection'}  # every follower has its own
ARGUMENTS = {
    'followers': ('2', f'how many, 1 to {MOST}'),
    'scenario': ('indoor', 'a name in config/scenarios, or the path of a .yaml file'),
    'seed': ('0', 'of everything that chance decides'),
    'port': ('14540', 'UDP port of the first one, on this machine only; the others have the next'),
}


def start(context: LaunchContext) -> list[Any]:
    """Return the launch actions of each follower."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if not (values['followers'].isdigit() and 1 <= int(values['followers']) <= MOST):
        raise ValueError(f'followers = {values["followers"]!r}: must be an integer in [1, {MOST}]')
    source = PythonLaunchDescriptionSource(
        str(Path(__file__).with_name('simulation.launch.py')))
    return [IncludeLaunchDescription(source, launch_arguments={
        'namespace': f'follower_{i}', 'system': str(i), 'scenario': values['scenario'],
        'seed': str(int(values['seed']) + i - 1), 'port': str(int(values['port']) + i - 1),
        'leader_topic': f'/follower_{i - 1}/truth/motion' if i > 1 else '',
        **({'view': 'false'} if i > 1 else {}),  # one page, that of the first
    }.items()) for i in range(1, int(values['followers']) + 1)]


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    of_follower = runpy.run_path(str(Path(__file__).with_name('follower.launch.py')))['ARGUMENTS']
    refuse_arguments(sys.argv, __file__, {*ARGUMENTS, *(of_follower.keys() - EACH)})
    arguments = [DeclareLaunchArgument(name, default_value=default, description=description)
                 for name, (default, description) in ARGUMENTS.items()]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
