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
What ``evaluate`` costs beside reading and decoding the same bag: ``make bench-evaluate``.

Both run in this process, in turns, on one thread; what counts is the least CPU time of each.
Reading and decoding is what any program has to do: every message from its bytes, every image to
pixels. The parts of ``evaluate`` are those of ``timings`` in its summary; the rest is odometry,
the comparison with the truth, and writing the result. Imports and the report are left out: they
do not grow with the bag.

Exit code 0 only if the ratio of ``--check skip`` keeps MOST.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
import sys
import tempfile
import time

from flock_desk.runs.evaluation import evaluate, Evaluation
from flock_follower.bags.bag import BagError, deserialize, open_bag
from flock_follower.parameters.files import read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.perception.images import compute_in_one_thread, decode_image
from flock_follower.system.files import resource

#: The aim is 3: perception, planner, gate and images alone take 2.4 of it.
MOST = 4.5
#: The parts of ``Evaluation.cpu``, by their titles.
PARTS = {'perception': ('track', 'roi', 'full'), 'planner': ('planner',), 'gate': ('gate',),
         'images': ('decode',)}


def read_and_decode(bag: Path) -> None:
    """Read every message of a bag from its bytes, and every image to pixels."""
    with open_bag(bag) as opened:
        for _, msgtype, _, data in opened.messages():
            message = deserialize(data, msgtype)
            if 'Image' in msgtype:
                decode_image(message)


def spent(run: Callable[[], Evaluation | None]) -> tuple[float, Evaluation | None]:
    """Return the CPU time of a call, s, and its result."""
    start = time.process_time()
    result = run()
    return time.process_time() - start, result


def main(args: Sequence[str] | None = None) -> int:
    """Measure, print the table, and return the exit code."""
    parser = argparse.ArgumentParser(description='Measure evaluate beside reading and decoding.')
    parser.add_argument('--bag', type=Path, default=resource('bags/sample'))
    parser.add_argument('--turns', type=int, default=10, help='%(default)s')
    options = parser.parse_args(args)
    if options.turns < 1:
        parser.error(f'--turns = {options.turns}: must be at least 1')
    compute_in_one_thread()
    values = read_parameters(resource('config/follower.yaml'), TABLE)
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / 'result.mcap'
        runs: dict[str, Callable[[], Evaluation | None]] = {
            'reading and decoding': lambda: read_and_decode(options.bag),
            'evaluate --check skip': lambda: evaluate(
                options.bag, values, result, with_check=False),
            'evaluate': lambda: evaluate(options.bag, values, result)}
        times: dict[str, list[tuple[float, Evaluation | None]]] = {name: [] for name in runs}
        try:
            for _ in range(options.turns):
                for name, run in runs.items():
                    times[name].append(spent(run))
        except (BagError, OSError) as error:
            print(f'error: {error}', file=sys.stderr)
            return 1
    best = {name: min(each, key=lambda one: one[0]) for name, each in times.items()}
    reading = best['reading and decoding'][0]
    for name, (cpu, evaluation) in best.items():
        real_time = '' if evaluation is None else (
            f'{evaluation.duration / evaluation.wall_time:7.1f} times real time')
        print(f'{name:<24}{1e3 * cpu:8.0f} ms{cpu / reading:7.2f}{real_time}')
    cpu, evaluation = best['evaluate --check skip']
    assert evaluation is not None
    rest = cpu
    for part, names in PARTS.items():
        share = sum(sum(evaluation.cpu.get(name, ())) for name in names)
        rest -= share
        print(f'  {part:<22}{1e3 * share:8.0f} ms{share / reading:7.2f}')
    print(f'  {"rest":<22}{1e3 * rest:8.0f} ms{rest / reading:7.2f}')
    return 0 if cpu <= MOST * reading else 1


if __name__ == '__main__':
    sys.exit(main())
