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

"""Figures as people read them: names and units in place of the keys of summary.json."""

from __future__ import annotations

from typing import Any

#: What a suffix of a key says, the longest first.
_UNITS = (('_m_s2', 'm/s²'), ('_m_s3', 'm/s³'), ('_m_s', 'm/s'), ('_ms', 'ms'), ('_hz', 'Hz'),
          ('_m', 'm'), ('_s', 's'))
#: Keys whose words do not tell what they are.
_NAMES = {
    'recall': 'share of images in view with an estimate (recall)',
    'recall_of_processed': 'share of images looked at with an estimate',
    'processed_share': 'share of images looked at in time',
    'frames': 'images', 'frames_in_view': 'images with the leader in view',
    'distance_m': 'estimated distance', 'true_distance_m': 'true distance',
    'distance_rms_m': 'error of the distance, RMS',
    'distance_bias_m': 'error of the distance, mean',
    'position_rms_m': 'error of the relative position, RMS of the vector',
    'position_bias_m': 'error of the relative position, mean by axis',
    'velocity_rms_m_s': 'error of the relative velocity, RMS of the vector',
    'velocity_rms_of_all_m_s': 'the same RMS of velocities, refused ones too',
    'velocity_bias_m_s': 'error of the relative velocity, mean by axis',
    'nees_position': 'consistency of positions (NEES; 3 is right)',
    'nees_velocity': 'consistency of velocities (NEES; 3 is right)',
    'orientation_wrong_share': "share with the leader's attitude wrong by over 20°",
    'own_speed_max_m_s': 'greatest speed of the follower in the bag',
    'faster_than_v_max_share': 'share of time it is faster than v_max',
    'detections': 'images by the stage that measured the leader',
    'track': 'track: edges, where it was expected', 'roi': 'roi: search near there',
    'full': 'full: search everywhere', 'none': 'none',
    'rejections': 'not used, and why', 'holds': 'HOLD of the planner: how long, and why',
    'reasons': 'reasons given',
    'cpu_ms_per_frame': 'CPU time of perception per image, ms',
    'cpu_ms': 'CPU time', 'cpu_cores': 'CPU, in cores', 'total': 'all processes',
    'realtime_factor': 'times faster than real time',
    'timings': 'time that this took', 'wall_time_s': 'in all',
    'latency_ms': 'from image to MAVLink', 'p50': 'median', 'p95': '95 % below',
    'p99': '99 % below', 'failed_processes': 'processes that did not end well',
    'time_in_band_share': 'share of time in the band',
    'longest_gap_in_view_s': 'longest time without an estimate, leader in view',
    'leader_speed_max_m_s': 'greatest speed of the leader',
    'leader_faster_than_v_max': 'leader faster than v_max for over 1 s',
    'altitude_off_m': "farthest from the leader's height",
    'skipped_images': 'images not rendered in time', 'ended_early': 'ended early by the bridge',
    'speed_max_m_s': 'greatest speed', 'missed_ticks': 'ticks missed',
    'missed_ticks_share': 'share of ticks missed', 'warnings': 'warnings (times told)',
    'warning': 'first warning', 'hold_count': 'times in HOLD', 'hold_s': 'time in HOLD',
    'acceleration_max_m_s2': 'greatest acceleration', 'rate_hz': 'rate',
    'outages': 'outages', 'hold_after_s': 'it held after', 'track_after_s': 'followed again after',
    'reason': 'reason', 'problems': 'problems told by the nodes, seconds each',
    'external': 'autopilot elsewhere', 'pace': 'pace of its clock by ours',
    'nearest_m': 'nearest any two came', 'pairs': 'nearest by pair, m',
    'column_of': 'scenario', 'min': 'least', 'max': 'greatest',
    # Of flights in lock step.
    'in_band': 'share of runs that never left the band',
    'time_in_band': 'share of time in the band',
    'min_separation_m': 'nearest of all runs', 'max_separation_m': 'farthest of all runs',
    'time_in_sight': 'share of time with the leader in sight',
    'guard_active': 'share of time in which the guard acted'}


def name(key: str) -> str:
    """Return the name of a figure by the last part of its key, and the unit where it has one."""
    unit = next(((suffix, unit) for suffix, unit in _UNITS if key.endswith(suffix)), None)
    if key in _NAMES:
        return _NAMES[key] if unit is None else f'{_NAMES[key]}, {unit[1]}'
    if unit is None or ' ' in key or key.startswith('at_') or '_at_' in key:
        return key.replace('_', ' ')
    return f'{key.removesuffix(unit[0]).replace("_", " ")}, {unit[1]}'


def text(value: Any) -> str:
    """Return a figure as people read it."""
    if value is None:
        return 'unknown'
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    if isinstance(value, list):
        return ', '.join(map(str, value))
    if not isinstance(value, float):
        return str(value)
    return f'{value:.4g}' if abs(value) >= 1e-3 else f'{round(value, 5) + 0.0:g}'
