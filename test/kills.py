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
Kill planner, relative_pose or replay at random moments of a flight, and time the braking.

Every time the whole chain runs as real processes in a namespace, on a bag that makes the planner
pull north for as long as it lasts, while the autopilot says it flies north: commands and braking
have opposite signs. The time is from SIGKILL to the first braking setpoint read from the wire.
``python test/kills.py --kills 100``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import math
import os
from pathlib import Path
import random
import signal
import sys
import tempfile
import time
from typing import Any

import numpy as np
from wire import V_NORTH, Wire

from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    wait_until,
)
from flock_follower.bags.bag import Bag, deserialize, open_bag, serialize
from flock_follower.bags.writer import BagWriter
from flock_follower.geometry import Array
from flock_follower.messages import NANOSECONDS
from flock_follower.messages.state_reader import from_odometry
from flock_follower.system.files import resource

VICTIMS = ('planner', 'relative_pose', 'replay')
LIMIT = 0.3  # s
START = 1_700_000_000 * NANOSECONDS
IMAGE, CAMERA, ODOM = '/image_raw/compressed', '/camera_info', '/odom'
FACING_NORTH = math.sqrt(0.5)
D1 = 3.0  # m^2: the leader is farther off, so that the guard always asks to come nearer
PULL = 0.05  # m/s^2, a command to the north


def write_bag(path: Path, seconds: float) -> None:
    """Write a bag in which every image is that of the sample bag with the leader farthest off."""
    with open_bag(resource('bags/sample')) as bag:
        images = list(bag.messages([IMAGE]))
        stamps = [m.stamp_ns for m in images]
        leader, follower = (_places(bag, f'/truth/{name}', stamps)
                            for name in ('neighbors', 'odom'))
        image = images[int(np.linalg.norm(leader - follower, axis=0).argmax())]
        info, odom = (next(iter(bag.messages([topic]))) for topic in (CAMERA, ODOM))
    with BagWriter(path) as writer:
        for k in range(round(seconds * 60)):
            stamp = START + k * NANOSECONDS // 60
            own = deserialize(odom.data, odom.msgtype)
            _fly(own, k / 60)
            for message, fields in ((odom, own), *((m, deserialize(m.data, m.msgtype)) for m in (
                    (info, image) if k % 2 == 0 else ()))):
                fields.header.stamp.sec, fields.header.stamp.nanosec = divmod(stamp, NANOSECONDS)
                writer.write(message.topic, message.msgtype, stamp,
                             serialize(fields, message.msgtype))


def _places(bag: Bag, topic: str, stamps: list[int]) -> Array:
    """Return the positions (3, n), m, on an Odometry topic at stamps, ns."""
    states = [from_odometry(deserialize(m.data, m.msgtype)) for m in bag.messages([topic])]
    return np.array([np.interp(stamps, [state.stamp for state in states],
                               [state.position[axis] for state in states]) for axis in range(3)])


def _fly(odom: Any, seconds: float) -> None:
    """Let a follower fly north behind the leader, as fast as the autopilot says."""
    pose, twist = odom.pose.pose, odom.twist.twist
    pose.position.x, pose.position.y, pose.position.z = 0.0, V_NORTH * seconds, 2.0
    pose.orientation.x = pose.orientation.y = 0.0
    pose.orientation.z = pose.orientation.w = FACING_NORTH
    for vector in (twist.linear, twist.angular):
        vector.x = vector.y = vector.z = 0.0
    twist.linear.x = V_NORTH


def braking_time(victim: str, delay: float, bag: Path, folder: Path) -> float:
    """
    Return how long after its kill, ``delay`` seconds into a flight, the first braking comes, s.

    :raises TimeoutError: where the flight does not begin, or no braking comes within 5 s.
    :raises RuntimeError: where the planner does not engage.
    """
    port = free_udp_port()
    wire = Wire(port)
    try:
        with Processes(private_environment(), folder) as processes:
            def start(node: str, *parameters: str) -> None:
                processes.start(node, f'flock_follower.nodes.{node}', [
                    '--ros-args', '-r', '__ns:=/one', *(
                        word for topic in (IMAGE, CAMERA, ODOM)
                        for word in ('-r', f'{topic[1:]}:={topic}')), *(
                        word for p in ('use_sim_time:=true', *parameters) for word in ('-p', p))])
            # The wire has no parameters, and answers no setpoint.
            start('mavlink_bridge', f'connection:=udpin:127.0.0.1:{port}', 'v_max:=2.0',
                  'velocity_source:=autopilot', 'require_failsafe:=false',
                  'wind_compensation:=never')
            start('planner', 'v_max:=2.0', f'd1:={D1}')
            processes.ask('/one/mavlink_bridge/offboard')
            start('relative_pose', 'image_transport:=compressed')
            processes.start('replay', 'flock_follower.nodes.replay', [str(bag)])
            processes.ask('/one/planner/engage')
            wait_until(lambda: any(m.afx > PULL for _, m in wire.setpoints), 10.0,
                       'a pull to the north')
            moment = time.monotonic() + delay
            wait_until(lambda: time.monotonic() >= moment, 10.0, 'the moment')
            # Whatever else brakes is not the doing of the kill.
            wait_until(lambda: wire.setpoints[-1][1].afx > PULL, 10.0, 'a pull to the north again')
            killed = time.monotonic()
            os.kill(processes.children[victim].pid, signal.SIGKILL)
            wait_until(lambda: wire.setpoints[-1][1].afx < 0.0, 5.0, 'braking')
            time_of_braking = next(t for t, m in wire.setpoints if t > killed and m.afx < 0.0)
            # It stays at that: the last command does not come back.
            received = len(wire.setpoints)
            wait_until(lambda: len(wire.setpoints) > received + 6, 5.0, 'the stream to go on')
            assert all(m.afx < 0.0 for _, m in wire.setpoints[received:]), 'commands came back'
            assert {(m.type_mask, m.coordinate_frame, m.target_system)
                    for _, m in wire.setpoints if m.afx > PULL} == {(0x83F, 1, 1)}
            assert max(abs(m.afx) for _, m in wire.setpoints) <= 2.5
            for child in processes.children.values():
                child.kill()
            return time_of_braking - killed
    finally:
        wire.close()


def braking_times(kills: int, seed: int, folder: Path) -> Iterator[tuple[str, float]]:
    """Yield the victim and the time to braking, s, of each of some kills, victims taking turns."""
    chance = random.Random(seed)
    bag = folder / 'bag'
    write_bag(bag, 25.0)
    for k in range(kills):
        victim = VICTIMS[k % len(VICTIMS)]
        yield victim, braking_time(victim, chance.uniform(0.3, 1.3), bag, folder / str(k))


def main(args: list[str] | None = None) -> int:
    """Kill, print the times, and return 1 where one was over the limit."""
    parser = argparse.ArgumentParser(description='Time the braking after kills of nodes.')
    parser.add_argument('--kills', type=int, default=100, help='how many (%(default)s)')
    parser.add_argument('--seed', type=int, default=1, help='of their moments (%(default)s)')
    options = parser.parse_args(args)
    times: dict[str, list[float]] = {victim: [] for victim in VICTIMS}
    with tempfile.TemporaryDirectory() as folder:
        for k, (victim, seconds) in enumerate(
                braking_times(options.kills, options.seed, Path(folder)), 1):
            times[victim].append(seconds)
            print(f'{k:4d} of {options.kills}: {victim:<13} {1e3 * seconds:4.0f} ms', flush=True)
    for victim, found in times.items():
        if found:
            print(f'{victim:<13} {len(found):3d} kills, braking after '
                  f'{1e3 * float(np.median(found)):.0f} ms (median), '
                  f'{1e3 * max(found):.0f} ms (longest), {1e3 * LIMIT:.0f} ms allowed')
    return int(any(seconds > LIMIT for found in times.values() for seconds in found))


if __name__ == '__main__':
    sys.exit(main())
