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
A flight by the real nodes: take-off, handover, a pilot who takes over, a bridge that is killed.

The embedded autopilot, the bridge and the planner are processes. Here are the operator, who calls
the services, the pilot's script, and a leader that is seen whatever happens.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import itertools
import json
import math
import os
from pathlib import Path
import signal
import time
from typing import Any, NamedTuple

from nav_msgs.msg import Odometry
import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from flock_desk.runs.processes import free_udp_port, private_environment, Processes
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp, to_odometry

DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time
HEIGHT = 1.5  # m, of the take-off
CLIMB = 2.0  # m, by the pilot
AHEAD = 2.0  # m, of the leader at first
LEADER_SPEED = 0.2  # m/s, eastward while the bridge says ACTIVE
PILOT, GIVES_BACK = 7.0, 15.0  # s after the first setpoint
FOLLOWING, HOLDING = 4.0, 3.0  # s for which it is watched; offboard is refused for 10 s
LEADER_PERIOD = 0.05  # s


class Personality(NamedTuple):
    """The modes of an autopilot, and parameters as config recommends them."""

    offboard: str
    manual: str
    given_back: str
    """What it is in once the pilot's switch is back where it was, and no setpoint comes."""
    parameters: tuple[str, ...]


PERSONALITIES = {
    'px4': Personality('OFFBOARD', 'POSCTL', 'AUTO.LOITER', (
        'COM_OF_LOSS_T=0.5', 'COM_OBL_RC_ACT=5', 'COM_RC_OVERRIDE=3',
        f'MIS_TAKEOFF_ALT={HEIGHT}')),
    'arducopter': Personality('GUIDED', 'LOITER', 'GUIDED', ('GUID_TIMEOUT=0.5',))}


class Said(NamedTuple):
    """Something that was published, asked or done, at a time, s, of the monotonic clock."""

    time: float
    who: str
    text: str


@dataclass(frozen=True)
class Record:
    """What is left of a flight; all times are s of the monotonic clock."""

    personality: Personality
    log: dict[str, Any]
    """See ``FlightLog``."""
    said: list[Said]
    asked: list[float]
    """When offboard was called."""
    engaged: list[float]
    """When engage was answered after it."""
    killed: float
    ended: float
    logs: str
    """What the processes printed."""

    def of(self, who: str) -> list[Said]:
        return [said for said in self.said if said.who == who]

    def transcript(self) -> str:
        """Return what was said, without what is only repeated."""
        return transcript(self.said)


def transcript(said: list[Said]) -> str:
    last: dict[str, str] = {}
    lines = []
    for entry in said:
        if last.get(entry.who) != entry.text or entry.who == 'operator':
            lines.append(f'{entry.time - said[0].time:6.2f} s  {entry.who:20} {entry.text}')
        last[entry.who] = entry.text
    return '\n'.join(lines)


class HandoverFlight:
    """The nodes' processes, and everybody they talk to."""

    def __init__(self, name: str, folder: Path) -> None:
        self.personality = PERSONALITIES[name]
        self.folder = folder
        self.said: list[Said] = []
        self.asked: list[float] = []
        self.engaged: list[float] = []
        self.altitude = math.nan
        self._name = name
        self._leader_due = 0.0
        self._leader_east = AHEAD
        self._port = free_udp_port()
        self._ros = ['--ros-args', '-r', f'__ns:=/handover_{name}']
        environment = private_environment(int(os.environ['ROS_DOMAIN_ID']))
        environment['PYTHONPATH'] = os.pathsep.join(
            [str(Path(__file__).parent), environment.get('PYTHONPATH', '')])  # faulty_autopilot
        self._processes = Processes(environment, folder / 'logs')
        self._node = Node('surroundings', namespace=f'handover_{name}')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic in ('mavlink_bridge/state', 'planner/state'):
            self._node.create_subscription(
                String, topic, partial(self._hear, topic), latched)
        self._node.create_subscription(
            Odometry, 'mavlink/odom', self._take_odometry, qos_profile_sensor_data)
        self._neighbors = self._node.create_publisher(Odometry, 'neighbors', 10)

    def fly(self) -> Record:
        """Fly, and return what happened."""
        try:
            with self._processes:
                killed = self._fly()
                ended = time.monotonic()
                assert self._processes.stop('autopilot', DEADLINE) == 0
                logs = self._logs()
        finally:
            self._executor.shutdown()
            self._node.destroy_node()
            (self.folder / 'transcript.txt').write_text(transcript(self.said))
        with np.load(self.folder / 'flight.npz') as log:
            return Record(self.personality, dict(log), self.said, self.asked, self.engaged,
                          killed, ended, logs)

    def _fly(self) -> float:
        """Fly, and return when the bridge was killed."""
        manual, given_back = self.personality.manual, self.personality.given_back
        self._start_bridge('mavlink_bridge')
        self._processes.start('planner', 'flock_follower.nodes.planner',
                              [*self._ros, '-r', 'odom:=mavlink/odom'])
        self._ask('planner/engage', True)
        self._start_autopilot()
        self._wait(lambda: self._bridge() not in ('', 'NO_AUTOPILOT'))
        self._ask('mavlink_bridge/arm', True)
        self._ask('mavlink_bridge/takeoff')
        self._offboard()
        flown = self.altitude
        self._wait(lambda: self._bridge() == 'TAKEN_OVER')
        self._wait(lambda: self.altitude > flown + CLIMB - 0.2)
        self._wait(lambda: f'{given_back}, armed' in self._processes.log(
            'mavlink_bridge').rpartition(f'{manual}, armed')[2])
        self._say('operator', f'waits: the switch is given back ({given_back})')
        self._run(HOLDING)
        self._offboard()
        self._run(FOLLOWING)

        bridge = self._processes.children['mavlink_bridge']
        os.kill(bridge.pid, signal.SIGKILL)
        bridge.wait()
        killed = time.monotonic()
        self._say('operator', 'kills the bridge, and starts it again')
        self._start_bridge('mavlink_bridge again')
        self._wait(lambda: self._bridge() not in ('', 'NO_AUTOPILOT'))
        self._run(HOLDING)
        self._offboard()
        self._run(FOLLOWING)
        return killed

    def _start_bridge(self, name: str) -> None:
        self._processes.start(name, 'flock_follower.nodes.mavlink_bridge', [
            *self._ros, '-p', f'connection:=udpin:127.0.0.1:{self._port}',
            '-p', 'velocity_source:=autopilot', '-p', f'takeoff_height:={HEIGHT}'])

    def _start_autopilot(self) -> None:
        switches = [
            {'kind': 'pilot', 'at': PILOT, 'after': 'setpoint', 'mode': self.personality.manual,
             'climb': CLIMB},
            {'kind': 'pilot', 'at': GIVES_BACK, 'after': 'setpoint',
             'mode': self.personality.offboard}]
        self._processes.start('autopilot', 'faulty_autopilot', [
            '--connect', f'127.0.0.1:{self._port}', '--personality', self._name,
            '--start', 'landed',
            *(word for switch in switches for word in ('--fault', json.dumps(switch))),
            '--log', str(self.folder / 'flight.npz'),
            *(word for text in self.personality.parameters for word in ('--param', text))])

    def _offboard(self) -> None:
        self.asked.append(time.monotonic())
        self._ask('mavlink_bridge/offboard', True)
        self._ask('planner/engage', True)  # the pilot's takeover disengaged it
        self.engaged.append(time.monotonic())
        self._wait(lambda: self._last('planner/state') == 'TRACK')

    def _ask(self, service: str, value: bool | None = None) -> None:
        """Call a SetBool, or without a value a Trigger, until it succeeds."""
        kind, request = (Trigger, Trigger.Request()) if value is None else (
            SetBool, SetBool.Request(data=value))
        client = self._node.create_client(kind, service)
        self._wait(client.service_is_ready)
        deadline = time.monotonic() + DEADLINE
        while True:
            self._say('operator', f'asks {service}')
            future = client.call_async(request)
            self._wait(future.done)
            answer = future.result()
            self._say('operator', f'is told: {answer.message}')
            if answer.success:
                return
            assert time.monotonic() < deadline, self._failure()
            self._run(0.2)  # as an operator would: the vehicle is getting ready

    def _wait(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, self._failure()
            self._spin()

    def _run(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._spin()

    def _spin(self) -> None:
        if time.monotonic() >= self._leader_due:
            self._leader_due = time.monotonic() + LEADER_PERIOD
            self._publish_leader()
        self._executor.spin_once(timeout_sec=0.01)

    def _publish_leader(self) -> None:
        speed = LEADER_SPEED if self._bridge() == 'ACTIVE' else 0.0
        self._leader_east += speed * LEADER_PERIOD
        self._neighbors.publish(to_odometry(
            nanoseconds_to_stamp(self._node.get_clock().now().nanoseconds), 'odom', 'leader',
            (self._leader_east, 0.0, HEIGHT), (0.0, 0.0, 0.0, 1.0), (speed, 0.0, 0.0)))

    def _take_odometry(self, message: Odometry) -> None:
        self.altitude = message.pose.pose.position.z

    def _hear(self, topic: str, message: String) -> None:
        self._say(topic, message.data)

    def _say(self, who: str, text: str) -> None:
        self.said.append(Said(time.monotonic(), who, text))

    def _last(self, who: str) -> str:
        return next((said.text for said in reversed(self.said) if said.who == who), '')

    def _bridge(self) -> str:
        """Return the first word of what the bridge that lives said last."""
        alive = itertools.takewhile(lambda said: 'kills' not in said.text, reversed(self.said))
        return next((said.text for said in alive if said.who == 'mavlink_bridge/state'),
                    '').partition(':')[0]

    def _failure(self) -> str:
        return '\n'.join(['waited in vain', transcript(self.said), self._logs()])

    def _logs(self) -> str:
        return '\n'.join(f'--- {name}\n{self._processes.log(name)}'
                         for name in self._processes.children)
