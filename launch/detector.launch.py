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
Start relative_pose as a marker detector alone: one camera, no odometry, no autopilot.

It publishes neighbors/NAME/pose, neighbors and /tf in the optical frame of the camera.
"""

import sys

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from flock_follower.parameters.launch_arguments import END_WITH_LAUNCH, refuse_arguments
from flock_follower.parameters.neighbors_file import load

ARGUMENTS = {
    'namespace': ('', 'namespace of every topic'),
    'image': ('image_raw', 'topic of the images; of compressed ones without /compressed'),
    'image_transport': ('raw', 'raw or compressed'),
    'camera_info': ('camera_info', 'topic of their calibration'),
    'neighbors_file': (PathJoinSubstitution([
        FindPackageShare('flock_follower'), 'config', 'neighbors.yaml']),
        'markers: their sizes, and where they are on each body'),
}


def start(context: LaunchContext) -> list[Node]:
    """Return the node as the arguments say."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    load(values['neighbors_file'])  # a node with an invalid file would only end
    return [Node(
        package='flock_follower', executable='relative_pose', exec_name='relative_pose',
        output='screen', prefix=f'{END_WITH_LAUNCH} ', namespace=values['namespace'],
        parameters=[{'odometry': 'none', 'image_transport': values['image_transport'],
                     'neighbors_file': values['neighbors_file']}],
        remappings=[('image_raw', values['image']),
                    ('image_raw/compressed', f'{values["image"]}/compressed'),
                    ('camera_info', values['camera_info'])])]


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    refuse_arguments(sys.argv, __file__, ARGUMENTS)
    arguments = [DeclareLaunchArgument(name, default_value=default, description=description)
                 for name, (default, description) in ARGUMENTS.items()]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
