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
A flight on the desk through the real nodes: what is started, asked of them, and waited for.

``fly`` is the command that does it, and tells what came of it.
"""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
from itertools import pairwise
import os
from pathlib import Path
import re
import subprocess
import sys
import time
from typing import NamedTuple

from flock_desk.runs.fly_bounds import Usage
from flock_desk.runs.fly_column import spacing
from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    SchedulingDelay,
)
from flock_desk.scenarios.scenario import Scenario
from flock_follower.mavlink.transport import open_transport

SIMULATOR = 'flock_desk.simulator_node'
RECORDED = ['neighbors:nav_msgs/msg/Odometry',
            '/diagnostics:diagnostic_msgs/msg/DiagnosticArray']
COMMANDS = 'command/trajectory:trajectory_msgs/msg/MultiDOFJointTrajectory'
SIH_TRUTH = 'udpin:127.0.0.1:19410'  # where PX4's SIH tells the truth, unasked
ORIGIN = '[47.397742,8.545594,488.0]'  # where PX4's simulators begin; any place would do
START_TIMEOUT = 40.0  # s for all processes to be there: a busy machine takes its time
READY_TIMEOUT = 90.0  # s for the estimator of an external autopilot, which refuses to arm before
#: s of asking for a take-off until it is armed again: longer than the bridge waits for the climb.
TAKEOFF_TIMEOUT = 20.0
LAND_TIMEOUT = 5.0  # s of asking for a landing at last
LANDING_TIMEOUT = 60.0  # s until it is down and disarmed
MARGIN = 1.5  # s beyond the duration: the simulator hears a little later that it is engaged
#: m/s between odometry and an estimate by GPS: PX4's SIH errs by 0.3 m/s at rest, by 1.0 at worst.
GPS_DISAGREEMENT = 1.2
PATIENCE = 20.0  # s beyond the scenario's duration after which the simulator must have ended


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


def namespaces(followers: int) -> list[str]:
    """Return the namespace of each, '' for one alone; the folder of its logs has that name."""
    return [''] if followers == 1 else [f'follower_{i}' for i in range(1, followers + 1)]


def within(namespace: str) -> str:
    """Return what the names of a follower's processes begin with."""
    return f'{namespace}/' if namespace else ''


def fly(scenario: Scenario, name: str, seed: int, duration: float, out: Path,
        external: External | None = None, followers: int = 1
        ) -> tuple[Usage, dict[str, int | None]]:
    """
    Fly a scenario through all nodes, leaving logs and records in ``out``.

    :param name: of the scenario, as the simulator shall load it.
    :param external: the autopilot that flies the follower; None: the embedded one.
    :param followers: how many fly in a column; the logs of each are in ``namespaces``.
    :returns: what it cost, and each process's exit code, None for one that had to be killed.
    :raises RuntimeError: where a process ends early or a service refuses, with the reason.
    :raises TooBusyError: if the machine is too busy.
    """
    fleet = namespaces(followers)
    with Processes(private_environment(), out) as processes:
        domain = processes.environment['ROS_DOMAIN_ID']
        print(f'{scenario.name}: {scenario.summary}\nto listen: ROS_DOMAIN_ID={domain} '
              'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ros2 topic list', flush=True)
        for i, namespace in enumerate(fleet):
            parameters = parameters_of_nodes(
                scenario, name, seed + i, duration, out / namespace, external,
                fleet[i - 1] if i else '', i + 1)
            start(processes, namespace, out / namespace / 'record', parameters, external, i == 0)
        try:
            for namespace in reversed(fleet):  # the first one flies off when it is engaged
                prefix = f'/{within(namespace)}' if namespace else ''
                if external:
                    take_off(processes)
                else:
                    call(processes, f'{prefix}mavlink_bridge/arm')
                call(processes, f'{prefix}mavlink_bridge/offboard')
                call(processes, f'{prefix}planner/engage')
            usage = Usage(processes_cpu(processes), time.monotonic())
            usage = watch(processes, usage, time.monotonic() + duration, external is not None)
            early = ended_by_bridge(processes.log('mavlink_bridge')) if external else ''
        except BaseException:
            if 'takeoff' in processes.children:
                come_down(processes)
            raise
        if early:
            print(f'\nthe bridge has ended the flight: {early}', flush=True)
            come_down(processes)
            await_disarmed(processes)
        elif external:
            land(processes)
        time.sleep(1.2)  # every node says once per second what it has counted
        if any(simulator.returncode for simulator in all_of(processes, 'simulator').values()):
            raise RuntimeError('the simulator failed')
        exit_codes = processes.stop_all()
        for recorder, code in exit_codes.items():
            if code == 1 and recorder.endswith('recorder'):
                raise RuntimeError(f'the recorder failed: {processes.last_line(recorder)}')
        return usage, exit_codes


def start(processes: Processes, namespace: str, record: Path, parameters: dict[str, list[str]],
          external: External | None, show: bool) -> None:
    """
    Start recorder and nodes of one follower.

    :param show: whether its simulator's live line is shown.
    """
    print(f'starting {", ".join(parameters)}{" of " if namespace else ""}{namespace}', flush=True)
    prefix = within(namespace)
    (processes.log_folder / namespace).mkdir(exist_ok=True)
    renamed = ['-r', f'__ns:=/{namespace}'] if namespace else []
    processes.start(f'{prefix}recorder', 'flock_desk.recorder_node', [
        str(record), *RECORDED, *([COMMANDS] if external else []),
        *(['--ros-args', *renamed] if renamed else [])])
    for node, values in parameters.items():
        arguments = [word for value in values for word in ('-p', value)]
        module = SIMULATOR if node == 'simulator' else f'flock_follower.nodes.{node}'
        processes.start(f'{prefix}{node}', module,
                        ['--ros-args', *renamed, *arguments],
                        show=show and node == 'simulator')


def all_of(processes: Processes, node: str) -> dict[str, subprocess.Popen[bytes]]:
    """Return the processes of a node, of every follower."""
    return {name: child for name, child in processes.children.items()
            if name.rpartition('/')[2] == node}


def parameters_of_nodes(scenario: Scenario, name: str, seed: int, duration: float, out: Path,
                        external: External | None, ahead: str = '',
                        system: int = 1) -> dict[str, list[str]]:
    """
    Return the parameters of each node that flies.

    :param ahead: the namespace of the follower that is its leader; '': the scenario's leader.
    :param system: MAVLink system id of an embedded autopilot.
    """
    flight = scenario.flight
    limits = [f'a_max:={flight.a_max}', f'v_max:={flight.v_max}']
    # Scenarios judge the planner in open space.
    envelope = ['height_max:=100.0', 'radius_max:=1000.0']
    if external is None:
        port = free_udp_port()
        bridge = [f'connection:=udpin:127.0.0.1:{port}', f'target_system:={system}']
        vehicle = [f'connection:=127.0.0.1:{port}', f'target_system:={system}']
        if ahead:
            vehicle += [f'leader_topic:=/{ahead}/truth/motion',
                        f'leader_offset:=[{spacing(scenario)},0.0,0.0]']
    else:
        forward = str(external.forward_odometry).lower()
        bridge = [f'connection:={external.connection}', f'forward_odometry:={forward}']
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
        'mavlink_bridge': [*limits, *envelope, *bridge],
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
            call(processes, 'mavlink_bridge/takeoff', (), TAKEOFF_TIMEOUT)
            return
        except RuntimeError as error:
            if 'already in the air' in str(error):  # its answer to an earlier one was lost
                return
            if time.monotonic() > deadline or processes.children['simulator'].poll() is not None:
                raise


def watch(processes: Processes, usage: Usage, end: float, external: bool) -> Usage:
    """
    Wait for the end of the scenario: the embedded vehicle's simulator ends with it.

    That of an external one ends when the vehicle is disarmed. It is not waited for here, and the
    scenario has ended as well where the bridge says so.

    :param end: when that should be, s on the monotonic clock.
    :raises RuntimeError: where the simulator does not keep up, or something ends early.
    :raises TooBusyError: if the machine is too busy.
    """
    simulators, delay = list(all_of(processes, 'simulator').values()), SchedulingDelay()
    while None in (codes := [simulator.poll() for simulator in simulators]):
        if any(codes):
            return usage
        if external and (time.monotonic() > end + MARGIN
                         or ended_by_bridge(processes.log('mavlink_bridge'))):
            return usage
        if time.monotonic() > end + PATIENCE:
            raise RuntimeError('the simulator does not keep up with the clock')
        for name, recorder in all_of(processes, 'recorder').items():
            if recorder.poll() is not None:
                raise RuntimeError(f'the recorder ended early: {processes.last_line(name)}')
        usage = usage.until(processes_cpu(processes), time.monotonic())
        delay.check(time.monotonic())
        time.sleep(0.2)
    if external and not ended_by_bridge(processes.log('mavlink_bridge')):
        raise RuntimeError('the simulator ended early')
    return usage


def ended_by_bridge(log: str) -> str:
    """
    Return what ``mavlink_bridge/state`` said when it was ACTIVE no more, or '' while it is.

    :param log: what the bridge has printed. NO_AUTOPILOT ends nothing: it may be heard again.
    """
    states = [state for state in re.findall(r'\]: state: (.+)', log)
              if not state.startswith('NO_AUTOPILOT')]
    return next((state for before, state in pairwise(states)
                 if before.startswith('ACTIVE') and not state.startswith('ACTIVE')), '')


def land(processes: Processes) -> None:
    """
    Give the vehicle back, land it, and wait for the simulator to see it disarmed.

    :raises RuntimeError: where it does not come down.
    """
    call(processes, 'planner/engage', ('false',))
    call(processes, 'mavlink_bridge/offboard', ('false',))
    call(processes, 'mavlink_bridge/land', ())
    await_disarmed(processes)


def await_disarmed(processes: Processes) -> None:
    """
    Wait for the simulator to see the vehicle disarmed.

    :raises RuntimeError: where it does not come down.
    """
    deadline = time.monotonic() + LANDING_TIMEOUT
    while processes.children['simulator'].poll() is None:
        if time.monotonic() > deadline:
            raise RuntimeError(f'it has not landed and disarmed within {LANDING_TIMEOUT:g} s')
        time.sleep(0.2)


def come_down(processes: Processes) -> None:
    """Ask for a landing after something failed, whatever becomes of it."""
    with contextlib.suppress(RuntimeError, KeyboardInterrupt):
        answer = processes.ask('mavlink_bridge/land', LAND_TIMEOUT, value=())
        print(f'\n{answer}', flush=True)


def call(processes: Processes, service: str, value: Sequence[str] = ('true',),
         timeout: float = START_TIMEOUT) -> None:
    """
    Call a service.

    :param value: see ``Processes.ask``.
    :raises RuntimeError: where it goes on refusing, or the simulator is gone, with the reason.
    """
    simulators = list(all_of(processes, 'simulator').values())
    answer = processes.ask(service, timeout, lambda: (
        'the simulator ended early' if any(s.poll() is not None for s in simulators) else ''),
        value)
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
