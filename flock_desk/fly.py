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
Exit code 0 only if every bound holds; 3 if the machine was too busy: then nothing is judged.

``--autopilot udp:127.0.0.1:14540`` (PX4) or ``tcp:127.0.0.1:5760`` (ArduPilot) has the follower
flown by an autopilot that runs already, see docs/desk.md: from the ground, and back to it. With
``--leader-truth`` its leader is the vehicle of a second autopilot, which another program flies.

``--followers 2`` flies a column: each follower with nodes, namespace, vehicle and simulator of its
own, its camera on the vehicle of the one before it.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
import math
from pathlib import Path
import sys
from typing import Any

import numpy as np

from flock_desk.runs.console import guarded, Options, parsed
from flock_desk.runs.flight import fly, links, namespaces, own, SIH_TRUTH, spacing
from flock_desk.runs.judge import FigureBound
from flock_desk.runs.record import clear, LiveRecord, locked, PICTURE, read_flown, set_aside
from flock_desk.runs.report import announce, Chapter, report
from flock_desk.runs.summary import (
    hold_within,
    jsonable,
    judged_outages,
    most,
    outage_name,
    scenario_figures,
)
from flock_desk.scenarios.scenario import DURATIONS, Scenario, SEEDS
from flock_desk.scenarios.scenario_file import load_for_real_time, names
from flock_follower.files import whole_file
from flock_follower.geometry import Array
from flock_follower.ranges import Range

FOLLOWERS = Range(1, 8, whole=True)
BUSY = 0.02  # of the images, not rendered in time: the machine was too slow
SPEED_TOLERANCE = 0.05  # m/s: what noise and gusts add to a speed that is held at v_max
SAFE = 0.9  # of sqrt(d0): nearer than this no follower may come
CORES = 1.5
MISSED = 0.005  # of the planner's ticks
RECALL = 0.9
GAP = 0.5  # s without an estimate although the leader could be seen
IN_BAND_EXTERNAL = 0.99  # of the time; what a real autopilot's loops and estimator may cost
ALTITUDE_OFF = 0.3  # m from the leader's height
DURATION_SHORT = 0.1  # s by which a flight may be shorter than requested
PACE = 0.9  # of our clock: a slower vehicle is another vehicle
AGAIN_WITHIN = 2.0  # s after odometry or leader have returned
STEP = 0.02  # s between the times at which the vehicles of a column are compared


_OPTIONS: Options = {
    '--scenario': {'default': 'indoor', 'metavar': 'NAME',
                   'help': 'a name in config/scenarios, or the path of a file (%(default)s)'},
    '--seed': {'type': int, 'default': 0, 'help': 'of everything that chance decides'},
    '--duration': {'type': float, 'default': 0.0, 'metavar': 'S',
                   'help': 'fly no longer than this, s; never longer than the scenario (as '
                   'long as it)'},
    '--followers': {'type': int, 'default': 1, 'metavar': 'N',
                    'help': 'in a column, each behind the one before it (%(default)s); every one '
                    'takes about one core'},
    '--output': {'type': Path, 'default': Path('build/fly'),
                 'help': 'folder for report and logs (%(default)s)'},
    '--moving': {'type': Path, 'metavar': 'FILE',
                 'help': 'also write a moving picture of the flight, an animated WebP'}}
_EXTERNAL: Options = {
    '--autopilot': {'default': '', 'metavar': 'URL',
                    'help': 'where the bridge finds it: udp:HOST:PORT where it sends to, '
                    'tcp:HOST:PORT where it listens'},
    '--truth': {'default': '', 'metavar': 'URL',
                'help': 'another link, on which it sends the true place '
                f'(udp: {SIH_TRUTH}; tcp: its port + 2)'},
    '--leader-truth': {'default': '', 'metavar': 'URL',
                       'help': "likewise of a second autopilot, MAVLink system 2, whose vehicle "
                       "is the leader (the scenario's own leader)"},
    '--forward-odometry': {'action': 'store_true',
                           'help': 'send it the odometry, for flight without GPS'}}


def main(args: Sequence[str] | None = None) -> int:
    """Fly, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='fly', description='Fly a scenario on the desk, through the real nodes.',
        epilog=f'scenarios: {", ".join(names())}')
    options = parsed(
        parser, args, _OPTIONS, {'an autopilot that runs already, see docs/desk.md': _EXTERNAL},
        {'seed': SEEDS, 'duration': DURATIONS, 'followers': FOLLOWERS})
    column = options.followers > 1
    for wrong, fault in (
            (not options.autopilot and (
                options.truth or options.leader_truth or options.forward_odometry),
             '--truth, --leader-truth and --forward-odometry: only with --autopilot'),
            (options.autopilot and column, '--followers: not with --autopilot'),
            (options.moving and column, '--moving: not with --followers')):
        if wrong:
            parser.error(fault)
    return guarded(partial(_fly, options),
                   hint=f'; the logs of every process are in {options.output}')


def _fly(options: argparse.Namespace) -> int:
    scenario = load_for_real_time(options.scenario)
    duration = min(options.duration or scenario.duration, scenario.duration)
    if options.duration > duration:
        print(f'{scenario.name} lasts {duration:g} s: it is flown for so long, not for '
              f'--duration = {options.duration:g} s', flush=True)
    external = (links(options.autopilot, options.truth, options.forward_odometry,
                      options.leader_truth) if options.autopilot else None)
    with locked(options.output):
        set_aside(options.output)
        for namespace in ('', *namespaces(options.followers)):
            clear(options.output / namespace)
        cores, exit_codes = fly(scenario, options.scenario, options.seed, duration,
                                options.output, external, options.followers)
        code = conclude(scenario, options.output, options.followers, cores, exit_codes)
        if options.moving:
            from flock_desk.runs.fly_pictures import moving_picture
            with whole_file(options.moving) as file:
                file.write(moving_picture(read_flown(scenario, options.output)))
        return code


def conclude(scenario: Scenario, out: Path, followers: int, cores: Mapping[str, float],
             exit_codes: Mapping[str, int | None]) -> int:
    """Write summaries and reports, print the figures, and return the exit code."""
    flights: dict[str, LiveRecord] = {}
    summaries: dict[str, dict[str, Any]] = {}
    limits: list[FigureBound] = []
    title = f'flock_follower on the desk: {scenario.name}'
    for namespace in namespaces(followers):
        folder = out / namespace
        flight = flights[namespace] = read_flown(scenario, folder, namespace)
        summary = summaries[namespace] = scenario_figures(
            flight, own(cores, namespace), own(exit_codes, namespace))
        bounds = scenario_bounds(flight, summary)
        limits += [bound._replace(key=f'{namespace}.{bound.key}') for bound in bounds]
        judgements = report(
            folder, f'{title} {namespace}'.rstrip(), scenario.summary, summary, bounds,
            partial(_pictures, folder, flight), warnings=cautions(summary))
    pages = [out / namespace / 'report.html' for namespace in flights]
    if followers > 1:
        summary = column_figures(scenario, flights)
        judgements = report(
            out, f'{title}, a column of {followers}', scenario.summary, summary,
            [nearest(scenario, 'nearest_m'), *limits],
            partial(_column_pictures, scenario, flights), parts=summaries)
        summary, pages = {**summary, **summaries}, [*pages, out / 'report.html']
    print()
    code = announce(summary, judgements, pages, out)
    for each in summaries.values():
        for warning in cautions(each):
            print(f'warning: {warning}', file=sys.stderr)
    return code


def scenario_bounds(flight: LiveRecord, summary: Mapping[str, Any]) -> list[FigureBound]:
    """Return what `fly` demands; an outrun follower must warn instead of holding the band."""
    params = flight.scenario.flight
    if summary['leader_faster_than_v_max']:
        bounds = [FigureBound('planner.warnings', least=1)]
    elif flight.external:
        bounds = [FigureBound('time_in_band_share', least=IN_BAND_EXTERNAL)]
    else:
        bounds = [FigureBound('time_in_band_share', least=1),
                  FigureBound('true_distance_m.max', most=round(math.sqrt(params.d1), 2))]
    if flight.external:
        bounds += [
            FigureBound('duration_s', least=float(flight.log['duration']) - DURATION_SHORT),
            FigureBound('altitude_off_m', most=ALTITUDE_OFF),
            FigureBound('external.pace', least=PACE)]
    bounds += [nearest(flight.scenario, 'true_distance_m.min'),
               FigureBound('recall', least=RECALL),
               FigureBound('longest_gap_in_view_s', most=GAP),
               FigureBound('planner.missed_ticks_share', most=MISSED),
               FigureBound('setpoints.acceleration_max_m_s2', most=params.a_max),
               FigureBound('speed_max_m_s', most=params.v_max + SPEED_TOLERANCE)]
    for outage in judged_outages(flight):
        key = f'outages.{outage_name(outage)}'
        bounds += [FigureBound(f'{key}.hold_after_s', 0, hold_within(outage)),
                   FigureBound(f'{key}.reasons', least=1)]
        if flight.duration > outage.at + outage.duration + AGAIN_WITHIN:
            bounds.append(FigureBound(f'{key}.track_after_s', 0, AGAIN_WITHIN))
    return [*bounds, FigureBound('cpu_cores.total', most=CORES),
            FigureBound('failed_processes', most=0)]


def nearest(scenario: Scenario, key: str) -> FigureBound:
    """Return the bound on the least distance of two vehicles."""
    return FigureBound(key, least=round(SAFE * math.sqrt(scenario.flight.d0), 3))


def column_tracks(scenario: Scenario, flights: Mapping[str, LiveRecord]
                  ) -> tuple[Array, dict[str, Array], dict[str, Array]]:
    """
    Return the motion of a column while all of it flew the scenario, in the first one's frame.

    :returns: times (n,), s; positions (n, 3), m, by vehicle; distances (n,), m, by pair.
    """
    logs = {name: flight.log for name, flight in flights.items()}
    began = max(float(log['began']) for log in logs.values())
    times = np.arange(began, min(float(log['ended']) for log in logs.values()), STEP)
    first = next(iter(logs.values()))
    tracks = {'leader': _at(times, float(first['start']) + (
        first['image_stamp'] - int(first['epoch_ns'])) * 1e-9, first['leader_position'])}
    for i, (name, log) in enumerate(logs.items()):
        tracks[name] = np.array([-i * spacing(scenario), 0.0, 0.0]) + _at(
            times, flights[name].speeds['follower'][0] + float(log['began']), log['position'])
    return times - began, tracks, {
        f'{a} to {b}': np.linalg.norm(tracks[a] - tracks[b], axis=1)
        for a, b in combinations(tracks, 2)}


def _at(times: Array, known: Array, positions: Array) -> Array:
    """Return positions (n, 3) at times (n,); NaN if they are unknown."""
    return np.stack([np.interp(times, known, column, np.nan, np.nan)
                     for column in positions.T], axis=1)


def column_figures(scenario: Scenario, flights: Mapping[str, LiveRecord]) -> dict[str, Any]:
    """
    Return the figures of a column as a whole.

    ``nearest_m`` is the least true distance of any two vehicles, ``pairs`` that of each two.
    """
    _, _, distances = column_tracks(scenario, flights)
    pairs = {pair: float(np.nanmin(distance)) for pair, distance in distances.items()}
    return jsonable({
        'column_of': scenario.name, 'followers': len(flights),
        'nearest_m': min(pairs.values(), default=math.nan), 'pairs': pairs,
        'speed_max_m_s': most(np.concatenate(
            [flight.speeds['follower'][1] for flight in flights.values()]))})


def _pictures(folder: Path, flight: LiveRecord) -> Sequence[Chapter]:
    from flock_desk.runs.fly_pictures import portrait, scenario_chapters
    with whole_file(folder / PICTURE) as file:
        file.write(portrait(flight))
    return scenario_chapters(flight)


def _column_pictures(scenario: Scenario, flights: Mapping[str, LiveRecord]) -> Sequence[Chapter]:
    from flock_desk.runs.fly_pictures import column_chapters
    return column_chapters(*column_tracks(scenario, flights),
                           next(iter(flights.values())).params.law)


def cautions(summary: Mapping[str, Any]) -> list[str]:
    """Return the warnings: a busy machine, a flight cut short."""
    warnings = []
    skipped = summary['skipped_images'] / (summary['skipped_images'] + summary['frames'])
    if skipped > BUSY:
        warnings.append(f'this machine was too busy: {100 * skipped:.0f} % of the images were not '
                    'rendered in time, which the follower feels as a camera that stops; fly again '
                    'when it is idle')
    if early := (summary['external'] or {}).get('ended_early'):
        warnings.append(f'the flight ended after {summary["duration_s"]:.1f} s: {early}')
    return warnings


if __name__ == '__main__':
    sys.exit(main())
