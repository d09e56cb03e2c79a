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
ROS and runs in the bag's own time, as fast as the machine allows; the order of events is that
of ``flock_desk.runs.recorded_flight``. It writes

- ``result.mcap``: ``neighbors``, ``command/trajectory``, ``planner/state`` as the nodes publish
  them, and ``setpoint``, what the gate lets through to the autopilot, in the format of a command
  (acceleration, yaw and yaw rate in the axes of odom; NaN if it gives none);
- ``summary.json``: the figures; null if the bag lacks the data, as errors without truth. Two runs
  differ in ``cpu_ms_per_frame``, ``realtime_factor`` and ``timings`` only;
- ``report.html``: the figures and pictures of the flight in one file.

The rules of ``check`` judge the bag at the same time: their errors and warnings stand before the
figures, in ``summary.json`` under ``check``, and in the report.

Of several bags, each has a folder of its name in OUT; a Dask cluster whose workers see the same
files shares the work (``--scheduler``).

Exit code 0, 1 if a bound of ``--expect`` is broken or ``check`` found an error (not with ``--check
report``), 2 for a bag, file or option that is wrong: the greatest of all bags.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
import sys
from typing import Any, NamedTuple

import cv2

from flock_desk.runs.console import explained, guarded, Options, parsed
from flock_desk.runs.evaluation import evaluate, Evaluation
from flock_desk.runs.judge import check_names, Judgement, load_bounds
from flock_desk.runs.processes import mapped
from flock_desk.runs.report import announce, Chapter, report
from flock_desk.runs.summary import evaluation_figures
from flock_follower.checks.findings import ERROR, ready, WARNING
from flock_follower.checks.topic_names import parse_remaps
from flock_follower.files import resource
from flock_follower.parameters.files import parameters_flown, read_parameters, TABLE

_OPTIONS: Options = {
    'bag': {'type': Path, 'nargs': '+', 'help': '.mcap, .db3, .bag or ROS 2 bag folder'},
    '--config': {'type': Path, 'help': 'ROS 2 parameter file (default: those flown, of a '
                 'recording of the black box, else config/follower.yaml of this package)'},
    '--output': {'type': Path, 'default': Path('build/evaluate'),
                 'help': 'folder for the results (default: %(default)s)'},
    '--expect': {'type': Path, 'metavar': 'FILE',
                 'help': 'YAML file of bounds; exit code 1 where one is broken'},
    '--check': {'choices': ('fail', 'report', 'skip'), 'default': 'fail',
                'help': 'errors that the rules of check find in the bag: exit code 1, only '
                'reported, or not looked for (default: %(default)s)'},
    '--namespace': {'default': '', 'help': 'of the topics in the bag'},
    '--remap': {'action': 'append', 'default': [], 'metavar': 'FROM:=TO',
                'help': 'one of our topics by its name in the bag, as '
                'odom:=/camera/odom/sample; may be repeated'},
    '--scheduler': {'default': '', 'metavar': 'ADDRESS',
                    'help': 'of a Dask cluster, as tcp://192.168.1.5:8786, whose workers see the '
                    'same files'}}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='evaluate', description='Run perception, planner and setpoint gate over a bag.')
    options = parsed(parser, args, _OPTIONS)
    names = [bag.expanduser().resolve().name for bag in options.bag]
    if twice := {name for name in names if names.count(name) > 1}:
        parser.error(f'{", ".join(sorted(twice))}: bags of one name would share a folder')
    each = [argparse.Namespace(**{
        **vars(options), 'bag': bag,
        'output': options.output / name if len(names) > 1 else options.output})
        for bag, name in zip(options.bag, names)]
    if options.scheduler:  # its workers run in other folders
        for one in each:
            vars(one).update({key: value.expanduser().absolute()
                              for key, value in vars(one).items() if isinstance(value, Path)})
    return guarded(partial(_evaluate_all, each, options.scheduler), refused=2)


def _evaluate_all(each: Sequence[argparse.Namespace], scheduler: str) -> int:
    """Evaluate bags, here or on a cluster, print the outcomes and return the exit code."""
    codes = []
    for options, outcome in zip(each, mapped(scheduler, evaluated, each) if scheduler
                                else map(evaluated, each)):
        if len(each) > 1:
            print(f'\n{options.bag}')
        for line in outcome.problems:
            print(line, file=sys.stderr)
        codes.append(outcome.code if outcome.code == 2 else max(outcome.code, announce(
            outcome.summary, outcome.judgements, [options.output / 'report.html'])))
    return max(codes)


class BagOutcome(NamedTuple):
    """The outcome of one bag: its exit code without the bounds, the lines on stderr, figures."""

    code: int
    problems: Sequence[str]
    summary: Mapping[str, Any] = {}
    judgements: Sequence[Judgement] = ()


def evaluated(options: argparse.Namespace) -> BagOutcome:
    """Evaluate one bag, write its files, and return the outcome."""
    cv2.setNumThreads(1)  # the cost measured is that of one core
    try:
        return run(options)
    except (OSError, ValueError) as error:
        return BagOutcome(2, [f'error: {explained(error)}'])


def run(options: argparse.Namespace) -> BagOutcome:
    """
    Evaluate one bag and write its files.

    :raises ValueError: for a bag, parameter or bound that is wrong.
    :raises OSError: for a file that cannot be read or written.
    """
    flown = None if options.config else parameters_flown(options.bag.expanduser(), TABLE)
    values = flown or read_parameters(options.config or resource('config/follower.yaml'), TABLE)
    remaps = parse_remaps(options.remap)
    bounds = load_bounds(options.expect) if options.expect else []
    options.output.mkdir(parents=True, exist_ok=True)
    evaluation = evaluate(
        options.bag, values, options.output / 'result.mcap', options.namespace, remaps,
        options.check != 'skip')
    summary = evaluation_figures(evaluation)
    check_names(bounds, summary)
    # Errors first; that the bag is incomplete is a warning of its own.
    findings = [finding for level in (ERROR, WARNING) for finding in evaluation.findings
                if finding.level == level and finding.what != 'bag']
    fast = too_fast(summary, evaluation.flight.planner_params.v_max)
    flown_with = ', with the parameters flown' if flown else ''
    lines = [finding.line for finding in findings]
    judgements = report(
        options.output, f'Evaluation of {evaluation.bag}',
        f'{summary["frames"]} images in {evaluation.duration:.1f} s, through perception, planner '
        f'and setpoint gate in lock step{flown_with}. The follower in the bag does not fly these '
        'setpoints.', summary, bounds, partial(_pictures, evaluation),
        warnings=[*lines, *fast])
    warnings = [f'the truth of {stranger!r} is not used: no neighbor has that name'
                for stranger in sorted(evaluation.errors.strangers)]
    if evaluation.incomplete:
        warnings.insert(0, f'{options.bag} is incomplete: {evaluation.incomplete}')
    failed = options.check == 'fail' and not ready(findings)
    return BagOutcome(int(failed), [*lines, *(f'warning: {each}' for each in (*warnings, *fast))],
                      summary, judgements)


def _pictures(evaluation: Evaluation) -> Sequence[Chapter]:
    from flock_desk.runs.plots import evaluation_chapters
    return evaluation_chapters(evaluation)


def too_fast(summary: Mapping[str, Any], v_max: float) -> list[str]:
    """Return the warning of a bag whose follower was faster than allowed, if it was."""
    share = summary['faster_than_v_max_share']
    if not share:
        return []
    return [f'the follower in this bag flies at up to {summary["own_speed_max_m_s"]:.2f} m/s, '
            f'{100 * share:.0f} % of the time above v_max = {v_max:g} m/s: there the setpoints '
            'brake; set v_max (--config) to the recorded speed']


if __name__ == '__main__':
    sys.exit(main())
