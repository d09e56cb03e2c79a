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
A closed-loop flight on the desk: the simulator in place of camera, odometry and both vehicles.

``python -m flock_desk.fly --scenario indoor`` starts simulator, relative_pose, planner
and mavlink_bridge, each a process of its own, in a ROS domain and on a UDP port that
other machines cannot receive; arms, changes to offboard mode, engages, and flies the scenario.
Exit code 0 only if every bound holds; 3 if the machine was too busy to judge the bounds on times,
and the other bounds hold.

``--autopilot udp:127.0.0.1:14540`` (PX4) or ``tcp:127.0.0.1:5760`` (ArduPilot) has the follower
flown by an autopilot that runs already, see docs/desk.md: from the ground, and back to it. With
``--leader-truth`` its leader is the vehicle of a second autopilot, which another program flies.

``--followers 2`` flies a column: each follower with nodes, namespace, vehicle and simulator of its
own, its camera on the vehicle of the one before it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations
import math
from pathlib import Path
import sys
from typing import Any

import numpy as np

from flock_desk.closed_loop.real_time_flight import MAX_SKIPPED_SHARE
from flock_desk.runs.console import guarded, logs_in, within
from flock_desk.runs.figure_table import bounds, UNBOUNDED
from flock_desk.runs.flight import (
    External,
    Flown,
    fly,
    links,
    namespaces,
    own,
    SIH_TRUTH,
    spacing,
)
from flock_desk.runs.judge import FigureBound
from flock_desk.runs.lock_step import sign_faults
from flock_desk.runs.moving_picture import moving_picture
from flock_desk.runs.plots import scenario_chapters
from flock_desk.runs.processes import (
    explained,
    failed,
    LateError,
    TOO_BUSY_EXIT_CODE,
    TooBusyError,
)
from flock_desk.runs.record import along, clear, LiveFlight, locked, read_flown
from flock_desk.runs.report import announce, report
from flock_desk.runs.summary import (
    hold_within,
    jsonable,
    judged_outages,
    most,
    outage_name,
    scenario_figures,
)
from flock_desk.scenarios.scenario import DURATIONS, Scenario, SEED_RANGE
from flock_desk.scenarios.scenario_file import load_for_real_time, names
from flock_follower.messages.bridge_state import TAKEN_OVER
from flock_follower.ranges import Range
from flock_follower.system.whole_file import whole_file

FOLLOWERS = Range(1, 8, whole=True)
SPEED_TOLERANCE = 0.05  # m/s: added by noise and gusts to a speed that is held at v_max
SAFE = 0.9  # of sqrt(d0): nearer than this no follower may come
DURATION_SHORT = 0.1  # s by which a flight may be shorter than requested
AGAIN_WITHIN = 2.0  # s after odometry or leader have returned
STEP = 0.02  # s between the times at which the vehicles of a column are compared


def main(args: Sequence[str] | None = None) -> int:
    """Fly, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='fly', description='Fly a scenario on the desk, through the real nodes.',
        epilog=f'scenarios: {", ".join(names())}')
    parser.add_argument('--scenario', default='indoor', metavar='NAME',
                        help='a name in config/scenarios, or the path of a file (%(default)s)')
    parser.add_argument('--seed', type=within(SEED_RANGE), default=0,
                        help='of everything that chance decides')
    parser.add_argument('--duration', type=within(DURATIONS), default=0.0, metavar='S',
                        help='fly no longer than this, s; never longer than the scenario')
    parser.add_argument('--followers', type=within(FOLLOWERS), default=1, metavar='N',
                        help='in a column, each behind the one before it (%(default)s); every one '
                        'takes about one core')
    parser.add_argument('--detector', type=Path, metavar='FILE',
                        help='a program that publishes poses of the leader, AprilTag 0 of 36h11; '
                        "FILE with .yaml is its neighbors' file (examples/other_detector.py)")
    parser.add_argument('--output', type=Path, default='build/fly',
                        help='folder for report and logs (%(default)s)')
    parser.add_argument('--moving', type=Path, metavar='FILE',
                        help='also write a moving picture of the flight, an animated WebP')
    external = parser.add_argument_group('an autopilot that runs already, see docs/desk.md')
    external.add_argument('--autopilot', default='', metavar='URL',
                          help='where the bridge finds it: udp:HOST:PORT where it sends to, '
                          'tcp:HOST:PORT where it listens')
    external.add_argument('--truth', default='', metavar='URL',
                          help='another link, on which it sends the true place '
                          f'(udp: {SIH_TRUTH}; tcp: its port + 2)')
    external.add_argument('--leader-truth', default='', metavar='URL',
                          help='likewise of a second autopilot, MAVLink system 2, whose vehicle '
                          "is the leader (the scenario's own leader)")
    external.add_argument('--forward-odometry', action='store_true',
                          help='send it the odometry, for flight without GPS')
    options = parser.parse_args(args)
    if not options.autopilot and (
            options.truth or options.leader_truth or options.forward_odometry):
        parser.error('--truth, --leader-truth and --forward-odometry: only with --autopilot')
    if options.autopilot and options.followers > 1:
        parser.error('--followers: not with --autopilot')
    for file in [] if options.detector is None else [
            options.detector, options.detector.with_suffix('.yaml')]:
        if not file.is_file() or options.detector.suffix != '.py':
            parser.error(f'--detector {options.detector}: {file} must be a file, and end with .py')
    if options.moving and options.followers > 1:
        parser.error('--moving: not with --followers')
    return guarded(partial(_fly, options), hint=partial(logs_in, options.output))


def _fly(options: argparse.Namespace) -> int:
    scenario = load_for_real_time(options.scenario)
    duration = min(options.duration or scenario.duration, scenario.duration)
    if options.duration > duration:
        print(f'{scenario.name} lasts {duration:g} s: it is flown for so long, not for '
              f'--duration = {options.duration:g} s', flush=True)
    external = (links(options.autopilot, options.truth, options.forward_odometry,
                      options.leader_truth) if options.autopilot else None)
    with locked(options.output):
        for namespace in ('', *namespaces(options.followers)):
            clear(options.output / namespace)
        code = at_any_load(
            scenario, partial(_fly_and_judge, options, scenario, duration, external))
        if options.moving:
            with whole_file(options.moving) as file:
                file.write(moving_picture(read_flown(scenario, options.output)))
        return code


def _fly_and_judge(options: argparse.Namespace, scenario: Scenario, duration: float,
                   external: External | None) -> int:
    flown = fly(scenario, options.scenario, options.seed, duration, options.output, external,
                options.followers, options.detector)
    with explained(None if failed(flown.exit_codes) else flown.load):
        code = conclude(scenario, options.output, options.followers, flown)
        if flown.late and code != 1:
            raise LateError(flown.late)
    return code


def at_any_load(scenario: Scenario, command: Callable[[], int]) -> int:
    """
    Return the exit code of a flight; judge the signs in lock step if the machine was too busy.

    :raises TooBusyError: from the command, if the signs are right.
    """
    busy = None
    try:
        code = command()
    except TooBusyError as error:
        code, busy = TOO_BUSY_EXIT_CODE, error
    if code == TOO_BUSY_EXIT_CODE and (faults := sign_faults(scenario)):
        for fault in faults:
            print(f'FAILED: {fault}', file=sys.stderr)
        return 1
    if busy is not None:
        raise busy
    return code


def conclude(scenario: Scenario, out: Path, followers: int, flown: Flown) -> int:
    """Write summaries and reports, print the figures, and return the exit code."""
    flights: dict[str, LiveFlight] = {}
    summaries: dict[str, dict[str, Any]] = {}
    limits: list[FigureBound] = []
    title = f'flock_follower on the desk: {scenario.name}'
    for namespace in namespaces(followers):
        flight = flights[namespace] = read_flown(scenario, out / namespace, namespace)
        summary = summaries[namespace] = scenario_figures(
            flight, own(flown.cores, namespace), own(flown.exit_codes, namespace), flown.load,
            flown.speed)
        demanded = scenario_bounds(flight, summary)
        limits += [bound._replace(key=f'{namespace}.{bound.key}') for bound in demanded]
        judgments = report(
            out / namespace, f'{title} {namespace}'.rstrip(), scenario.summary, summary, demanded,
            scenario_chapters(flight), cautions(summary), load=flown.load)
    pages = [out / namespace / 'report.html' for namespace in flights]
    if followers > 1:
        summary = column_figures(scenario, flights)
        nearest = FigureBound('nearest_m', nearest_allowed(scenario), load=UNBOUNDED)
        judgments = report(
            out, f'{title}, a column of {followers}', scenario.summary, summary,
            [nearest, *limits], (), parts=summaries, load=flown.load)
        summary, pages = {**summary, **summaries}, [*pages, out / 'report.html']
    print()
    for each in summaries.values():
        for warning in cautions(each):
            print(f'warning: {warning}', file=sys.stderr)
    return announce(summary, judgments, pages, out, flown.load)


def scenario_bounds(flight: LiveFlight, summary: Mapping[str, Any]) -> list[FigureBound]:
    """Return the bounds of `fly`; if the leader is too fast, a warning replaces the band."""
    params = flight.scenario.flight
    demanded = bounds('external' if flight.external else 'fly', {
        'near': nearest_allowed(flight.scenario), 'far': round(math.sqrt(params.d1), 2),
        'a_max': params.a_max, 'speed': params.v_max + SPEED_TOLERANCE,
        'planned': float(flight.log['duration']) - DURATION_SHORT})
    if summary['leader_faster_than_v_max']:
        for key in ('time_in_band_share', 'true_distance_m.max'):
            demanded.pop(key, None)
        demanded['planner.warnings'] = FigureBound('planner.warnings', least=1, load=UNBOUNDED)
    # A pilot takes over on any machine.
    if str((summary['external'] or {}).get('ended_early')).startswith(TAKEN_OVER):
        demanded['duration_s'] = demanded['duration_s']._replace(load=0.0)
    found = [*demanded.values()]
    for outage in judged_outages(flight):
        key = f'outages.{outage_name(outage)}'
        found += [FigureBound(f'{key}.hold_after_s', 0, hold_within(outage), UNBOUNDED),
                  FigureBound(f'{key}.reasons', least=1, load=UNBOUNDED)]
        if flight.duration > outage.at + outage.duration + AGAIN_WITHIN:
            found.append(FigureBound(f'{key}.track_after_s', 0, AGAIN_WITHIN, UNBOUNDED))
    return found


def nearest_allowed(scenario: Scenario) -> float:
    """Return the least distance allowed between two vehicles, m."""
    return round(SAFE * math.sqrt(scenario.flight.d0), 3)


def column_figures(scenario: Scenario, flights: Mapping[str, LiveFlight]) -> dict[str, Any]:
    """
    Return the figures of a whole column, for the time in which all its vehicles flew.

    ``nearest_m`` is the least true distance of any two vehicles; ``pairs`` has the least distance
    of each pair.
    """
    logs = {name: flight.log for name, flight in flights.items()}
    times = np.arange(max(float(log['began']) for log in logs.values()),
                      min(float(log['ended']) for log in logs.values()), STEP)
    first = next(iter(logs.values()))
    seen = float(first['start']) + (first['image_stamp'] - int(first['epoch_ns'])) * 1e-9
    tracks = {'leader': along(times, seen, first['leader_position'])}  # in the first one's frame
    for i, (name, log) in enumerate(logs.items()):
        tracks[name] = np.array([-i * spacing(scenario), 0.0, 0.0]) + along(
            times, flights[name].speeds['follower'][0] + float(log['began']), log['position'])
    pairs = {f'{a} to {b}': float(np.nanmin(np.linalg.norm(tracks[a] - tracks[b], axis=1)))
             for a, b in combinations(tracks, 2)}
    return jsonable({
        'column_of': scenario.name, 'followers': len(flights),
        'nearest_m': min(pairs.values()), 'pairs': pairs,
        'speed_max_m_s': most(np.concatenate(
            [flight.speeds['follower'][1] for flight in flights.values()]))})


def cautions(summary: Mapping[str, Any]) -> list[str]:
    """Return the warnings: images left out, a flight cut short."""
    warnings = []
    skipped = summary['skipped_images'] / (summary['skipped_images'] + summary['frames'])
    if skipped > MAX_SKIPPED_SHARE:
        warnings.append(f'{100 * skipped:.0f} % of the images were not rendered in time')
    if early := (summary['external'] or {}).get('ended_early'):
        warnings.append(f'the flight ended after {summary["duration_s"]:.1f} s: {early}')
    return warnings


if __name__ == '__main__':
    sys.exit(main())
