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
What the three nodes cost in flight, beside three bare rclpy nodes: ``make bench-stack``.

A flight of the scenario ``indoor`` in closed loop: the simulator sends images of 640x480, mono8,
at 30 Hz, and odometry that reaches all at 200 Hz; relative_pose tracks the leader, the planner
commands at 10 Hz, the bridge flies an embedded autopilot with 20 setpoints a second. At the same
time the three nodes of ``bare_nodes.py`` take the same messages from the same simulator, by
ordinary callbacks, and pass on as many of their own. The ratio is the CPU time of the three over
that of the bare three, in the same seconds, so that a busy machine slows both. It is CPU time of
whole processes, by /proc; what makes the messages, the autopilot and this program do not count.

Lateness, of the planner's ticks by the time in each command, of the setpoints by the kernel's time
of reception: how much later one came, in a grid of 0.1 s and 0.05 s, than the earliest of the
same 10 s do. A missed one left its place in the grid empty.

Exit code 0 only if the ratio keeps MOST.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import contextlib
import json
import os
from pathlib import Path
import select
import socket
import struct
import sys
import threading
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from trajectory_msgs.msg import MultiDOFJointTrajectory

from flock_desk.program import PROGRAMS
from flock_desk.runs.processes import free_udp_port, private_environment, Processes
from flock_follower.messages.command_reader import from_trajectory

NODES = ('relative_pose', 'planner', 'mavlink_bridge')
MOST = 0.8  # times the CPU time of the bare nodes
WINDOW = 10.0  # s over which the share of a core is reported
SETTLING = 5.0  # s of flight that are not counted
PERIODS = {'planner': 0.1, 'mavlink_bridge': 0.05}  # s
EARLY = 5  # percentile of those of 10 s that counts as in time
EARLIEST = 0.1  # of a period: a message earlier than that is late by most of a period
SO_TIMESTAMPNS = 35  # of Linux; the socket module does not name it
SETPOINT = 84  # id of SET_POSITION_TARGET_LOCAL_NED
SCENARIO = """summary: "indoor, for long"
leader: {{motion: wander, speed: 0.4, heading: away}}
duration: {duration}
"""


class Relay:
    """Stands between bridge and autopilot, and notes when the kernel got each setpoint."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.bridge = '127.0.0.1', free_udp_port()
        self._to_bridge, self._to_autopilot = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._to_bridge.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._to_autopilot.bind(('127.0.0.1', 0))
        self.autopilot = self._to_autopilot.getsockname()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        vehicle = None
        while True:
            ready = select.select([self._to_bridge, self._to_autopilot], [], [])[0]
            if self._to_autopilot in ready:
                data, vehicle = self._to_autopilot.recvfrom(4096)
                self._to_bridge.sendto(data, self.bridge)
            if self._to_bridge in ready:
                try:
                    data, ancillary, _, _ = self._to_bridge.recvmsg(4096, 64)
                except ConnectionRefusedError:
                    continue  # the bridge does not listen yet
                if int.from_bytes(data[7:10], 'little') == SETPOINT:  # of MAVLink 2
                    seconds, nanoseconds = struct.unpack('qq', ancillary[0][2])
                    self.times.append(seconds + nanoseconds * 1e-9)
                if vehicle is not None:
                    self._to_autopilot.sendto(data, vehicle)


class Ticks:
    """Notes the time in each command of the planner."""

    def __init__(self) -> None:
        self.times: list[float] = []
        rclpy.init()
        self._node = Node('stack')
        self._node.create_subscription(
            MultiDOFJointTrajectory, 'command/trajectory', self._take,
            QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Take no more."""
        rclpy.try_shutdown()
        self._thread.join()

    def _spin(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    def _take(self, message: MultiDOFJointTrajectory) -> None:
        self.times.append(time.time() - from_trajectory(message, 'odom').ages(time.time_ns())[0])


def lateness(times: Sequence[float], period: float) -> dict[str, float]:
    """Return by how much, ms, times in s are late in their grid, and how many it lacks."""
    t = np.asarray(times)
    begun = ((t - t[0]) / WINDOW).astype(int)
    late, missed = [], 0
    for some in (t[begun == k] for k in np.unique(begun)):
        angle = np.angle(np.mean(np.exp(2j * np.pi * (some - some[0]) / period)))
        middle = some[0] + angle / (2.0 * np.pi) * period
        phase = (some - middle + 0.5 * period) % period  # most are near the middle of it
        phase -= np.percentile(phase, EARLY)
        phase[phase < -EARLIEST * period] += period  # so late that it is nearly the next one
        late.append(np.maximum(phase, 0.0))
        places = np.round((some - phase) / period)
        missed += int(places[-1] - places[0]) + 1 - len(np.unique(places))
    p50, p99, most = 1e3 * np.percentile(np.concatenate(late), [50, 99, 100])
    return {'count': len(t), 'missed': missed, 'late_p50_ms': float(p50),
            'late_p99_ms': float(p99), 'late_max_ms': float(most)}


def memory(pid: int) -> float:
    """Return the most memory that a process had resident, MB."""
    status = Path(f'/proc/{pid}/status').read_text(encoding='utf-8')
    return next(int(line.split()[1]) for line in status.splitlines()
                if line.startswith('VmHWM')) / 1e3


def measure(processes: Processes, duration: float) -> dict[str, dict[str, float]]:
    """Return what each process used while it flew: percent of a core, and MB."""
    began = time.monotonic()
    seen = [(began, processes.cpu())]
    while seen[-1][0] < began + duration:
        time.sleep(max(0.0, min(seen[-1][0] + WINDOW, began + duration) - time.monotonic()))
        seen.append((time.monotonic(), processes.cpu()))
        ended = [name for name, child in processes.children.items()
                 if name in seen[0][1] and child.poll() is not None]
        if ended:
            raise RuntimeError(f'{", ".join(ended)} ended early: see {processes.log_folder}')
    times = np.array([at for at, _ in seen])
    result = {}
    for name in seen[0][1]:
        used = 100.0 * np.array([cpu[name] for _, cpu in seen])
        shares = np.diff(used) / np.diff(times)
        result[name] = {
            'percent': float((used[-1] - used[0]) / (times[-1] - times[0])),
            'most_in_10_s': float(shares.max()), 'memory_mb': memory(processes.children[name].pid)}
    return result


def fly(options: argparse.Namespace, environment: dict[str, str]) -> dict[str, Any]:
    """Fly with all nodes, and return the figures."""
    scenario = options.output / 'scenario.yaml'
    scenario.write_text(SCENARIO.format(
        duration=options.duration + 120.0), encoding='utf-8')
    relay, ticks = Relay(), Ticks()
    parameters = {
        'relative_pose': [], 'planner': [],
        'mavlink_bridge': [f'connection:=udpin:{relay.bridge[0]}:{relay.bridge[1]}',
                           f'forward_odometry:={str(options.forward).lower()}',
                           # The embedded vehicle does not fuse it.
                           f'require_failsafe:={str(not options.forward).lower()}'],
        'simulator': [f'scenario:={scenario}',
                      f'connection:={relay.autopilot[0]}:{relay.autopilot[1]}']}
    renamed = ['-r', 'odom:=simulated/odom']
    with Processes(environment, options.output) as processes:
        for name, values in parameters.items():
            processes.start(name, PROGRAMS[name], [
                '--ros-args', *(word for value in values for word in ('-p', value)),
                *(renamed if name == 'simulator' else [])])
        processes.start('often_odometry', 'bare_nodes', ['often_odometry'])
        for name in NODES:
            processes.start(f'bare_{name}', 'bare_nodes', [name])
        for service in ('mavlink_bridge/arm', 'mavlink_bridge/offboard', 'planner/engage'):
            print(processes.ask(service, 60.0), flush=True)
            processes.stop(service.rpartition('/')[2])
        time.sleep(SETTLING)
        began, load = time.time(), os.getloadavg()
        cost = measure(processes, options.duration)
        late = {name: lateness([t for t in times if t > began], PERIODS[name])
                for name, times in (('planner', ticks.times), ('mavlink_bridge', relay.times))}
        processes.stop_all()
    ticks.stop()
    ours, bare = (sum(cost[f'{prefix}{name}']['percent'] for name in NODES)
                  for prefix in ('', 'bare_'))
    return {'duration_s': options.duration, 'forward_odometry': options.forward,
            'load_before': load[0], 'load_after': os.getloadavg()[0], 'ratio': ours / bare,
            'percent': ours, 'bare_percent': bare, 'nodes': cost, 'lateness': late}


def show(figures: dict[str, Any]) -> None:
    """Print the tables."""
    print(f'\n{"":15}{"% of a core":>13}{"most in 10 s":>14}{"memory MB":>11}'
          f'{"bare %":>9}{"ratio":>8}')
    cost = figures['nodes']
    for name in NODES:
        node, bare = cost[name], cost[f'bare_{name}']['percent']
        print(f'{name:15}{node["percent"]:13.1f}{node["most_in_10_s"]:14.1f}'
              f'{node["memory_mb"]:11.0f}{bare:9.1f}{node["percent"] / bare:8.2f}')
    print(f'{"all three":15}{figures["percent"]:13.1f}{"":25}{figures["bare_percent"]:9.1f}'
          f'{figures["ratio"]:8.2f}\n')
    for name, late in figures['lateness'].items():
        what = 'ticks' if name == 'planner' else 'setpoints'
        print(f'{name}: {late["count"]} {what}, {late["missed"]} missed; late by '
              f'{late["late_p50_ms"]:.2f} ms (p50), {late["late_p99_ms"]:.2f} (p99), '
              f'{late["late_max_ms"]:.2f} (most)')
    print(f'over {figures["duration_s"]:g} s, load {figures["load_before"]:.1f} to '
          f'{figures["load_after"]:.1f} on {os.cpu_count()} cores')


def main(args: Sequence[str] | None = None) -> int:
    """Measure, print, write the figures, and return the exit code."""
    parser = argparse.ArgumentParser(description='Measure what the nodes cost in flight.')
    parser.add_argument('--duration', type=float, default=60.0, metavar='S',
                        help='how long to measure (%(default)s)')
    parser.add_argument('--forward', action='store_true',
                        help='with forward_odometry: as ODOMETRY to the autopilot')
    parser.add_argument('--output', type=Path, default=Path('build/stack'),
                        help='folder for stack.json and logs (%(default)s)')
    options = parser.parse_args(args)
    options.output.mkdir(parents=True, exist_ok=True)
    environment = private_environment()
    environment['PYTHONPATH'] = os.pathsep.join(filter(None, [
        str(Path(__file__).resolve().parent), environment.get('PYTHONPATH', '')]))
    os.environ.update(environment)
    try:
        figures = fly(options, environment)
    except (OSError, RuntimeError) as error:
        print(f'error: {error}; the logs are in {options.output}', file=sys.stderr)
        return 1
    show(figures)
    file = options.output / 'stack.json'
    file.write_text(json.dumps(figures, indent=1), encoding='utf-8')
    print(f'written: {file}')
    return 0 if figures['ratio'] <= MOST else 1


if __name__ == '__main__':
    sys.exit(main())
