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

``python -m flock_follower.tools.fly --scenario indoor`` starts simulator, relative_pose, planner
and mavlink_bridge, each a process of its own, in a ROS domain and on a UDP port that nobody
outside this machine can hear; arms, changes to offboard mode, engages, and flies the scenario.
Exit code 0 only if every bound holds.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import os
from pathlib import Path
import shutil
import sys
import time

from flock_follower.simulation.scenarios.scenario import DURATIONS, Scenario, SEEDS
from flock_follower.simulation.scenarios.scenario_file import (
    load_for_real_time,
    names,
    ScenarioError,
)
from flock_follower.tools.fly_bounds import bounds, summarize, Usage
from flock_follower.tools.fly_record import chapters, read
from flock_follower.tools.judge import judge
from flock_follower.tools.processes import free_udp_port, private_environment, Processes
from flock_follower.tools.report import announce, write_report
from flock_follower.tools.summary import write_summary

RECORDED = ['neighbors:nav_msgs/msg/Odometry',
            '/diagnostics:diagnostic_msgs/msg/DiagnosticArray']
SERVICES = ('mavlink_bridge/arm', 'mavlink_bridge/offboard', 'planner/engage')
START_TIMEOUT = 40.0  # s for all processes to be there: a busy machine takes its time
PATIENCE = 20.0  # s beyond the scenario's duration after which the simulator must have ended


def main(args: Sequence[str] | None = None) -> int:
    """Fly, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='fly', description='Fly a scenario on the desk, through the real nodes.',
        epilog=f'scenarios: {", ".join(names())}')
    parser.add_argument('--scenario', default='indoor', metavar='NAME',
                        help='of a file in config/scenarios, or the path of one (%(default)s)')
    parser.add_argument('--seed', type=int, default=0, help='of everything that chance decides')
    parser.add_argument('--duration', type=float, default=0.0, metavar='S',
                        help='fly no longer than this, s (as long as the scenario says)')
    parser.add_argument('--output', type=Path, default=Path('build/fly'),
                        help='folder for report and logs (%(default)s)')
    options = parser.parse_args(args)
    try:
        SEEDS.check('--seed', options.seed)
        DURATIONS.check('--duration', options.duration)
    except ValueError as error:
        parser.error(str(error))
    try:
        scenario = load_for_real_time(options.scenario)
        duration = min(options.duration or scenario.duration, scenario.duration)
        clear(options.output)
        usage, exit_codes = fly(scenario, options.scenario, options.seed, duration,
                                options.output)
        flight = read(scenario, options.output)
        summary = summarize(flight, usage, exit_codes)
        judgements = judge(bounds(flight, summary), summary)
        write_summary(summary, options.output / 'summary.json')
        report = options.output / 'report.html'
        write_report(report, f'flock_follower on the desk: {scenario.name}', scenario.summary,
                     summary, judgements, lambda: chapters(flight))
    except ScenarioError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except (OSError, RuntimeError, ValueError) as error:
        what = (f'{error.filename}: {error.strerror}'
                if isinstance(error, OSError) and error.filename else error)
        print(f'error: {what}; the logs of every process are in {options.output}',
              file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    print()
    return announce(summary, judgements, [report], options.output)


def fly(scenario: Scenario, name: str, seed: int, duration: float,
        out: Path) -> tuple[Usage, dict[str, int | None]]:
    """
    Fly a scenario through all nodes, leaving logs and records in ``out``.

    :param name: of the scenario, as the simulator shall load it.
    :returns: what it cost, and each process's exit code, None for one that had to be killed.
    :raises RuntimeError: where a process ends early or a service refuses, with the reason.
    """
    port, flight = free_udp_port(), scenario.flight
    limits = [f'a_max:={flight.a_max}', f'v_max:={flight.v_max}']
    parameters = {
        'relative_pose': [],
        'planner': [*limits, f'beta:={flight.beta}', f'd0:={flight.d0}', f'd1:={flight.d1}'],
        'mavlink_bridge': [*limits, f'connection:=udpin:127.0.0.1:{port}'],
        'simulator': [f'scenario:={name}', f'seed:={seed}', f'duration:={duration}',
                      f'connection:=127.0.0.1:{port}', f'log:={out / "flight.npz"}'],
    }
    with Processes(private_environment(), out) as processes:
        print(f'{scenario.name}: {scenario.summary}\nstarting {", ".join(parameters)}', flush=True)
        processes.start('recorder', 'flock_follower.nodes.recorder',
                        [str(out / 'record'), *RECORDED])
        for node, values in parameters.items():
            arguments = [word for value in values for word in ('-p', value)]
            processes.start(node, f'flock_follower.nodes.{node}', ['--ros-args', *arguments],
                            show=node == 'simulator')
        for service in SERVICES:
            call(processes, service)
        usage = Usage(processes_cpu(processes), time.monotonic())
        deadline = time.monotonic() + duration + PATIENCE
        while processes.children['simulator'].poll() is None:
            if time.monotonic() > deadline:
                raise RuntimeError('the simulator does not keep up with the clock')
            if processes.children['recorder'].poll() is not None:
                raise RuntimeError(f'the recorder ended early: {processes.last_line("recorder")}')
            usage = usage.until(processes_cpu(processes), time.monotonic())
            time.sleep(0.2)
        time.sleep(1.2)  # every node says once per second what it has counted
        if processes.children['simulator'].returncode:
            raise RuntimeError('the simulator failed')
        exit_codes = processes.stop_all()
        if exit_codes['recorder'] == 1:
            raise RuntimeError(f'the recorder failed: {processes.last_line("recorder")}')
        return usage, exit_codes


def call(processes: Processes, service: str) -> None:
    """
    Call a SetBool service with true.

    :raises RuntimeError: where it goes on refusing, or the simulator is gone, with the reason.
    """
    simulator = processes.children['simulator']
    answer = processes.ask(service, START_TIMEOUT, lambda: (
        '' if simulator.poll() is None else 'the simulator ended early'))
    # On a terminal in place of the simulator's live line, which it draws anew below.
    print(f'\r{answer}\x1b[K' if sys.stdout.isatty() else answer, flush=True)


def clear(folder: Path) -> None:
    """Remove what an earlier flight left in a folder, and nothing else."""
    shutil.rmtree(folder / 'record', ignore_errors=True)
    for name in ('flight.npz', 'report.html', 'summary.json'):
        (folder / name).unlink(missing_ok=True)


def processes_cpu(processes: Processes) -> dict[str, float]:
    """Return the CPU time, s, that each running child has used; nothing where /proc is not."""
    used = {}
    for name, child in processes.children.items():
        try:
            stat = Path(f'/proc/{child.pid}/stat').read_text(encoding='utf-8')
        except OSError:
            continue
        fields = stat.rpartition(')')[2].split()  # after the name, which may hold anything
        if fields[0] != 'Z':
            used[name] = (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
    return used


if __name__ == '__main__':
    sys.exit(main())
