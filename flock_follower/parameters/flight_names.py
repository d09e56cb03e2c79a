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
The names of the parameters of relative_pose, planner and mavlink_bridge, as test_tables checks.

With these names a node refuses an unknown name in a section that all three nodes read, without
the tables of the other nodes.
"""

from __future__ import annotations

from typing import Final

FLIGHT_NAMES: Final = frozenset({
    'a_max', 'acceleration', 'acceleration_time', 'altitude_max', 'altitude_min', 'altitude_mode',
    'altitude_offset', 'announce_as_gcs', 'autopilot', 'b', 'battery_action', 'battery_low',
    'beta', 'blind_action', 'camera.NAME.camera_info', 'camera.NAME.image',
    'camera.NAME.position', 'camera.NAME.readout_time', 'camera.NAME.rectified',
    'camera.NAME.rpy', 'camera.NAME.time_offset', 'camera_position', 'camera_rpy', 'cameras',
    'climb_rate_max',
    'coast_timeout', 'connection', 'd0', 'd1', 'engage_timeout', 'forward_odometry',
    'global_origin', 'guard', 'height_max', 'height_min', 'image_transport', 'K',
    'leader_acceleration_max', 'leader_lost_action', 'leader_speed_max', 'link_timeout', 'm',
    'max_wait', 'neighbors_file', 'odom_child_position', 'odom_child_rpy', 'odom_std',
    'odom_timeout', 'odom_twist_frame', 'odometry', 'odometry_rate', 'perception_timeout',
    'planner_timeout',
    'predict_timeout', 'publish_tf', 'radius', 'radius_max', 'range_noise', 'readout_time',
    'rectified', 'relative_flight', 'relative_timeout', 'report_to_gcs', 'require_bridge',
    'require_failsafe', 'resume_timeout', 'retreat_max', 'scan_rate', 'signing_key_file',
    'source_system',
    'stick_override', 'stream_rate', 'tag_position', 'takeoff_height', 'target_system', 'tau',
    'telemetry_rate', 'time_offset', 'time_offset_mode', 'v_max', 'velocity_disagreement',
    'velocity_source', 'wind_compensation', 'yaw_disagreement', 'yaw_mode', 'yaw_rate_max'})
