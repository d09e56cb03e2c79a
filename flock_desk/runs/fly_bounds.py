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

"""What a live flight did, in figures, and the bounds that it must keep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
import math
import re
from typing import Any

import numpy as np

from flock_desk.runs.flight_record import flight_figures
from flock_desk.runs.fly_record import LiveRecord
from flock_desk.runs.judge import FigureBound
from flock_desk.runs.summary import jsonable, most
from flock_desk.scenarios.scenario import FlightParams, Outage
from flock_follower.geometry import Array

SPEED_TOLERANCE = 0.05  # m/s: what noise and gusts add to a speed that is held at v_max
SAFE = 0.9  # of sqrt(d0): nearer than this no follower may come
CORES = 1.5
MISSED = 0.005  # of the planner's ticks
RECALL = 0.9
GAP = 0.5  # s without an estimate although the leader could be seen
BRAKE_WITHIN = 0.3  # s after the last odometry
HOLD_WITHIN = 2.1  # s after the last image of the leader: coast_timeout, and one tick
IN_BAND_EXTERNAL = 0.99  # of the time; what a real autopilot's loops and estimator may cost
ALTITUDE_OFF = 0.3  # m from the leader's height
LEVEL_WITHIN = 3.0  # s after the leader has come into view: by then its height is reached
DURATION_SHORT = 0.1  # s by which a flight may be shorter than was asked for
OK = (0, b'\x00')  # DiagnosticStatus.OK, as readers of bags and rclpy give a byte
PACE = 0.9  # of our clock: a slower vehicle is another vehicle
AGAIN_WITHIN = 2.0  # s after odometry or leader have returned
OUTRUN = 1.0  # s for which a leader is faster than v_max that outruns; a gust is shorter


@dataclass(frozen=True)
class Usage:
    """CPU time, s, of every process, from one moment to another, s on the monotonic clock."""

    begin: dict[str, float]
    began: float
    end: dict[str, float] = field(default_factory=dict)
    ended: float = math.nan

    def until(self, end: dict[str, float], ended: float) -> Usage:
        """Return the same up to a later moment; who has ended meanwhile keeps what it used."""
        return Usage(self.begin, self.began, {**self.end, **end}, ended)

    def of(self, prefix: str) -> Usage:
        """Return that of the processes whose names begin so, under the rest of their names."""
        begin, end = ({name.removeprefix(prefix): used for name, used in times.items()
                       if name.startswith(prefix)} for times in (self.begin, self.end))
        return Usage(begin, self.began, end, self.ended)

    def cores(self) -> dict[str, float]:
        """Return how many cores each process used."""
        return {name: (used - self.begin[name]) / (self.ended - self.began)
                for name, used in self.end.items() if name in self.begin}


def summarize(flight: LiveRecord, usage: Usage,
              exit_codes: Mapping[str, int | None]) -> dict[str, Any]:
    """
    Return the summary of a flight: figures by name, those that cannot be known None.

    Beside :func:`~flock_desk.runs.flight_record.flight_figures`: ``time_in_band_share`` is
    of all times, ``longest_gap_in_view_s`` the longest time without an estimate of which all
    images showed the leader; ``planner.warnings`` counts the times it published any, and
    ``warning`` is the first. ``outages``: after how long the planner held, and followed again.
    ``altitude_off_m`` is how far the height was from the leader's at most, see
    :func:`_altitude_off`. ``problems`` counts what each node had to complain of, in seconds.
    ``external``: of an autopilot elsewhere, what placed the vehicle, and how fast its time went by
    ours; what placed the leader, if that was flown elsewhere, too; and with which words the bridge
    ended the flight before its time, if it did.
    """
    params = flight.scenario.flight
    cores = dict(sorted(usage.cores().items(), key=lambda item: -item[1]))
    common = flight_figures(flight, exit_codes)
    faster = flight.leader_speed > 1.001 * params.v_max
    warnings = [text for t, text in flight.values('planner', 'warnings') if t > 0.0 and text]
    table = flight.table
    return {key: jsonable(value) for key, value in {
        'scenario': flight.scenario.name,
        **common,
        'time_in_band_share': flight.time_in_band_share,
        'longest_gap_in_view_s': _longest(
            table['time'], ~np.isfinite(table['distance']) & (table['visible'] == 1.0)),
        'leader_speed_max_m_s': most(flight.leader_speed),
        'leader_faster_than_v_max': _longest(table['time'], faster) >= OUTRUN,
        'altitude_off_m': most(_altitude_off(flight)),
        'planner': {
            **common['planner'],
            'missed_ticks_share': common['planner']['missed_ticks'] * flight.params.period
            / flight.duration,
            'warnings': len(warnings),
            'warning': warnings[0] if warnings else None},
        'outages': {_name(outage): _outage(flight, outage) for outage in _judged(flight)},
        'problems': _problems(flight),
        'external': ({'pose_from': str(flight.log['pose_source']),
                      'leader_from': str(flight.log['pose_source_of_leader']) or None,
                      'pace': flight.pace,
                      'ended_early': str(flight.log['ended_early']) or None}
                     if flight.external else None),
        'skipped_images': int(flight.log['skipped_images']),
        'cpu_cores': {'total': sum(cores.values()) if cores else None, **cores},
    }.items()}


def bounds(flight: LiveRecord, summary: Mapping[str, Any]) -> list[FigureBound]:
    """Return what a flight must keep; who is outrun need not hold the band, but say so."""
    params = flight.scenario.flight
    return [
        *_of_band(params, summary['leader_faster_than_v_max'], flight.external),
        *(_of_external(flight) if flight.external else []),
        FigureBound('true_distance_m.min', least=round(SAFE * math.sqrt(params.d0), 3)),
        FigureBound('recall', least=RECALL),
        FigureBound('longest_gap_in_view_s', most=GAP),
        FigureBound('planner.missed_ticks_share', most=MISSED),
        FigureBound('setpoints.acceleration_max_m_s2', most=params.a_max),
        FigureBound('speed_max_m_s', most=params.v_max + SPEED_TOLERANCE),
        *(bound for outage in _judged(flight) for bound in _of_outage(flight, outage)),
        FigureBound('cpu_cores.total', most=CORES),
        FigureBound('failed_processes', most=0)]


def _of_external(flight: LiveRecord) -> list[FigureBound]:
    return [FigureBound('duration_s', least=float(flight.log['duration']) - DURATION_SHORT),
            FigureBound('altitude_off_m', most=ALTITUDE_OFF),
            FigureBound('external.pace', least=PACE)]


def _altitude_off(flight: LiveRecord) -> Array:
    """
    Return how far the follower's height was from the leader's, m, at the images that count.

    Those count whose leader has been in view for ``LEVEL_WITHIN``: the follower cannot know the
    height of a leader that it does not see. One of the scenario begins at the follower's height,
    so all images from the beginning count; one flown elsewhere begins at any height.
    """
    times, hidden = flight.table['time'], flight.table['visible'] == 0.0
    begin = times[0] if str(flight.log['pose_source_of_leader']) else -math.inf
    last_hidden = np.maximum.accumulate(np.where(hidden, times, begin))
    off: Array = np.abs(flight.leader[:, 2] - flight.follower[:, 2])
    return off[times - last_hidden >= LEVEL_WITHIN]


def _of_band(params: FlightParams, outrun: bool, external: bool) -> list[FigureBound]:
    if outrun:
        return [FigureBound('planner.warnings', least=1)]
    if external:
        return [FigureBound('time_in_band_share', least=IN_BAND_EXTERNAL)]
    return [FigureBound('time_in_band_share', least=1),
            FigureBound('true_distance_m.max', most=round(math.sqrt(params.d1), 2))]


def _of_outage(flight: LiveRecord, outage: Outage) -> Iterator[FigureBound]:
    yield FigureBound(f'outages.{_name(outage)}.hold_after_s', 0, _hold_within(outage))
    yield FigureBound(f'outages.{_name(outage)}.reasons', least=1)
    if flight.duration > outage.at + outage.duration + AGAIN_WITHIN:
        yield FigureBound(f'outages.{_name(outage)}.track_after_s', 0, AGAIN_WITHIN)


def _hold_within(outage: Outage) -> float:
    return BRAKE_WITHIN if outage.what == 'vio' else HOLD_WITHIN


def _name(outage: Outage) -> str:
    return f'{outage.what}_at_{outage.at:g}_s'


def _judged(flight: LiveRecord) -> list[Outage]:
    """Return the outages long enough, and flown far enough, to ask for HOLD."""
    return [outage for outage in flight.scenario.outages if outage.duration >= _hold_within(outage)
            and flight.duration >= outage.at + _hold_within(outage)]


def _outage(flight: LiveRecord, outage: Outage) -> dict[str, Any]:
    """Return when the planner held after an outage began, and followed again after its end."""
    end = outage.at + outage.duration
    held = next((t for t, s in flight.states if s == 'HOLD' and t >= outage.at), math.nan)
    again = next((t for t, s in flight.states if s == 'TRACK' and t >= max(held, end)), math.nan)
    reasons = [r for t, r in flight.values('planner', 'reason') if outage.at < t < end and r]
    return {'hold_after_s': held - outage.at, 'track_after_s': again - end,
            'reasons': len(reasons), 'reason': reasons[-1] if reasons else None}


def _problems(flight: LiveRecord) -> dict[str, int]:
    """Return how often each node told which problem, numbers left out, during the scenario."""
    told = Counter(
        f'{status.name}: {re.sub(r"[0-9]+([.][0-9]+)?", "#", status.message)}'
        for t, array in flight.diagnostics if 0.0 < t <= flight.duration
        for status in array.status if status.level not in OK)
    return dict(told.most_common())


def _longest(times: Array, holds: Any) -> float:
    """Return the longest time, s, at whose images (n,) something holds, from the one before."""
    longest, since = 0.0, math.inf
    for time, held in zip(times.tolist(), holds.tolist()):
        since = min(since, time) if held else time
        longest = max(longest, time - since)
    return longest
