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
The one table of figures: key in summary.json, words and unit, where it is printed, its bounds.

``summary.py`` computes the figures, ``judge.py`` judges them, ``report.py`` prints them: the key,
the words and the bounds of each are here alone. Dots in a key lead into a group; keys that depend
on the flight (reasons, outages, processes) are named by their last part.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import math
import re
from typing import Final, NamedTuple

from flock_desk.runs.judge import FigureBound

#: Least and greatest value, both included: a number, the name of a limit of the flight, or None.
Ends = tuple[float | str | None, float | str | None]


class Figure(NamedTuple):
    """
    A figure, or a group of them.

    :param words: name and unit on the page.
    :param shown: whether the console shows it even if it has no bound.
    :param demo: its bounds in ``demo``; :param fly: its bounds in ``fly``.
    :param external: its bounds in ``fly`` on an external autopilot, if they differ.
    :param load: how far beyond its bounds a busy machine can push it: a number, the name of a
        limit of the flight, or UNBOUNDED.
    """

    words: str
    shown: bool = False
    demo: Ends | None = None
    fly: Ends | None = None
    external: Ends | None = None
    load: float | str = 0.0


#: Any distance: processes that wait for a processor are late by any time, or lose images.
UNBOUNDED: Final = math.inf

FIGURES: Final[dict[str, Figure]] = {
    'bag': Figure('bag'),
    'scenario': Figure('scenario'),
    'duration_s': Figure('duration, s', True, external=('planned', None), load=UNBOUNDED),
    'frames': Figure('images', True),
    'frames_in_view': Figure('images with the leader in view'),
    'processed_share': Figure('share of images processed in time', demo=(0.9, None),
                              load=UNBOUNDED),
    'recall': Figure('share of images in view with an estimate (recall)', True, fly=(0.9, None),
                     load=UNBOUNDED),
    'recall_of_processed': Figure('share of processed images with an estimate',
                                  demo=(0.99, None)),
    'longest_gap_in_view_s': Figure('longest time without an estimate, leader in view, s',
                                    fly=(None, 0.5), load=UNBOUNDED),
    'time_in_band_share': Figure('share of time in the band', True, fly=(1, None),
                                 external=(0.99, None), load=UNBOUNDED),
    'distance_m': Figure('estimated distance, m', True),
    'true_distance_m': Figure('true distance, m', True),
    'true_distance_m.min': Figure('least', True, demo=('near', None), fly=('near', None),
                                  load=UNBOUNDED),
    'true_distance_m.max': Figure('greatest', True, demo=(None, 'far'), fly=(None, 'far'),
                                  external=(None, None), load=UNBOUNDED),
    'distance_rms_m': Figure('error of the distance, RMS, m', True),
    'distance_bias_m': Figure('error of the distance, mean, m', True),
    'position_rms_m': Figure('error of the relative position, RMS of the vector, m', True,
                             demo=(None, 0.05)),
    'position_bias_m': Figure('error of the relative position, mean by axis, m'),
    'velocity_rms_m_s': Figure('error of the relative velocity, RMS of the vector, m/s', True,
                               demo=(None, 0.15), load=UNBOUNDED),
    'velocity_rms_of_all_m_s': Figure('the same RMS of velocities, refused ones too, m/s',
                                      demo=(None, 0.15), load=UNBOUNDED),
    'velocity_bias_m_s': Figure('error of the relative velocity, mean by axis, m/s'),
    'nees_position': Figure('consistency of positions (NEES; 3 is expected)', True),
    'nees_velocity': Figure('consistency of velocities (NEES; 3 is expected)', True),
    'orientation_wrong_share': Figure("share with the leader's attitude wrong by over 20°", True),
    'altitude_off_m': Figure("farthest from the leader's height, m", external=(None, 0.3),
                             load=UNBOUNDED),
    'own_speed_max_m_s': Figure('greatest speed of the follower in the bag, m/s', True),
    'faster_than_v_max_share': Figure('share of time it is faster than v_max', True),
    # While setpoints are late the autopilot keeps the last one for 0.5 s (COM_OF_LOSS_T), and the
    # bridge brakes by a velocity that may be 0.5 s old: 1 s at a_max.
    'speed_max_m_s': Figure('greatest speed, m/s', demo=(None, 'speed'), fly=(None, 'speed'),
                            load='a_max'),
    'leader_speed_max_m_s': Figure('greatest speed of the leader, m/s', True),
    'leader_faster_than_v_max': Figure('leader faster than v_max for over 1 s', True),
    'check': Figure('found by the rules of check'),
    'detections': Figure('images by the stage that measured the leader', True),
    'detections.track': Figure('track: edges, where it was expected'),
    'detections.roi': Figure('roi: search near there'),
    'detections.full': Figure('full: search everywhere'),
    'rejections': Figure('not used, and why', True),
    'planner.rate_hz': Figure('rate, Hz', demo=(9.9, 10.1), load=UNBOUNDED),
    'planner.along_law_share': Figure('share of commands that point along the law',
                                      demo=(0.5, None), fly=(0.5, None)),
    # A shared machine may stall for a tick or two; the bridge brakes meanwhile, as it should.
    'planner.missed_ticks': Figure('ticks missed', demo=(None, 3), load=UNBOUNDED),
    'planner.missed_ticks_share': Figure('share of ticks missed', fly=(None, 0.005),
                                         load=UNBOUNDED),
    'planner.acceleration_max_m_s2': Figure('greatest acceleration, m/s²'),
    'planner.states': Figure('ticks in each state', True),
    'planner.hold_count': Figure('times in HOLD'),
    'planner.hold_s': Figure('time in HOLD, s'),
    'planner.warnings': Figure('warnings (count)'),
    'planner.warning': Figure('first warning', True),
    'holds': Figure('HOLD of the planner: how long, and why', True),
    'setpoints': Figure('setpoints', True),
    'setpoints.sent': Figure('sent', demo=(1, None), load=UNBOUNDED),
    'setpoints.rate_hz': Figure('rate, Hz', demo=(19.5, 30.5), load=UNBOUNDED),
    'setpoints.opposed_share': Figure('share against the command; without one, along the velocity',
                                      demo=(None, 0.5), fly=(None, 0.5), external=(None, None)),
    'setpoints.acceleration_max_m_s2': Figure('greatest acceleration, m/s²', True,
                                              demo=(None, 'a_max'), fly=(None, 'a_max')),
    'setpoints.reasons': Figure('reasons given'),
    'latency_ms': Figure('from image to MAVLink, ms', True),
    # Newer images replace those that wait for a processor: this one grows by a late camera alone.
    # The scenario `latency` reaches 280.
    'latency_ms.estimate_p50': Figure('from image to estimate, median', True, demo=(None, 120),
                                      fly=(None, 300)),
    'latency_ms.p50': Figure('median', True, demo=(None, 120), load=UNBOUNDED),
    'latency_ms.p95': Figure('95 % below', True, demo=(None, 180), load=UNBOUNDED),
    'latency_ms.p99': Figure('99 % below', True, demo=(None, 200), load=UNBOUNDED),
    'outages': Figure('outages', True),
    'hold_after_s': Figure('it held after, s'),
    'track_after_s': Figure('followed again after, s'),
    'problems': Figure('problems reported by the nodes, seconds each'),
    'external': Figure('autopilot elsewhere'),
    'external.pace': Figure('pace of its clock by ours', external=(0.9, None), load=UNBOUNDED),
    'external.ended_early': Figure('ended early by the bridge'),
    'skipped_images': Figure('images not rendered in time', True),
    'cpu_ms_per_frame': Figure('CPU time of perception per image, ms', True),
    'realtime_factor': Figure('times faster than real time', True),
    'timings': Figure('time that this took'),
    'timings.wall_time_s': Figure('in all, s'),
    'timings.cpu_ms': Figure('CPU time, ms'),
    'cpu_cores': Figure('CPU, in cores', True),
    'cpu_cores.total': Figure('all processes', True),
    # A processor of half the speed needs twice the cores for the same work.
    'cpu_cores.at_reference': Figure('all processes, at cpu_speed 1', True, fly=(None, 1.5),
                                     load=UNBOUNDED),
    'cpu_speed': Figure('speed of a processor, as a share of the reference', True),
    'failed_processes': Figure('processes that did not end well', demo=(None, 0), fly=(None, 0)),
    'late_processes': Figure('processes cut off while they waited for a processor', demo=(None, 0),
                             fly=(None, 0), load=UNBOUNDED),
    'machine': Figure('other programs', True),
    'machine.waited_share': Figure('waited for them, share of the worst 2 s'),
    'machine.others': Figure('processors that they used then'),
    # Of a column of followers.
    'column_of': Figure('scenario'),
    'nearest_m': Figure('nearest any two came, m'),
    'pairs': Figure('nearest by pair, m'),
    # Of flights in lock step.
    'in_band': Figure('share of runs that never left the band'),
    'time_in_band': Figure('share of time in the band'),
    'min_separation_m': Figure('nearest of all runs, m'),
    'max_separation_m': Figure('farthest of all runs, m'),
    'time_in_sight': Figure('share of time with the leader in sight'),
    'guard_active': Figure('share of time in which the guard acted'),
    # Parts of groups.
    'min': Figure('least'), 'max': Figure('greatest'), 'p50': Figure('median'),
    'p99': Figure('99 % below')}


def parts_of(key: str) -> list[str]:
    """Return the groups of a key, and its figure; a dot between digits belongs to a number."""
    return re.split(r'\.(?!\d)|(?<!\d)\.', key)


def words(key: str) -> str:
    """Return name and unit of a figure or group; the key if it is not in the table."""
    last = parts_of(key)[-1]
    for known in (key, last):
        if known in FIGURES:
            return FIGURES[known].words
    return last.replace('_', ' ')


def shown(key: str) -> bool:
    """Return whether a figure, or a group that it is in, is printed on the console."""
    parts = parts_of(key)
    groups = ('.'.join(parts[:n + 1]) for n in range(len(parts)))
    return any(group in FIGURES and FIGURES[group].shown for group in groups)


def bounds(command: str, limits: Mapping[str, float],
           keys: Iterable[str] = FIGURES) -> dict[str, FigureBound]:
    """
    Return the bounds of a command by key.

    :param command: 'demo', 'fly' or 'external'.
    :param limits: the values of the limits that the table names.
    :param keys: the figures to judge, by default all.
    """
    found = {}
    for key in keys:
        figure = FIGURES[key]
        ends = figure.demo if command == 'demo' else figure.fly
        if command == 'external':
            ends = figure.external or ends
        if ends is not None and ends != (None, None):
            least, most = (limits[end] if isinstance(end, str) else end for end in ends)
            load = limits[figure.load] if isinstance(figure.load, str) else figure.load
            found[key] = FigureBound(key, least, most, load)
    return found
