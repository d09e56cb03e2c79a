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
Two whole chains as real processes: a bag in, and what arrives on two MAVLink wires.

The test is the autopilots here: it sends HEARTBEAT and LOCAL_POSITION_NED over loopback UDP and
decodes the setpoints with pymavlink, so nothing of the project's own judges the result.
"""

from __future__ import annotations

import os
from pathlib import Path
import signal
import time
from typing import Any

import numpy as np
from odometry_series import states_of
from pymavlink import mavutil
import pytest
from wire import Wire

from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    wait_until,
)
from flock_follower.resources import resource

pytestmark = pytest.mark.slow
BAG = resource('bags/sample')
INPUTS = ('image_raw/compressed', 'camera_info', 'odom')


def start_follower(processes: Processes, name: str, port: int, system: int) -> None:
    own = {'relative_pose': ['-p', 'image_transport:=compressed'],
           'planner': ['-p', 'v_max:=2.0'],
           'mavlink_bridge': [
               '-p', f'connection:=udpin:127.0.0.1:{port}', '-p', f'target_system:={system}',
               '-p', 'velocity_source:=autopilot', '-p', 'v_max:=2.0',
               # The wire has no parameters, and answers no setpoint.
               '-p', 'require_failsafe:=false', '-p', 'wind_compensation:=never']}
    shared = [word for topic in INPUTS for word in ('-r', f'{topic}:=/{topic}')]
    for node, arguments in own.items():
        processes.start(f'{name}-{node}', f'flock_follower.nodes.{node}', [
            '--ros-args', '-r', f'__ns:=/{name}', '-p', 'use_sim_time:=true', *shared, *arguments])


def pulls(commands: list[tuple[float, Any]], ended: float) -> tuple[list[float], list[float]]:
    """Return the accelerations towards a far leader that leaves, and a near one that comes."""
    leader, follower = states_of(BAG, '/truth/neighbors'), states_of(BAG, '/truth/odom')
    far, near = [], []
    for received, m in commands:
        # The replay ran at rate 1 and ended with the last image: the image 0.1 s before.
        stamp = int(leader.stamps[-1]) - int((ended - received + 0.1) * 1e9)
        offset = leader.at(stamp)[0] - follower.at(stamp)[0]
        distance = float(np.linalg.norm(offset))
        closing = float(offset @ (leader.at(stamp)[2] - follower.at(stamp)[2])) / distance
        pull = float(np.array([m.afy, m.afx, -m.afz]) @ offset) / distance
        if distance > 2.4 and closing > 0.05:
            far.append(pull)
        if distance < 1.6 and closing < -0.05:
            near.append(pull)
    return far, near


def test_two_complete_followers_fly_beside_each_other(tmp_path: Path) -> None:
    """Each has its nodes, its autopilot and its namespace; what fails in one stays in it."""
    ports = dict.fromkeys(('one', 'two'), 0)
    while len(set(ports.values())) < 2:
        ports = {name: free_udp_port() for name in ports}
    wires = {name: Wire(port, system) for system, (name, port) in enumerate(ports.items(), 1)}

    def commanded(name: str, since: float = 0.0) -> list[tuple[float, Any]]:
        """Return the setpoints that are not braking, against the north, or level."""
        return [(t, m) for t, m in wires[name].setpoints if t > since and m.afy != 0.0]
    try:
        with Processes(private_environment(), tmp_path / 'logs') as processes:
            for system, (name, port) in enumerate(ports.items(), 1):
                start_follower(processes, name, port, system)
            for name in ports:
                processes.ask(f'/{name}/mavlink_bridge/offboard')
                processes.ask(f'/{name}/planner/engage')
            processes.start('replay', 'flock_follower.nodes.replay', [
                str(BAG), '--ros-args', '-p', 'wait_for_subscribers:=10.0',
                '-p', f'topics:=[{",".join(f"/{topic}" for topic in INPUTS)}]'])
            for name in ports:
                wait_until(lambda name=name: len(commanded(name)) > 60, 20.0, f'{name} to fly')
            killed = time.monotonic()
            os.kill(processes.children['one-planner'].pid, signal.SIGKILL)
            wait_until(lambda: processes.children['replay'].poll() is not None, 20.0, 'the end')
            ended = time.monotonic()
            assert not [m for t, m in commanded('one', killed + 0.3) if t < ended]
            codes = processes.stop_all()
            logs = ''.join(processes.log(name) for name in codes)
    finally:
        for wire in wires.values():
            wire.close()
    assert {code for name, code in codes.items() if name != 'one-planner'} == {0}
    assert 'Traceback' not in logs
    for system, wire in enumerate(wires.values(), 1):
        assert {(m.coordinate_frame, m.target_system) for _, m in wire.setpoints} == {
            (mavutil.mavlink.MAV_FRAME_LOCAL_NED, system)}
        assert max(np.linalg.norm([m.afx, m.afy, m.afz]) for _, m in wire.setpoints) <= 2.5
    far, near = pulls([(t, m) for t, m in commanded('two') if t < ended - 0.5], ended)
    assert {m.type_mask for _, m in commanded('two')} == {0x83F}  # acceleration and yaw
    # On a busy machine some are late and brake instead.
    assert len(far) > 5 and np.median(far) > 0.0
    assert len(near) > 5 and np.median(near) < 0.0
