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
The whole chain as real processes: a bag in, setpoints on a MAVLink wire out.

The test is the autopilot here: it sends HEARTBEAT and LOCAL_POSITION_NED over loopback UDP and
decodes the setpoints with pymavlink, so no code of the project judges the result.
"""

from __future__ import annotations

from pathlib import Path
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


def start_follower(processes: Processes, name: str, port: int) -> None:
    own = {'relative_pose': ['-p', 'image_transport:=compressed'],
           'planner': ['-p', 'v_max:=2.0'],
           'mavlink_bridge': [
               '-p', f'connection:=udpin:127.0.0.1:{port}',
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


def test_a_complete_follower_in_a_namespace_pulls_towards_a_far_leader(tmp_path: Path) -> None:
    port = free_udp_port()
    wire = Wire(port, 1)
    try:
        with Processes(private_environment(), tmp_path / 'logs') as processes:
            start_follower(processes, 'one', port)
            processes.ask('/one/mavlink_bridge/offboard')
            processes.ask('/one/planner/engage')
            processes.start('replay', 'flock_follower.nodes.replay', [
                str(BAG), '--ros-args', '-p', 'wait_for_subscribers:=10.0',
                '-p', f'topics:=[{",".join(f"/{topic}" for topic in INPUTS)}]'])
            wait_until(lambda: processes.children['replay'].poll() is not None, 60.0, 'the end')
            ended = time.monotonic()
            codes = processes.stop_all()
            logs = ''.join(processes.log(name) for name in codes)
    finally:
        wire.close()
    assert set(codes.values()) == {0} and 'Traceback' not in logs
    assert {(m.coordinate_frame, m.target_system) for _, m in wire.setpoints} == {
        (mavutil.mavlink.MAV_FRAME_LOCAL_NED, 1)}
    assert max(np.linalg.norm([m.afx, m.afy, m.afz]) for _, m in wire.setpoints) <= 2.5
    # Setpoints that are not braking, against the north, or level.
    commanded = [(t, m) for t, m in wire.setpoints if m.afy != 0.0 and t < ended - 0.5]
    assert {m.type_mask for _, m in commanded} == {0x83F}  # acceleration and yaw
    far, near = pulls(commanded, ended)
    # On a busy machine some are late and brake instead.
    assert len(far) > 5 and np.median(far) > 0.0
    assert len(near) > 5 and np.median(near) < 0.0
