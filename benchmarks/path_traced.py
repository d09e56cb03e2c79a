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
Measure perception on path-traced flights: CPU time of the mean and of the worst image.

``python benchmarks/path_traced.py [--rows room_hover room_hover/flare ...]``. A row is a flight of
``../shared/data/rendered``, which are not in this repository, and an effect of the tool ``bag.py``
there, which makes a bag of both. The bags are written once, into ``build/bags/path_traced``. Every
image goes through OpenCV's default detector and through ours, in turns as in ``flight.py``,
and through aruco2 if it is installed (see ``detectors.py``). The default's mean in the same run is
the unit: milliseconds of a busy machine mean little.

A gross image is one with NEES of the position above 30 and an error of 0.2 m or of 0.3 m/s.

Exit code 0 only if every row holds: 99 % of our images cost at most the mean of the default's (if
they are of 640x480), NEES of the position is at most 4.5, no attitude is turned after half a
second, no image is gross, and recall is at least as in RECALL.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec, module_from_spec, spec_from_file_location
import json
from pathlib import Path
import sys
from typing import Any, NamedTuple

from flight import BAGS, Flight, WRONG
import numpy as np

from flock_follower.perception.images import compute_in_one_thread

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data' / 'rendered'
ROWS = ('room_hover', 'room_hover/jitter', 'room_hover/finger', 'room_hover/flare',
        'room_hover/overexp', 'room_hover/occlude', 'room_hover/blur1', 'room_hover/blur15',
        'room_hover/blur2', 'room_dim', 'room_tag', 'room_hd')
JITTER = 0.003  # s of the stamps, of the rows 'jitter'
#: Least recall of a row's effect, and of any other.
RECALL = {'occlude': 0.93, 'finger': 0.65, 'flare': 0.9, 'blur15': 0.9, 'blur2': 0.75}
LEAST_RECALL = 0.95
MAX_NEES = 4.5
SETTLED = 0.5  # s, from which on no attitude may be turned
#: NEES, m and m/s of a gross image: the first, and one of the others.
GROSS = 30.0, 0.2, 0.3


class Row(NamedTuple):
    """
    The figures of one row.

    CPU time per image in ms, in multiples of the default's mean, that of aruco2 likewise (NaN
    without it), and when the neighbor was first measured, s. ``sigmas_m`` is the mean of three
    standard deviations of the position, m.
    """

    default_ms: float
    cpu_ms: float
    cpu_share: float
    p99_share: float
    aruco2_share: float
    aruco2_p99_share: float
    first_s: float
    recall: float
    nees_position: float
    nees_velocity: float
    turned: int
    gross: int
    sigmas_m: float
    position_rms_m: float


def main(args: Sequence[str] | None = None) -> int:
    """Fly the rows, print their figures and the bounds missed, and return the exit code."""
    parser = argparse.ArgumentParser(description='Measure perception on path-traced flights.')
    parser.add_argument('--rows', nargs='+', default=ROWS, metavar='FLIGHT[/EFFECT]',
                        help=f'default: {", ".join(ROWS)}')
    parser.add_argument('--frames', type=int, default=0, help='images of each (default: all)')
    parser.add_argument('--seed', type=int, default=1, help='of noise and odometry (default: 1)')
    parser.add_argument('--json', type=Path, help='file to write the figures to')
    options = parser.parse_args(args)
    if not (DATA / 'bag.py').exists():
        print(f'error: {DATA}: the path-traced flights are not here', file=sys.stderr)
        return 1
    if find_spec('scipy') is None:
        print('error: the tool of the path-traced flights needs scipy', file=sys.stderr)
        return 1
    compute_in_one_thread()
    print('                     default  in means of default: ours     aruco2   first'
          '               NEES                   3 sigma   RMS\n'
          '                          ms           mean   p99   mean   p99       s'
          '  recall  position  velocity turned gross    mm    mm')
    figures, missed = {}, []
    for name in options.rows:
        row = fly(name, options.frames, options.seed)
        figures[name] = row._asdict()
        missed += [f'{name}: {text}' for text in misses(name, row)]
        print(f'  {name:<20}{row.default_ms:6.1f}{row.cpu_share:15.2f}{row.p99_share:6.2f}'
              f'{row.aruco2_share:7.2f}{row.aruco2_p99_share:6.2f}{row.first_s:8.2f}'
              f'{row.recall:8.3f}{row.nees_position:10.2f}{row.nees_velocity:10.2f}'
              f'{row.turned:7d}{row.gross:6d}{1e3 * row.sigmas_m:6.1f}'
              f'{1e3 * row.position_rms_m:6.1f}', flush=True)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + '\n', encoding='utf-8')
    print('\nevery bound holds' if not missed else '\nbounds missed:')
    for text in missed:
        print(f'  {text}')
    return 1 if missed else 0


def fly(name: str, frames: int, seed: int) -> Row:
    """Return the figures of a row."""
    flight, _, effect = name.partition('/')
    tool = load_tool()
    bag = BAGS / 'path_traced' / f'{name.replace("/", "_")}_{seed}'
    if not bag.exists():
        bag.parent.mkdir(parents=True, exist_ok=True)
        tool.write(flight, bag, seed=seed, **tool.BASE.get(flight, {}), **(
            {'jitter': JITTER} if effect == 'jitter' else {'effect_': effect or 'none'}))
    others = ('default', 'aruco2') if find_spec('aruco2') else ('default',)
    flown = Flight(bag, frames, tool.traj.flight(flight)['tag'], others)
    table = flown.errors['ours'].table('leader')
    time = table['time'] - table['time'][0]
    found = np.isfinite(table['distance'])
    known = found & np.isfinite(table['true_distance'])
    default, ours = (np.array(flown.milliseconds[method]) for method in ('default', 'ours'))
    unit = float(default.mean())
    aruco2 = np.array(flown.milliseconds.get('aruco2', [np.nan]))
    position, velocity = (np.linalg.norm(table[what][known], axis=1)
                          for what in ('position', 'velocity'))
    least, far, fast = GROSS
    gross = (table['nees_position'][known] > least) & ((position > far) | (velocity > fast))
    return Row(
        unit, float(ours.mean()), float(ours.mean()) / unit,
        float(np.percentile(ours, 99)) / unit,
        float(aruco2.mean()) / unit, float(np.percentile(aruco2, 99)) / unit,
        float(time[found][0]) if found.any() else np.inf, float(found.mean()),
        float(table['nees_position'][known].mean()),
        float(table['nees_velocity'][known].mean()),
        int(np.count_nonzero(known & (time > SETTLED) & (table['turned'] > WRONG))),
        int(np.count_nonzero(gross)),
        3.0 * float(np.linalg.norm(table['position_sigma'][known], axis=1).mean()),
        float(np.sqrt(np.mean(position**2))))


@cache
def load_tool() -> Any:
    """Return the module of a file that makes bags of the flights."""
    spec = spec_from_file_location('path_traced_bag', DATA / 'bag.py')
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def misses(name: str, row: Row) -> list[str]:
    """Return the bounds that a row misses, and its figures."""
    flight, _, effect = name.partition('/')
    recall = RECALL.get(effect, LEAST_RECALL)
    checks = [
        (f'p99 {row.p99_share:.2f} means of default, must be at most 1',
         flight == 'room_hd' or row.p99_share <= 1.0),
        (f'recall {row.recall:.3f}, must be at least {recall:g}', row.recall >= recall),
        (f'NEES {row.nees_position:.2f}, must be at most {MAX_NEES:g}',
         row.nees_position <= MAX_NEES),
        (f'{row.turned} attitudes turned, must be 0', not row.turned),
        (f'{row.gross} gross images, must be 0', not row.gross)]
    return [text for text, holds in checks if not holds]


if __name__ == '__main__':
    sys.exit(main())
