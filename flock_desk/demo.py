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
The demonstration: replays a bag to MAVLink setpoints, and compares the result with bounds.

``python -m flock_desk.demo`` starts replay, relative_pose, planner, mavlink_bridge and
the embedded autopilot, each a process of its own, in a ROS domain and on a UDP port that
other machines cannot receive. Exit code 0 only if every bound holds; 3 if the machine was too busy
to judge the bounds on times, and the other bounds hold.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
import sys
import time

import numpy as np

from flock_desk.runs.console import guarded, logs_in
from flock_desk.runs.figure_table import bounds
from flock_desk.runs.flight import COUNTER_PERIOD, RECORDED, start, start_view, VIEW
from flock_desk.runs.judge import FigureBound
from flock_desk.runs.plots import chapters
from flock_desk.runs.processes import (
    explained,
    failed,
    free_udp_port,
    private_environment,
    Processes,
)
from flock_desk.runs.record import clear, locked, read_replayed
from flock_desk.runs.report import announce, report
from flock_desk.runs.summary import replay_figures
from flock_follower.bags.bag import deserialize, open_bag
from flock_follower.checks.processor import Load
from flock_follower.geometry import yaw_from_quaternion
from flock_follower.messages import OdometryState
from flock_follower.messages.state_reader import from_odometry
from flock_follower.parameters.files import parameters_flown
from flock_follower.parameters.flight_parameters import TABLE
from flock_follower.planner.parameter_table import planner_params
from flock_follower.planner.params import PlannerParams
from flock_follower.system.files import resource

BAG = resource('bags/sample')
PLAYED = ['/image_raw/compressed', '/camera_info', '/odom']
STATE = 'planner/state:std_msgs/msg/String'
TITLE = 'flock_follower: a recorded bag, flown by an embedded autopilot'
INTRODUCTION = (
    'The bag is replayed through the nodes, and an embedded autopilot flies their commands. '
    'The camera in the bag does not move with that vehicle: its speed is shown, its path would '
    'mean nothing. Distance, path and errors are those of the recorded flight.')


def flown() -> PlannerParams:
    """Return the planner's parameters of the flight in the bag, from the file beside it."""
    values = parameters_flown(BAG, TABLE)
    if values is None:
        raise ValueError(f'{BAG}: no parameters.yaml beside the bag')
    return planner_params(values['planner'])


def demo_bounds(params: PlannerParams) -> list[FigureBound]:
    """Return the bounds of the demonstration for the parameters flown."""
    return [*bounds('demo', {
        'near': round(params.law.d0**0.5, 2), 'far': round(params.law.d1**0.5, 2),
        'a_max': params.a_max, 'speed': params.v_max}).values()]


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code."""
    parser = argparse.ArgumentParser(prog='demo', description='Replay a bag into an autopilot.')
    parser.add_argument('--output', type=Path, default='build/demo',
                        help='folder for report and logs (%(default)s)')
    out = parser.parse_args(args).output
    return guarded(partial(_demonstrate, out), hint=partial(logs_in, out))


def _demonstrate(out: Path) -> int:
    params = flown()
    with locked(out):
        clear(out)
        exit_codes, load = fly(BAG, out, params)
        with explained(None if failed(exit_codes) else load):
            flight = read_replayed(BAG, out, params)
        summary = replay_figures(flight, exit_codes, load)
        judgments = report(out, TITLE, INTRODUCTION, summary, demo_bounds(params),
                           chapters(flight), load=load)
        print()
        return announce(summary, judgments, [out / 'report.html'], out, load)


def fly(bag: Path, out: Path, params: PlannerParams) -> tuple[dict[str, int | None], Load | None]:
    """
    Replay the bag through all nodes, leaving logs and records in ``out``.

    :returns: the exit code of each process, see ``Processes.stop``, and the load meanwhile.
    :raises RuntimeError: if a process ends early or a service refuses.
    :raises TooBusyError: if something came too late because the machine was too busy.
    """
    begin = first_odometry(bag)
    port = free_udp_port()
    common = ['use_sim_time:=true', f'a_max:={params.a_max}', f'v_max:={params.v_max}']
    parameters = {
        'relative_pose': ['use_sim_time:=true', 'image_transport:=compressed'],
        'planner': [*common, f'd0:={params.law.d0}', f'd1:={params.law.d1}'],
        # The vehicle that flies is the autopilot's, not the one whose odometry is in the bag: only
        # the autopilot knows its velocity.
        'mavlink_bridge': [*common, f'connection:=udpin:127.0.0.1:{port}',
                           'velocity_source:=autopilot', 'yaw_disagreement:=3.2']}
    with Processes(private_environment(), out) as processes:
        processes.start('autopilot', 'flock_desk.autopilot', [
            '--connect', f'127.0.0.1:{port}', '--altitude', f'{begin.position[2]:.2f}',
            '--yaw', f'{np.degrees(yaw_from_quaternion(begin.quaternion)):.1f}',
            '--param-file', str(resource('config/px4.params')),
            '--log', str(out / 'autopilot.npz')])
        start(processes, parameters, [*RECORDED, STATE])
        start_view(processes)
        processes.wait_for_log('recorder', 'recording')
        processes.ask('mavlink_bridge/offboard')
        processes.ask('planner/engage')
        replay = processes.start('replay', 'flock_follower.nodes.replay', [
            str(bag), '--ros-args', '-p', f'topics:=[{",".join(PLAYED)}]',
            '-p', 'wait_for_subscribers:=10.0'], show=True, ends=True)
        began = time.monotonic()
        replay.wait()
        if replay.returncode != 0:
            raise RuntimeError('the replay failed')
        time.sleep(COUNTER_PERIOD)
        exit_codes = processes.stop_all()
        exit_codes.pop(VIEW, None)  # the page is no part of the flight
        return exit_codes, processes.load.worst(began)


def first_odometry(path: Path) -> OdometryState:
    """Return the first state on ``odom`` in a bag."""
    with open_bag(path) as bag:
        return next(from_odometry(deserialize(m.data, m.msgtype)) for m in bag.messages(['/odom']))


if __name__ == '__main__':
    sys.exit(main())
