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
The demonstration: a recorded bag becomes MAVLink setpoints, judged against bounds.

``python -m flock_follower.tools.demo`` starts replay, relative_pose, planner, mavlink_bridge and
the embedded autopilot, each a process of its own, in a ROS domain and on a UDP port that nobody
outside this machine can hear. Exit code 0 only if every bound holds.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import shutil
import sys
import time
from typing import Any

import numpy as np

from flock_follower.bags.bag import BagError, deserialize, open_bag
from flock_follower.geometry import Array, yaw_from_quaternion
from flock_follower.resources import resource
from flock_follower.tools.metrics import mean_rate, relative_errors, states, states_of
from flock_follower.tools.processes import free_udp_port, private_environment, Processes
from flock_follower.tools.report import Check, draw, Flight, verdict, within

# The law's band and the acceleration limit are the flight defaults; the follower of the bag flies
# faster than the 0.5 m/s of a first flight.
D0, D1, A_MAX, V_MAX = 1.0, 8.0, 2.5, 2.0
PLAYED = ['/image_raw/compressed', '/camera_info', '/odom']
RECORDED = ['neighbors:nav_msgs/msg/Odometry', 'planner/state:std_msgs/msg/String',
            'command/trajectory:trajectory_msgs/msg/MultiDOFJointTrajectory',
            '/diagnostics:diagnostic_msgs/msg/DiagnosticArray']
NODES = ('relative_pose', 'planner', 'mavlink_bridge')


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code."""
    parser = argparse.ArgumentParser(prog='demo', description='Replay a bag into an autopilot.')
    parser.add_argument('--out', type=Path, default=Path('build/demo'), help='%(default)s')
    options = parser.parse_args(args)
    shutil.rmtree(options.out, ignore_errors=True)
    try:
        bag = resource('bags/sample')
        exit_codes = fly(bag, options.out)
        checks, flight = judge(bag, options.out, exit_codes)
        draw(flight, options.out / 'report.png',
             'flock_follower: a recorded bag, flown by an embedded autopilot')
    except (BagError, OSError, RuntimeError) as error:
        print(f'error: {error}\nthe logs of every process are in {options.out}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    return verdict(checks, f'picture: {options.out / "report.png"}', options.out)


def fly(bag: Path, out: Path) -> dict[str, int | None]:
    """
    Replay the bag through all nodes, leaving logs and records in ``out``.

    :returns: the exit code of each process; None for one that had to be killed.
    :raises RuntimeError: where a process ends early or a service refuses.
    """
    start = states_of(bag, '/odom')
    port = free_udp_port()
    limits = ['-p', f'a_max:={A_MAX}', '-p', f'v_max:={V_MAX}']
    arguments = {
        'relative_pose': ['-p', 'image_transport:=compressed'],
        'planner': [*limits, '-p', f'd0:={D0}', '-p', f'd1:={D1}'],
        # The vehicle that flies is the autopilot's, not the one whose odometry is in the bag: its
        # speed is the autopilot's to know, its altitude the autopilot's to hold.
        'mavlink_bridge': [*limits, '-p', f'connection:=udpin:127.0.0.1:{port}',
                           '-p', 'velocity_source:=autopilot', '-p', 'yaw_disagreement:=3.2',
                           '-p', 'setpoint_mode:=acceleration_xy_altitude_yaw'],
    }
    with Processes(private_environment(), out) as processes:
        print('starting autopilot, ' + ', '.join(NODES))
        processes.start('autopilot', 'flock_follower.simulation.autopilot', [
            '--connect', f'127.0.0.1:{port}', '--altitude', f'{start.positions[0, 2]:.2f}',
            '--yaw', f'{np.degrees(yaw_from_quaternion(start.quaternions[0])):.1f}',
            '--log', str(out / 'autopilot.npz')])
        for node in NODES:
            processes.start(node, f'flock_follower.nodes.{node}',
                            ['--ros-args', '-p', 'use_sim_time:=true', *arguments[node]])
        processes.start('recorder', 'flock_follower.nodes.recorder',
                        [str(out / 'record'), *RECORDED])
        processes.wait_for_log('recorder', 'recording')
        processes.ask('mavlink_bridge/offboard')
        processes.ask('planner/engage')
        replay = processes.start('replay', 'flock_follower.nodes.replay', [
            str(bag), '--ros-args', '-p', f'topics:=[{",".join(PLAYED)}]',
            '-p', 'wait_for_subscribers:=10.0'], show=True)
        if replay.wait() != 0:
            raise RuntimeError('the replay failed')
        time.sleep(1.2)  # every node says once per second what it has counted
        return processes.stop_all()


def judge(bag: Path, out: Path,
          exit_codes: dict[str, int | None]) -> tuple[list[Check], Flight]:
    """Return the table of figures and what the picture shows, from the records in ``out``."""
    record = read_record(out / 'record')
    leader, follower = states_of(bag, '/truth/neighbors'), states_of(bag, '/truth/odom')
    errors = relative_errors(states(m for _, m in record['/neighbors']), states_of(bag, '/odom'),
                             leader, follower)
    received = np.array([t for t, _ in record['/command/trajectory']])
    ticks = np.array([tick_time(m) for _, m in record['/command/trajectory']])
    # The bag's clock against the monotonic one of the logs.
    offset = float(np.median(received - ticks))
    log = np.load(out / 'autopilot.npz')
    start = int(leader.stamps[0])
    origin = start * 1e-9 + offset
    flown = (log['state_time'] >= received[0]) & (log['state_time'] <= received[-1])
    sent = (log['setpoint_time'] >= received[0]) & (log['setpoint_time'] <= received[-1])
    flight = Flight(
        errors, leader, follower, start, log['setpoint_time'][sent] - origin,
        log['setpoint_acceleration'][sent], log['state_time'][flown] - origin,
        log['position'][flown], log['velocity'][flown], D0, D1, A_MAX, V_MAX)
    bridge = last_status(record['/diagnostics'], 'mavlink_bridge')
    planner = last_status(record['/diagnostics'], 'planner')
    perception = last_status(record['/diagnostics'], 'relative_pose')
    images = len(leader.stamps)
    processed = max(float(perception.get('images_processed', 'nan')), 1.0)
    distance = errors.true_distance if errors.recall else np.full(1, np.nan)
    checks = [
        Check('images in the bag', str(images), '', None),
        within('images processed in time', 100 * processed / images, '%', 90, None),
        within('leader detected in those', 100 * errors.recall * images / processed, '%', 99,
               None),
        within('distance, least', float(np.min(distance)), 'm', round(D0**0.5, 2), None),
        Check('distance, mean', f'{np.mean(distance):.2f} m', '', None),
        within('distance, greatest', float(np.max(distance)), 'm', None, round(D1**0.5, 2)),
        within('relative position error, RMS', 100 * errors.position_rms, 'cm', None, 5),
        within('relative velocity error, RMS', errors.velocity_rms, 'm/s', None, 0.15, 3),
        within('planner commands', mean_rate(ticks), 'Hz', 9.9, 10.1),
        # A shared machine may stall for a tick or two; the bridge brakes meanwhile, as it should.
        within('planner ticks missed', float(planner.get('missed_ticks', 'nan')), '', None, 3, 0),
        within('setpoints sent', int(np.count_nonzero(sent)), '', 1, None, 0),
        within('setpoint rate', mean_rate(log['setpoint_time'][sent]), 'Hz', 19.5, 20.5),
        within('largest acceleration sent', longest(flight.setpoints), 'm/s²', None, A_MAX),
        within('largest speed flown', longest(flight.vehicle_velocities), 'm/s', None, V_MAX),
        *(within(f'image to MAVLink latency, p{p}',
                 float(bridge.get(f'latency_p{p}_ms', 'nan')), 'ms', None, bound, 0)
          for p, bound in ((50, 120), (95, 180), (99, 200))),
        within('processes that ended badly',
               sum(code != 0 for code in exit_codes.values()), '', None, 0, 0),
    ]
    return checks, flight


def longest(vectors: Array) -> float:
    """Return the greatest length of the rows (n, 3); 0 without any."""
    return float(np.max(np.linalg.norm(vectors, axis=1), initial=0.0))


def read_record(path: Path) -> dict[str, list[tuple[float, Any]]]:
    """Return what the recorder wrote: by topic, (time of receipt in s, message)."""
    record: dict[str, list[tuple[float, Any]]] = {}
    with open_bag(path) as bag:
        for m in bag.messages():
            record.setdefault(m.topic, []).append(
                (m.stamp_ns * 1e-9, deserialize(m.data, m.msgtype)))
    missing = {f'/{t.split(":")[0].lstrip("/")}' for t in RECORDED} - set(record)
    if missing:
        raise RuntimeError(f'nothing was published on {", ".join(sorted(missing))}')
    return record


def tick_time(message: Any) -> float:
    """Return when a command applies, s: its stamp plus its point's time from start."""
    stamp, ahead = message.header.stamp, message.points[0].time_from_start
    return float(stamp.sec + ahead.sec + (stamp.nanosec + ahead.nanosec) * 1e-9)


def last_status(diagnostics: list[tuple[float, Any]], node: str) -> dict[str, str]:
    """Return the key-value pairs of a node's last status; empty where it sent none."""
    for _, array in reversed(diagnostics):
        for status in array.status:
            if status.name == node:
                return {pair.key: pair.value for pair in status.values}
    return {}


if __name__ == '__main__':
    sys.exit(main())
