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

"""Start the three nodes of a follower: relative_pose, planner and mavlink_bridge."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    'namespace': ('', 'namespace of every topic and service'),
    'use_sim_time': ('false', 'true when a bag is replayed'),
    'connection': ('udpin:127.0.0.1:14540', 'where the autopilot is'),
    'image_transport': ('raw', 'raw or compressed'),
    'config': (PathJoinSubstitution([FindPackageShare('flock_follower'), 'config']),
               'folder with a NODE.yaml for each node, and neighbors.yaml'),
}


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    config = LaunchConfiguration('config')
    own = {
        'relative_pose': {
            'image_transport': LaunchConfiguration('image_transport'),
            'neighbors_file': PathJoinSubstitution([config, 'neighbors.yaml']),
        },
        'planner': {},
        'mavlink_bridge': {'connection': LaunchConfiguration('connection')},
    }
    use_sim_time = ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    arguments = [DeclareLaunchArgument(name, default_value=default, description=description)
                 for name, (default, description) in ARGUMENTS.items()]
    nodes = [Node(package='flock_follower', executable=name, output='screen',
                  namespace=LaunchConfiguration('namespace'),
                  parameters=[PathJoinSubstitution([config, f'{name}.yaml']), parameters,
                              {'use_sim_time': use_sim_time}])
             for name, parameters in own.items()]
    return LaunchDescription([*arguments, *nodes])
