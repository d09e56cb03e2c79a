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
A flight on the desk through the real nodes: starting them, requests, and the end of the flight.

``demo`` starts the nodes beside a replay, ``fly`` beside the simulator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
from itertools import pairwise
import os
from pathlib import Path
import re
import subprocess
import sys
import time
from typing import NamedTuple, TypeVar

import numpy as np

from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    SIH_TRUTH_PORT,
    wait_until,
)
from flock_desk.runs.yardstick import Yardstick
from flock_desk.scenarios.scenario import Scenario
from flock_follower.checks.processor import Load
from flock_follower.gate.envelope import GateLimits
from flock_follower.mavlink.transport import open_transport

RECORDED = ['neighbors:nav_msgs/msg/Odometry',
            '/diagnostics:diagnostic_msgs/msg/DiagnosticArray',
            'command/trajectory:trajectory_msgs/msg/MultiDOFJointTrajectory']
GLOBAL_ORIGIN = '[47.397742,8.545594,488.0]'  # where PX4's simulators begin; any place would do
START_TIMEOUT = 40.0  # s for all processes to be there: a busy machine takes its time
READY_TIMEOUT = 90.0  # s for an external estimator, without which the autopilot does not arm
#: s of take-off requests until it is armed again: longer than the bridge waits for the climb.
TAKEOFF_TIMEOUT = 20.0
LAND_TIMEOUT = 5.0  # s of requests for a landing after something failed
LANDING_TIMEOUT = 60.0  # s until it is down and disarmed
MARGIN = 1.5  # s beyond the duration: the simulator receives the engagement a little later
#: m/s between odometry and an estimate by GPS: PX4's SIH errs by 0.3 m/s at rest, by 1.0 at worst.
GPS_DISAGREEMENT = 1.2
PATIENCE = 20.0  # s beyond the scenario's duration after which the simulator must have ended
COUNTER_PERIOD = 1.2  # s in which every node publishes its counters once more
SIH_TRUTH = f'udpin:127.0.0.1:{SIH_TRUTH_PORT}'  # where PX4's SIH sends the truth
VIEW = 'view'
DETECTED = 'DICT_APRILTAG_36h11'  # of the leader's marker, for another detector
T = TypeVar('T')


class External(NamedTuple):
    """Links to an autopilot that runs already, as ``mavlink.transport`` takes them."""

    connection: str
    truth: str
    forward_odometry: bool
    leader_truth: str = ''
    """That of a second one; '': the scenario's own leader."""


class Flown(NamedTuple):
    """What ``fly`` returns beside the records."""

    cores: dict[str, float]
    """Of each process: its CPU time as a share of the flight."""
    exit_codes: dict[str, int | None]
    """See ``Processes.stop``."""
    load: Load | None
    """During the flight; None if it is unknown."""
    speed: float | None
    """Of a processor meanwhile, as a share of the reference, see ``yardstick``."""
    late: str
    """The step that was too late to complete the scenario; '' if it was completed."""


def links(autopilot: str, truth: str, forward_odometry: bool, leader: str = '') -> External:
    """
    Return the links to an autopilot; without a truth ``usual_truth``.

    :raises ValueError: for a URL that is invalid. :raises OSError: if it cannot be opened.
    """
    truth = truth or usual_truth(autopilot)
    with contextlib.ExitStack() as opened:  # all at once: none may have the port of another
        for url in filter(None, (autopilot, truth, leader)):
            opened.callback(open_transport(url).close)
    return External(autopilot, truth, forward_odometry, leader)


def usual_truth(autopilot: str) -> str:
    """Return the link on which a simulator tells the truth by default: ArduPilot's, else SIH's."""
    tcp = re.fullmatch(r'(tcp:.*:)(\d+)', autopilot)
    return f'{tcp[1]}{int(tcp[2]) + 2}' if tcp else SIH_TRUTH


def namespaces(followers: int) -> list[str]:
    """Return each follower's namespace ('' for a single one), the name of its logs' folder."""
    return [''] if followers == 1 else [f'follower_{i}' for i in range(1, followers + 1)]


def own(values: Mapping[str, T], namespace: str) -> dict[str, T]:
    """Return the values of a follower's processes by the names of its nodes."""
    prefix = f'{namespace}/' if namespace else ''
    return {name.removeprefix(prefix): value for name, value in values.items()
            if name.startswith(prefix)}


def spacing(scenario: Scenario) -> float:
    """Return the mean distance between two vehicles of a column at its start, m."""
    return float(np.mean(scenario.start.distance))


def fly(scenario: Scenario, name: str, seed: int, duration: float, out: Path,
        external: External | None = None, followers: int = 1, detector: Path | None = None
        ) -> Flown:
    """
    Fly a scenario through all nodes, leaving logs and records in ``out``.

    :param name: of the scenario, as the simulator shall load it.
    :param external: the autopilot that flies the follower; None: the embedded one.
    :param followers: how many fly in a column; the logs of each are in ``namespaces``.
    :param detector: a program whose poses replace the marker's, see ``with_detector``.
    :raises RuntimeError: if a process ends early or a service refuses, with the reason.
    :raises TooBusyError: if something came too late because the machine was too busy.
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
            if detector is not None:
                parameters = with_detector(parameters, detector)
            start(processes, parameters, RECORDED,
                  namespace, show=i == 0)
        start_view(processes, fleet[0])
        try:
            engage(processes, fleet, external is not None)
            began = time.monotonic()
            cores, speed, late = watch(processes, duration, external is not None)
            early = ended_by_bridge(processes.log('mavlink_bridge')) if external else ''
            if early:
                print(f'\nthe bridge has ended the flight: {early}', flush=True)
            elif external:
                call(processes, 'planner/engage', ('false',))
                call(processes, 'mavlink_bridge/offboard', ('false',))
        finally:
            if 'takeoff' in processes.children:
                come_down(processes)
        if external:
            simulator = processes.children['simulator']
            wait_until(lambda: simulator.poll() is not None, LANDING_TIMEOUT,
                       'the vehicle to land and disarm')
        time.sleep(COUNTER_PERIOD)
        if any(simulator.returncode for simulator in simulators_of(processes)):
            raise RuntimeError('the simulator failed')
        exit_codes = processes.stop_all()
        for of_each in cores, exit_codes:
            of_each.pop(VIEW, None)  # the page is no part of the flight
        for recorder, code in exit_codes.items():
            if code == 1 and recorder.endswith('recorder'):
                raise RuntimeError(f'the recorder failed: {processes.last_line(recorder)}')
        return Flown(cores, exit_codes, processes.load.worst(began), speed, late)


def engage(processes: Processes, fleet: Sequence[str], external: bool) -> None:
    """Arm or take off, request offboard, and engage all followers of the namespaces."""
    for namespace in reversed(fleet):  # the first one flies off when it is engaged
        prefix = f'/{namespace}/' if namespace else ''
        if external:
            take_off(processes)
        else:
            call(processes, f'{prefix}mavlink_bridge/arm')
        call(processes, f'{prefix}mavlink_bridge/offboard')
        call(processes, f'{prefix}planner/engage')


def start(processes: Processes, parameters: Mapping[str, Sequence[str]], recorded: Sequence[str],
          namespace: str = '', show: bool = False) -> None:
    """
    Start the nodes of one follower, and their recorder, which writes the folder ``record``.

    :param parameters: of each node, as ``NAME:=VALUE``.
    :param show: whether the live line of its simulator is shown.
    """
    print(f'starting {", ".join(parameters)}{" of " if namespace else ""}{namespace}', flush=True)
    prefix = f'{namespace}/' if namespace else ''
    folder = processes.log_folder / namespace
    folder.mkdir(exist_ok=True)
    renamed = ['-r', f'__ns:=/{namespace}'] if namespace else []
    processes.start(f'{prefix}recorder', 'flock_desk.recorder_node', [
        str(folder / 'record'), *recorded, *(['--ros-args', *renamed] if renamed else [])])
    for node, values in parameters.items():
        simulates = node == 'simulator'
        processes.start(
            f'{prefix}{Path(node).stem}',
            'flock_desk.simulator_node' if simulates else node if node.endswith('.py') else (
                f'flock_follower.nodes.{node}'),
            ['--ros-args', *renamed, *(word for value in values for word in ('-p', value))],
            show=show and simulates, ends=simulates)


def start_view(processes: Processes, namespace: str = '') -> None:
    """
    Start the live page, unless the variable VIEW of the environment is ``no``.

    It prints its address, or one line if it cannot serve: the flight goes on without it.
    """
    if os.environ.get('VIEW') != 'no':
        renamed = ['--ros-args', '-r', f'__ns:=/{namespace}'] if namespace else []
        processes.start(VIEW, 'flock_follower.nodes.view', renamed, show=True, ends=True)


def simulators_of(processes: Processes) -> list[subprocess.Popen[bytes]]:
    """Return the simulators of all followers."""
    return [child for name, child in processes.children.items() if name.endswith('simulator')]


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
    envelope = ['height_max:=100.0', 'radius_max:=1000.0',
                f'relative_flight:={str(flight.relative_flight).lower()}']
    if external is None:
        port = free_udp_port()
        bridge = [f'connection:=udpin:127.0.0.1:{port}', f'target_system:={system}']
        vehicle = [f'connection:=127.0.0.1:{port}', f'target_system:={system}']
        if ahead:
            vehicle += [f'leader_topic:=/{ahead}/truth/motion',
                        f'leader_offset:=[{spacing(scenario)},0.0,0.0]']
    else:
        forward = str(external.forward_odometry).lower()
        bridge = [f'connection:={external.connection}', f'forward_odometry:={forward}',
                  f'global_origin:={GLOBAL_ORIGIN}' if external.forward_odometry
                  else f'velocity_disagreement:={GPS_DISAGREEMENT}']
        vehicle = ['vehicle:=external', f'truth_connection:={external.truth}',
                   f'require_truth:={forward}']
        if external.leader_truth:
            vehicle.append(f'leader_truth_connection:={external.leader_truth}')
    return {
        'relative_pose': [],
        'planner': [*limits, f'K:={flight.K}', f'beta:={flight.beta}', f'd0:={flight.d0}',
                    f'd1:={flight.d1}',
                    # No wider than the gate's, which would be a warning.
                    f'altitude_min:={max(flight.altitude_min, GateLimits.height_min)}'],
        'mavlink_bridge': [*limits, *envelope, *bridge],
        'simulator': [f'scenario:={name}', f'seed:={seed}', f'duration:={duration}', *vehicle,
                      f'log:={out / "flight.npz"}'],
    }


def with_detector(parameters: Mapping[str, list[str]], detector: Path) -> dict[str, list[str]]:
    """
    Return the parameters of the nodes with another detector, a program, among them.

    The neighbors' file has the detector's name with .yaml; the simulator draws an AprilTag.
    """
    neighbors = f'neighbors_file:={detector.with_suffix(".yaml").resolve()}'
    added = {'relative_pose': neighbors, 'planner': neighbors,
             'simulator': f'dictionary:={DETECTED}'}
    return {str(detector.resolve()): [], **{
        node: [*values, *([added[node]] if node in added else [])]
        for node, values in parameters.items()}}


def take_off(processes: Processes) -> None:
    """
    Arm and take off.

    The estimator may take a minute to be ready. ArduPilot arms before that, refuses the take-off,
    and disarms again after a while: so both are requested until they succeed.

    :raises RuntimeError: if they have not by then, with the last reason.
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


def watch(processes: Processes, duration: float, external: bool
          ) -> tuple[dict[str, float], float | None, str]:
    """
    Wait for the end of the scenario; return the cores of each process, and speed and lateness.

    The last two are those of ``Flown``.

    The simulator of an embedded vehicle ends with the scenario. The simulator of an external
    vehicle ends when the vehicle is disarmed; this function does not wait for that. The scenario
    has also ended if the bridge reports so.

    :raises RuntimeError: if the simulator ends early.
    """
    late, yardstick = '', Yardstick()
    simulators = simulators_of(processes)
    begin = now = time.monotonic()
    used = before = processes.cpu()
    while None in (codes := [simulator.poll() for simulator in simulators]) and not any(codes):
        now = time.monotonic()
        if external and (now > begin + duration + MARGIN
                         or ended_by_bridge(processes.log('mavlink_bridge'))):
            break
        if now > begin + duration + PATIENCE:
            late = 'the simulator does not keep up with the clock'
            break
        used = {**used, **processes.cpu()}
        yardstick.sample(now)
        time.sleep(0.2)
    else:
        if external and not any(codes) and not ended_by_bridge(processes.log('mavlink_bridge')):
            raise RuntimeError('the simulator ended early')
    return {name: (used[name] - before[name]) / (now - begin)
            for name in before if now > begin}, yardstick.speed, late


def ended_by_bridge(log: str) -> str:
    """
    Return the first ``mavlink_bridge/state`` after ACTIVE, or '' while it is ACTIVE.

    :param log: the bridge's output. NO_AUTOPILOT ends nothing: the link may come back.
    """
    states = [state for state in re.findall(r'\]: state: (.+)', log)
              if not state.startswith('NO_AUTOPILOT')]
    return next((state for before, state in pairwise(states)
                 if before.startswith('ACTIVE') and not state.startswith('ACTIVE')), '')


def come_down(processes: Processes) -> None:
    """Request a landing after a failure; ignore the result."""
    with contextlib.suppress(RuntimeError, KeyboardInterrupt):
        answer = processes.ask('mavlink_bridge/land', LAND_TIMEOUT, value=())
        print(f'\n{answer}', flush=True)


def call(processes: Processes, service: str, value: Sequence[str] = ('true',),
         timeout: float = START_TIMEOUT) -> None:
    """
    Call a service.

    :param value: see ``Processes.ask``.
    :raises LateError: if the service continues to refuse, with the reason.
    :raises RuntimeError: if the simulator has ended, or a node has.
    """
    simulators = simulators_of(processes)
    answer = processes.ask(service, timeout, lambda: (
        'the simulator ended early' if any(s.poll() is not None for s in simulators) else ''),
        value)
    # On a terminal in place of the simulator's live line, which it draws anew below.
    print(f'\r{answer}\x1b[K' if sys.stdout.isatty() else answer, flush=True)
