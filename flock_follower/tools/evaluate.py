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
Run perception, planner and setpoint gate over a bag, and say how well they did.

``python -m flock_follower.tools.evaluate BAG --config config/follower.yaml --output OUT`` needs no
ROS and runs in the bag's own time, as fast as the machine allows; what happens when is told in
``flock_follower.pipeline.lockstep``. It writes

- ``result.mcap``: ``neighbors``, ``command/trajectory``, ``planner/state`` as the nodes publish
  them, and ``setpoint``, what the gate lets through to the autopilot, in the format of a command
  (acceleration, yaw and yaw rate in the axes of odom; NaN where it gives none);
- ``summary.json``: the figures; null where the bag does not tell, as errors without truth. Two
  runs differ in ``cpu_ms_per_frame``, ``realtime_factor`` and ``timings`` only;
- ``report.html``: the figures and pictures of the flight in one file.

Exit code 0, 1 where a bound of ``--expect`` is broken, 2 for a bag, file or option that is wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
from pathlib import Path
import sys
from typing import Any

import cv2

from flock_follower.bags.bag import BagError
from flock_follower.bags.integrity import incomplete
from flock_follower.parameters.files import read_parameters
from flock_follower.pipeline.lockstep import TABLE
from flock_follower.resources import resource
from flock_follower.tools.evaluation import evaluate, Evaluation
from flock_follower.tools.evaluation_report import write_report
from flock_follower.tools.expectations import (
    check_names,
    judge,
    load_expectations,
    Outcome,
)
from flock_follower.tools.summary import flat, summarize

#: The figures printed; the others are in the summary.
SHOWN = ('frames', 'recall', 'detections.', 'rejections.', 'distance_m.', 'distance_rms_m',
         'distance_bias_m', 'position_rms_m', 'velocity_rms_m_s', 'nees_position', 'nees_velocity',
         'orientation_wrong_share', 'planner.states.', 'setpoints.', 'cpu_ms_per_frame',
         'realtime_factor')


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='evaluate', description='Run perception, planner and setpoint gate over a bag.')
    parser.add_argument('bag', type=Path, help='.mcap, .db3, .bag or ROS 2 bag folder')
    parser.add_argument('--config', type=Path, help='ROS 2 parameter file (default: '
                        'config/follower.yaml of this package)')
    parser.add_argument('--output', type=Path, default=Path('build/evaluate'),
                        help='folder for the results (default: %(default)s)')
    parser.add_argument('--expect', type=Path, metavar='FILE',
                        help='YAML file of bounds; exit code 1 where one is broken')
    parser.add_argument('--namespace', default='', help='of the topics in the bag')
    options = parser.parse_args(args)
    cv2.setNumThreads(1)  # what is measured is to be the cost on one core
    try:
        evaluation, summary, outcomes = run(options)
    except BagError as error:
        return _refuse(error)
    except OSError as error:
        return _refuse(f'{error.filename}: {error.strerror}' if error.strerror else error)
    except ValueError as error:
        return _refuse(error)
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    for line in _lines(summary):
        print(line)
    if reason := incomplete(options.bag.expanduser()):
        print(f'warning: {options.bag} is incomplete: {reason}', file=sys.stderr)
    for stranger in sorted(evaluation.errors.strangers):
        print(f'warning: the truth of {stranger!r} is not used: no neighbor has that name',
              file=sys.stderr)
    faults = [outcome.fault for outcome in outcomes if outcome.fault]
    for fault in faults:
        print(f'FAILED: {fault}', file=sys.stderr)
    print(f'report: {options.output / "report.html"}')
    return 1 if faults else 0


def run(options: argparse.Namespace) -> tuple[Evaluation, dict[str, Any], list[Outcome]]:
    """
    Evaluate and write the files; return the evaluation, its summary and the judgement.

    :raises ValueError: for a bag, parameter or expectation that is wrong.
    :raises OSError: for a file that cannot be read or written.
    """
    values = read_parameters(options.config or resource('config/follower.yaml'), TABLE)
    expectations = load_expectations(options.expect) if options.expect else []
    options.output.mkdir(parents=True, exist_ok=True)
    evaluation = evaluate(
        options.bag, values, options.output / 'result.mcap', options.namespace)
    summary = summarize(evaluation)
    check_names(expectations, summary)
    outcomes = judge(expectations, summary)
    (options.output / 'summary.json').write_text(
        json.dumps(summary, indent=2, ensure_ascii=False) + '\n', encoding='utf-8')
    write_report(evaluation, summary, outcomes, options.output / 'report.html')
    return evaluation, summary, outcomes


def _lines(summary: dict[str, Any]) -> list[str]:
    figures = [(key, _text(value)) for key, value in flat(summary) if value is not None
               and any(key == shown or (shown.endswith('.') and key.startswith(shown))
                       for shown in SHOWN)]
    width = max(len(key) for key, _ in figures)
    return [f'  {key:<{width}}  {text}' for key, text in figures]


def _text(value: Any) -> str:
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def _refuse(problem: Any) -> int:
    print(f'error: {problem}', file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
