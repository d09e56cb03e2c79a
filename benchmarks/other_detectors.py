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
Fly scenarios in lock step on the poses of simulated detectors that are not ours.

``python benchmarks/other_detectors.py [--scenario NAME ...] [--seeds N] [--duration S]``: prints
a row for each flight; exit code 1 if a bound does not hold. ``--acceleration`` and
``--acceleration_time`` are the parameters of relative_pose.
"""

from __future__ import annotations

import argparse
import sys

from flock_desk.closed_loop.detector_flight import DetectorFlight, DETECTORS, Figures
from flock_desk.scenarios.scenario_file import load
from flock_follower.bags.message_types import empty
from flock_follower.perception.neighbor_motion import FilterParams

SCENARIOS = ('indoor', 'random_walk', 'circle')
NEAREST = 0.9  # m
#: Share of time, at least; detectors that are not in it need not hold the band, but the rest.
IN_BAND = {'full pose': 0.95, 'position only': 0.95, 'degraded': 0.90}
ROUNDING = 1e-9  # m/s^2


def faults(name: str, figures: Figures, a_max: float) -> list[str]:
    """Return the bounds that the figures of a flight on a detector do not hold."""
    return [text for text, holds in (
        (f'in band {figures.in_band:.3f}', figures.in_band >= IN_BAND.get(name, 0.0)),
        (f'nearest {figures.nearest:.2f} m', figures.nearest >= NEAREST),
        (f'acceleration {figures.acceleration:.2f} m/s^2',
         figures.acceleration <= a_max + ROUNDING)) if not holds]


def main() -> int:
    """Fly, print, and return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--scenario', nargs='+', default=[*SCENARIOS], metavar='NAME')
    parser.add_argument('--detector', nargs='+', default=[*IN_BAND], choices=[*DETECTORS])
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--duration', type=float, default=60.0, help='s')
    parser.add_argument('--acceleration', type=float, default=FilterParams.acceleration)
    parser.add_argument('--acceleration_time', type=float,
                        default=FilterParams.acceleration_time)
    options = parser.parse_args()
    params = FilterParams(acceleration=options.acceleration,
                          acceleration_time=options.acceleration_time)
    failed = False
    print('scenario, detector, seed: in band, nearest m, farthest m, |a| m/s^2, |v| m/s, TRACK')
    for seed in range(options.seeds):
        for name in options.scenario:
            scenario = load(name)
            for detector in options.detector:
                figures = DetectorFlight(
                    scenario, seed, DETECTORS[detector], empty, params).fly(
                        min(options.duration, scenario.duration))
                wrong = faults(detector, figures, scenario.flight.a_max)
                failed |= bool(wrong)
                numbers = ', '.join(f'{value:.3f}' for value in figures[:-1])
                print(f'{name}, {detector}, {seed}: {numbers}; {figures.reasons}'
                      f'{" FAILS: " if wrong else ""}{"; ".join(wrong)}', flush=True)
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
