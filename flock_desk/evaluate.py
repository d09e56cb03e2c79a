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
Run perception, planner and setpoint gate over a bag, and report their errors.

``python -m flock_desk.evaluate BAG --config config/follower.yaml --output OUT`` needs no
ROS and runs in the bag's own time, as fast as the machine allows. It writes

- ``result.mcap``: ``neighbors``, ``command/trajectory``, ``planner/state`` as the nodes publish
  them, and ``setpoint``, the output of the gate to the autopilot, in the format of a command
  (acceleration, yaw and yaw rate in the axes of odom; NaN if it gives none);
- ``summary.json``: the figures; null if the bag lacks the data, as errors without truth. Two runs
  differ in ``cpu_ms_per_frame``, ``realtime_factor`` and ``timings`` only;
- ``report.html``: the figures and pictures of the flight in one file.

The rules of ``check`` judge the bag at the same time: their errors and warnings stand before the
figures, in ``summary.json`` under ``check``, and in the report.

With several bags, each has a folder of its name in OUT; a Dask cluster whose workers see the same
files shares the work (``--scheduler``).

Exit code: 1 if a bound of ``--expect`` is broken or ``check`` found an error (not with ``--check
report``), 2 for a wrong bag, file or option, else 0. With several bags it is the highest one.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
import sys
from typing import Any, NamedTuple

from flock_desk.runs.console import explained, guarded
from flock_desk.runs.evaluation import evaluate
from flock_desk.runs.judge import check_names, Judgment, load_bounds
from flock_desk.runs.plots import evaluation_chapters
from flock_desk.runs.processes import computed
from flock_desk.runs.report import announce, report
from flock_desk.runs.summary import evaluation_figures
from flock_follower.checks.findings import ERROR, Finding, ready, WARNING
from flock_follower.messages.topic_names import parse_remaps
from flock_follower.parameters.files import parameters_flown, read_parameters
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.perception.images import compute_in_one_thread
from flock_follower.system.files import resource


class BagOutcome(NamedTuple):
    """The outcome of one bag: its exit code without the bounds, the lines on stderr, figures."""

    code: int
    problems: Sequence[str]
    summary: Mapping[str, Any] = {}
    judgments: Sequence[Judgment] = ()


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='evaluate', description='Run perception, planner and setpoint gate over a bag.')
    parser.add_argument('bag', type=Path, nargs='+', help='.mcap, .db3, .bag or ROS 2 bag folder')
    parser.add_argument('--config', type=Path, help='ROS 2 parameter file (default: those flown, '
                        'of a recording of the black box, else config/follower.yaml)')
    parser.add_argument('--output', type=Path, default='build/evaluate',
                        help='folder for the results (default: %(default)s)')
    parser.add_argument('--expect', type=Path, metavar='FILE',
                        help='YAML file of bounds; exit code 1 if one is broken')
    parser.add_argument('--check', choices=('fail', 'report', 'skip'), default='fail',
                        help='errors that the rules of check find in the bag: exit code 1, only '
                        'reported, or not looked for (default: %(default)s)')
    parser.add_argument('--namespace', default='', help='of the topics in the bag')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO',
                        help='one of our topics by its name in the bag, as '
                        'odom:=/camera/odom/sample; may be repeated')
    parser.add_argument('--scheduler', default='', metavar='ADDRESS',
                        help='of a Dask cluster, as tcp://192.168.1.5:8786, whose workers see the '
                        'same files')
    options = parser.parse_args(args)
    bags = {bag.resolve().name: bag.absolute() for bag in options.bag}
    if len(bags) < len(options.bag):
        parser.error(f'{", ".join(map(str, options.bag))}: bags of one name would share a folder')
    for name in ('config', 'output', 'expect'):  # workers of a cluster run in other folders
        if getattr(options, name):
            setattr(options, name, getattr(options, name).absolute())
    return guarded(partial(_evaluate_all, bags, options), refused=2)


def _evaluate_all(bags: Mapping[str, Path], options: argparse.Namespace) -> int:
    """Evaluate bags, here or on a cluster, print the outcomes and return the exit code."""
    folders = [options.output / name if len(bags) > 1 else options.output for name in bags]
    tasks = [partial(evaluated, bag, folder, options) for bag, folder in zip(
        bags.values(), folders)]
    codes = []
    for folder, outcome in zip(folders, computed(_run, tasks, 1, options.scheduler)):
        if len(bags) > 1:
            print(f'\n{folder.name}')
        for line in outcome.problems:
            print(line, file=sys.stderr)
        codes.append(outcome.code if outcome.code == 2 else max(outcome.code, announce(
            outcome.summary, outcome.judgments, [folder / 'report.html'])))
    return max(codes)


def _run(task: partial[BagOutcome]) -> BagOutcome:
    compute_in_one_thread()  # the cost measured is that of one core
    try:
        return task()
    except (OSError, ValueError) as error:
        return BagOutcome(2, [f'error: {explained(error)}'])


def evaluated(bag: Path, folder: Path, options: argparse.Namespace) -> BagOutcome:
    """
    Evaluate one bag and write its files.

    :raises ValueError: for a bag, parameter or bound that is wrong.
    :raises OSError: for a file that cannot be read or written.
    """
    flown = None if options.config else parameters_flown(bag, TABLE)
    values = flown or read_parameters(options.config or resource('config/follower.yaml'), TABLE)
    remaps = parse_remaps(options.remap)
    bounds = load_bounds(options.expect) if options.expect else []
    folder.mkdir(parents=True, exist_ok=True)
    evaluation = evaluate(
        bag, values, folder / 'result.mcap', options.namespace, remaps, options.check != 'skip')
    summary = evaluation_figures(evaluation)
    check_names(bounds, summary)
    # Errors first; that the bag is incomplete is a warning of its own.
    findings = [finding for level in (ERROR, WARNING) for finding in evaluation.findings
                if finding.level == level and finding.what != 'bag']
    if summary['recall'] == 0.0:  # of no check: another cause than those that it knows
        findings.append(Finding(ERROR, 'recall', 'no image gave an estimate of a neighbor',
                                'estimates', 'see the marker row of check, and rejections'))
    lines = [finding.line for finding in findings]
    incomplete = evaluation.bag.incomplete
    warnings = [f'{bag} is incomplete: {incomplete}'] if incomplete else []
    warnings += [f'the truth of {stranger!r} is not used: no neighbor has that name'
                 for stranger in sorted(evaluation.errors.strangers)]
    if share := summary['faster_than_v_max_share']:
        warnings.append(
            f'the follower in this bag flies at up to {summary["own_speed_max_m_s"]:.2f} m/s, '
            f'{100 * share:.0f} % of the time above '
            f'v_max = {evaluation.params.v_max:g} m/s: there the setpoints '
            'brake; set v_max (--config) to the recorded speed')
    flown_with = ', with the parameters flown' if flown else ''
    judgments = report(
        folder, f'Evaluation of {bag.name}',
        f'{summary["frames"]} images in {evaluation.duration:.1f} s, through perception, planner '
        f'and setpoint gate in lock step{flown_with}. The follower in the bag does not fly these '
        'setpoints.', summary, bounds, evaluation_chapters(evaluation), [*lines, *warnings])
    failed = options.check == 'fail' and not ready(findings)
    return BagOutcome(int(failed), [*lines, *(f'warning: {each}' for each in warnings)],
                      summary, judgments)


if __name__ == '__main__':
    sys.exit(main())
