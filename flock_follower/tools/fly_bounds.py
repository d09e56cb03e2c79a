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

"""What a live flight did, judged against bounds."""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np

from flock_follower.geometry import Array
from flock_follower.simulation.scenarios.scenario import Outage
from flock_follower.tools.fly_record import LiveRecord
from flock_follower.tools.report import Check, within

SPEED_TOLERANCE = 0.05  # m/s: what noise and gusts add to a speed that is held at v_max
SAFE = 0.9  # of sqrt(d0): nearer than this no follower may come
CORES = 1.5
MISSED = 0.5  # % of the planner's ticks
GAP = 0.5  # s without an estimate although the leader could be seen
BRAKE_WITHIN = 0.3  # s after the last odometry
HOLD_WITHIN = 2.1  # s after the last image of the leader: coast_timeout, and one tick
AGAIN_WITHIN = 2.0  # s after odometry or leader have returned


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

    def cores(self) -> dict[str, float]:
        """Return how many cores each process used."""
        return {name: (used - self.begin[name]) / (self.ended - self.began)
                for name, used in self.end.items() if name in self.begin}


def judge(flight: LiveRecord, usage: Usage, exit_codes: dict[str, int | None]) -> list[Check]:
    """Return the table of figures beside their bounds."""
    params, log = flight.scenario.flight, flight.log
    low, high = math.sqrt(params.d0), math.sqrt(params.d1)
    inside = (flight.distance > low) & (flight.distance < high)
    fastest = float(np.max(np.linalg.norm(log['leader_velocity'], axis=1)))
    outrun = fastest > 1.001 * params.v_max
    cores = usage.cores()
    ended = flight.duration
    ticks = ended / params.planner(True).period
    missed = float(flight.value('planner', 'missed_ticks', ended + 1.0, 'nan')) - float(
        flight.value('planner', 'missed_ticks', 0.0, '0'))
    usable = log['image_usable'].astype(bool)
    return [
        Check('flown', f'{ended:.1f} s', '', None),
        Check('leader, fastest', f'{fastest:.2f} m/s', 'faster than v_max' if outrun else '',
              None),
        *_banded(flight, outrun, 100 * float(inside.mean()), high),
        within('distance, least', float(flight.distance.min()), 'm', round(SAFE * low, 3), None),
        Check('distance, mean', f'{flight.distance.mean():.2f} m', '', None),
        within('largest acceleration sent', _longest(flight.setpoints), 'm/s²', None,
               params.a_max),
        within('largest speed flown', _longest(log['velocity']), 'm/s', None,
               params.v_max + SPEED_TOLERANCE),
        within('planner ticks missed', 100 * missed / ticks, '%', None, MISSED),
        within('leader found where it can be seen',
               100 * float(flight.seen[usable].mean()) if usable.any() else 0.0, '%', 90, None,
               1),
        within('longest gap in that', _longest_gap(flight.times, flight.seen, usable), 's', None,
               GAP),
        Check('relative position error, RMS',
              f'{100 * flight.errors.position_rms:.1f} cm' if len(flight.errors.stamps) else '-',
              '', None),
        Check('relative velocity error, RMS',
              f'{flight.errors.velocity_rms:.3f} m/s' if len(flight.errors.stamps) else '-', '',
              None),
        *(check for outage in flight.scenario.outages for check in _outage(flight, outage)),
        *(Check(f'image to MAVLink latency, p{p}',
                flight.value('mavlink_bridge', f'latency_p{p}_ms', ended, '-') + ' ms', '', None)
          for p in (50, 95)),
        Check('images left out by the simulator', str(int(log['skipped_images'])), '', None),
        within('CPU cores used', sum(cores.values()), '', None, CORES),
        *(Check(f'  {name}', f'{used:.2f}', '', None) for name, used in sorted(
            cores.items(), key=lambda item: -item[1])),
        within('processes that ended badly',
               sum(code != 0 for code in exit_codes.values()), '', None, 0, 0),
    ]


def _banded(flight: LiveRecord, outrun: bool, inside: float, high: float) -> list[Check]:
    """Return how far the band was held; whom the leader outruns cannot, but has to say so."""
    greatest = float(flight.distance.max())
    if not outrun:
        return [within('in the band', inside, '%', 100, None, 1),
                within('distance, greatest', greatest, 'm', None, round(high, 2))]
    said = [text for t, text in flight.values('planner', 'warnings') if t > 0.0 and text]
    return [Check('in the band', f'{inside:.1f} %', '', None),
            Check('distance, greatest', f'{greatest:.2f} m', '', None),
            Check('told by the planner', said[0] if said else 'nothing', 'some', bool(said))]


def _outage(flight: LiveRecord, outage: Outage) -> list[Check]:
    """Return when the planner did what an outage asks for."""
    bound = BRAKE_WITHIN if outage.what == 'vio' else HOLD_WITHIN
    end = outage.at + outage.duration
    if outage.duration < bound or flight.duration < outage.at + bound:
        return []
    what = 'odometry' if outage.what == 'vio' else 'marker'
    held = next((t for t, s in flight.states if s == 'HOLD' and t >= outage.at), math.nan)
    again = next((t for t, s in flight.states if s == 'TRACK' and t >= max(held, end)), math.nan)
    reasons = [r for t, r in flight.values('planner', 'reason') if outage.at < t < end and r]
    reason = Check('  reason told', reasons[-1] if reasons else 'none', 'some', bool(reasons))
    checks = [
        within(f'{what} lost at {outage.at:g} s, HOLD after', held - outage.at, 's', 0, bound),
        reason]
    if flight.duration > end + AGAIN_WITHIN:
        checks.append(within('  following again after its return', again - end, 's', 0,
                             AGAIN_WITHIN))
    return checks


def _longest_gap(times: Array, seen: Any, usable: Any) -> float:
    """Return the longest time without an estimate of which all images were usable, s."""
    longest, since = 0.0, None
    for time, found, could in zip(times.tolist(), seen.tolist(), usable.tolist()):
        if found or not could:
            since = time
        elif since is not None:
            longest = max(longest, time - since)
    return longest


def _longest(vectors: Array) -> float:
    return float(np.max(np.linalg.norm(vectors, axis=1), initial=0.0))
