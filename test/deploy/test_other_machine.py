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
From another machine nobody engages a follower that runs with the environment of the unit.

The two machines are network namespaces with a cable between them, each with shared memory of its
own. Beside the follower that is tested runs one that ROS's default leaves open: that one is
engaged over the same cable by the same command, or the test would prove nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import subprocess
import sys

import pytest

from flock_desk.runs.processes import wait_until
from flock_follower.checks.reach import find_reach, Reach

ROOT = Path(__file__).resolve().parents[2]
ADDRESSES = {'drone': '10.213.7.1', 'laptop': '10.213.7.2'}
OPEN = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}
#: Who names the drone by its address needs no multicast to find it.
BY_ADDRESS = {**OPEN, 'ROS_STATIC_PEERS': ADDRESSES['drone']}
CLOSED = dict(line.removeprefix('Environment=').split('=', 1) for line in (
    ROOT / 'deploy' / 'flock_follower@.service').read_text().splitlines()
    if line.startswith('Environment='))
ENGAGED = '[planner]: engaged'
DOMAINS = {'closed': '7', 'open': '8'}


def ip(*arguments: str) -> None:
    """Run ip; where this machine lets nobody make namespaces the test is skipped."""
    try:
        subprocess.run(['ip', *arguments], check=True, text=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip('the command ip is not there (apt install iproute2)')
    except subprocess.CalledProcessError as error:
        pytest.skip(f'no network namespaces here: ip {" ".join(arguments)}: {error.stderr}')


class Machines:
    """Two machines, and what runs on them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = {name: f'{name}{os.getpid()}' for name in ADDRESSES}
        self.running: list[subprocess.Popen[str]] = []
        self.followers: dict[str, subprocess.Popen[str]] = {}

    def connect(self) -> None:
        """Make the machines, and lay the cable."""
        for name in self.names.values():
            ip('netns', 'add', name)
        ends = [['name', 'cable', 'netns', name] for name in self.names.values()]
        ip('link', 'add', *ends[0], 'type', 'veth', 'peer', *ends[1])
        for name, address in ADDRESSES.items():
            ip('-n', self.names[name], 'addr', 'add', f'{address}/24', 'dev', 'cable')
            for interface in ('lo', 'cable'):
                ip('-n', self.names[name], 'link', 'set', interface, 'up')
        # The kernel may take a second for it, and Fast DDS uses no interface that comes later.
        for name in self.names.values():
            wait_until(lambda name=name: 'state UP' in subprocess.run(
                ['ip', '-n', name, 'link', 'show', 'cable'], text=True, capture_output=True,
                check=True).stdout, 5.0, 'the cable')

    def start(self, machine: str, log: str, environment: dict[str, str],
              *arguments: str) -> subprocess.Popen[str]:
        """Start a module on a machine; it sees no shared memory of the other."""
        own = {name: value for name, value in os.environ.items()
               if not name.startswith(('ROS_', 'FASTRTPS', 'FASTDDS'))}
        with open(self.folder / log, 'w') as output:
            process = subprocess.Popen(
                ['ip', 'netns', 'exec', self.names[machine], 'unshare', '--mount', 'sh', '-c',
                 'mount -t tmpfs none /dev/shm && exec "$@"', 'sh', sys.executable, '-m',
                 *arguments], stdout=output, stderr=subprocess.STDOUT, text=True,
                env={**own, **environment, 'PYTHONPATH': str(ROOT), 'PYTHONUNBUFFERED': '1',
                     'ROS_LOG_DIR': str(self.folder)})
        self.running.append(process)
        return process

    def reported(self, log: str) -> str:
        return (self.folder / log).read_text()

    def follower(self, which: str, environment: dict[str, str]) -> None:
        self.followers[which] = self.start(
            'drone', which, {**environment, 'ROS_DOMAIN_ID': DOMAINS[which]},
            'flock_follower.nodes.planner')

    def reach(self, which: str) -> Reach | None:
        """Return from where the follower is reached, as ``check`` finds it."""
        return find_reach(self.followers[which].pid, int(DOMAINS[which]))

    def engage(self, machine: str, which: str, environment: dict[str, str],
               log: str) -> subprocess.Popen[str]:
        return self.start(machine, log, {**environment, 'ROS_DOMAIN_ID': DOMAINS[which]},
                          'flock_follower.nodes.call', 'planner/engage', 'true', '--timeout', '3')

    def disconnect(self) -> None:
        for process in self.running:
            process.kill()
            process.wait()
        for name in self.names.values():
            subprocess.run(['ip', 'netns', 'del', name], capture_output=True)


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[Machines]:
    made = Machines(tmp_path)
    try:
        made.connect()
        yield made
    finally:
        made.disconnect()


@pytest.mark.ros
def test_engage_from_other_machine_needs_open_ros_network(
        machines: Machines) -> None:
    assert CLOSED['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    machines.follower('closed', CLOSED)
    machines.follower('open', OPEN)
    wait_until(lambda: all('IDLE' in machines.reported(which) for which in DOMAINS), 20.0, 'both')
    assert machines.reach('closed') == Reach.COMPUTER and machines.reach('open') == Reach.NETWORK
    # Discovery between two machines now and then takes longer than a call waits: once more, then.
    wait_until(
        lambda: machines.engage('laptop', 'open', OPEN, 'into the open one').wait(20.0) == 0,
        20.0, 'the open one to be engaged')
    tried = {log: machines.engage('laptop', 'closed', environment, log) for environment, log in (
        (OPEN, 'found by multicast'), (BY_ADDRESS, 'named by its address'))}
    ended = {log: process.wait(20.0) for log, process in tried.items()}
    assert ENGAGED in machines.reported('open')
    for log, code in ended.items():
        assert code == 1 and 'no such service' in machines.reported(log), machines.reported(log)
    assert ENGAGED not in machines.reported('closed')
    # A caller on the drone could have engaged it all the time.
    assert machines.engage('drone', 'closed', CLOSED, 'on the drone').wait(20.0) == 0
    wait_until(lambda: ENGAGED in machines.reported('closed'), 5.0, 'the engagement')
