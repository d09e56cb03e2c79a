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

``python -m flock_desk.demo`` starts replay, relative_pose, planner, mavlink_bridge and
the embedded autopilot, each a process of its own, in a ROS domain and on a UDP port that nobody
outside this machine can hear. Exit code 0 only if every bound holds; 3 if the machine was too
busy: then nothing is judged.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import shutil
import sys
import time

import numpy as np

from flock_desk.runs.demo_record import chapters, read, summarize
from flock_desk.runs.judge import FigureBound, judge
from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    SchedulingDelay,
    TOO_BUSY_EXIT_CODE,
    TooBusyError,
)
from flock_desk.runs.report import announce, write_report
from flock_desk.runs.summary import write_summary
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.flocking import FlockingParams
from flock_follower.geometry import yaw_from_quaternion
from flock_follower.messages import from_odometry, OdometryState
from flock_follower.planner.params import PlannerParams
from flock_follower.resources import resource

# The law's band and the acceleration limit are the flight defaults; the follower of the bag flies
# faster than the 0.5 m/s of a first flight.
PARAMS = PlannerParams(FlockingParams(beta=0.25, d0=1.0, d1=8.0), a_max=2.5, v_max=2.0)
PLAYED = ['/image_raw/compressed', '/camera_info', '/odom']
RECORDED = ['neighbors:nav_msgs/msg/Odometry', 'planner/state:std_msgs/msg/String',
            'command/trajectory:trajectory_msgs/msg/MultiDOFJointTrajectory',
            '/diagnostics:diagnostic_msgs/msg/DiagnosticArray']
NODES = ('relative_pose', 'planner', 'mavlink_bridge')
TITLE = 'flock_follower: a recorded bag, flown by an embedded autopilot'
INTRODUCTION = (
    'The bag is replayed through the nodes, and an embedded autopilot flies what they command. '
    'The camera in the bag does not move with that vehicle: its speed is shown, its path would '
    'mean nothing. Distance, path and errors are those of the recorded flight.')
BOUNDS = (
    FigureBound('processed_share', least=0.9),
    FigureBound('recall_of_processed', least=0.99),
    FigureBound('true_distance_m.min', least=round(PARAMS.law.d0**0.5, 2)),
    FigureBound('true_distance_m.max', most=round(PARAMS.law.d1**0.5, 2)),
    FigureBound('position_rms_m', most=0.05),
    FigureBound('velocity_rms_m_s', most=0.15),
    FigureBound('velocity_rms_of_all_m_s', most=0.15),
    FigureBound('planner.rate_hz', 9.9, 10.1),
    # A shared machine may stall for a tick or two; the bridge brakes meanwhile, as it should.
    FigureBound('planner.missed_ticks', most=3),
    FigureBound('setpoints.sent', least=1),
    FigureBound('setpoints.rate_hz', 19.5, 30.5),
    FigureBound('setpoints.acceleration_max_m_s2', most=PARAMS.a_max),
    FigureBound('speed_max_m_s', most=PARAMS.v_max),
    FigureBound('latency_ms.p50', most=120),
    FigureBound('latency_ms.p95', most=180),
    FigureBound('latency_ms.p99', most=200),
    FigureBound('failed_processes', most=0))


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code."""
    parser = argparse.ArgumentParser(prog='demo', description='Replay a bag into an autopilot.')
    parser.add_argument('--output', type=Path, default=Path('build/demo'),
                        help='folder for report and logs (%(default)s)')
    options = parser.parse_args(args)
    shutil.rmtree(options.output, ignore_errors=True)
    pages = [options.output / 'report.html', options.output / 'report.png']
    try:
        bag = resource('bags/sample')
        exit_codes = fly(bag, options.output)
        flight = read(bag, options.output / 'record', options.output / 'autopilot.npz', PARAMS)
        summary = summarize(flight, exit_codes)
        judgements = judge(BOUNDS, summary)
        write_summary(summary, options.output / 'summary.json')
        write_report(pages[0], TITLE, INTRODUCTION, summary, judgements,
                     lambda: chapters(flight, TITLE, pages[1]))
    except TooBusyError as error:
        print(f'\ntoo busy: {error}', file=sys.stderr)
        return TOO_BUSY_EXIT_CODE
    except (OSError, RuntimeError, ValueError) as error:
        print(f'error: {error}\nthe logs of every process are in {options.output}',
              file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    print()
    return announce(summary, judgements, [p for p in pages if p.exists()], options.output)


def fly(bag: Path, out: Path) -> dict[str, int | None]:
    """
    Replay the bag through all nodes, leaving logs and records in ``out``.

    :returns: the exit code of each process; None for one that had to be killed.
    :raises RuntimeError: where a process ends early or a service refuses.
    """
    start = first_odometry(bag)
    port = free_udp_port()
    limits = ['-p', f'a_max:={PARAMS.a_max}', '-p', f'v_max:={PARAMS.v_max}']
    arguments = {
        'relative_pose': ['-p', 'image_transport:=compressed'],
        'planner': [*limits, '-p', f'd0:={PARAMS.law.d0}', '-p', f'd1:={PARAMS.law.d1}'],
        # The vehicle that flies is the autopilot's, not the one whose odometry is in the bag: its
        # speed is the autopilot's to know.
        'mavlink_bridge': [*limits, '-p', f'connection:=udpin:127.0.0.1:{port}',
                           '-p', 'velocity_source:=autopilot', '-p', 'yaw_disagreement:=3.2'],
    }
    with Processes(private_environment(), out) as processes:
        print('starting autopilot, ' + ', '.join(NODES))
        processes.start('autopilot', 'flock_desk.autopilot', [
            '--connect', f'127.0.0.1:{port}', '--altitude', f'{start.position[2]:.2f}',
            '--yaw', f'{np.degrees(yaw_from_quaternion(start.quaternion)):.1f}',
            '--param-file', str(resource('config/px4.params')),
            '--log', str(out / 'autopilot.npz')])
        for node in NODES:
            processes.start(node, f'flock_follower.nodes.{node}',
                            ['--ros-args', '-p', 'use_sim_time:=true', *arguments[node]])
        processes.start('recorder', 'flock_desk.recorder_node',
                        [str(out / 'record'), *RECORDED])
        processes.wait_for_log('recorder', 'recording')
        processes.ask('mavlink_bridge/offboard')
        processes.ask('planner/engage')
        replay = processes.start('replay', 'flock_follower.nodes.replay', [
            str(bag), '--ros-args', '-p', f'topics:=[{",".join(PLAYED)}]',
            '-p', 'wait_for_subscribers:=10.0'], show=True)
        delay = SchedulingDelay()
        while replay.poll() is None:
            delay.check(time.monotonic())
            time.sleep(0.5)
        if replay.returncode != 0:
            raise RuntimeError('the replay failed')
        time.sleep(1.2)  # every node says once per second what it has counted
        return processes.stop_all()


def first_odometry(path: Path) -> OdometryState:
    """Return the first state on ``odom`` in a bag."""
    with open_bag(path) as bag:
        return next(from_odometry(deserialize(m.data, m.msgtype)) for m in bag.messages(['/odom']))


if __name__ == '__main__':
    sys.exit(main())
