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
Start a flight on the desk: the simulator, and the three nodes of a follower.

The exit code is 1 if the simulator ends with an error, or because the machine is too busy; then
its last line begins with ``too busy:``.
"""

import os
from pathlib import Path
import runpy
import sys

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    IncludeLaunchDescription,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from flock_follower.parameters.launch_arguments import END_WITH_LAUNCH, refuse_arguments

FOLLOWER = str(Path(__file__).with_name('follower.launch.py'))
ARGUMENTS = {
    'namespace': ('', 'namespace of every topic and service'),
    'scenario': ('indoor', 'a name in config/scenarios, or the path of a .yaml file'),
    'seed': ('0', 'of everything that chance decides'),
    'port': ('14540', 'UDP port, on this machine only, between autopilot and bridge'),
    'system': ('1', 'MAVLink system id of the autopilot'),
    'visualize': ('true', 'visualizer, too, which draws the flight for RViz and Foxglove'),
    'view': ('false' if os.environ.get('VIEW') == 'no' else 'true',
             'view, too, a live page at http://127.0.0.1:8090; false, or VIEW=no: none'),
    'record': ('false', 'true: a black box records the flight'),
    'leader_topic': ('', "truth/motion of another follower's simulator: that is the leader"),
}


def generate_launch_description() -> LaunchDescription:
    """
    Return the launch description.

    It hovers until ``mavlink_bridge/offboard`` and ``planner/engage`` are called, and ends with
    the scenario. Limits and band are those of ``config``, not of the scenario.
    """
    of_follower = runpy.run_path(FOLLOWER)['ARGUMENTS'].keys() - {'connection', 'target_system'}
    refuse_arguments(sys.argv, __file__, {*ARGUMENTS, *of_follower})
    port = LaunchConfiguration('port')
    simulator = Node(
        package='flock_follower', executable='simulator', exec_name='simulator', output='screen',
        prefix=END_WITH_LAUNCH,
        namespace=LaunchConfiguration('namespace'), parameters=[{
            'scenario': LaunchConfiguration('scenario'),
            'seed': ParameterValue(LaunchConfiguration('seed'), value_type=int),
            'target_system': ParameterValue(LaunchConfiguration('system'), value_type=int),
            'leader_topic': ParameterValue(LaunchConfiguration('leader_topic'), value_type=str),
            'end_if_busy': True,
            'connection': ParameterValue(['127.0.0.1:', port], value_type=str)}])
    follower = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(FOLLOWER),
        launch_arguments={'namespace': LaunchConfiguration('namespace'),
                          'record': LaunchConfiguration('record'),
                          'target_system': LaunchConfiguration('system'),
                          'visualize': LaunchConfiguration('visualize'),
                          'view': LaunchConfiguration('view'),
                          'connection': ['udpin:127.0.0.1:', port]}.items())
    arguments = [DeclareLaunchArgument(name, default_value=default, description=description)
                 for name, (default, description) in ARGUMENTS.items()]
    end = RegisterEventHandler(OnProcessExit(target_action=simulator, on_exit=flown))
    return LaunchDescription([*arguments, follower, simulator, end])


def flown(event: ProcessExited, context: LaunchContext) -> EmitEvent:
    """
    End the launch with the simulator.

    :raises RuntimeError: if the simulator failed: launch prints it and ends with exit code 1.
    """
    if event.returncode:
        raise RuntimeError(f'the simulator ended with exit code {event.returncode}')
    return EmitEvent(event=Shutdown(reason='flown'))
