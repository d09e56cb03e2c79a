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
The whole chain as real processes: a bag in, and what arrives on the MAVLink wire.

The test is the autopilot here: it sends HEARTBEAT and LOCAL_POSITION_NED over loopback UDP and
decodes the setpoints with pymavlink, so nothing of the project's own judges the result.
"""

import math
import os
import signal
import time

import numpy as np
from odometry_series import states_of
from pymavlink import mavutil
import pytest
from wire import permit, V_NORTH, Wire

from flock_desk.runs.processes import (
    free_udp_port,
    private_environment,
    Processes,
    wait_until,
)
from flock_follower.bags.bag import deserialize, open_bag, typestore
from flock_follower.bags.writer import BagWriter
from flock_follower.resources import resource

pytestmark = pytest.mark.slow
START = 1_700_000_000  # s, of the bags written here


def write_bag(path, seconds):
    """Write a leader 2.6 m north that flies away at 0.3 m/s, and a follower that faces it."""
    types = typestore().types
    msg = {name.rsplit('/', 1)[1]: cls for name, cls in types.items() if '/msg/' in name}
    vector, quaternion = msg['Vector3'], msg['Quaternion']
    half = math.sqrt(0.5)

    def odometry(stamp, child, north, speed):
        return types['nav_msgs/msg/Odometry'](
            msg['Header'](msg['Time'](stamp // 10**9, stamp % 10**9), 'odom'), child,
            msg['PoseWithCovariance'](
                msg['Pose'](msg['Point'](0.0, north, 2.0), quaternion(0.0, 0.0, half, half)),
                np.zeros(36)),
            msg['TwistWithCovariance'](
                msg['Twist'](vector(speed, 0.0, 0.0), vector(0.0, 0.0, 0.0)), np.zeros(36)))

    with BagWriter(path) as bag:
        for i in range(seconds * 50):
            stamp = START * 10**9 + i * 20_000_000
            bag.write('/odom', 'nav_msgs/msg/Odometry', stamp,
                      odometry(stamp, 'base_link', 0.0, 0.0))
            if i % 2 == 0:
                bag.write('/neighbors', 'nav_msgs/msg/Odometry', stamp,
                          odometry(stamp, 'leader', 2.6, 0.3))


@pytest.fixture
def chain(tmp_path):
    """Return a function that starts the given nodes, replays a bag, and engages the planner."""
    port = free_udp_port()
    wire = Wire(port)
    with Processes(private_environment(), tmp_path / 'logs') as processes:
        def start(bag, *extra, topics):
            ros = ['--ros-args', '-p', 'use_sim_time:=true', '-p']
            processes.start('mavlink_bridge', 'flock_follower.nodes.mavlink_bridge',
                            [*ros, f'connection:=udpin:127.0.0.1:{port}',
                             '-p', 'velocity_source:=autopilot', '-p', 'v_max:=2.0',
                             # The wire has no parameters, and answers no setpoint.
                             '-p', 'require_failsafe:=false', '-p', 'wind_compensation:=never'])
            processes.start('planner', 'flock_follower.nodes.planner', [*ros, 'v_max:=2.0'])
            permit(processes)
            for node, *arguments in extra:
                processes.start(node, f'flock_follower.nodes.{node}', [*ros, *arguments])
            processes.start('replay', 'flock_follower.nodes.replay', [
                str(bag), '--ros-args', '-p', 'wait_for_subscribers:=10.0',
                '-p', f'topics:=[{",".join(topics)}]'])
            processes.ask('planner/engage')
            processes.wait_for_log('planner', 'TRACK')

        yield processes, wire, start
    wire.close()


def test_a_leader_north_and_too_far_pulls_north_until_the_planner_is_killed(chain, tmp_path):
    processes, wire, start = chain
    write_bag(tmp_path / 'north', 20)
    start(tmp_path / 'north', topics=['/odom', '/neighbors'])

    def pulls():
        """Return the setpoints since it last braked or was level, as a busy machine makes it."""
        others = [i for i, (_, m) in enumerate(wire.setpoints) if m.afx <= 0.0]
        return wire.setpoints[others[-1] + 1 if others else 0:]
    wait_until(lambda: len(pulls()) > 45, 15.0, 'two seconds of commands')

    times, setpoints = zip(*pulls()[:45])
    for m in setpoints:
        assert m.type_mask == 0x83F  # acceleration and yaw, nothing else
        assert m.coordinate_frame == mavutil.mavlink.MAV_FRAME_LOCAL_NED
        assert m.target_system == 1
        assert m.afx > 0.1 and abs(m.afy) < 0.05 and abs(m.afz) < 0.05
        assert m.yaw == pytest.approx(0.0, abs=0.02)  # facing north
        assert math.hypot(m.afx, m.afy, m.afz) <= 2.5
    assert np.median(np.diff(times)) == pytest.approx(0.05, rel=0.05)

    killed = time.monotonic()
    os.kill(processes.children['planner'].pid, signal.SIGKILL)
    wait_until(lambda: wire.setpoints[-1][1].afx < 0.0, 2.0, 'braking')
    braking = next(t for t, m in wire.setpoints if t > killed and m.afx < 0.0)
    assert braking - killed <= 0.3
    # From then on it only brakes, and the stream goes on.
    count = len(wire.setpoints)
    wait_until(lambda: len(wire.setpoints) > count + 20, 3.0, 'a second of braking')
    assert all(m.afx < 0.0 and abs(m.afy) < 1e-6 for _, m in wire.setpoints[count:])
    wait_until(lambda: wire.setpoints[-1][1].afx == pytest.approx(-V_NORTH / 0.3, rel=0.01), 5.0,
               'braking on a fresh velocity')

    codes = processes.stop_all()
    assert {name: code for name, code in codes.items() if name != 'planner'} == {
        'mavlink_bridge': 0, 'replay': 0, 'offboard': 0, 'engage': 0}
    assert 'Traceback' not in processes.log('mavlink_bridge') + processes.log('replay')


def test_the_sample_bag_pulls_towards_a_far_leader_and_away_from_a_near_one(chain):
    processes, wire, start = chain
    bag = resource('bags/sample')
    start(bag, ('relative_pose', 'image_transport:=compressed'),
          topics=['/image_raw/compressed', '/camera_info', '/odom'])
    replayed = time.monotonic()
    wait_until(lambda: processes.children['replay'].poll() is not None, 20.0, 'the end of the bag')
    ended = time.monotonic()
    assert processes.stop('replay') == 0

    leader, follower = states_of(bag, '/truth/neighbors'), states_of(bag, '/truth/odom')
    bag_end = int(leader.stamps[-1])
    towards = {'far': [], 'near': []}
    flown = [(t, m) for t, m in wire.setpoints if replayed + 0.5 < t < ended - 0.5]
    strongest = max(np.linalg.norm([m.afx, m.afy, m.afz]) for _, m in flown)
    assert strongest <= 2.5, f'{strongest!r} m/s^2: {strongest - 2.5:.3g} above a_max'
    # A machine that stands still makes it brake, horizontally against the velocity: north.
    commands = [(t, m) for t, m in flown if m.afy != 0.0]
    assert len(commands) > 0.5 * len(flown)
    for received, m in commands:
        # The replay ran at rate 1 and ended with the last image: the image 0.1 s before.
        stamp = bag_end - int((ended - received + 0.1) * 1e9)
        offset = leader.at(stamp)[0] - follower.at(stamp)[0]
        drift = leader.at(stamp)[2] - follower.at(stamp)[2]
        distance = float(np.linalg.norm(offset))
        closing = float(offset @ drift) / distance
        pull = float(np.array([m.afy, m.afx, -m.afz]) @ offset) / distance
        if distance > 2.4 and closing > 0.05:
            towards['far'].append(pull)
        if distance < 1.6 and closing < -0.05:
            towards['near'].append(pull)
    # On a busy machine some are late and brake instead.
    assert len(towards['far']) > 5 and np.median(towards['far']) > 0.0
    assert len(towards['near']) > 5 and np.median(towards['near']) < 0.0
    for name in ('relative_pose', 'planner', 'mavlink_bridge'):
        assert processes.stop(name) == 0
        assert 'Traceback' not in processes.log(name)


def test_two_complete_followers_fly_beside_each_other(tmp_path):
    """Each has its nodes, its autopilot and its namespace; what fails in one stays in it."""
    names, ports = ('one', 'two'), []
    while len(set(ports)) < 2:
        ports.append(free_udp_port())
    ports = sorted(set(ports))
    wires = [Wire(port, system) for system, port in enumerate(ports, start=1)]
    record = tmp_path / 'record'
    with Processes(private_environment(), tmp_path / 'logs') as processes:
        processes.start('recorder', 'flock_desk.recorder_node', [
            str(record), '/diagnostics:diagnostic_msgs/msg/DiagnosticArray'])
        processes.wait_for_log('recorder', 'recording')
        for system, (name, port) in enumerate(zip(names, ports), start=1):
            own = {'relative_pose': ['-p', 'image_transport:=compressed'],
                   'planner': ['-p', 'v_max:=2.0'],
                   'mavlink_bridge': ['-p', f'connection:=udpin:127.0.0.1:{port}',
                                      '-p', f'target_system:={system}', '-p', 'v_max:=2.0',
                                      '-p', 'velocity_source:=autopilot',
                                      '-p', 'require_failsafe:=false',
                                      '-p', 'wind_compensation:=never']}
            for node, arguments in own.items():
                shared = [word for topic in ('image_raw/compressed', 'camera_info', 'odom')
                          for word in ('-r', f'{topic}:=/{topic}')]
                processes.start(f'{name}-{node}', f'flock_follower.nodes.{node}', [
                    '--ros-args', '-r', f'__ns:=/{name}', '-p', 'use_sim_time:=true', *shared,
                    *arguments])
        for name in names:
            processes.ask(f'/{name}/mavlink_bridge/offboard')
            processes.ask(f'/{name}/planner/engage')
        processes.start('replay', 'flock_follower.nodes.replay', [
            str(resource('bags/sample')), '--ros-args', '-p', 'wait_for_subscribers:=10.0',
            '-p', 'topics:=[/image_raw/compressed,/camera_info,/odom]'])
        for name in names:
            processes.wait_for_log(f'{name}-planner', 'TRACK')

        def commanded(wire, since=0.0):
            """Return the setpoints that are not braking or level: those the planner made."""
            return [m for t, m in wire.setpoints if t > since and m.afy != 0.0]
        for wire, name in zip(wires, names):
            wait_until(lambda w=wire: len(commanded(w)) > 20, 15.0, f'commands of {name}')
        os.kill(processes.children['one-planner'].pid, signal.SIGKILL)
        killed = time.monotonic()
        wait_until(lambda: len(commanded(wires[1], killed + 0.3)) > 20, 5.0,
                   'the other one to go on')
        ended = time.monotonic()
        assert not [m for t, m in wires[0].setpoints if killed + 0.3 < t < ended
                    and m.afy != 0.0], 'a follower without planner was commanded'
        codes = processes.stop_all()
    for system, wire in enumerate(wires, start=1):
        wire.close()
        assert {m.target_system for _, m in wire.setpoints} == {system}
    assert {code for name, code in codes.items() if name != 'one-planner'} == {0}
    with open_bag(record) as bag:
        told = {status.name.partition(':')[0] for message in bag.messages(['/diagnostics'])
                for status in deserialize(message.data, message.msgtype).status}
    assert {n.strip('/') for n in told} - {'replay'} == {
        f'{name}/{node}' for name in names for node in (
            'relative_pose', 'planner', 'mavlink_bridge')}
