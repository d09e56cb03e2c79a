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
Measure perception beside other marker detectors: CPU time, recall, accuracy, consistency.

``make bench-perception``, or ``python benchmarks/perception.py --flights sample hard``. A flight
is a bag of images, odometry and truth. Every image goes, in one process on one thread, through

- default: ``cv2.aruco.ArucoDetector`` with its default parameters over the whole image, then the
  square's pose by IPPE; velocity from the difference of two positions;
- subpix: the same with ``CORNER_REFINE_SUBPIX``;
- aruco2 and apriltag, if their packages are installed: see ``benchmarks/detectors.py``;
- ours: ``Tracker.process_image`` as the node calls it, fed with the odometry.

They take turns, see ``benchmarks/flight.py``. Exit code 0 only if every bound holds. The flight
``tag36h11`` is the sample with a marker that AprilTag and OpenCV both know.

``--flights cameras`` compares two cameras with one in the same way, on the sample: a second one
that sees the leader as well, and a second one that looks back and sees nobody.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
import json
import os
from pathlib import Path
import sys
from typing import NamedTuple

from cameras import CAMERAS, Cameras
import cv2
from detectors import ARUCO, TAG
from flight import BAGS, Figures, Flight
import numpy as np

from flock_desk.camera.renderer import leader, marker_print, Renderer, SIDE_LENGTH
from flock_desk.sample_bag import IMAGE_RATE, Recording, VARIANTS, write
from flock_follower.bags.bag import BagError
from flock_follower.bags.writer import BagWriter
from flock_follower.perception import markers as neighbors
from flock_follower.perception.images import compute_in_one_thread
from flock_follower.system.files import resource

SHORT = 100  # images of a flight that is rendered only to measure time


class Bounds(NamedTuple):
    """What a flight must reach; infinite if it need not."""

    ratio: float
    """CPU time of default over ours, at least."""
    distance_rms: float = np.inf
    """m, at most."""
    velocity_rms: float = np.inf
    """m/s, at most."""
    turned: float = np.inf
    """Share of attitudes more than 20 degrees wrong, at most."""


FLIGHTS = {
    'sample': Bounds(7.0, 0.004, 0.03, 0.01),
    'hd': Bounds(12.0, 0.004, 0.03, 0.01),
    'full_hd': Bounds(25.0, 0.004, 0.03, 0.01),
    'hard': Bounds(7.0, 0.015),
    'fisheye': Bounds(7.0),
    'tag36h11': Bounds(7.0, 0.004, 0.03, 0.01),
}
#: Of the normalized estimation error squared (NEES) of position and of velocity: half to twice
#: their three dimensions.
NEES = 1.5, 6.0


def main(args: Sequence[str] | None = None) -> int:
    """Run the flights, print the tables and the bounds missed, and return the exit code."""
    parser = argparse.ArgumentParser(
        description='Measure perception beside other marker detectors.')
    choices = [*FLIGHTS, 'cameras']
    parser.add_argument('--flights', nargs='+', choices=choices, default=choices,
                        metavar='NAME', help=f'of {", ".join(choices)} (default: all)')
    parser.add_argument('--frames', type=int, default=0, help='images of each (default: all)')
    parser.add_argument('--json', type=Path, help='file to write the figures to')
    options = parser.parse_args(args)
    if options.frames < 0:
        parser.error(f'--frames = {options.frames}: must be at least 0')
    compute_in_one_thread()
    print(f'OpenCV {cv2.__version__}, numpy {np.__version__}, one thread, CPU time')
    figures: dict[str, dict[str, dict[str, float]]] = {}
    missed: list[str] = []
    try:
        for name in options.flights:
            if name == 'cameras':
                shares = Cameras(flight_bag('sample'), options.frames).shares()
                missed += [f'{setup}: CPU {share:.2f} times that of one camera, must be at most '
                           f'{CAMERAS[setup]:g}' for setup, share in shares.items()
                           if share > CAMERAS[setup]]
                figures[name] = {'cpu_share': shares}
                continue
            results = Flight(flight_bag(name), options.frames,
                             TAG if name == 'tag36h11' else ARUCO).figures()
            show(name, results)
            missed += [f'{name}: {text}' for text in misses(results, FLIGHTS[name])]
            figures[name] = {method: f._asdict() for method, f in results.items()}
        if options.json:
            options.json.write_text(json.dumps(figures, indent=1) + '\n', encoding='utf-8')
    except (BagError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    print('\nevery bound holds' if not missed else '\nbounds missed:')
    for text in missed:
        print(f'  {text}')
    return 1 if missed else 0


def flight_bag(name: str) -> Path:
    """Return the bag of a flight, rendered first where it is not there."""
    if name == 'sample':
        return resource('bags/sample')
    whole, short = BAGS / name, BAGS / 'short' / name
    if whole.exists() or short.exists():
        return whole if whole.exists() else short
    if name == 'tag36h11':
        write_tagged(short)
        return short
    variant, bag = VARIANTS[name], whole
    if name in ('hd', 'full_hd'):  # the same flight as the sample: what is new is the time
        variant, bag = replace(variant, duration=SHORT / IMAGE_RATE), short
    write(variant, 1, bag, os.cpu_count() or 1)
    return bag


def write_tagged(bag: Path) -> None:
    """Write the first images of the sample, with marker 0 of the dictionary TAG on the leader."""
    variant = replace(VARIANTS['sample'], duration=SHORT / IMAGE_RATE)
    recording, cells = Recording(variant), neighbors.marker_cells(TAG)
    code = np.pad(neighbors.draw_marker(TAG, 0, cells) > 127, 1, constant_values=True)
    recording.renderer = Renderer(variant.camera, variant.sensor, leader(
        marker_print(code.astype(float), SIDE_LENGTH / cells)))
    with BagWriter(bag) as writer:
        for message in recording.messages(map(recording.image, range(SHORT))):
            writer.write(message.topic, message.msgtype, message.stamp_ns, message.data)


def misses(results: dict[str, Figures], bounds: Bounds) -> list[str]:
    """Return what each bound that is missed asks for, and the figure."""
    ours, default = results['ours'], results['default']
    ratio = default.cpu_ms_mean / ours.cpu_ms_mean
    checks = [
        (f'CPU ratio {ratio:.1f}, must be at least {bounds.ratio:g}', ratio >= bounds.ratio),
        (f'recall {ours.recall:.3f}, must be at least that of default, {default.recall:.3f}',
         ours.recall >= default.recall),
        (f'distance RMS {100 * ours.distance_rms_m:.2f} cm, must be at most '
         f'{100 * bounds.distance_rms:.2g} cm', ours.distance_rms_m <= bounds.distance_rms),
        (f'velocity RMS {ours.velocity_rms_m_s:.3f} m/s, must be at most '
         f'{bounds.velocity_rms:g} m/s', ours.velocity_rms_m_s <= bounds.velocity_rms),
        (f'attitude off by more than 20 degrees in {ours.turned_share:.1%}, must be in at most '
         f'{bounds.turned:.0%}', ours.turned_share <= bounds.turned),
        *((f'NEES of {what} {value:.2f}, must be in [{NEES[0]}, {NEES[1]}]',
           NEES[0] <= value <= NEES[1])
          for what, value in (('position', ours.nees_position),
                              ('velocity', ours.nees_velocity)))]
    return [text for text, holds in checks if not holds]


def show(name: str, results: dict[str, Figures]) -> None:
    """Print the table of a flight."""
    print(f'\n{name:<13}    CPU, ms per image            recall   distance, cm     velocity   '
          'turned     NEES of 3\n'
          '                   mean     p50     p99   ratio           bias     RMS    RMS m/s   '
          '> 20 deg   position  velocity')
    for method, f in results.items():
        ratio = results['default'].cpu_ms_mean / f.cpu_ms_mean
        nees = '' if not np.isfinite(f.nees_position) else (
            f'{f.nees_position:11.2f}{f.nees_velocity:10.2f}')
        print(f'  {method:<13}{f.cpu_ms_mean:8.2f}{f.cpu_ms_p50:8.2f}{f.cpu_ms_p99:8.2f}'
              f'{ratio:8.1f}{f.recall:9.3f}{100 * f.distance_bias_m:8.2f}'
              f'{100 * f.distance_rms_m:8.2f}{f.velocity_rms_m_s:11.3f}{f.turned_share:11.1%}'
              f'{nees}', flush=True)


if __name__ == '__main__':
    sys.exit(main())
