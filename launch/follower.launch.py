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
Start the nodes of a follower: relative_pose, planner, mavlink_bridge, and a black box.

An argument left empty leaves its parameter as the parameter files have it. A file that is missing
and parameters with which a node would end at its start end the launch; a node that ends later is
started again.
camera.launch.py includes it with the topics and the mounting of a known camera and odometry
(docs/sensors.md).
"""

import sys
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare
import yaml

from flock_follower.parameters.flight_parameters import refuse_start
from flock_follower.parameters.launch_arguments import END_WITH_LAUNCH, refuse_arguments

ARGUMENTS = {
    'namespace': ('', 'namespace of every topic and service'),
    'use_sim_time': ('false', 'true when a bag is replayed'),
    'connection': ('udpin:127.0.0.1:14540', 'where the autopilot is'),
    'config': (PathJoinSubstitution([FindPackageShare('flock_follower'), 'config']),
               'folder with follower.yaml and neighbors.yaml'),
    'target_system': ('', 'MAVLink system id of the autopilot'),
    'a_max': ('', 'largest acceleration, m/s^2, of planner and mavlink_bridge alike'),
    'v_max': ('', 'largest speed, m/s, of planner and mavlink_bridge alike'),
    'image': ('image_raw', 'topic of the images; of compressed ones without /compressed'),
    'image_transport': ('raw', 'raw or compressed'),
    'camera_info': ('camera_info', 'topic of their calibration'),
    'cameras': ('', 'file with the parameters of several cameras, as config/two_cameras.yaml'),
    'odom': ('odom', 'topic of the odometry'),
    'camera_position': ('', 'place of the camera on base_link, m, such as [0.10, 0.0, 0.0]'),
    'camera_rpy': ('', 'roll, pitch, yaw of the camera on base_link, rad; zeros look ahead'),
    'odom_child_position': ('', "place of the odometry's child frame on base_link, m"),
    'odom_child_rpy': ('', "roll, pitch, yaw of the odometry's child frame on base_link, rad"),
    'respawn': ('true', 'start a node again that ended, after a second; a bridge sends nothing '
                'until mavlink_bridge/offboard is called'),
    'visualize': ('false', 'true: visualizer, too, which draws the flight for RViz and Foxglove'),
    'view': ('false', 'true: view, too, a live page at http://127.0.0.1:8090'),
    'odom_twist_frame': ('', "frame of the odometry's velocity: auto, child, odom or none"),
    'bridge_prefix': ('', 'command that starts mavlink_bridge, alone, such as '
                      '/usr/local/lib/flock_follower/prefer_realtime 3 40'),
    'record': ('true', 'false: no black box, nothing is recorded'),
    'record_folder': ('', 'of the recordings; empty: ~/.ros/flock_follower/black_box'),
    'record_images': ('', 'compressed or none'),
    'disk_used': ('', 'what recordings may take of the disk, MB'),
}
ODOMETRY = ['odom_child_position', 'odom_child_rpy', 'odom_twist_frame']
#: Which arguments are parameters of which node.
PARAMETERS = {
    'relative_pose': ['image_transport', 'camera_position', 'camera_rpy', *ODOMETRY],
    'planner': ['a_max', 'v_max', 'camera_rpy', *ODOMETRY],
    'mavlink_bridge': ['connection', 'target_system', 'a_max', 'v_max', *ODOMETRY],
    'visualizer': [],
    'view': [],
    'black_box': ['image_transport', 'record_folder', 'record_images', 'disk_used'],
}
NUMBERS = ('a_max', 'v_max')
WHOLE = ('target_system', 'disk_used')
#: By which argument a node is started or not.
BY_CHOICE = {'visualizer': 'visualize', 'view': 'view', 'black_box': 'record'}


def value(name: str, text: str) -> Any:
    """Return what an argument says: a number, numbers if it is a list, or a string."""
    if name in (*NUMBERS, *WHOLE):
        try:
            return int(text) if name in WHOLE and text.isdigit() else float(text)
        except ValueError:
            raise ValueError(f'{name}:={text}: must be a number') from None
    return [float(number) for number in yaml.safe_load(text)] if text.startswith('[') else text


def yes(values: dict[str, str], name: str) -> bool:
    """Return whether an argument is true: `record:=yes` must not mean that none is recorded."""
    if values[name].lower() not in ('true', 'false'):
        raise ValueError(f'{name}:={values[name]}: must be true or false')
    return values[name].lower() == 'true'


def start(context: LaunchContext) -> list[Node]:
    """Return the nodes as the arguments say."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    started, given = [], {}
    own, neighbors = (f'{values["config"]}/{name}.yaml' for name in ('follower', 'neighbors'))
    for node, names in PARAMETERS.items():
        if node in BY_CHOICE and not yes(values, BY_CHOICE[node]):
            continue
        parameters = {name: value(name, values[name]) for name in names if values[name]}
        parameters['use_sim_time'] = yes(values, 'use_sim_time')
        if node in ('relative_pose', 'planner'):
            parameters['neighbors_file'] = neighbors
        given[node] = parameters
        files = [] if node in BY_CHOICE else [own]
        if values['cameras'] and node in ('relative_pose', 'planner', 'black_box'):
            files.append(values['cameras'])
        prefix = values['bridge_prefix'] if node == 'mavlink_bridge' else ''
        started.append(Node(
            package='flock_follower', executable=node, exec_name=node, output='screen',
            prefix=f'{END_WITH_LAUNCH} {prefix}',
            # A page whose port is busy would be refused for ever.
            respawn=yes(values, 'respawn') and node != 'view', respawn_delay=1.0,
            namespace=values['namespace'], parameters=[*files, parameters],
            remappings=[('image_raw', values['image']),
                        ('image_raw/compressed', f'{values["image"]}/compressed'),
                        ('camera_info', values['camera_info']), ('odom', values['odom'])]))
    # launch_ros skips a parameter file that is missing: the defaults would fly.
    refuse_start([own, *filter(None, [values['cameras']])], given,
                 values['namespace'])
    return started


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    refuse_arguments(sys.argv, __file__, ARGUMENTS)
    arguments = [DeclareLaunchArgument(name, default_value=default, description=description)
                 for name, (default, description) in ARGUMENTS.items()]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])
