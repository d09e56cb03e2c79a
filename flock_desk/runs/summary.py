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
Compute the figures of a flight for ``evaluate``, ``demo`` and ``fly``.

A summary is a mapping of figures by name, groups of them nested; None is unknown. Words, units
and bounds are in ``figure_table.py``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
import json
import math
from pathlib import Path
import re
from typing import Any

import numpy as np

from flock_desk.runs.evaluation import Evaluation, STATES
from flock_desk.runs.frame_errors import STAGES, Table
from flock_desk.runs.processes import failed, TOO_BUSY_EXIT_CODE
from flock_desk.runs.record import Flight, LiveFlight
from flock_desk.scenarios.scenario import Outage
from flock_follower.checks.findings import ERROR, WARNING
from flock_follower.checks.processor import Load
from flock_follower.geometry import Array
from flock_follower.system.whole_file import whole_file

#: Attitudes farther than this from the truth count as wrong, rad.
WRONG_ATTITUDE = math.radians(20.0)
#: A mean NEES of three-dimensional errors that is still consistent; 3 is expected.
CONSISTENT = (1.5, 6.0)
BRAKE_WITHIN = 0.3  # s after the last odometry
HOLD_WITHIN = 2.1  # s after the last image of the leader: coast_timeout, and one tick
LEVEL_WITHIN = 3.0  # s after the leader has come into view: by then its height is reached
OUTRUN = 1.0  # s for which a leader is faster than v_max that outruns; a gust is shorter
COMMANDS = 10  # whose directions are judged at least
OK = (0, b'\x00')  # DiagnosticStatus.OK, as readers of bags and rclpy give a byte


def sight_figures(tables: Sequence[Table], max_velocity_std: float) -> dict[str, Any]:
    """
    Return how often and how well neighbors were measured, from the tables of ``frame_errors``.

    Images count once for each neighbor. ``recall`` is the share of images with an estimate, among
    the images in which the truth has a marker in view, or among all images if there is no truth.
    Errors are computed from all images with an estimate and truth. ``velocity_rms_m_s`` and
    ``velocity_bias_m_s`` leave out the estimates that the planner refuses: those with a velocity
    more uncertain than ``max_velocity_std``, m/s, for example the first of a track.
    ``velocity_rms_of_all_m_s`` includes them. ``nees_`` are means; 3 is right.
    """
    rows = {column: np.concatenate([table[column] for table in tables]) for column in tables[0]}
    found, known = np.isfinite(rows['distance']), np.isfinite(rows['true_distance'])
    in_view = rows['visible'] == 1.0
    measured = np.isfinite(rows['position'] + rows['velocity']).all(axis=1)
    usable = measured & (np.sum(rows['velocity_sigma']**2, axis=1) <= max_velocity_std**2)
    off = (rows['distance'] - rows['true_distance'])[found & known]
    return {
        'frames_in_view': int(np.count_nonzero(in_view)) if np.any(known) else None,
        'recall': mean(found[in_view]) if np.any(known) else (mean(found) or 0.0),
        'distance_m': spread(rows['distance'][found]),
        'true_distance_m': spread(rows['true_distance'][known]),
        'distance_rms_m': rms(off),
        'distance_bias_m': mean(off),
        'position_rms_m': rms(norms(rows['position'][measured])),
        'position_bias_m': _by_axis(rows['position'][measured]),
        'velocity_rms_m_s': rms(norms(rows['velocity'][usable])),
        'velocity_rms_of_all_m_s': rms(norms(rows['velocity'][measured])),
        'velocity_bias_m_s': _by_axis(rows['velocity'][usable]),
        'nees_position': mean(_finite(rows['nees_position'])),
        'nees_velocity': mean(_finite(rows['nees_velocity'])),
        'orientation_wrong_share': mean(_finite(rows['turned']) > WRONG_ATTITUDE)}


def consistency(nees: float | None) -> str:
    """Return the verdict on a mean NEES of three-dimensional errors, '' of an unknown one."""
    if nees is None:
        return ''
    if nees > CONSISTENT[1]:
        return 'covariances too small'
    return 'consistent' if nees >= CONSISTENT[0] else 'covariances too large'


def hold_figures(states: Sequence[tuple[float, str]], reasons: Sequence[tuple[float, str]],
                 end: float) -> dict[str, dict[str, Any]]:
    """
    Return number and total time of the planner's HOLDs from time 0 to an end, s, and each of them.

    :param states: those entered, each with its time.
    :param reasons: the reported reasons with their times; the first one reported during a HOLD
    counts.
    """
    total, holds = 0.0, dict[str, str]()
    for (begin, state), (until, _) in zip(states, [*states[1:], (end, '')]):
        begin, until = max(begin, 0.0), min(until, end)
        if state == 'HOLD' and begin < until:
            total += until - begin
            why = next((reason for t, reason in reasons if begin <= t <= until and reason),
                       'too short: its reason was not published on /diagnostics')
            holds[f'at_{begin:.1f}_s'] = f'{until - begin:.1f} s: {why}'
    return {'planner': {'hold_count': len(holds), 'hold_s': total}, 'holds': holds}


def evaluation_figures(evaluation: Evaluation) -> dict[str, Any]:
    """
    Return the summary of an evaluation.

    Beside :func:`sight_figures`: ``cpu_ms_per_frame`` is the CPU time of perception without
    decoding; under ``timings`` it is by the costliest stage an image needed.
    ``own_speed_max_m_s`` is the highest speed of the follower in the bag,
    ``faster_than_v_max_share`` the share of ticks above ``v_max``. ``check`` holds the errors and
    warnings of ``check``, a line each.
    """
    tables = [*evaluation.tables.values()]
    stages = np.concatenate([np.where(np.isfinite(table['distance']), table['stage'], 0.0)
                             for table in tables])
    cpu = {what: 1e3 * np.array(evaluation.cpu.get(what, ()), dtype=float)
           for what in ('decode', *STAGES, 'planner', 'gate')}
    ticks, params = evaluation.ticks, evaluation.params
    acceleration, speed = _finite(ticks[:, 2]), _finite(ticks[:, 3])
    held = hold_figures(evaluation.states, evaluation.reasons, evaluation.duration)
    return jsonable({
        'bag': evaluation.bag.path.name,
        'duration_s': evaluation.duration,
        'check': {f'{level}s': [finding.line for finding in evaluation.findings
                                if finding.level == level] for level in (ERROR, WARNING)},
        'neighbors': [*evaluation.tables],
        'frames': evaluation.frames,
        **sight_figures(tables, params.max_velocity_std),
        'own_speed_max_m_s': most(speed),
        'faster_than_v_max_share': mean(ticks[:, 3] > params.v_max),
        'detections': {stage: int(np.count_nonzero(stages == STAGES.index(stage)))
                       for stage in (*STAGES[1:], STAGES[0])},
        'rejections': dict(sorted(evaluation.rejections.items())),
        'planner': {
            'ticks': len(ticks), 'commands': len(acceleration),
            'acceleration_max_m_s2': most(acceleration),
            'states': {state: int(np.count_nonzero(ticks[:, 1] == i))
                       for i, state in enumerate(STATES)},
            **held['planner']},
        'holds': held['holds'],
        'setpoints': {
            **{kind: evaluation.setpoint_kinds[kind]
               for kind in ('command', 'brake', 'level', 'none')},
            'acceleration_max_m_s2': most(norms(evaluation.setpoints[:, 1:4])),
            'reasons': dict(sorted(evaluation.brake_reasons.items()))},
        'cpu_ms_per_frame': mean(np.concatenate([cpu[stage] for stage in STAGES])),
        'realtime_factor': evaluation.duration / evaluation.wall_time,
        'timings': {
            'wall_time_s': evaluation.wall_time,
            'cpu_ms': {what: {
                'p50': percentile(times, 50), 'p99': percentile(times, 99), 'count': len(times)}
                for what, times in cpu.items()}}})


def flight_figures(flight: Flight, exit_codes: Mapping[str, int | None],
                   load: Load | None = None) -> dict[str, Any]:
    """
    Return the figures that ``demo`` and ``fly`` have in common, NaN if they are unknown.

    ``true_distance_m`` is from ``flight.distance``, ``setpoints`` from the wire, ``speed_max_m_s``
    from the vehicle. ``latency_ms`` is the time from an image's stamp to MAVLink, measured by the
    bridge. ``holds`` lists each HOLD of the planner with its reason. ``late_processes`` waited for
    a processor until they were ended; ``failed_processes`` counts the others that did not end with
    0 in time. ``along_law_share`` is None for fewer than ``COMMANDS`` commands; ``opposed_share``
    counts at least ``COMMANDS`` setpoints. ``machine`` describes the other programs during the
    worst 2 s, None if unknown.

    :param load: of the flight, None if unknown.
    """
    held = hold_figures(flight.states, flight.values('planner', 'reason'), flight.duration)
    after = flight.duration + 1.0  # every node publishes its counters once per second
    missed = (flight.value('planner', 'missed_ticks', after)
              - flight.value('planner', 'missed_ticks', 0.0, 0.0))
    return {
        'duration_s': flight.duration,
        'frames': len(flight.table['time']),
        **sight_figures([flight.table], flight.params.max_velocity_std),
        'true_distance_m': spread(flight.distance),
        'planner': {'along_law_share': (mean(flight.along_law)
                                        if len(flight.along_law) >= COMMANDS else None),
                    'missed_ticks': missed, **held['planner']},
        'holds': held['holds'],
        'setpoints': {
            'sent': len(flight.setpoints),
            'rate_hz': rate(flight.setpoint_times),
            'opposed_share': float(np.sum(flight.opposed)) / max(len(flight.opposed), COMMANDS),
            'acceleration_max_m_s2': most(norms(flight.setpoints))},
        'speed_max_m_s': most(next(iter(flight.speeds.values()))[1]),
        'latency_ms': {
            'estimate_p50': flight.value('relative_pose', 'stamp_to_estimate_p50_ms', after),
            **{f'p{p}': flight.value('mavlink_bridge', f'latency_p{p}_ms', after)
               for p in (50, 95, 99)}},
        'failed_processes': len(failed(exit_codes)),
        'late_processes': sum(code == TOO_BUSY_EXIT_CODE for code in exit_codes.values()),
        'machine': {'waited_share': None if load is None else load.share,
                    'others': None if load is None else load.others}}


def replay_figures(flight: Flight, exit_codes: Mapping[str, int | None],
                   load: Load | None = None) -> dict[str, Any]:
    """
    Return the summary of ``demo``.

    Beside :func:`flight_figures`: ``processed_share`` is the share of the bag's images that
    perception processed in time; ``recall_of_processed`` is the recall of these images.
    """
    common = flight_figures(flight, exit_codes, load)
    processed = flight.value('relative_pose', 'images_processed', math.inf) / common['frames']
    return jsonable({
        **common,
        'processed_share': processed,
        'recall_of_processed': (common['recall'] or 0.0) / processed if processed else None,
        'planner': {'rate_hz': rate(flight.command_times), **common['planner']}})


def scenario_figures(flight: LiveFlight, cores: Mapping[str, float],
                     exit_codes: Mapping[str, int | None], load: Load | None = None,
                     speed: float | None = None) -> dict[str, Any]:
    """
    Return the summary of ``fly``.

    Beside :func:`flight_figures`: ``time_in_band_share`` counts all times.
    ``longest_gap_in_view_s`` is the longest time without an estimate in which all images showed
    the leader. ``planner.warnings`` counts the diagnostics with a warning; ``warning`` is the
    first of these. ``outages``: the times until the planner held, and until it followed again.
    ``altitude_off_m`` is the greatest distance from the leader's height, see
    :func:`_altitude_off`. ``problems`` counts the problems that each node reported, in seconds.
    ``external`` describes an external autopilot: the source of the vehicle's pose, the rate of its
    clock relative to ours, the source of the leader's pose if a second autopilot flew the leader,
    and the reason if the bridge ended the flight early.

    :param cores: used by each process, empty if unknown.
    :param speed: of a processor, as a share of the reference; None if unknown.
    """
    params, table, log = flight.scenario.flight, flight.table, flight.log
    times, leader_speeds = flight.speeds['leader']
    common = flight_figures(flight, exit_codes, load)
    warnings = [text for t, text in flight.values('planner', 'warnings') if t > 0.0 and text]
    total = sum(cores.values()) if cores else None
    missed = common['planner']['missed_ticks'] * flight.params.period / flight.duration
    return jsonable({
        'scenario': flight.scenario.name,
        **common,
        'time_in_band_share': flight.time_in_band_share,
        'longest_gap_in_view_s': _longest_time(
            table['time'], ~np.isfinite(table['distance']) & (table['visible'] == 1.0)),
        'leader_speed_max_m_s': most(leader_speeds),
        'leader_faster_than_v_max': _longest_time(
            times, leader_speeds > 1.001 * params.v_max) >= OUTRUN,
        'altitude_off_m': most(_altitude_off(flight)),
        'planner': {**common['planner'], 'missed_ticks_share': missed, 'warnings': len(warnings),
                    'warning': warnings[0] if warnings else None},
        'outages': {outage_name(outage): _outage(flight, outage)
                    for outage in judged_outages(flight)},
        'problems': _problems(flight),
        'external': ({'pose_from': str(log['pose_source']),
                      'leader_from': str(log['pose_source_of_leader']) or None,
                      'pace': flight.pace,
                      'ended_early': str(log['ended_early']) or None}
                     if flight.external else None),
        'skipped_images': int(log['skipped_images']),
        'cpu_speed': speed,
        'cpu_cores': {'total': total,
                      'at_reference': total and speed and total * speed,
                      **dict(sorted(cores.items(), key=lambda item: -item[1]))}})


def _altitude_off(flight: LiveFlight) -> Array:
    """
    Return the height difference between follower and leader, m, at the images that count.

    An image counts if the leader has been in view for ``LEVEL_WITHIN``: the follower does not know
    the height of a leader out of view. A scenario's leader begins at the follower's height, so all
    images from the beginning count. A leader flown by an autopilot begins at any height.
    """
    times, hidden = flight.table['time'], flight.table['visible'] == 0.0
    begin = times[0] if str(flight.log['pose_source_of_leader']) else -math.inf
    last_hidden = np.maximum.accumulate(np.where(hidden, times, begin))
    off: Array = np.abs(flight.paths['leader'][:, 2] - flight.paths['follower'][:, 2])
    return off[times - last_hidden >= LEVEL_WITHIN]


def hold_within(outage: Outage) -> float:
    """Return the time after which the planner must hold in an outage, s."""
    return BRAKE_WITHIN if outage.what == 'vio' else HOLD_WITHIN


def outage_name(outage: Outage) -> str:
    """Return the key of an outage."""
    return f'{outage.what}_at_{outage.at:g}_s'


def judged_outages(flight: LiveFlight) -> list[Outage]:
    """Return the outages that are long enough, and were flown long enough, to require HOLD."""
    return [outage for outage in flight.scenario.outages if outage.duration >= hold_within(outage)
            and flight.duration >= outage.at + hold_within(outage)]


def _outage(flight: LiveFlight, outage: Outage) -> dict[str, Any]:
    """Return when the planner held after an outage began, and followed again after its end."""
    end = outage.at + outage.duration
    held = next((t for t, s in flight.states if s == 'HOLD' and t >= outage.at), math.nan)
    again = next((t for t, s in flight.states if s == 'TRACK' and t >= max(held, end)), math.nan)
    reasons = [r for t, r in flight.values('planner', 'reason') if outage.at < t < end and r]
    return {'hold_after_s': held - outage.at, 'track_after_s': again - end,
            'reasons': len(reasons), 'reason': reasons[-1] if reasons else None}


def _problems(flight: LiveFlight) -> dict[str, int]:
    """Return the count of each problem reported by each node; numbers in its text are masked."""
    reported = Counter(
        f'{status.name}: {re.sub(r"[0-9]+([.][0-9]+)?", "#", status.message)}'
        for t, array in flight.diagnostics if 0.0 < t <= flight.duration
        for status in array.status if status.level not in OK)
    return dict(reported.most_common())


def _longest_time(times: Array, holds: Any) -> float:
    """Return the longest time, s, in which ``holds`` (n,) is True, from the image before it."""
    longest, since = 0.0, math.inf
    for time, held in zip(times.tolist(), holds.tolist()):
        since = min(since, time) if held else time
        longest = max(longest, time - since)
    return longest


def write_summary(summary: Mapping[str, Any], path: Path) -> None:
    """
    Write a summary as JSON.

    :raises OSError: if it cannot be written.
    """
    with whole_file(path) as file:
        file.write((json.dumps(summary, indent=2, ensure_ascii=False) + '\n').encode())


def jsonable(value: Any) -> Any:
    """Return a summary with None for NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: jsonable(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def mean(values: Any) -> float | None:
    """Return the mean, or None of nothing."""
    return float(np.mean(values)) if len(values) else None


def rms(values: Array) -> float | None:
    """Return the root mean square, or None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def most(values: Array) -> float | None:
    """Return the greatest value, or None of nothing or if a value is NaN or infinite."""
    return float(np.max(values)) if len(values) and np.isfinite(values).all() else None


def percentile(values: Array, percent: float) -> float | None:
    """Return a percentile, or None of nothing."""
    return float(np.percentile(values, percent)) if len(values) else None


def spread(values: Array) -> dict[str, float | None]:
    """Return least, mean and greatest finite value."""
    values = _finite(values)
    return {'min': float(np.min(values)) if len(values) else None, 'mean': mean(values),
            'max': most(values)}


def rate(times: Array) -> float:
    """Return the mean rate, Hz, of events at the given times (n,), s; 0 for fewer than two."""
    return float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 else 0.0


def norms(vectors: Array) -> Array:
    """Return the norms, (n,) of vectors (n, 3)."""
    return np.linalg.norm(vectors, axis=1)


def _finite(values: Array) -> Array:
    return values[np.isfinite(values)]


def _by_axis(errors: Array) -> dict[str, float | None]:
    return {axis: mean(errors[:, i]) for i, axis in enumerate('xyz')}
