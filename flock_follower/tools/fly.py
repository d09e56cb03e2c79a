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

``--autopilot udp:127.0.0.1:14540`` (PX4) or ``tcp:127.0.0.1:5760`` (ArduPilot) has the follower
flown by an autopilot that runs already, see docs/sitl.md: from the ground, and back to it. With
``--leader-truth`` its leader is the vehicle of a second one, which somebody else flies.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import contextlib
import os
from pathlib import Path
import re
import sys
import time
from typing import NamedTuple

from flock_follower.mavlink.transport import open_transport
from flock_follower.simulation.scenarios.scenario import DURATIONS, Scenario, SEEDS
from flock_follower.simulation.scenarios.scenario_file import (
    load_for_real_time,
    names,
    ScenarioError,
)
from flock_follower.tools.flight_folder import clear, set_aside
from flock_follower.tools.fly_bounds import bounds, summarize, Usage
from flock_follower.tools.fly_record import chapters, read
from flock_follower.tools.judge import judge
from flock_follower.tools.processes import free_udp_port, private_environment, Processes
from flock_follower.tools.report import announce, write_report
from flock_follower.tools.summary import write_summary

RECORDED = ['neighbors:nav_msgs/msg/Odometry',
            '/diagnostics:diagnostic_msgs/msg/DiagnosticArray']
COMMANDS = 'command/trajectory:trajectory_msgs/msg/MultiDOFJointTrajectory'
SIH_TRUTH = 'udpin:127.0.0.1:19410'  # where PX4's SIH tells the truth, unasked
ORIGIN = '[47.397742,8.545594,488.0]'  # where PX4's simulators begin; any place would do
START_TIMEOUT = 40.0  # s for all processes to be there: a busy machine takes its time
READY_TIMEOUT = 90.0  # s for the estimator of an external autopilot, which refuses to arm before
TRY_TIMEOUT = 5.0  # s of asking for a take-off until it is armed again, and for a landing at last
LANDING_TIMEOUT = 60.0  # s until it is down and disarmed
MARGIN = 1.5  # s beyond the duration: the simulator hears a little later that it is engaged
#: m/s between odometry and an estimate by GPS: PX4's SIH errs by 0.3 m/s at rest, by 1.0 at worst.
GPS_DISAGREEMENT = 1.2
WIND_COMPENSATION = 1.0  # m/s^2, for an autopilot in whose simulator a wind may blow
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
    group = parser.add_argument_group('an autopilot that runs already, see docs/sitl.md')
    group.add_argument('--autopilot', default='', metavar='URL',
                       help='where the bridge finds it: udp:HOST:PORT where it sends to, '
                       'tcp:HOST:PORT where it listens')
    group.add_argument('--truth', default='', metavar='URL',
                       help='another link, on which it tells where the vehicle is '
                       f'(udp: {SIH_TRUTH}; tcp: its port + 2)')
    group.add_argument('--leader-truth', default='', metavar='URL',
                       help="likewise of a second autopilot, MAVLink system 2, whose vehicle is "
                       "the leader (the scenario's own leader)")
    group.add_argument('--forward-odometry', action='store_true',
                       help='send it the odometry, for flight without GPS')
    parser.add_argument('--output', type=Path, default=Path('build/fly'),
                        help='folder for report and logs (%(default)s)')
    options = parser.parse_args(args)
    try:
        SEEDS.check('--seed', options.seed)
        DURATIONS.check('--duration', options.duration)
    except ValueError as error:
        parser.error(str(error))
    if not options.autopilot and (
            options.truth or options.leader_truth or options.forward_odometry):
        parser.error('--truth, --leader-truth and --forward-odometry: only with --autopilot')
    try:
        scenario = load_for_real_time(options.scenario)
        duration = min(options.duration or scenario.duration, scenario.duration)
        external = (elsewhere(options.autopilot, options.truth, options.forward_odometry,
                              options.leader_truth) if options.autopilot else None)
        set_aside(options.output)
        clear(options.output)
        usage, exit_codes = fly(scenario, options.scenario, options.seed, duration,
                                options.output, external)
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


class External(NamedTuple):
    """Links to an autopilot that runs already, as ``mavlink.transport`` takes them."""

    connection: str
    truth: str
    forward_odometry: bool
    leader_truth: str = ''
    """That of a second one; '': the scenario's own leader."""


def elsewhere(autopilot: str, truth: str, forward_odometry: bool, leader: str = '') -> External:
    """
    Return the links to an autopilot, ``udp:`` meaning ``udpin:``; where none is, the usual truth.

    :raises ValueError: for a URL that is none. :raises OSError: where it cannot be opened.
    """
    autopilot, truth, leader = (
        re.sub('^udp:', 'udpin:', url) for url in (autopilot, truth, leader))
    if not truth:
        tcp = re.fullmatch(r'(tcp:.*:)(\d+)', autopilot)
        truth = f'{tcp[1]}{int(tcp[2]) + 2}' if tcp else SIH_TRUTH
    with contextlib.ExitStack() as links:  # all at once: none may have the port of another
        for url in filter(None, (autopilot, truth, leader)):
            links.callback(open_transport(url).close)
    return External(autopilot, truth, forward_odometry, leader)


def fly(scenario: Scenario, name: str, seed: int, duration: float, out: Path,
        external: External | None = None) -> tuple[Usage, dict[str, int | None]]:
    """
    Fly a scenario through all nodes, leaving logs and records in ``out``.

    :param name: of the scenario, as the simulator shall load it.
    :param external: the autopilot that flies the follower; None: the embedded one.
    :returns: what it cost, and each process's exit code, None for one that had to be killed.
    :raises RuntimeError: where a process ends early or a service refuses, with the reason.
    """
    parameters = parameters_of_nodes(scenario, name, seed, duration, out, external)
    with Processes(private_environment(), out) as processes:
        print(f'{scenario.name}: {scenario.summary}\nstarting {", ".join(parameters)}', flush=True)
        processes.start('recorder', 'flock_follower.nodes.recorder',
                        [str(out / 'record'), *RECORDED, *([COMMANDS] if external else [])])
        for node, values in parameters.items():
            arguments = [word for value in values for word in ('-p', value)]
            processes.start(node, f'flock_follower.nodes.{node}', ['--ros-args', *arguments],
                            show=node == 'simulator')
        try:
            if external:
                take_off(processes)
            else:
                call(processes, 'mavlink_bridge/arm')
            call(processes, 'mavlink_bridge/offboard')
            call(processes, 'planner/engage')
            usage = Usage(processes_cpu(processes), time.monotonic())
            usage = watch(processes, usage, time.monotonic() + duration, external is not None)
        except BaseException:
            if 'takeoff' in processes.children:
                come_down(processes)
            raise
        if external:
            land(processes)
        time.sleep(1.2)  # every node says once per second what it has counted
        if processes.children['simulator'].returncode:
            raise RuntimeError('the simulator failed')
        exit_codes = processes.stop_all()
        if exit_codes['recorder'] == 1:
            raise RuntimeError(f'the recorder failed: {processes.last_line("recorder")}')
        return usage, exit_codes


def parameters_of_nodes(scenario: Scenario, name: str, seed: int, duration: float, out: Path,
                        external: External | None) -> dict[str, list[str]]:
    """Return the parameters of each node that flies."""
    flight = scenario.flight
    limits = [f'a_max:={flight.a_max}', f'v_max:={flight.v_max}']
    if external is None:
        port = free_udp_port()
        bridge = [f'connection:=udpin:127.0.0.1:{port}']
        vehicle = [f'connection:=127.0.0.1:{port}']
    else:
        forward = str(external.forward_odometry).lower()
        bridge = [f'connection:={external.connection}', f'forward_odometry:={forward}',
                  f'wind_compensation:={WIND_COMPENSATION}']
        bridge.append(f'global_origin:={ORIGIN}' if external.forward_odometry
                      else f'velocity_disagreement:={GPS_DISAGREEMENT}')
        vehicle = ['vehicle:=external', f'truth_connection:={external.truth}',
                   f'require_truth:={forward}']
        if external.leader_truth:
            vehicle.append(f'leader_truth_connection:={external.leader_truth}')
    return {
        'relative_pose': [],
        'planner': [*limits, f'beta:={flight.beta}', f'd0:={flight.d0}', f'd1:={flight.d1}',
                    f'altitude_min:={flight.altitude_min}'],
        'mavlink_bridge': [*limits, *bridge],
        'simulator': [f'scenario:={name}', f'seed:={seed}', f'duration:={duration}', *vehicle,
                      f'log:={out / "flight.npz"}'],
    }


def take_off(processes: Processes) -> None:
    """
    Arm and take off.

    Its estimator may take a minute to be ready. ArduPilot arms before that, refuses the take-off,
    and disarms again after a while: so both are asked for until they succeed.

    :raises RuntimeError: where they have not by then, with the last reason.
    """
    deadline = time.monotonic() + READY_TIMEOUT
    while True:
        call(processes, 'mavlink_bridge/arm', timeout=max(deadline - time.monotonic(), 1.0))
        try:
            call(processes, 'mavlink_bridge/takeoff', (), TRY_TIMEOUT)
            return
        except RuntimeError:
            if time.monotonic() > deadline or processes.children['simulator'].poll() is not None:
                raise


def watch(processes: Processes, usage: Usage, end: float, external: bool) -> Usage:
    """
    Wait for the end of the scenario: the embedded vehicle's simulator ends with it.

    :param end: when that should be, s on the monotonic clock.
    :raises RuntimeError: where the simulator does not keep up, or something ends early.
    """
    simulator = processes.children['simulator']
    while simulator.poll() is None:
        if external and time.monotonic() > end + MARGIN:
            return usage
        if time.monotonic() > end + PATIENCE:
            raise RuntimeError('the simulator does not keep up with the clock')
        if processes.children['recorder'].poll() is not None:
            raise RuntimeError(f'the recorder ended early: {processes.last_line("recorder")}')
        usage = usage.until(processes_cpu(processes), time.monotonic())
        time.sleep(0.2)
    if external:
        raise RuntimeError('the simulator ended early')
    return usage


def land(processes: Processes) -> None:
    """
    Give the vehicle back, land it, and wait for the simulator to see it disarmed.

    :raises RuntimeError: where it does not come down.
    """
    call(processes, 'planner/engage', ('false',))
    call(processes, 'mavlink_bridge/offboard', ('false',))
    call(processes, 'mavlink_bridge/land', ())
    deadline = time.monotonic() + LANDING_TIMEOUT
    while processes.children['simulator'].poll() is None:
        if time.monotonic() > deadline:
            raise RuntimeError(f'it has not landed and disarmed within {LANDING_TIMEOUT:g} s')
        time.sleep(0.2)


def come_down(processes: Processes) -> None:
    """Ask for a landing after something failed, whatever becomes of it."""
    with contextlib.suppress(RuntimeError, KeyboardInterrupt):
        print(f'\n{processes.ask("mavlink_bridge/land", TRY_TIMEOUT, lambda: "", ())}', flush=True)


def call(processes: Processes, service: str, value: Sequence[str] = ('true',),
         timeout: float = START_TIMEOUT) -> None:
    """
    Call a service.

    :param value: see ``Processes.ask``.
    :raises RuntimeError: where it goes on refusing, or the simulator is gone, with the reason.
    """
    simulator = processes.children['simulator']
    answer = processes.ask(service, timeout, lambda: (
        '' if simulator.poll() is None else 'the simulator ended early'), value)
    # On a terminal in place of the simulator's live line, which it draws anew below.
    print(f'\r{answer}\x1b[K' if sys.stdout.isatty() else answer, flush=True)


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
