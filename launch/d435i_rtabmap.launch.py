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
Start a follower that sees with a RealSense D435i and moves by rtabmap_odom.

Start camera and odometry separately; docs/sensors.md explains how to measure the values set here.
Arguments of follower.launch.py are valid, too.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    'image': ('/camera/camera/infra1/image_rect_raw', 'left infrared image, emitter off'),
    'camera_info': ('/camera/camera/infra1/camera_info', 'its calibration'),
    'odom': ('/odom', 'odometry of camera_link, at the rate of the images'),
    'camera_position': ('[0.10, 0.0, 0.0]', 'place of the left infrared lens on base_link, m'),
    'camera_rpy': ('[0.0, 0.0, 0.0]', 'roll, pitch, yaw of the camera, rad; zeros look ahead'),
    # camera_link is the left infrared lens, its axes are x ahead, y left, z up.
    'odom_child_position': ('[0.10, 0.0, 0.0]', 'place of camera_link: camera_position'),
    'odom_child_rpy': ('[0.0, 0.0, 0.0]', 'roll, pitch, yaw of camera_link: camera_rpy'),
}


def generate_launch_description() -> LaunchDescription:
    """Return the launch description; the file included takes the arguments declared here."""
    arguments = [DeclareLaunchArgument(name, default_value=default, description=description)
                 for name, (default, description) in ARGUMENTS.items()]
    follower = IncludeLaunchDescription(PythonLaunchDescriptionSource(PathJoinSubstitution(
        [FindPackageShare('flock_follower'), 'launch', 'follower.launch.py'])))
    return LaunchDescription([*arguments, follower])
