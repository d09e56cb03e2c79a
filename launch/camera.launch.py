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
Start a follower with the topics and the mounting of a known camera and odometry: `recipe:=t265`.

Start camera and odometry separately; docs/sensors.md explains how to measure the values set here.
Every argument of follower.launch.py is valid, and beats the value of the recipe.
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

FOLLOWER = str(Path(__file__).with_name('follower.launch.py'))
#: RealSense D435i: the left infrared image, emitter off. The IMU is 12 mm behind the lens, 6 mm to
#: its right and 5 mm above; its axes are the camera's: x right, y down, z ahead.
D435I = {
    'image': '/camera/camera/infra1/image_rect_raw',
    'camera_info': '/camera/camera/infra1/camera_info',
    'camera_position': '[0.10, 0.0, 0.0]', 'camera_rpy': '[0.0, 0.0, 0.0]',
    'odom_child_position': '[0.088, -0.006, 0.005]', 'odom_child_rpy': '[-1.5708, 0.0, -1.5708]'}
#: By the name of the recipe, the arguments of follower.launch.py that it sets.
RECIPES = {
    'd435i_openvins': {**D435I, 'odom': '/ov_msckf/odomimu'},
    'd435i_vins_fusion': {**D435I, 'odom': '/imu_propagate'},
    # camera_link is the left infrared lens; its axes are x ahead, y left, z up.
    'd435i_rtabmap': {**D435I, 'odom': '/odom', 'odom_child_position': '[0.10, 0.0, 0.0]',
                      'odom_child_rpy': '[0.0, 0.0, 0.0]'},
    # The left fisheye lens; the odometry is that of the middle between the lenses.
    't265': {'image': '/camera/fisheye1/image_raw', 'camera_info': '/camera/fisheye1/camera_info',
             'odom': '/camera/odom/sample',
             'camera_position': '[0.10, 0.032, 0.0]', 'camera_rpy': '[0.0, 0.0, 0.0]',
             'odom_child_position': '[0.10, 0.0, 0.0]', 'odom_child_rpy': '[0.0, 0.0, 0.0]'},
    # usb_cam; mavlink/odom as odom is the autopilot's own.
    'usb_camera': {'image': '/image_raw', 'camera_info': '/camera_info', 'odom': '/odom',
                   'camera_position': '[0.10, 0.0, 0.0]', 'camera_rpy': '[0.0, 0.0, 0.0]'},
}
ARGUMENTS = {
    'recipe': (None, f'camera and odometry: {", ".join(RECIPES)}'),
}


def declare(context: LaunchContext) -> list[Any]:
    """Return the arguments with the values of the recipe as their defaults."""
    recipe = LaunchConfiguration('recipe').perform(context)
    if recipe not in RECIPES:
        raise ValueError(f'recipe:={recipe}: must be one of {", ".join(RECIPES)}')
    return [DeclareLaunchArgument(name, default_value=default, description='of the recipe')
            for name, default in RECIPES[recipe].items()]


def generate_launch_description() -> LaunchDescription:
    """Return the launch description; the file included takes the arguments declared here."""
    refuse_arguments(sys.argv, __file__, {*ARGUMENTS, *runpy.run_path(FOLLOWER)['ARGUMENTS']})
    arguments = [DeclareLaunchArgument(name, default_value=default, description=description)
                 for name, (default, description) in ARGUMENTS.items()]
    return LaunchDescription([
        *arguments, OpaqueFunction(function=declare),
        IncludeLaunchDescription(PythonLaunchDescriptionSource(FOLLOWER))])
